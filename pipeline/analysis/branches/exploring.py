"""Follow all branches that are connected by bifurcations with some given orbits, each branch once.

At a pitchfork one branch passes straight through and the other turns back, so that its two arms lie on one side.
The point belongs to the first.

The section of the cycles that start at a Hopf point has the level of this point, so that small cycles cross it. The
first cycle has a given amplitude along the critical eigenvector; Newton's method finds its parameter
value. Larger cycles often cross the section of the run as well.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from magpend_core.orbits import scaled_distance, section_map
from magpend_core.poincare import Section, section_of
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from pipeline.analysis.branches.arclength import Point, Settings, Trace, correct
from pipeline.analysis.branches.bifurcations import SAME_PLACE, TESTS, Bifurcation, locate, settle_sides
from pipeline.analysis.branches.following import (
    Branch,
    Half,
    crossing_half,
    doubled_start,
    first_point,
    half_branch,
    half_orbit,
    joined,
    opposite,
    problem_of,
)
from pipeline.analysis.branches.kinds import BRANCHING, DOUBLING, FOLD, HOPF
from pipeline.analysis.branches.known import Start, fixed, gap, lie_on, same_others, shorter_orbit
from pipeline.analysis.branches.limits import settle_limits
from pipeline.analysis.branches.lockstep import Begun, Query, Steps, run_alone, run_together
from pipeline.analysis.branches.normal_forms import judge
from pipeline.analysis.branches.problems import Family, OrbitProblem, Value
from pipeline.results.tolerances import BRANCH_RTOL

FOLLOWING = "following branches"
"""First words of the work's name in progress reports."""

POINTS_BESIDE = 3
"""Points of a branch away from a bifurcation at which it is seen on which side of it the branch lies."""


LEAST_POINTS = 5
"""Points below which a doubled branch that is stuck is no branch: it is named among those left out."""


@dataclass(frozen=True, eq=False)
class Scope:
    """Limits within which branches are explored: parameter interval, longest period, number of generations."""

    # interval of the parameter
    low: float
    high: float
    max_period: int = 8  # longest period of a branch [drive periods]
    max_generations: int = 3  # most generations of branches that bifurcate from branches
    settings: Settings = field(default_factory=Settings)  # settings of the traces


@dataclass(eq=False)
class _Doubled:
    """Branches that spring from period doublings, followed from these on beside the branches on which they lie.

    A branch of twice the period that is being followed may end at a doubling, whose other branch it then is. So each
    of these branches holds the doubling that is nearest to its latest orbit: nothing is followed from there as yet.
    """

    scope: Scope
    _located: dict[Value, tuple[Family, Bifurcation]] = field(default_factory=dict)  # by its orbit; nothing begun
    _begun: dict[Value, Begun[Half]] = field(default_factory=dict)
    _latest: dict[OrbitProblem, np.ndarray] = field(default_factory=dict)  # unknowns on each branch

    def half(self, family: Family, start: Point, single: Point | None = None) -> Steps[Half]:
        """Follow one half of a branch, and note the period doublings on it; `single` is the orbit at whose doubling it
        starts.
        """
        low, high, settings = self.scope.low, self.scope.high, self.scope.settings
        note = partial(self._note, family)
        return half_branch(family, start, low, high, settings, single is not None, note, single)

    def _note(self, family: Family, one: Bifurcation) -> None:
        if self._leads_on(family, one) and self.scope.low <= family.values(one.point.u)[0] <= self.scope.high:
            self._located[one.point.value] = family, one

    def _leads_on(self, family: Family, one: Bifurcation) -> bool:
        """Return whether the other branch at a bifurcation is one of twice the period, within the limit of periods."""
        return one.kind == DOUBLING and 2 * family.period <= self.scope.max_period

    def beside(self, queries: Sequence[Query]) -> Iterable[Begun[Half]]:
        """Begin branches at the doublings that no branch holds; return all that have been begun."""
        self._latest |= {query.problem: query.u for query in queries if isinstance(query.problem, OrbitProblem)}
        held = {self._nearest(*latest) for latest in self._latest.items()} if self._located else set()
        for end in [end for end in self._located if end not in held]:
            self._begun[end] = Begun(self._branch(*self._located.pop(end)))
        return self._begun.values()

    def _nearest(self, problem: OrbitProblem, u: np.ndarray) -> Value | None:
        """Return the nearest doubling at which a branch may end; None if there is none of half its period."""
        period = problem.family.period
        near = [(end, one) for end, (family, one) in self._located.items() if 2 * family.period == period]
        away = {end: float(np.linalg.norm(one.point.u - u)) for end, one in near}
        return min(away, key=away.__getitem__, default=None)

    def follow(self, branches: Sequence[Branch], what: str) -> list[tuple[Branch, Bifurcation, Half]]:
        """Follow to its end the branch at each doubling on some branches from which none is known."""
        ends = [(branch, one) for branch in branches for one in branch.bifurcations if one.child is None]
        ends = [(branch, one) for branch, one in ends if self._leads_on(branch.family, one)]
        self._located.clear()  # branches that are known now have ended at the others
        self._latest.clear()
        begun = [self._begun.pop(one.point.value, None) for _, one in ends]
        halves = run_together(
            [
                self._branch(b.family, one) if own is None else own.rest()
                for (b, one), own in zip(ends, begun, strict=True)
            ],
            what,
            beside=self.beside,
        )
        return [(b, one, half) for (b, one), half in zip(ends, halves, strict=True)]

    def _branch(self, family: Family, one: Bifurcation) -> Steps[Half]:
        start = yield from doubled_start(family, one)
        if start is None:
            return Half(Trace([one.point], "stuck"))
        return (yield from self.half(replace(family, period=2 * family.period), start, one.point))


def explore(starts: Sequence[Start], scope: Scope) -> list[Branch]:
    """Follow the branches of all starting orbits, and the branches that start at the bifurcations on them.

    Returns
    -------
    list of Branch
        Branches of the starts in their order, then those of each generation.
    """
    branches: list[Branch] = []
    doubled = _Doubled(scope)
    _follow_starts(starts, branches, doubled)
    for generation in range(scope.max_generations):
        n_known = len(branches)
        _follow_starts(_adopt(branches), branches, doubled)
        _adopt(branches)
        _switch(branches, doubled, f"{FOLLOWING} that spring from others, round {generation + 1}")
        _leave_equilibria(branches, doubled)
        if len(branches) == n_known:
            break
    _adopt(branches)
    _adopt_cycles(branches)
    settle_crossings(branches)
    settle_limits(branches)
    judge([(branch.family, one) for branch in branches for one in branch.bifurcations])
    return branches


def _follow_starts(starts: Sequence[Start], branches: list[Branch], doubled: _Doubled) -> None:
    """Follow the branch of each starting orbit that lies on no known branch, and append it to `branches`.

    When a start is followed, so are the others at its value, and the first start of each other attractor, on
    lanes that would be idle. Most of these are needed later; one that turns out to lie on a known branch is
    dropped.
    """
    values = {value: i for i, value in enumerate(dict.fromkeys(start.value for start in starts))}
    starts = [s for s in starts if s.family.period <= doubled.scope.max_period]
    starts.sort(key=lambda start: values[start.value])
    followed: dict[int, Branch | None] = {}
    is_known, n_compared = np.zeros(len(starts), bool), 0
    for i, start in enumerate(starts):
        if n_compared < len(branches):
            rest = i + np.flatnonzero(~is_known[i:])
            is_known[rest] = lie_on([starts[k] for k in rest], branches[n_compared:])
            n_compared = len(branches)
        if is_known[i]:
            continue
        if i not in followed:
            here = [k for k in range(i, len(starts)) if starts[k].value == start.value and not is_known[k]]
            here += _first_of_each(starts, {*followed, *here})
            what = f"{FOLLOWING} from {start.value:g}"
            followed |= zip(here, _both_ways([starts[k] for k in here], doubled, what), strict=True)
        branch = followed[i]
        if branch is not None:
            branches.append(branch)


def _first_of_each(starts: Sequence[Start], followed: set[int]) -> list[int]:
    """Return, for each attractor and period that is not followed yet, the index of its first starting orbit."""
    kinds = [(start.attractor, start.family.period) for start in starts]
    done = {kinds[i] for i in followed}
    firsts = {kind: i for i, kind in reversed(list(enumerate(kinds))) if kind[0] >= 0 and kind not in done}
    return sorted(firsts.values())


def _both_ways(starts: Sequence[Start], doubled: _Doubled, what: str) -> list[Branch | None]:
    firsts = run_together([first_of(start, doubled.scope.settings) for start in starts])
    pairs = [pair for pair in firsts if pair is not None]
    halves = run_together(
        [doubled.half(family, way) for family, point in pairs for way in (opposite(point), point)],
        what,
        beside=doubled.beside,
    )
    found = iter(joined(family, *halves[2 * i : 2 * i + 2]) for i, (family, _) in enumerate(pairs))
    return [None if pair is None else next(found) for pair in firsts]


def first_of(start: Start, settings: Settings) -> Steps[tuple[Family, Point] | None]:
    """Return the first point of a branch and the family of its least period; None if Newton's method fails.

    At a period doubling a starting orbit of twice the period may be the single one but for its error.
    """
    family, u = start.family, start.unknowns
    while True:
        point = yield from first_point(problem_of(family), u, settings)
        if point is None:
            return None
        shorter = shorter_orbit(family, point)
        if shorter is None:
            return family, point
        family, u = shorter


# ---- switching ---------------------------------------------------------------------------------


def _adopt(branches: Sequence[Branch]) -> list[Start]:
    """Connect each branch that ends on an orbit of half its period to the period doubling at that orbit.

    Return the orbits of half the period as starts, for ends without a known doubling.
    """
    orphans = []
    for branch in branches:
        for which in (0, 1):
            if branch.ends[which] != "period_halving":
                continue
            at = _doubling_at(branches, branch, which)
            if at is None:
                orphans.append(_half_orbit(branch, which))
            elif at.child is None:
                at.child = branch
                branch.origin = branch.origin or at
                at.criticality = _criticality(at, branch, -1 if which else 0)
    return orphans


def _doubling_at(branches: Sequence[Branch], branch: Branch, which: int) -> Bifurcation | None:
    """Find the period doubling at which a branch ends. It lies on a branch of half the period, within a few steps of
    the end; among several, its orbit is the most like the last one.
    """
    end, inner = (branch.points[0], branch.points[1]) if which == 0 else branch.points[:-3:-1]
    reach = 3.0 * max(float(np.linalg.norm(end.u - inner.u)), 1e-3)
    found = []
    for other in branches:
        if 2 * other.family.period != branch.family.period or not same_others(other.family, branch.family):
            continue
        for one in other.bifurcations:
            if one.kind == DOUBLING:
                away = max(gap(branch.family, end.u, one.point), abs(end.u[-1] - one.point.u[-1]))
                if away < reach:
                    found.append(one)
    return min(found, key=lambda one: _apart(branch.family, end, one.point), default=None)


def _apart(family: Family, doubled: Point, single: Point) -> float:
    """Return the largest scaled distance between the section points of an orbit and those of one of half its period."""
    away = np.array([scaled_distance(single.value.images, x, family.system) for x in doubled.value.images])
    n, each = len(single.value.images), np.arange(len(away))
    return min(float(away[each, (each + k) % n].max()) for k in range(n))


def _half_orbit(branch: Branch, which: int) -> Start:
    state, value = half_orbit(branch.family, branch.points[-which])
    return Start(replace(branch.family, period=branch.family.period // 2), state, value)


def _criticality(at: Bifurcation, child: Branch, end: int) -> str:
    """Decide whether a period doubling is sub- or supercritical, from the side on which the doubled branch lies: at the
    first point that is certainly away, as it may soon turn.
    """
    # least distance from the bifurcation, by the parameter in its scale, that shows on which side a point lies
    certain = 1e-8
    near = child.points[:4] if end == 0 else child.points[:-5:-1]
    away = [point.u[-1] - at.point.u[-1] for point in near]
    sure = [x for x in away if abs(x) > certain] or away[-1:]
    return _side_criticality(at, 1 if sure[0] > 0.0 else -1)


def _switch(branches: list[Branch], doubled: _Doubled, what: str) -> None:
    """Follow the new branches that start at period doublings and branch points of the known branches."""
    ends = [(branch, one) for branch in branches for one in branch.bifurcations if one.child is None]
    for parent, one, half in doubled.follow(branches, what):
        n_points, end = len(half.trace.points), half.trace.end
        if one.child is not None or (n_points == 1 and end == "bound"):
            continue
        family = replace(parent.family, period=2 * parent.family.period)
        child = Branch(family, half.trace.points, half.bifurcations, ("start", end), one)
        if n_points < LEAST_POINTS and end == "stuck":
            one.stuck = child
            continue
        one.child, one.criticality = child, _criticality(one, child, 0)
        branches.append(child)
        if child.ends[1] == "period_halving":
            other = _doubling_at(branches, child, 1)
            if other is not None:
                other.child, other.criticality = child, _criticality(other, child, -1)
    scope, crossings = doubled.scope, [(branch, one) for branch, one in ends if one.kind == BRANCHING]
    cross(crossings, branches, (scope.low, scope.high), scope.settings)


# ---- Hopf points -------------------------------------------------------------------------------


def _adopt_cycles(branches: Sequence[Branch]) -> None:
    """Connect each branch of limit cycles that ends at an equilibrium to the Hopf point there."""
    for branch in branches:
        for which in (0, 1):
            if branch.ends[which] == "equilibrium":
                at = _hopf_at(branches, branch, branch.points[-which])
                if at is not None:
                    at.child = at.child or branch
                    branch.origin = branch.origin or at


def _hopf_at(branches: Sequence[Branch], cycles: Branch, end: Point) -> Bifurcation | None:
    largest = 0.05  # scaled distance of the last cycle of a branch from the Hopf point at which it ends
    near = [
        (max(gap(cycles.family, end.u, one.point), abs(end.u[-1] - one.point.u[-1])), one)
        for other in branches
        if not other.family.period and other.family.free == cycles.family.free
        for one in other.bifurcations
        if one.kind == HOPF
    ]
    away, nearest = min(near, key=lambda pair: pair[0], default=(np.inf, None))
    return nearest if away < largest else None


def _leave_equilibria(branches: list[Branch], doubled: _Doubled) -> None:
    """Follow the limit cycles that start at Hopf points, if no known branch of limit cycles ends there."""
    _adopt_cycles(branches)
    scope = doubled.scope
    points = [
        (branch, one) for branch in branches for one in branch.bifurcations if one.kind == HOPF and one.child is None
    ]
    families = [cycle_family(branch.family, one.point) for branch, one in points]
    ready = [(*point, family) for point, family in zip(points, families, strict=True) if family is not None]
    halves = run_together(
        [cycles_from(family, one, scope.low, scope.high, scope.settings) for _, one, family in ready], FOLLOWING
    )
    for (rest, one, family), half in zip(ready, halves, strict=True):
        if half is not None and len(half.trace.points) > 2 and one.child is None:
            child = Branch(family, half.trace.points, half.bifurcations, ("start", half.trace.end), one)
            parts = _without_known(child, rest.family, branches, doubled)
            one.child = parts[0] if parts else None
            branches += parts


def _without_known(cycles: Branch, own: Family, branches: list[Branch], doubled: _Doubled) -> list[Branch]:
    """Return those parts of a branch of limit cycles that are not yet known from another Poincare section.

    Diagrams show the section of the run, `own`. So cycles that cross it are followed there, unless they have
    been, and are left out here.
    """
    clear = 2  # points of a branch by which cycles are away from where they touch a section
    wanted = np.ones(len(cycles.points), bool)
    for section in _other_sections(cycles, own, branches):
        crossings = crossings_of(cycles, section, doubled.scope.max_period)
        starts = {}
        for first, last in _equal_runs(np.where(wanted, [period for _, period in crossings], 0)):
            state, period = crossings[min(first + clear, last)]
            value = float(cycles.values[min(first + clear, last)])
            starts[first, last] = Start(replace(section, period=period), state, value)
        if section is own:
            _follow_starts(list(starts.values()), branches, doubled)
        for (first, last), is_known in zip(starts, lie_on(list(starts.values()), branches), strict=True):
            wanted[first : last + 1] &= not is_known
    return _parts(cycles, wanted)


def _equal_runs(periods: np.ndarray) -> list[tuple[int, int]]:
    """Find runs of equal positive numbers in an array; return the first and last index of each."""
    bounds = np.flatnonzero(np.diff(periods, prepend=-1, append=-1))
    return [(a, b - 1) for a, b in itertools.pairwise(map(int, bounds)) if periods[a] > 0]


def _other_sections(cycles: Branch, own: Family, branches: Sequence[Branch]) -> list[Family]:
    """Return a family of orbits for each Poincare section of the known branches, except the section of `cycles`."""
    families = [own, *(b.family for b in branches if b.family.period and b.family.free == own.free)]
    by_section = {fixed(family).tobytes(): family for family in reversed(families)}
    by_section.pop(fixed(cycles.family).tobytes(), None)
    return list(reversed(by_section.values()))


def _parts(cycles: Branch, wanted: np.ndarray) -> list[Branch]:
    """Cut from a branch of limit cycles the ranges of wanted points, each with one more point at either end."""
    n, parts = len(wanted), []
    for first, last in [(max(a - 1, 0), min(b + 1, n - 1)) for a, b in _equal_runs(wanted.astype(int))]:
        ends = cycles.ends[0] if first == 0 else "other_section", cycles.ends[1] if last == n - 1 else "other_section"
        inside = [replace(one, after=one.after - first) for one in cycles.bifurcations if first <= one.after < last]
        origin = cycles.origin if first == 0 else None
        parts.append(Branch(cycles.family, cycles.points[first : last + 1], inside, ends, origin))
    return parts


def cycle_family(equilibria: Family, at: Point, omega: float | None = None) -> Family | None:
    """Return the family of limit cycles near a Hopf point, on a Poincare section through this point; None if they do
    not cross it.

    The cycles have the angular frequency `omega` [rad/s], by default that of the pair nearest to the imaginary axis.

    There is none if the system has no section by crossing, or if what crosses its level does not oscillate.
    """
    same = 1e-9  # two sections this close are one [scales of the states]
    section = section_of(equilibria.system)
    if section is None or cycle_direction(equilibria, at, omega) is None:
        return None
    state, level = at.value.images[:1], equilibria.parameters.copy()
    packed = equilibria.rows(at.u[None]).parameters
    at_rest = float(section.values(state, packed)[0])
    if abs(at_rest - level[-1]) > same * section.scaled_normals(state, packed)[1][0]:
        level[-1] = at_rest
    for name, value in zip(equilibria.free, equilibria.values(at.u), strict=True):
        level[equilibria.system.parameter_names.index(name)] = value
    return replace(equilibria, period=1, parameters=level)


def cycles_from(family: Family, at: Bifurcation, low: float, high: float, settings: Settings) -> Steps[Half | None]:
    """Follow the limit cycles that start at a Hopf point along the parameter; None if no small cycle is found."""
    direction = cycle_direction(family, at.point)
    assert direction is not None
    normal = np.append(direction / np.linalg.norm(direction), 0.0)
    for amplitude in settings.amplitudes:
        guess = at.point.u + amplitude * np.append(direction, 0.0)
        first = yield from correct(OrbitProblem(family), guess, normal, settings)
        if first is not None:
            return (yield from half_branch(family, first, low, high, settings))
    return None


def cycle_direction(family: Family, at: Point, omega: float | None = None) -> np.ndarray | None:
    """Return the scaled direction from an equilibrium to the point where small limit cycles cross the section; None if
    they do not cross it. See `cycle_family` for `omega`.

    It is the real part of the critical eigenvector at the phase at which it passes the section in its direction; its
    largest component is 1.
    """
    section = Section(family.system)
    (normal,), _ = section.scaled_normals(at.value.images[:1], family.rows(at.u[None]).parameters)
    values, vectors = np.linalg.eig(family.scaled(at.value.monodromy))
    away = np.abs(values.real) if omega is None else np.abs(values - 1j * omega)
    vector = vectors[:, int(np.argmin(away + 1e300 * (values.imag <= 0.0)))]
    across = normal @ vector
    if abs(across) < 1e-6 * np.abs(vector).max():
        return None
    turned = vector * np.exp(-1j * (section.sign * np.pi / 2.0 + np.angle(across)))
    found = np.asarray(turned.real)
    found -= (normal @ found) * normal
    largest = np.abs(found).max()
    return found / largest if largest > 1e-9 * np.abs(vector).max() else None


def crossings_of(cycles: Branch, section: Family, most: int) -> list[tuple[np.ndarray, int]]:
    """Find where the limit cycles of a branch cross another Poincare section of the same flow.

    Parameters
    ----------
    cycles
        The branch.
    section
        A family of the same flow with the other section.
    most
        Largest number of crossings per cycle that is looked for.

    Returns
    -------
    list of (ndarray, int)
        For each cycle a point on the section, and the number of crossings per period, 0 if there is none.
    """
    rounding = 1e-6  # relative difference within which the times of some returns add up to the period of a cycle
    rows = section.rows(np.array([point.u for point in cycles.points]))
    first = run_branches(
        rows.parameters[:, None],
        rows.frequency_hz[:, None],
        rows.states,
        n_transient=1,
        n_keep=1,
        **limits_at(BRANCH_RTOL),
        system=section.system,
    ).section[:, 0, 0]
    found = section_map(rows.parameters, rows.frequency_hz, first, most, rtol=BRANCH_RTOL, system=section.system)
    seconds = np.array([point.value.seconds for point in cycles.points])[:, None]
    closes = np.abs(np.cumsum(found.times, axis=1) - seconds) < rounding * seconds
    periods = np.where(closes.any(axis=1), closes.argmax(axis=1) + 1, 0)
    return list(zip(first, map(int, periods), strict=True))


def cross(
    points: Sequence[tuple[Branch, Bifurcation]],
    branches: list[Branch],
    interval: tuple[float, float],
    settings: Settings,
) -> None:
    """Follow the second branch through each branch point in both directions, and append it to `branches`."""
    for parent, one in points:
        known = _crossing(parent, one, branches)
        if known is not None:
            branch, other = known
            one.child, other.child = branch, parent
            continue
        halves = run_together(
            [
                crossing_half(parent.family, one, _crossing_direction(parent, one), way, *interval, settings)
                for way in (-1.0, 1.0)
            ],
            FOLLOWING,
        )
        child = joined(parent.family, *halves)
        if len(child.points) > 2:
            child.origin, one.child = one, child
            branches.append(child)


def _crossing_direction(branch: Branch, at: Bifurcation) -> np.ndarray:
    """Return the direction of a branch at a bifurcation: the difference of the points after and before it."""
    u = np.array([p.u for p in branch.points])
    i = int(np.argmin(np.linalg.norm(u - at.point.u, axis=1)))
    return np.asarray(u[min(i + 1, len(u) - 1)] - u[max(i - 1, 0)])


def _crossing(parent: Branch, one: Bifurcation, branches: Sequence[Branch]) -> tuple[Branch, Bifurcation] | None:
    """Find a branch on which the same branch point was located as well, and the point there."""
    for branch in branches:
        if branch.family.period != parent.family.period or not same_others(branch.family, parent.family):
            continue
        for other in branch.bifurcations:
            away = gap(branch.family, one.point.u, other.point), abs(one.point.u[-1] - other.point.u[-1])
            if other is not one and other.kind == BRANCHING and max(away) < SAME_PLACE:
                return branch, other
    return None


def settle_crossings(branches: Sequence[Branch]) -> None:
    """Leave each branch point on one of its two branches: at a pitchfork on the one that passes straight through.

    The branch that turns there tells the criticality: its arms lie on one side.
    """
    for branch in branches:
        for one in [one for one in branch.bifurcations if one.kind == BRANCHING]:
            if one.child is None or not any(one is own for own in branch.bifurcations):
                continue
            twin = _crossing(branch, one, [one.child])
            if twin is not None:
                kept, dropped = (twin[1], one) if _side(branch, one) else (one, twin[1])
                other = branch if dropped is one else one.child
                side = _side(other, dropped)
                _drop(dropped, other)
                kept.child, other.origin = other, other.origin or kept
            elif _side(branch, one) and not _side(one.child, one):
                kept, side = one, _side(branch, one)
                _move(one, branch)
            else:
                kept, side = one, _side(one.child, one)
            if side:
                kept.criticality = _side_criticality(kept, side)


def _side(branch: Branch, at: Bifurcation) -> int:
    """Return on which side of a bifurcation in the parameter a branch lies that turns there: 1 above, -1 below; 0 if it
    passes through.
    """
    after = _place(branch, at)
    before, beyond = (
        branch.points[max(after - POINTS_BESIDE + 1, 0)],
        branch.points[min(after + POINTS_BESIDE, len(branch.points) - 1)],
    )
    sides = np.sign([p.u[-1] - at.point.u[-1] for p in (before, beyond)])
    return int(sides[0]) if sides[0] == sides[1] else 0


def _place(branch: Branch, at: Bifurcation) -> int:
    """Return the index of a branch's point after which a bifurcation lies; the point itself if the branch has it."""
    if any(at is own for own in branch.bifurcations):
        return at.after
    return next((i for i, p in enumerate(branch.points) if p.u is at.point.u), 0)


def _move(one: Bifurcation, turning: Branch) -> None:
    """Make a branch point, located where a branch turns, one of the branch that passes straight through."""
    straight: Branch = one.child
    _drop(one, turning)
    place = _place(straight, one)
    del straight.points[place]
    for own in straight.bifurcations:
        own.after -= own.after >= place
    one.after, one.child = place - 1, turning
    straight.bifurcations = sorted([*straight.bifurcations, one], key=lambda own: own.after)
    straight.origin, turning.origin = None, turning.origin or one
    _relocate(one, straight, place)
    settle_sides(straight.points, straight.bifurcations)


def _relocate(one: Bifurcation, branch: Branch, place: int) -> None:
    """Locate a branch point again between the points of the branch that passes straight through it: on the branch that
    turns there it is known to the root of its residual alone.
    """
    if not 0 < place < len(branch.points):
        return
    before, after = branch.points[place - 1 : place + 1]
    if TESTS[BRANCHING](before) * TESTS[BRANCHING](after) < 0.0:
        found = run_alone(locate(problem_of(branch.family), before, after, BRANCHING, Settings(), Settings.shifts))
        if found is not None:
            one.point, one.bracket = found.point, found.bracket


def _drop(one: Bifurcation, branch: Branch) -> None:
    """Drop a branch point that belongs to another branch, and the fold where a branch turns there."""
    branch.bifurcations = [
        own
        for own in branch.bifurcations
        if own is not one and (own.kind != FOLD or np.abs(own.point.u - one.point.u).max() >= SAME_PLACE)
    ]
    settle_sides(branch.points, branch.bifurcations)


def _side_criticality(at: Bifurcation, side: int) -> str:
    """Decide whether a bifurcation is sub- or supercritical, from the side of the branch that turns there."""
    if at.n_unstable_before == at.n_unstable_after:
        return ""
    worse = 1 if (at.n_unstable_after > at.n_unstable_before) == at.rises_before else -1
    return "supercritical" if side == worse else "subcritical"
