"""Declare the analyses of attractors, of hysteresis, and of invariant sets that are not periodic orbits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from pipeline.products.column import Columns, only, over, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, StateOptions, option
from pipeline.results.set_columns import IDENTIFIED_COLUMNS

_ROOM = "pipeline.analysis.attractors.analysis"


class IdentifyOptions(Options):
    """Options for finding attractors."""

    tolerance: float = option(
        0.0,
        "Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for "
        "ten times the run's closure tolerance, at least 1e-4.",
        ge=0.0,
    )
    polish: bool = option(True, "Refine orbits by Newton's method, which integrates a point per orbit.")
    residual: float = option(1e-10, "Scaled residual at which Newton's method has converged.", gt=0.0)
    max_orbit_period: int = option(
        32, "Longest orbit period that is sought in cells that are not closed.", unit="drive periods or returns", ge=1
    )
    n_points: int = option(64, "Section points stored per attractor.", ge=1)
    mirror_threshold: float = option(0.3, "Largest distance of a mirror partner from the image.", gt=0.0)
    extend: bool = option(
        True, "Extend the integration of sample cells that are on no known orbit, to find their sets."
    )
    budget: float = option(
        1.0, "Longest extension at a parameter point, in units of the run's own integration there.", ge=0.0
    )
    n_sample: int = option(24, "Number of cells in the first sample that is extended.", ge=1)
    lifetime_confidence: float = option(0.95, "Level of the intervals of lifetimes.", gt=0.0, lt=1.0)

    @classmethod
    def from_attrs(cls, attrs: Mapping[Any, Any]) -> Self:
        """Return the options in the attributes of a result; those that it lacks have their defaults."""
        given = {name: (attrs.get(f"identify_{name}"), info.default) for name, info in cls.model_fields.items()}
        return cls(**{name: type(default)(value) for name, (value, default) in given.items() if value is not None})


class AttractorOptions(IdentifyOptions):
    """Options for finding attractors, and for matching attractor ids along the swept parameters."""

    threshold: float = option(0.3, "Matching: largest distance between sets with one id.", gt=0.0)
    look_back: int = option(3, "Matching: steps over which an id is remembered.", ge=1)
    connect: bool = option(
        True, "Matching: follow closed orbits along the axes by integration; otherwise match by distance."
    )


class HysteresisOptions(Options):
    """Options for finding hysteresis."""

    events: bool = option(
        False, "Name the events at which branches fall off an attractor; follows branches, as analyse events does."
    )


IDENTIFIED = Analysis(
    "identified",
    "Find the attractors of each parameter point on its own.",
    IdentifyOptions,
    compute=f"{_ROOM}:identified",
    columns=IDENTIFIED_COLUMNS,
    version=7,
    by_point=True,
)

ATTRACTORS_COLUMNS: Columns = (*IDENTIFIED_COLUMNS, *over("set", match_basis="what the id rests on"))

ATTRACTORS = Analysis(
    "attractors",
    """Find the attractors at every parameter point, show that they attract, and follow them along the axes.

    Options that are given hold for the run from then on: all other analyses and figures show these attractors.
    Prints a table per parameter point, or with more than six points a line per attractor with the
    range in which it exists. Cells on no known orbit are integrated further, at most as long as in the
    run itself. Basin fractions are fractions of all cells, with 95 % intervals.""",
    AttractorOptions,
    compute=f"{_ROOM}:attractors",
    whole="ids follow from all parameter points; the search before is in blocks",
    columns=ATTRACTORS_COLUMNS,
    version=4,
    table="pipeline.analysis.attractors.analysis:attractors_table",
    builds_on=("identified",),
    figure="attractors",
)

HYSTERESIS_COLUMNS: Columns = (
    *over("*", differs="up and down meet other attractors"),
    *over("* direction attractor", present="met by a branch"),
    *over("attractor", attractor="attractor"),
    *over("direction", direction="direction of the walk"),
    *over("loop", loop_points="points"),
    *over("loop", "{path}", loop_from="first value of the path", loop_to="last value of the path"),
    *over("loop attractor", only_down="points at which only down meets it", only_up="points at which only up meets it"),
    *over("jump", jump_count="branches", jump_direction="direction of the walk, 1 up, -1 down"),
    *over("jump", jump_from_id="attractor before", jump_to_id="attractor after"),
    *over("jump", "{path}", jump_from="value of the path before", jump_to="value of the path after"),
    *over(
        "jump", jump_event="number of the event at which the attractor ends, -1 none", jump_what="name of this event"
    ),
    *with_parts(over("jump", "{path}", jump_value="parameter value of this event"), "error"),
)

HYSTERESIS = Analysis(
    "hysteresis",
    "List where a continuation follows different attractors upwards and downwards, and where it jumps.",
    HysteresisOptions,
    compute="pipeline.analysis.attractors.hysteresis:hysteresis",
    whole="it compares ids, and integrates nothing",
    columns=HYSTERESIS_COLUMNS,
    table="pipeline.analysis.attractors.hysteresis:hysteresis_table",
    needs="pipeline.analysis.attractors.hysteresis:needs_directions",
    builds_on=("attractors", "events"),
    figure="attractors",
)

SETTLING_COLUMNS: Columns = (
    *only(
        IDENTIFIED_COLUMNS,
        "n_sets ran_out attractor kind stability evidence orbit_period closes_above n_cells n_sampled n_left n_leaving "
        "time_at_risk mean_lifetime lifetime_low lifetime_high lyapunov_max lyapunov_low lyapunov_high from_set to "
        "n_to",
    ),
)

SETTLING = Analysis(
    "settling",
    """List each set that does not close: whether its cells stay or leave, and where they go.

    The option budget of the attractors says for how long a sample of their cells is integrated.
    Transient lifetimes are in drive periods or returns.""",
    Options,
    compute="pipeline.analysis.attractors.settling:settling",
    whole="it lists what the attractors know",
    columns=SETTLING_COLUMNS,
    table="pipeline.analysis.attractors.settling:settling_table",
    builds_on=("attractors",),
)


ATTRACTORS_FIGURE = Figure(
    "attractors",
    "Draw all coexisting attractors over the swept parameter, with the hysteresis of a continuation.",
    StateOptions,
    "pipeline.analysis.basins.fractions_figure:draw_coexisting",
)


GALLERY_FIGURE = Figure(
    "gallery",
    """Draw the attractors of one parameter point: phase portraits, and the model's own drawing of the path.

    One period of each attractor is integrated for the portraits.""",
    FigureOptions,
    "pipeline.analysis.attractors.figure:draw",
    panels="several",
    follows_motion=True,
)
