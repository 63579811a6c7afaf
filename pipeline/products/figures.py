"""The figures: what each shows, and its options. They are drawn in `pipeline.plots`."""

from __future__ import annotations

from typing import Literal

from pipeline.products.attractors import AttractorOptions
from pipeline.products.branches import BranchOptions, CurveOptions
from pipeline.products.chaos import DimensionOptions
from pipeline.products.product import Figure, FigureOptions, StateOptions, option

Per = Literal["s", "period"]


def _without(options: FigureOptions, name: str) -> str:
    """The label of options as if one of them were as by default."""
    return FigureOptions.label(options.model_copy(update={name: ""}))


class BifurcationOptions(StateOptions):
    """A bifurcation diagram."""

    quantity: str = option(
        "",
        "Instead of a state at the sections, a quantity over each kept period: NAME.min, NAME.max or "
        "NAME.mean; the run needs the product extremes.",
    )
    layout: Literal["overlay", "side"] = option("overlay", "Both directions in one panel, or a panel each.")

    def label(self) -> str:
        """What the file's name says; no state where a quantity is drawn."""
        return super().label() if not self.quantity else _without(self, "state")


class SectionOptions(AttractorOptions, StateOptions):
    """Section points of one parameter point."""

    against: str = option("", "State that is drawn upwards; by default the rate of the other, or the next.")
    colour: Literal["motion", "attractor"] = option(
        "motion", "What has a colour: the kind of motion, or each attractor, which are found first."
    )


class AttractorFigureOptions(AttractorOptions, FigureOptions):
    """A figure of the attractors at one parameter point."""


class BasinFigureOptions(AttractorFigureOptions):
    """A figure of basins."""

    shade: bool = option(False, "Darken what took longer to converge.")


class CoexistingOptions(AttractorOptions, StateOptions):
    """All attractors over a parameter."""


class RegimeOptions(AttractorFigureOptions):
    """A map of two parameters."""

    show: Literal["periods", "attractors", "number"] = option("periods", "What is told apart.")


class LyapunovFigureOptions(StateOptions):
    """Exponents over a parameter, or as a map."""

    spectrum: bool = option(False, "All stored exponents, not the largest alone.")
    as_map: bool = option(False, "A map over two parameters instead of a diagram over one.", flag="--map")
    per: Per = option("s", "Exponents per second, or per drive period or return.")

    def label(self) -> str:
        """What the file's name says; no state on a map."""
        return _without(self, "state") if self.as_map else super().label()


class ConvergenceOptions(FigureOptions):
    """How exponents converge."""

    exponent: int = option(1, "Which exponent, 1 the largest.", ge=1)
    per: Per = option("s", "Exponents per second, or per drive period or return.")


class DimensionFigureOptions(DimensionOptions, FigureOptions):
    """A correlation sum and its fit."""


class _AlongOptions(BranchOptions, FigureOptions):
    """Options of a figure along a parameter."""

    def label(self) -> str:
        """What the file's name says; the drive's frequency goes without saying."""
        return _without(self, "parameter") if self.parameter == "frequency_hz" else super().label()


class BranchFigureOptions(_AlongOptions, StateOptions):
    """Branches over a diagram."""

    over: str = option("", "Run over the same parameter that is drawn below; by default DIR.")
    shown: int | None = option(None, "Longest period drawn.", unit="drive periods or returns", ge=1)


class MultiplierOptions(_AlongOptions):
    """Multipliers along a branch."""

    branch: int = option(0, "Number of the branch, as in the table.", ge=0)


class CurveFigureOptions(CurveOptions, _AlongOptions):
    """Curves of bifurcations."""


BIFURCATION = Figure(
    "bifurcation",
    "Draw a bifurcation diagram: motions over the swept parameter, in the colours of their class.",
    BifurcationOptions,
    "pipeline.plots.bifurcation:draw",
)

SECTION = Figure(
    "section",
    """Draw the section of one parameter point in the plane of two states.

    Parts of it with --xlim and --ylim; many points are counted on pixels.""",
    SectionOptions,
    "pipeline.plots.section:draw",
)

ATTRACTORS = Figure(
    "attractors",
    "Draw all coexisting attractors over the swept parameter, with the hysteresis of a continuation.",
    CoexistingOptions,
    "pipeline.plots.coexisting:draw",
)

GALLERY = Figure(
    "gallery",
    """Draw the attractors of one parameter point: phase portraits, and the model's own drawing of the path.

    Integrates one period of each, for the portraits.""",
    AttractorFigureOptions,
    "pipeline.plots.gallery:draw",
)

BASINS = Figure(
    "basins",
    "Draw basins of attraction: which attractor each initial state of a grid ends on.",
    BasinFigureOptions,
    "pipeline.plots.basins:draw",
)

FRACTIONS = Figure(
    "fractions",
    "Draw basin fractions over the swept parameter, as stacked bands.",
    AttractorFigureOptions,
    "pipeline.plots.fractions:draw",
)

REGIMES = Figure(
    "regimes",
    "Draw a map of two swept parameters: which periods or attractors coexist, or how many.",
    RegimeOptions,
    "pipeline.plots.regimes:draw",
)

LYAPUNOV = Figure(
    "lyapunov",
    "Draw Lyapunov exponents, under the bifurcation diagram or as a map over two parameters.",
    LyapunovFigureOptions,
    "pipeline.plots.lyapunov:draw",
)

CONVERGENCE = Figure(
    "convergence",
    "Draw how the Lyapunov exponents of the cells of one parameter point converge.",
    ConvergenceOptions,
    "pipeline.plots.convergence:draw",
)

DIMENSION = Figure(
    "dimension",
    "Draw the correlation sum of the chaotic sections of one parameter point, with fit and local slope.",
    DimensionFigureOptions,
    "pipeline.plots.dimension:draw",
)

BRANCHES = Figure(
    "branches",
    "Draw branches of periodic orbits over the bifurcation diagram: solid stable, dashed unstable.",
    BranchFigureOptions,
    "pipeline.plots.branches:draw",
)

MULTIPLIERS = Figure(
    "multipliers",
    "Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.",
    MultiplierOptions,
    "pipeline.plots.multipliers:draw_multipliers",
)

CURVES = Figure(
    "curves",
    "Draw curves of folds, period doublings and Neimark-Sacker points in the plane of two parameters.",
    CurveFigureOptions,
    "pipeline.plots.multipliers:draw_curves",
)
