"""Declare the analysis of events: where attractors begin, change and end along a parameter, and why."""

from __future__ import annotations

from pipeline.analysis.branches.declaration import AlongOptions
from pipeline.products.column import Columns, over, swept, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, option

_ROOM = "pipeline.analysis.events.analysis"


class EventOptions(AlongOptions):
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


COLUMNS: Columns = (
    *over(
        "event",
        attractor="id of the attractor",
        set="kind of the attractor",
        period="period of the attractor, 0 none",
        period_after="period beyond a change, -1 none",
        rises="1 if it ends as the parameter rises",
        what="name of the event",
        criticality="criticality",
        evidence="what decided the event, or what was tried",
        same_as="number of the event that this end belongs to",
        bifurcation="number of the bifurcation, -1 none",
        branch="branch of the attractor, -1 none",
        other_branch="other branch there, -1 none",
        is_own="1 if the bifurcation lies on its branch, 0 if the branch springs from it",
        n_cells="cells of the attractor",
        ratio="ratio of the last two intervals of a cascade",
        exponent="minus the power of the distance with which times grow",
        exponent_error="error of this exponent",
        rotation="rotation number p/q of a locked orbit",
        met_period="period of the unstable orbit that is met, 0 none",
        twin="id of the set with which it merges, -1 none",
        lives_beyond="1 if the set beyond meets the orbit",
        stretch_of="stretch that ends",
        stretch_after="stretch beyond a change, -1 none",
    ),
    *swept("value", "event", "parameter value of the event"),
    *over(
        "event",
        "{parameter}",
        value_error="error of the value",
        seen="last value with cells",
        beyond="next value of the run beyond the event",
    ),
    *over("event doubling", "{parameter}", doublings="values of the doublings of a cascade"),
    *over(
        "event outcome",
        to_attractor="ids on which the cells go on, -2 they diverge, -1 none",
        to_cells="cells that go on on each",
        to_stretch="stretches on which they go on, -2 they diverge, -1 none",
    ),
    *over("stretch", stretch_attractor="id of the attractor", stretch_set="kind of the attractor"),
    *over("stretch", stretch_period="period of the attractor, 0 none"),
    *over(
        "stretch", "{parameter}", stretch_low="least value of the stretch", stretch_high="largest value of the stretch"
    ),
    *over("stretch end", stretch_side="class of motion, by the model's classifier"),
    *with_parts(over("stretch end", stretch_fraction="basin fraction"), "low", "high"),
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
    whole="an end of an attractor is named by ends of others; long calls of the engine use all threads",
    columns=COLUMNS,
    table="pipeline.analysis.events.sentences:events_table",
    needs=f"{_ROOM}:needs_one_axis",
    settle=f"{_ROOM}:settle_events",
    builds_on=("attractors", "branches"),
    figure="genealogy",
    version=17,
)


class GenealogyOptions(EventOptions, FigureOptions):
    """Options of a figure of the events of attractors."""


GENEALOGY_FIGURE = Figure(
    "genealogy",
    "Draw the range of each attractor over the swept parameter as a bar, with the events at its ends.",
    GenealogyOptions,
    "pipeline.analysis.events.figure:draw",
)
