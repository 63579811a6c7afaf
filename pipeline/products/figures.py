"""Declare the figures and their options; `pipeline.plots` draws them."""

from __future__ import annotations

from typing import Literal

from pipeline.products.backbone import BackboneOptions
from pipeline.products.branches import BranchOptions, CurveOptions, SensitivityOptions, TongueOptions
from pipeline.products.chaos import DimensionOptions
from pipeline.products.events import EventOptions
from pipeline.products.manifolds import ManifoldOptions
from pipeline.products.noise import DensityOptions, EscapeOptions
from pipeline.products.product import Figure, FigureOptions, Options, StateOptions, option
from pipeline.products.resilience import EdgeOptions, ResilienceOptions
from pipeline.products.response import ResponseOptions
from pipeline.products.spectrum import SeriesOptions, SpectraOptions, SpectrumOptions
from pipeline.products.transfer import TransferOptions

Per = Literal["s", "period"]

_POSTERIOR = "Directory of magpend identify posterior whose 95 % bands are drawn."


def _without(options: FigureOptions, name: str) -> str:
    return FigureOptions.label(options.model_copy(update={name: ""}))


class PointOptions(FigureOptions):
    """Options of a figure that shows measured points over its curves."""

    points: str = option("", "CSV file of measured points: a column of the axis, and one of each thing drawn.")


class BifurcationOptions(PointOptions, StateOptions):
    """Options of a bifurcation diagram."""

    quantity: str = option(
        "",
        "Quantity over each kept period instead of a state: NAME.min, NAME.max or NAME.mean; the run needs "
        "the product extremes.",
    )
    layout: Literal["overlay", "side"] = option("overlay", "Both directions in one panel, or one panel each.")
    posterior: str = option("", _POSTERIOR)

    def label(self) -> str:
        """Return the part of the figure's file name that lists the options. It omits the state if a quantity is
        drawn.
        """
        return super().label() if not self.quantity else _without(self, "state")


class SectionOptions(StateOptions):
    """Options of a figure of section points at one parameter point."""

    against: str = option("", "State on the vertical axis; by default the other state's rate, or the next state.")
    colour: Literal["motion", "attractor"] = option(
        "motion", "Colour by class of motion, or by attractor; attractors are computed first."
    )


class BasinFigureOptions(FigureOptions):
    """Options of a figure of basins of attraction."""

    shade: bool = option(False, "Darken cells that took longer to converge.")


class RegimeOptions(FigureOptions):
    """Options of a regime map over two parameters."""

    show: Literal["periods", "attractors", "number"] = option("periods", "Property that is coloured.")
    curves: str = option("", "Run along one axis whose bifurcation curves are drawn over the map.")


class LyapunovFigureOptions(StateOptions):
    """Options of a figure of Lyapunov exponents over one parameter, or in the plane of two."""

    spectrum: bool = option(False, "Draw all stored exponents, not only the largest.")
    as_map: bool = option(False, "Draw a map over two parameters instead of a diagram over one.", flag="--map")
    per: Per = option("s", "Exponents per second, or per drive period or return.")

    def label(self) -> str:
        """Return the part of the figure's file name that lists the options. It omits the state if the figure shows a
        plane of two parameters.
        """
        return _without(self, "state") if self.as_map else super().label()


class ConvergenceOptions(FigureOptions):
    """Options of a figure of the convergence of Lyapunov exponents."""

    exponent: int = option(1, "Index of the exponent; 1 is the largest.", ge=1)
    per: Per = option("s", "Exponents per second, or per drive period or return.")


class DimensionFigureOptions(DimensionOptions, FigureOptions):
    """Options of a figure of a correlation sum and its fit."""


class BranchFigureOptions(BranchOptions, PointOptions, StateOptions):
    """Options of a figure of branches of periodic orbits over a bifurcation diagram."""

    over: str = option("", "Run whose diagram is drawn below; it must sweep the same parameter. By default DIR.")
    posterior: str = option("", _POSTERIOR)
    shown: int | None = option(None, "Longest orbit period that is drawn.", unit="drive periods or returns", ge=1)


class MultiplierOptions(BranchOptions, FigureOptions):
    """Options of a figure of Floquet multipliers along a branch."""

    branch: int = option(0, "Index of the branch, as in the table.", ge=0)


class CurveFigureOptions(CurveOptions, FigureOptions):
    """Options of a figure of bifurcation curves."""

    over: str = option("", "Run over both parameters whose map of regimes is drawn below.")
    show: Literal["periods", "attractors", "number"] = option("periods", "Property that is coloured.")


class GenealogyOptions(EventOptions, FigureOptions):
    """Options of a figure of the events of attractors."""


class ResponseFigureOptions(ResponseOptions, PointOptions):
    """Options of a figure of frequency responses."""

    channel: str = option("", "State or quantity to draw; by default the model's first state.")
    harmonic: int = option(0, "Draw the amplitude of this harmonic; 0 draws half of peak to peak.", ge=0)


class SensitivityFigureOptions(SensitivityOptions, FigureOptions):
    """Options of a figure of sensitivities."""

    shown: int = option(6, "Number of bifurcations that get a panel: the first by rising value.", ge=1, le=24)


class BackboneFigureOptions(BackboneOptions, FigureOptions):
    """Options of a figure of backbone curves."""


Axis = Literal["", "order", "Hz"]

_AXIS = "Frequencies as orders, multiples of the drive's, or in hertz; by default orders where there is a drive."


class SpectrumFigureOptions(SpectrumOptions, FigureOptions):
    """Options of a figure of spectra at one parameter point."""

    axis: Axis = option("", _AXIS)


class SeriesFigureOptions(SeriesOptions, FigureOptions):
    """Options of a figure of a motion's time series."""


class WaterfallOptions(SpectraOptions, FigureOptions):
    """Options of a figure of spectra along a parameter."""

    scaling: Literal["density", "spectrum"] = option(
        "spectrum", "Colours show amplitudes, or power per hertz, as in scipy.signal.welch."
    )
    axis: Axis = option("", _AXIS)


class TongueFigureOptions(TongueOptions, FigureOptions):
    """Options of a figure of Arnold tongues."""


class ManifoldFigureOptions(ManifoldOptions, FigureOptions):
    """Options of a figure of manifolds."""


class DriftFigureOptions(StateOptions):
    """Options of a figure of sections over a moving parameter."""

    moving: str = option("", "Moving parameter; by default the only one.")
    over: str = option("", "Run with constant parameters that sweeps the moving one; its diagram is drawn below.")


class ResilienceFigureOptions(ResilienceOptions, FigureOptions):
    """Options of a figure of critical shocks."""


class EdgeFigureOptions(EdgeOptions, FigureOptions):
    """Options of a figure of edge states."""


class EscapeFigureOptions(EscapeOptions, FigureOptions):
    """Options of a figure of escapes."""

    show: Literal["rates", "paths"] = option("rates", "Rates over the axis, or the last stretch before leaving.")


class DensityFigureOptions(DensityOptions, FigureOptions):
    """Options of a figure of the density of section points."""


class TransferFigureOptions(TransferOptions, FigureOptions):
    """Options of a figure of the transfer operator's sets."""


BIFURCATION = Figure(
    "bifurcation",
    "Draw a bifurcation diagram: section points over the swept parameter, coloured by class of motion.",
    BifurcationOptions,
    "pipeline.plots.bifurcation:draw",
    unless=("layout", "side"),
)

SECTION = Figure(
    "section",
    """Draw the section of one parameter point in the plane of two states.

    Choose a part with --xlim and --ylim. Many points are drawn as counts per pixel.""",
    SectionOptions,
    "pipeline.plots.section:draw",
)

ATTRACTORS = Figure(
    "attractors",
    "Draw all coexisting attractors over the swept parameter, with the hysteresis of a continuation.",
    StateOptions,
    "pipeline.plots.fractions:draw_coexisting",
)

GALLERY = Figure(
    "gallery",
    """Draw the attractors of one parameter point: phase portraits, and the model's own drawing of the path.

    One period of each attractor is integrated for the portraits.""",
    FigureOptions,
    "pipeline.plots.gallery:draw",
    panels="several",
)

BASINS = Figure(
    "basins",
    "Draw basins of attraction: the attractor on which each initial state of a grid ends.",
    BasinFigureOptions,
    "pipeline.plots.basins:draw_basins",
)

FRACTIONS = Figure(
    "fractions",
    "Draw basin fractions over the swept parameter, as stacked bands.",
    FigureOptions,
    "pipeline.plots.fractions:draw_fractions",
)

REGIMES = Figure(
    "regimes",
    "Draw a map of two swept parameters: coexisting periods or attractors, or their number.",
    RegimeOptions,
    "pipeline.plots.regimes:draw_regimes",
    panels="either",
)

LYAPUNOV = Figure(
    "lyapunov",
    "Draw Lyapunov exponents, under the bifurcation diagram or as a map over two parameters.",
    LyapunovFigureOptions,
    "pipeline.plots.lyapunov:draw",
    panels="several",
    unless=("as_map", True),
)

CONVERGENCE = Figure(
    "convergence",
    "Draw the convergence of the Lyapunov exponents of the cells at one parameter point.",
    ConvergenceOptions,
    "pipeline.plots.convergence:draw",
    panels="several",
)

DIMENSION = Figure(
    "dimension",
    "Draw the correlation sum of the chaotic sections of one parameter point, with fit and local slope.",
    DimensionFigureOptions,
    "pipeline.plots.dimension:draw",
    panels="several",
)

SPECTRUM = Figure(
    "spectrum",
    "Draw the spectrum of each attractor of a parameter point: lines of closed orbits, otherwise densities.",
    SpectrumFigureOptions,
    "pipeline.plots.spectrum:draw_spectrum",
    needs="pipeline.analysis.spectrum.analysis:needs_axis",
    panels="several",
)

SERIES = Figure(
    "series",
    "Draw a motion's delay portrait, return map, divergence, correlation sums, recurrences and spectrum.",
    SeriesFigureOptions,
    "pipeline.plots.series:draw_series",
    panels="several",
)

WATERFALL = Figure(
    "waterfall",
    """Draw spectra along the swept parameter, as colours.

    At each value the spectrum is that of the attractor on which most cells end, or of --attractor.""",
    WaterfallOptions,
    "pipeline.plots.spectrum:draw_waterfall",
    needs="pipeline.analysis.spectrum.analysis:needs_axis",
)

BRANCHES = Figure(
    "branches",
    "Draw branches of periodic orbits over the bifurcation diagram: solid stable, dashed unstable.",
    BranchFigureOptions,
    "pipeline.plots.branches:draw_branches",
)

MULTIPLIERS = Figure(
    "multipliers",
    "Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.",
    MultiplierOptions,
    "pipeline.plots.branches:draw_multipliers",
)

SENSITIVITIES = Figure(
    "sensitivities",
    "Draw how far 1 % more of each parameter moves each bifurcation: bars by size, a panel for each bifurcation.",
    SensitivityFigureOptions,
    "pipeline.plots.sensitivities:draw_sensitivities",
    panels="several",
)

CURVES = Figure(
    "curves",
    "Draw curves of folds, period doublings and Neimark-Sacker points in the plane of two parameters.",
    CurveFigureOptions,
    "pipeline.plots.regimes:draw_curves",
)

GENEALOGY = Figure(
    "genealogy",
    "Draw the range of each attractor over the swept parameter as a bar, with the events at its ends.",
    GenealogyOptions,
    "pipeline.plots.genealogy:draw",
)

ROTATION = Figure(
    "rotation",
    "Draw rotation numbers over a parameter, with the steps p/q (the devil's staircase), or as a map over two.",
    FigureOptions,
    "pipeline.plots.tongues:draw_rotation",
)

RESPONSE = Figure(
    "response",
    "Draw amplitude and phase along a parameter: stable solid, unstable dashed, one colour for each level of force.",
    ResponseFigureOptions,
    "pipeline.plots.response:draw",
    panels="several",
)

BACKBONE = Figure(
    "backbone",
    "Draw backbone curves over the frequency: phase resonance over the response, and normal modes.",
    BackboneFigureOptions,
    "pipeline.plots.backbone:draw_backbone",
)

TONGUES = Figure(
    "tongues",
    "Draw the edges of the Arnold tongues p/q in a plane, over the map of rotation numbers if the run spans it.",
    TongueFigureOptions,
    "pipeline.plots.tongues:draw_tongues",
    needs="pipeline.analysis.branches.tongues:needs_rotation",
)

MANIFOLDS = Figure(
    "manifolds",
    "Draw the stable and unstable manifolds of saddle orbits, over the basins of a run on a grid of two states.",
    ManifoldFigureOptions,
    "pipeline.plots.basins:draw_manifolds",
)

DRIFT = Figure(
    "drift",
    "Draw sections over a parameter that moves, coloured by the swept number, over the diagram of another run.",
    DriftFigureOptions,
    "pipeline.plots.drift:draw",
)

RESILIENCE = Figure(
    "resilience",
    """Draw basin stability, critical shocks and arrival times of the attractors, over the swept parameter.

    Attractors stand side by side if nothing is swept. Bars show intervals.""",
    ResilienceFigureOptions,
    "pipeline.plots.resilience:draw",
    needs="pipeline.analysis.resilience.analysis:needs_sweep",
    panels="several",
)

EDGE = Figure(
    "edge",
    "Draw the edge states between two attractors, over the basins of a run on a grid of two states.",
    EdgeFigureOptions,
    "pipeline.plots.basins:draw_edge",
    needs="pipeline.analysis.resilience.edge:needs_pair",
)

ESCAPES = Figure(
    "escapes",
    """Draw rates of escape with intervals, over a strength with Kramers' law, or the last stretch before leaving.

    Over the strength σ of the noise, the horizontal axis is 1/σ².""",
    EscapeFigureOptions,
    "pipeline.plots.noise:draw_escapes",
    needs="pipeline.analysis.noise.escapes:needs_set",
    unless=("show", "paths"),
)

DENSITY = Figure(
    "density",
    "Draw the density of noisy section points, over an axis with its peaks: a stochastic bifurcation diagram.",
    DensityFigureOptions,
    "pipeline.plots.noise:draw_density",
    panels="either",
)

TRANSFER = Figure(
    "transfer",
    "Draw the slow sets of the section map: stationary density within each, cores, and committors.",
    TransferFigureOptions,
    "pipeline.plots.transfer:draw",
    needs="pipeline.analysis.transfer.analysis:needs_pairs",
    panels="several",
)


MOST_FRAMES = 5000
"""Most frames of a film; it takes some minutes to draw, and some hundred megabytes as GIF."""


class AnimationOptions(Options):
    """Options of an animation of a run."""

    at: dict[str, float] = option({}, "Value of an axis of the run, for the parameter point to show.")
    nearest: bool = option(False, "Use the axes' values nearest to --at, and print them; otherwise --at must match.")
    degrees: bool = option(False, "Use degrees instead of radians.")
    portrait: str = option("", "State whose phase portrait is shown.")
    seconds: float = option(8.0, "Length of the film.", unit="s", gt=0.0, le=600.0)
    fps: float = option(25.0, "Frames per second.", unit="1/s", gt=0.0, le=120.0)
    speed: float | None = option(None, "Seconds of the model per second of film.", gt=0.0)
    size: int = option(800, "Width of a frame.", unit="pixels", ge=200, le=4000)
