"""Attractors, where going up and down differ, and which sets stay."""

from __future__ import annotations

from typing import Self

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.attractors.product"


class IdentifyOptions(Options):
    """How attractors are found."""

    tolerance: float = option(
        0.0,
        "Distance, in units of the states' scales, within which a closed cell belongs to an orbit; 0 takes "
        "ten times the run's closure tolerance, at least 1e-4.",
        ge=0.0,
    )
    polish: bool = option(True, "Refine orbits by Newton's method, which integrates a point per orbit.")
    residual: float = option(1e-10, "Scaled residual that Newton's method is to reach.", gt=0.0)
    max_orbit_period: int = option(
        32, "Longest period looked for in cells that are not closed.", unit="drive periods or returns", ge=1
    )
    n_points: int = option(64, "Section points stored per attractor.", ge=1)
    mirror_threshold: float = option(0.3, "Largest distance of a mirror partner from the image.", gt=0.0)
    extend: bool = option(
        True, "Extend samples of the cells that no orbit accounts for, to show what they are on."
    )
    budget: float = option(
        1.0,
        "Longest extension at a parameter point, in units of what the run itself integrated there.",
        ge=0.0,
    )
    n_sample: int = option(32, "Cells of the first sample that is extended.", ge=1)
    lifetime_confidence: float = option(0.95, "Level of the intervals of lifetimes.", gt=0.0, lt=1.0)

    @property
    def effort(self) -> tuple[float, int]:
        """Budget of the extension and sample, 0 without one: of two results the larger knows more."""
        return (self.budget, self.n_sample) if self.extend and self.budget else (0.0, 0)

    def with_effort(self, effort: tuple[float, int]) -> Self:
        """Return the same options with another budget of the extension and another sample."""
        budget, n_sample = effort
        if not budget:
            return self.model_copy(update={"extend": False})
        return self.model_copy(update={"extend": True, "budget": budget, "n_sample": n_sample})


class AttractorOptions(IdentifyOptions):
    """How attractors are found, and how their ids are carried along the axes."""

    threshold: float = option(0.3, "Matching: largest distance between appearances of one id.", gt=0.0)
    look_back: int = option(3, "Matching: steps over which an id is remembered.", ge=1)
    connect: bool = option(
        True,
        "Matching: follow closed orbits along the axes, which integrates; without it, ids rest on distance.",
    )


IDENTIFIED = Analysis(
    "identified",
    "Attractors of each parameter point by itself.",
    IdentifyOptions,
    compute=f"{_ROOM}:identified",
)

ATTRACTORS = Analysis(
    "attractors",
    """Find the attractors at every parameter point, show that they attract, and follow them along the axes.

    A table per parameter point, or with more than six points a line per attractor with the range in
    which it exists. Cells that no orbit accounts for are extended, at most for as long as the run took.
    Shares are those of the cells that end on attractors, with 95 % intervals.""",
    AttractorOptions,
    compute=f"{_ROOM}:attractors",
    table="pipeline.analysis.attractors.table:attractors_table",
    builds_on=("identified",),
    figure="attractors",
)

HYSTERESIS = Analysis(
    "hysteresis",
    "Say where a continuation meets other attractors going up than going down, and where it jumps.",
    AttractorOptions,
    compute="pipeline.analysis.attractors.hysteresis_product:hysteresis",
    table="pipeline.analysis.attractors.hysteresis_table:hysteresis_table",
    needs="pipeline.analysis.attractors.hysteresis_product:needs_directions",
    builds_on=("attractors",),
    figure="attractors",
)

SETTLING = Analysis(
    "settling",
    """Print what was shown of each set that does not close: does it stay, or do its cells leave, where to?

    With --budget a larger sample of it is integrated for longer; what is found then holds for all analyses of
    the run. Lifetimes are in drive periods or returns.""",
    AttractorOptions,
    compute="pipeline.analysis.attractors.settling_product:settling",
    table="pipeline.analysis.attractors.settling_table:settling_table",
    builds_on=("attractors",),
)
