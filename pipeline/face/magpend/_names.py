"""The analyses of a run and its figures as methods, made by ``python -m pipeline.cli.reference``."""

from __future__ import annotations

from magpend._methods import AnalysisMethod, AnyPanels, Bifurcation, OnePanel, SeveralPanels
from pipeline.analysis.atlas import declaration as of_atlas
from pipeline.analysis.attractors import declaration as of_attractors
from pipeline.analysis.basins import declaration as of_basins
from pipeline.analysis.branches import declaration as of_branches
from pipeline.analysis.chaos import declaration as of_chaos
from pipeline.analysis.events import declaration as of_events
from pipeline.analysis.manifolds import declaration as of_manifolds
from pipeline.analysis.noise import declaration as of_noise
from pipeline.analysis.phase import declaration as of_phase
from pipeline.analysis.resilience import declaration as of_resilience
from pipeline.analysis.response import declaration as of_response
from pipeline.analysis.series import declaration as of_series
from pipeline.analysis.spectrum import declaration as of_spectrum
from pipeline.analysis.tipping import declaration as of_tipping
from pipeline.analysis.transfer import declaration as of_transfer
from pipeline.products import diagrams as of_diagrams
from pipeline.products import product as of_product


class Analyses:
    """The analyses of a run."""

    attractors = AnalysisMethod(of_attractors.AttractorOptions)
    settling = AnalysisMethod(of_product.Options)
    hysteresis = AnalysisMethod(of_attractors.HysteresisOptions)
    basins = AnalysisMethod(of_basins.BasinOptions)
    resilience = AnalysisMethod(of_resilience.ResilienceOptions)
    edge = AnalysisMethod(of_resilience.EdgeOptions)
    transfer = AnalysisMethod(of_transfer.TransferOptions)
    overlaps = AnalysisMethod(of_tipping.OverlapOptions)
    chaos = AnalysisMethod(of_chaos.ChaosOptions)
    dimension = AnalysisMethod(of_chaos.DimensionOptions)
    spectrum = AnalysisMethod(of_spectrum.SpectrumOptions)
    series = AnalysisMethod(of_series.SeriesOptions)
    branches = AnalysisMethod(of_branches.BranchOptions)
    phase = AnalysisMethod(of_phase.PhaseOptions)
    events = AnalysisMethod(of_events.EventOptions)
    response = AnalysisMethod(of_response.ResponseOptions)
    backbone = AnalysisMethod(of_response.BackboneOptions)
    bands = AnalysisMethod(of_branches.BandOptions)
    sensitivities = AnalysisMethod(of_branches.SensitivityOptions)
    curves = AnalysisMethod(of_branches.CurveOptions)
    atlas = AnalysisMethod(of_atlas.AtlasOptions)
    orbits = AnalysisMethod(of_branches.OrbitOptions)
    tongues = AnalysisMethod(of_branches.TongueOptions)
    manifolds = AnalysisMethod(of_manifolds.ManifoldOptions)
    tangency = AnalysisMethod(of_manifolds.TangencyOptions)
    tipping = AnalysisMethod(of_tipping.TippingOptions)
    delay = AnalysisMethod(of_tipping.DelayOptions)
    escapes = AnalysisMethod(of_noise.EscapeOptions)
    density = AnalysisMethod(of_noise.DensityOptions)


class Figures:
    """The figures of a run."""

    bifurcation = Bifurcation(of_diagrams.BifurcationOptions)
    section = OnePanel(of_diagrams.SectionOptions)
    attractors = OnePanel(of_product.StateOptions)
    gallery = SeveralPanels(of_product.FigureOptions)
    regimes = AnyPanels(of_basins.RegimeOptions)
    basins = OnePanel(of_basins.BasinFigureOptions)
    fractions = OnePanel(of_basins.FractionFigureOptions)
    resilience = SeveralPanels(of_resilience.ResilienceFigureOptions)
    edge = OnePanel(of_resilience.EdgeFigureOptions)
    transfer = SeveralPanels(of_transfer.TransferFigureOptions)
    lyapunov = AnyPanels(of_chaos.LyapunovFigureOptions)
    convergence = SeveralPanels(of_chaos.ConvergenceOptions)
    dimension = SeveralPanels(of_chaos.DimensionFigureOptions)
    spectrum = SeveralPanels(of_spectrum.SpectrumFigureOptions)
    waterfall = OnePanel(of_spectrum.WaterfallOptions)
    series = SeveralPanels(of_series.SeriesFigureOptions)
    branches = OnePanel(of_branches.BranchFigureOptions)
    multipliers = OnePanel(of_branches.MultiplierOptions)
    phase = SeveralPanels(of_phase.PhaseFigureOptions)
    isochrones = OnePanel(of_phase.IsochroneOptions)
    genealogy = OnePanel(of_events.GenealogyOptions)
    response = SeveralPanels(of_response.ResponseFigureOptions)
    backbone = OnePanel(of_response.BackboneFigureOptions)
    sensitivities = SeveralPanels(of_branches.SensitivityFigureOptions)
    curves = OnePanel(of_branches.CurveFigureOptions)
    atlas = OnePanel(of_atlas.AtlasFigureOptions)
    rotation = OnePanel(of_product.FigureOptions)
    tongues = OnePanel(of_branches.TongueFigureOptions)
    manifolds = OnePanel(of_manifolds.ManifoldFigureOptions)
    drift = OnePanel(of_tipping.DriftFigureOptions)
    tipping = OnePanel(of_tipping.TippingFigureOptions)
    escapes = AnyPanels(of_noise.EscapeFigureOptions)
    density = AnyPanels(of_noise.DensityFigureOptions)
