"""Name ends of chaotic sets and tori in windows of a few neighbouring points, and carry the names along lines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magpend_core.models.model import Parameters
from pipeline.analysis.atlas.ends import End
from pipeline.analysis.atlas.lines import Line, lines_through
from pipeline.analysis.atlas.plane import Change, Plane
from pipeline.analysis.atlas.verdicts import Verdict
from pipeline.analysis.events.kinds import LIVES_ON, RANGE_END, UNDECIDED
from pipeline.analysis.events.windows import events_within
from pipeline.layout.vocabulary import APERIODIC, parameter_name
from pipeline.results.ragged import isel
from pipeline.results.tabular import words_of

BESIDE = 1
"""Points of a window beyond the two between which a set ends, on each side."""

NO_WINDOW = "a set that is no orbit; it lies between no two places at which its line was looked at (--windows)"


def set_lines(plane: Plane, changes: Sequence[Change]) -> list[Line]:
    """Join the changes of sets that are no orbits to lines; their items are numbers of changes."""
    own = [k for k, one in enumerate(changes) if plane.kind[one.row] in APERIODIC]
    items = []
    for k in own:
        one = changes[k]
        after = int(plane.period[one.other]) if one.other >= 0 else -1
        middle = plane.values[[one.here, one.there]].mean(axis=0)
        items.append((int(plane.parent[one.edge]), ("", int(plane.kind[one.row]), after), middle))
    return [
        Line(one.what, one.period, one.places, tuple(own[i] for i in one.items)) for one in lines_through(plane, items)
    ]


def chosen(lines: Sequence[Line], n: int) -> list[int]:
    """Choose up to about `n` changes: of long lines more, evenly spaced, with both ends."""
    total = sum(len(line.items) for line in lines)
    found: list[int] = []
    for line in sorted(lines, key=lambda one: -len(one.items)):
        wanted = min(len(line.items), max(2, round(n * len(line.items) / total)), n - len(found))
        found += [line.items[int(i)] for i in np.unique(np.linspace(0, len(line.items) - 1, wanted).round())]
    return sorted(set(found))


def named(plane: Plane, row: int, axis: int, target: float, base: Parameters) -> End:
    """Name the end of a set between its point and a neighbour, by the events in a window around both."""
    name, other = plane.names[axis], plane.names[1 - axis]
    here = plane.values[plane.node[row]]
    along = np.unique(plane.values[:, axis])
    ends = np.searchsorted(along, sorted((here[axis], target)))
    inside = along[max(ends[0] - BESIDE, 0) : ends[1] + BESIDE + 1]
    places = np.flatnonzero(np.isin(plane.sets[name].values, inside))
    line = int(np.flatnonzero(plane.sets[other].values == here[1 - axis])[0])
    between = float(along[ends[0]]), float(along[ends[1]])
    part = isel(plane.sets, {name: places, other: line})
    found = events_within(part, parameter_name(name), base, (float(along[0]), float(along[-1])), between=between)
    number, rises = int(plane.attractor[row]), int(target > here[axis])
    seen = found["seen"].values == here[axis]
    own = np.flatnonzero(seen & (found["attractor"].values == number) & (found["rises"].values == rises))
    if not len(own):
        return End(UNDECIDED, why="no event of it is between the two points")
    k = int(own[0])
    what = words_of(found["what"])[int(found["what"].values[k])]
    if what in (RANGE_END, LIVES_ON):
        what = UNDECIDED
    value, error = float(found["value"].values[k]), float(found["value_error"].values[k])
    return End(what, value, error, why=str(found["evidence"].values[k]))


def carried(lines: Sequence[Line], found: Sequence[Verdict], tested: Sequence[int]) -> None:
    """Give each change of a line the name that the nearest tested places on both sides agree on; in place."""
    known = set(tested)
    for line in lines:
        places = [i for i, k in enumerate(line.items) if k in known]
        for i, k in enumerate(line.items):
            if k in known:
                continue
            beside = [p for p in places if p < i][-1:] + [p for p in places if p > i][:1]
            whats = {found[line.items[p]].what for p in beside}
            one = found[k]
            one.what, one.why = UNDECIDED, NO_WINDOW
            if len(beside) < 2:
                continue
            if len(whats) > 1:
                one.why = f"the places of its line on both sides were named differently: {', '.join(sorted(whats))}"
            elif (what := whats.pop()) == UNDECIDED:
                one.why = "at the places of its line on both sides it was not decided"
            else:
                one.what, one.why = what, "as at the places of its line on both sides, where it was named"
