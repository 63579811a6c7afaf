"""Declare the analysis of events: where attractors begin, change and end along a parameter, and why."""

from __future__ import annotations

from pipeline.products.branches import BranchOptions
from pipeline.products.product import Analysis, option

_ROOM = "pipeline.analysis.events.analysis"


class EventOptions(BranchOptions):
    """Options for naming the events of attractors."""

    at: dict[str, float] = option({}, "Value of a further axis of the run.")


EVENTS = Analysis(
    "events",
    """Name the bifurcation at which each attractor begins, changes its period and ends along the swept parameter.

    Follows the branch of each orbit from the last value at which cells end on it. Ends of chaotic sets and tori are
    named where doublings, a Neimark-Sacker point, or slow passages near an orbit beyond prove them (intermittency,
    locking); all others are not decided.""",
    EventOptions,
    compute=f"{_ROOM}:events",
    table="pipeline.analysis.events.sentences:events_table",
    needs=f"{_ROOM}:needs_one_axis",
    settle=f"{_ROOM}:settle_events",
    builds_on=("attractors", "branches"),
    figure="genealogy",
    version=2,
)
