"""Declare the analysis of events: where attractors begin, change and end along a parameter, and why."""

from __future__ import annotations

from pipeline.products.branches import BranchOptions
from pipeline.products.product import Analysis, option

_ROOM = "pipeline.analysis.events.analysis"


class EventOptions(BranchOptions):
    """Options for naming the events of attractors."""

    at: dict[str, float] = option({}, "Value of a further axis of the run.")
    refine: float = option(
        0.0,
        "Interval in which an event may stay undecided, in the unit of the swept parameter. Further values are run "
        "in DIR-refined until all are as short; 0 runs none.",
        ge=0.0,
    )
    orbits: bool = option(
        False,
        "Name only the ends of periodic orbits and equilibria. Each end of a chaotic set or a torus takes many long "
        "trajectories: a minute at low frequencies.",
    )


EVENTS = Analysis(
    "events",
    """Name the bifurcation at which each attractor begins, changes its period and ends along the swept parameter.

    Follows the branch of each orbit from the last value at which cells end on it. Ends of chaotic sets and tori are
    named where doublings, a Neimark-Sacker point, slow passages near an orbit beyond (intermittency, locking), the
    touch of an unstable orbit (crises), lifetimes beyond (transients) or exponents in between (break-up of a torus)
    prove them; all others are not decided.""",
    EventOptions,
    compute=f"{_ROOM}:events",
    table="pipeline.analysis.events.sentences:events_table",
    needs=f"{_ROOM}:needs_one_axis",
    settle=f"{_ROOM}:settle_events",
    builds_on=("attractors", "branches"),
    figure="genealogy",
    version=15,
)
