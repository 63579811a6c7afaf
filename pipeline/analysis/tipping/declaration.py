"""Declare the analyses of tipping: after parameters have moved, and between two basins."""

from __future__ import annotations

from pipeline.products.column import STATES, Columns, over
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, StateOptions, option

_ROOM = "pipeline.analysis.tipping"

COURSES = ("not_decided", "tracking", "returning", "tipping", "return_tipping")
"""What becomes of the attractor on which a trajectory begins."""


class TippingOptions(Options):
    """Options for finding which attractors are reached after parameters have moved."""

    parameter: str = option("", "Swept number along which critical values are bisected; by default the only axis.")
    settle: int = option(300, "Integration at the final parameters before attractors are told.", unit="periods", ge=1)
    keep: int = option(64, "Sections kept after that.", ge=16)
    steps: int = option(64, "Steps in which attractors are continued along the motion of the parameters.", ge=1)
    interval: float = option(
        1e-6, "Width of a critical value's interval, as a part of the axis' range.", gt=0.0, lt=1.0
    )
    brackets: int = option(64, "Most critical values that are bisected.", ge=0)


class OverlapOptions(Options):
    """Options for tipping probabilities from the overlaps of basins at two parameter values."""

    parameter: str = option("", "Swept parameter; by default the only axis.")
    before: float = option(..., "Value of the parameter before the change, on its axis.", flag="--from")
    after: float = option(..., "Value of the parameter after the change, on its axis.", flag="--to")
    at: dict[str, float] = option({}, "Value of an axis of the run, for the parameter point.")
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)


class DelayOptions(Options):
    """Options for finding where trajectories leave an orbit while a parameter moves."""

    moving: str = option("", "Moving parameter; by default the only one.")
    period: int = option(1, "Period of the orbit that is left.", unit="drive periods", ge=1)
    distance: float = option(
        0.01, "Largest distance between sections one period of the orbit apart, in units of the states' scales.", gt=0.0
    )
    static: float | None = option(None, "Value of the bifurcation at a parameter that does not move.", unit="SI")


TIPPING_COLUMNS: Columns = (
    *over("* +", outcome="attractor reached, -2 diverged, -1 none"),
    *over("* +", course="whether the trajectory keeps to the attractor on which it begins"),
    *over(
        "attractor",
        attractor_kind="kind of set",
        attractor_period="period in {periods}, 0 none",
        attractor_n_cells="cells that end on it",
        attractor_group="group of final parameters",
    ),
    *over("attractor state", STATES, attractor_point="section point"),
    *over("group", final_parameters="values of the parameters at the end"),
    *over(
        "critical",
        critical_start="initial condition",
        critical_from="attractor below, -2 diverged",
        critical_to="attractor above, -2 diverged",
        critical_decided="1 if every one reached an attractor",
        critical_n_evaluated="trajectories of the bisection",
    ),
    *over(
        "critical",
        "{parameter}",
        critical_value="critical value of the parameter",
        critical_low="last value with the first attractor",
        critical_high="first value with the second one",
    ),
)

TIPPING = Analysis(
    "tipping",
    """Find which attractor each trajectory reaches after its parameters have moved, and the critical rates.

    For runs with a table [drift]. Every trajectory is integrated on at the final parameters, where attractors are found
    as by `attractors`. Where neighbouring values of the swept number lead to different attractors, it is bisected.
    A trajectory tracks, returns or tips: it stays on the attractor on which it begins, leaves it until the parameters
    come back, or ends on another one.""",
    TippingOptions,
    compute=f"{_ROOM}.analysis:tipping",
    whole="all cells and intervals advance in step",
    columns=TIPPING_COLUMNS,
    table=f"{_ROOM}.analysis:tipping_table",
    needs=f"{_ROOM}.analysis:needs_drift",
    figure="tipping",
    motions=("drifting",),
    version=2,
)


class TippingFigureOptions(TippingOptions, FigureOptions):
    """Options of a diagram of tracking, returning and tipping."""

    condition: int = option(0, "Number of the initial condition of a map; bands over one swept number show all.", ge=0)


TIPPING_FIGURE = Figure(
    "tipping",
    """Draw which trajectories track, return and tip: a map over two swept numbers, or bands over one.

    The horizontal axis is the number along which critical values are bisected, which are dots.""",
    TippingFigureOptions,
    f"{_ROOM}.diagram:draw_tipping",
    needs=f"{_ROOM}.analysis:needs_drift",
    motions=("drifting",),
)

OVERLAPS_COLUMNS: Columns = (
    *over("", n_unknown="starts whose end is not known before or after"),
    *over("before", before="attractor before, -2 diverges"),
    *over("after", after="attractor after, -2 diverges"),
    *over("before after", count="starts in both basins", probability="tipping probability"),
    *over("before after", low="lower end of the interval", high="upper end of the interval"),
)

OVERLAPS = Analysis(
    "overlaps",
    """Compute tipping probabilities between two parameter values from the overlaps of their basins.

    If the parameter jumps from the first value to the second, a start of the basin i before ends on attractor j
    after with the fraction of the basin that lies in basin j. Nothing is integrated for it.""",
    OverlapOptions,
    compute=f"{_ROOM}.overlaps:overlaps",
    whole="it counts cells, and integrates nothing",
    columns=OVERLAPS_COLUMNS,
    table=f"{_ROOM}.overlaps:overlaps_table",
    needs=f"{_ROOM}.overlaps:needs_basins",
    builds_on=("attractors",),
)

DELAY_COLUMNS: Columns = (
    *over("* +", "{moving}", left="value of the moving parameter at which the cell leaves"),
    *over("* +", "{moving}", delay="this value minus that of the static bifurcation"),
    *over("* +", left_index="section at which it leaves, or -1"),
)

DELAY = Analysis(
    "delay",
    """Find the value of a moving parameter at which trajectories leave a periodic orbit, such as a delayed doubling.

    A trajectory has left an orbit of period p when two of its sections p apart differ by more than a distance. With
    --static the delay behind the bifurcation at a constant parameter is listed.""",
    DelayOptions,
    compute=f"{_ROOM}.delay:delay",
    whole="it compares stored section points, and integrates nothing",
    columns=DELAY_COLUMNS,
    table=f"{_ROOM}.delay:delay_table",
    needs=f"{_ROOM}.delay:needs_sections",
    figure="drift",
    motions=("drifting",),
)


class DriftFigureOptions(StateOptions):
    """Options of a figure of sections over a moving parameter."""

    moving: str = option("", "Moving parameter; by default the only one.")
    over: str = option("", "Run with constant parameters that sweeps the moving one; its diagram is drawn below.")


DRIFT_FIGURE = Figure(
    "drift",
    "Draw sections over a parameter that moves, coloured by the swept number, over the diagram of another run.",
    DriftFigureOptions,
    "pipeline.analysis.tipping.figure:draw",
    motions=("drifting",),
)
