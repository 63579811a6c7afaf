"""Detect which periodic orbits at different parameter values lie on one branch, and link them.

Orbits are given at several values of one parameter. Each is followed from value to value, stable or not,
until it meets another one, at which moment the two are linked:

* Neighbours are compared first. They are linked if a step along the tangent from each leads to the other,
  within a tenth of the step's length: the continuation would accept this step.
* An orbit without a linked neighbour is followed by pseudo-arclength continuation, also through unstable
  parts, as long as it can meet other orbits. It ends at a fold, where the branch turns back in the parameter.
  So a group of linked orbits has at most one orbit at each parameter value.
* An orbit of even period that reaches the orbit of half its period, at a period doubling, continues as that
  orbit.

The outcome is open if Newton's method failed or there were too many points. Orbits are apart if following
ended at a fold, or passed all the orbits that it could have met.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.analysis.branches.arclength import Point, Settings, correct, trace
from pipeline.analysis.branches.following import first_point, half_orbit, has_halved, opposite
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.analysis.branches.problems import Family, OrbitProblem
from pipeline.analysis.tolerances import CONNECT_RTOL, SAME_CONNECTED

CONNECT = Settings(first_step=2e-3, longest_step=0.05, shortest_step=1e-6, max_points=300, tolerance=1e-9)
"""Settings with longer steps than for a branch, since no bifurcations are located."""

NEAR = 0.1
"""Largest distance of a neighbour from the step along the tangent, as a share of the step's length."""

LONGEST = 0.1
"""Longest step along a tangent that is compared with a neighbour."""

LINKED, APART, OPEN = "linked", "apart", "open"


@dataclass(frozen=True, eq=False)
class Found:
    """A periodic orbit at one value of the parameter, to be linked with orbits at other values.

    Attributes
    ----------
    number : int
        The caller's number for it.
    place : int
        Index of the value on its axis.
    family : Family
        With the parameter free.
    points : ndarray, (period, n_states)
        Its section points in the order of time.
    value : float
        The parameter's value.
    """

    number: int
    place: int
    family: Family
    points: np.ndarray
    value: float

    @property
    def period(self) -> int:
        """Period of the orbit [drive periods]."""
        return self.family.period

    def distance(self, u: np.ndarray) -> tuple[float, int]:
        """Return the scaled distance from a branch point `u` to the nearest section point of this orbit, and the index
        of that section point.
        """
        away = [float(np.linalg.norm(self.family.mismatch(u, point))) for point in self.points]
        nearest = int(np.argmin(away))
        return away[nearest], nearest


@dataclass(frozen=True)
class Link:
    """Link between two orbits of one branch, with the number of period doublings between them."""

    first: int
    second: int
    n_doublings: int = 0


@dataclass(eq=False)
class Links:
    """Links between orbits along one parameter, and the reason why following each orbit ended.

    Attributes
    ----------
    up, down : dict
        Outcome by number: ``linked``, ``apart`` (followed to a fold, or past all orbits that it could meet)
        or ``open`` (no answer); no entry if there was no orbit to meet.
    """

    links: list[Link] = field(default_factory=list)
    up: dict[int, str] = field(default_factory=dict)
    down: dict[int, str] = field(default_factory=dict)


def connect(lines: Sequence[Sequence[Found]], settings: Settings = CONNECT) -> list[Links]:
    """Link the orbits that lie on one branch, separately for each line of parameter points.

    Parameters
    ----------
    lines
        Orbits along one parameter each, all others fixed; numbers are unique within a line.
    settings
        Settings of the trace; arclengths are in units of the families' scales.

    Returns
    -------
    list of Links
        Per line.
    """
    everyone = [one for line in lines for one in line]
    points = run_together([_tangent(one, settings) for one in everyone], rtol=CONNECT_RTOL)
    known = iter(points)
    result: list[Links] = []
    traces: list[tuple[Links, Found, int, Steps[tuple[str, Link | None]]]] = []
    for line in lines:
        start = {one.number: next(known) for one in line}
        found = _neighbours([one for one in line if start[one.number] is not None], start)
        result.append(found)
        for one in line:
            point = start[one.number]
            for way in (1, -1):
                targets = [] if point is None else _targets(one, line, way, found)
                if point is not None and targets:
                    traces.append((found, one, way, _follow(one, point, targets, way, settings)))
    answers = run_together([steps for *_, steps in traces], "connecting orbits", rtol=CONNECT_RTOL)
    for (found, one, way, _), (outcome, link) in zip(traces, answers, strict=True):
        (found.up if way > 0 else found.down)[one.number] = outcome
        if link is not None:
            found.links.append(link)
    return result


def _tangent(one: Found, settings: Settings) -> Steps[Point | None]:
    u = one.family.unknowns(one.points[0], [one.value])
    found = yield from first_point(OrbitProblem(one.family), u, settings)
    return found


# ---- neighbours --------------------------------------------------------------------------------


def _neighbours(line: Sequence[Found], start: dict[int, Point | None]) -> Links:
    """Link orbits at adjacent parameter values if one step along the branch's tangent leads from one to the other."""
    result = Links()
    by_place: dict[tuple[int, int], list[Found]] = {}
    for one in line:
        by_place.setdefault((one.place, one.period), []).append(one)
    for one in line:
        others = by_place.get((one.place + 1, one.period), ())
        near = [other for other in others if _is_one_step(one, other, start)]
        if len(near) == 1 and near[0].number not in result.down:
            result.links.append(Link(one.number, near[0].number))
            result.up[one.number] = result.down[near[0].number] = LINKED
    return result


def _is_one_step(a: Found, b: Found, start: dict[int, Point | None]) -> bool:
    """Return whether each of two orbits is reached from the other by one step along the tangent."""
    phases = [_leads_to(start[a.number], b), _leads_to(start[b.number], a)]
    return all(p is not None for p in phases) and sum(p for p in phases if p is not None) % a.period == 0


def _leads_to(point: Point | None, other: Found) -> int | None:
    """Return the index of the section point of another orbit that a step along the tangent reaches; None if it misses
    them all.
    """
    if point is None or point.tangent[-1] == 0.0:
        return None
    change = other.value / other.family.scales[0] - point.u[-1]
    step = change / point.tangent[-1] * point.tangent
    length = float(np.linalg.norm(step))
    away, phase = other.distance(point.u + step)
    return phase if length <= LONGEST and away <= NEAR * length else None


# ---- following ---------------------------------------------------------------------------------


def _targets(one: Found, line: Sequence[Found], way: int, known: Links) -> list[Found]:
    """Return the orbits that a branch can reach: orbits of half, a quarter, ... of its period and, going up, of the
    same period.
    """
    if one.number in (known.up if way > 0 else known.down):
        return []
    halves = {one.period // 2**k for k in range(1, one.period.bit_length()) if one.period % 2**k == 0}

    def can_be_met(other: Found) -> bool:
        if other.period in halves:
            return True
        return way > 0 and other.period == one.period and other.number not in known.down

    return [other for other in line if (other.value - one.value) * way > 0.0 and can_be_met(other)]


@dataclass(eq=False)
class _Meeting:
    """Detector that looks after each step of a branch whether the branch has reached one of given orbits."""

    family: Family
    targets: Sequence[Found]
    way: int
    settings: Settings
    met: Found | None = None

    def between(self, a: Point, b: Point) -> Steps[bool]:
        """Record the target orbit, if any, that the branch reached during the last step; always accept the step."""
        chord = b.u - a.u
        for target in self.targets:
            value = target.value / self.family.scales[0]
            passed = (value - a.u[-1]) * self.way > 0.0 >= (value - b.u[-1]) * self.way
            if target.period != self.family.period or not passed:
                continue
            guess = a.u + (value - a.u[-1]) / chord[-1] * chord
            if target.distance(guess)[0] > 2.0 * float(np.linalg.norm(chord)):
                continue
            normal = np.zeros(len(guess))
            normal[-1] = 1.0
            there = yield from correct(OrbitProblem(self.family), guess, normal, self.settings)
            if there is not None and target.distance(there.u)[0] <= SAME_CONNECTED:
                self.met = target
                break
        return True

    def stop(self, points: list[Point]) -> str:
        """Return the reason to stop following the branch; an empty text to continue."""
        here = points[-1]
        if self.met is not None:
            return LINKED
        if has_halved(self.family, points):
            return "period_halving"
        if here.tangent[-1] * self.way <= 0.0:
            return APART
        value = float(self.family.values(here.u)[0])
        return APART if all((value - t.value) * self.way > 0.0 for t in self.targets) else ""


def _follow(
    one: Found, point: Point, targets: Sequence[Found], way: int, settings: Settings
) -> Steps[tuple[str, Link | None]]:
    """Follow an orbit up or down in the parameter until its branch reaches a target orbit. Halve the period at period
    doublings.
    """
    family, here = one.family, point
    for n_doublings in range(one.period.bit_length()):
        meeting = _Meeting(family, targets, way, settings)
        if here.tangent[-1] * way < 0.0:
            here = opposite(here)
        found = yield from trace(OrbitProblem(family), here, settings, meeting.stop, meeting.between)
        if meeting.met is not None:
            return LINKED, Link(one.number, meeting.met.number, n_doublings)
        if found.end != "period_halving":
            return (APART if found.end == APART else OPEN), None
        state, value = half_orbit(family, found.points[-1])
        family = replace(family, period=family.period // 2)
        next_point = yield from first_point(OrbitProblem(family), family.unknowns(state, [value]), settings)
        if next_point is None:
            return OPEN, None
        here = next_point
    return OPEN, None


# ---- groups ------------------------------------------------------------------------------------


def grouped(places: Sequence[Hashable], links: Iterable[Link]) -> tuple[np.ndarray, list[Link]]:
    """Group linked orbits, with at most one orbit of each parameter point per group. Links without period doublings
    count first.

    Parameters
    ----------
    places
        Place of each orbit.
    links
        Links between orbits, numbered by their index in `places`.

    Returns
    -------
    group : ndarray
        Least number of each orbit's group.
    used : list of Link
        Links between orbits of one group.
    """
    members = {i: [i] for i in range(len(places))}
    taken = {i: {place} for i, place in enumerate(places)}
    group = np.arange(len(places))
    ordered = sorted(links, key=lambda x: (x.n_doublings, min(x.first, x.second), max(x.first, x.second)))
    for link in ordered:
        a, b = sorted((int(group[link.first]), int(group[link.second])))
        if a == b or taken[a] & taken[b]:
            continue
        moved = members.pop(b)
        group[moved] = a
        members[a] += moved
        taken[a] |= taken.pop(b)
    return group, [link for link in ordered if group[link.first] == group[link.second]]
