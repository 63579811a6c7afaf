"""Define `Plots`, the figures of a run or a cube as methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

from magpend._methods import AnyPanels, Bifurcation, OnePanel, SeveralPanels
from pipeline.products import figures as options
from pipeline.products.product import FigureOptions, StateOptions
from pipeline.products.registry import FIGURES
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr


class Plots:
    """The figures of a run or a cube, by name; each method draws one and returns its axes.

    Parameters
    ----------
    source
        An opened run, or a cube.
    """

    bifurcation = Bifurcation(options.BifurcationOptions)
    section = OnePanel(options.SectionOptions)
    attractors = OnePanel(StateOptions)
    gallery = SeveralPanels(FigureOptions)
    basins = OnePanel(options.BasinFigureOptions)
    fractions = OnePanel(FigureOptions)
    regimes = AnyPanels(options.RegimeOptions)
    lyapunov = AnyPanels(options.LyapunovFigureOptions)
    convergence = SeveralPanels(options.ConvergenceOptions)
    dimension = SeveralPanels(options.DimensionFigureOptions)
    spectrum = SeveralPanels(options.SpectrumFigureOptions)
    series = SeveralPanels(options.SeriesFigureOptions)
    waterfall = OnePanel(options.WaterfallOptions)
    branches = OnePanel(options.BranchFigureOptions)
    multipliers = OnePanel(options.MultiplierOptions)
    sensitivities = SeveralPanels(options.SensitivityFigureOptions)
    curves = OnePanel(options.CurveFigureOptions)
    genealogy = OnePanel(options.GenealogyOptions)
    rotation = OnePanel(FigureOptions)
    response = SeveralPanels(options.ResponseFigureOptions)
    backbone = OnePanel(options.BackboneFigureOptions)
    tongues = OnePanel(options.TongueFigureOptions)
    manifolds = OnePanel(options.ManifoldFigureOptions)
    drift = OnePanel(options.DriftFigureOptions)
    resilience = SeveralPanels(options.ResilienceFigureOptions)
    edge = OnePanel(options.EdgeFigureOptions)
    escapes = AnyPanels(options.EscapeFigureOptions)
    density = AnyPanels(options.DensityFigureOptions)
    transfer = SeveralPanels(options.TransferFigureOptions)

    def __init__(self, source: RunDirectory | xr.Dataset) -> None:
        self._source = source

    def __repr__(self) -> str:
        return f"figures: {', '.join(FIGURES)}"
