"""Attractors, where going up and down differ, and which bounded sets stay."""

from __future__ import annotations

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
        16, "Longest period guessed for cells that are not closed.", unit="drive periods or returns", ge=1
    )
    n_points: int = option(64, "Section points stored per attractor.", ge=1)
    mirror_threshold: float = option(0.3, "Largest distance of a mirror partner from the image.", gt=0.0)
    rule_box: float = option(0.1, "Bounded sets: scaled side of the boxes that are compared.", gt=0.0)
    rule_same_share: float = option(0.5, "Bounded sets: least share of boxes in common.", gt=0.0, le=1.0)
    rule_rotation: float = option(
        0.2, "Bounded sets: largest difference of rotation.", unit="turns per period", ge=0.0
    )
    rule_n_anchors: int = option(192, "Bounded sets: cells compared with each other in a round.", ge=1)
    rule_n_rounds: int = option(4, "Bounded sets: rounds.", ge=1)


class AttractorOptions(IdentifyOptions):
    """How attractors are found, and how their ids are carried along the axes."""

    threshold: float = option(0.3, "Matching: largest distance between appearances of one id.", gt=0.0)
    look_back: int = option(3, "Matching: steps over which an id is remembered.", ge=1)
    connect: bool = option(
        True,
        "Matching: follow closed orbits along the axes, which integrates; without it, ids rest on distance.",
    )


class SettlingOptions(AttractorOptions):
    """How bounded sets are run on."""

    n_sample: int = option(32, "Cells of each bounded set that are run on.", ge=1)
    n_periods: int = option(1024, "Time that they are run on.", unit="drive periods or returns", ge=1)
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)
    rtol: float = option(0.0, "Relative tolerance; 0 takes that of the run.", ge=0.0)
    atol: float = option(0.0, "Absolute tolerance; 0 takes that of the run.", ge=0.0)


IDENTIFIED = Analysis(
    "identified",
    "Attractors of each parameter point by itself.",
    IdentifyOptions,
    compute=f"{_ROOM}:identified",
)

ATTRACTORS = Analysis(
    "attractors",
    """Find the attractors at every parameter point, and follow them along the axes.

    A table per parameter point, or with more than six points a line per attractor with the range in
    which it exists. Shares are those of the cells whose outcome is known, with 95 % intervals.""",
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
    """Run a sample of every bounded set on: does it stay, or was it a transient, and where does it go?

    This integrates, for minutes if there are many sets. Lifetimes are in drive periods or returns.""",
    SettlingOptions,
    compute="pipeline.analysis.attractors.settling_product:settling",
    table="pipeline.analysis.attractors.settling_table:settling_table",
    builds_on=("attractors",),
)
