"""Follow all branches that are connected by bifurcations with some given orbits, each branch once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.analysis.branches.arclength import Point, Settings
from pipeline.analysis.branches.bifurcations import BRANCHING, DOUBLING, HOPF, Bifurcation
from pipeline.analysis.branches.crossings import FOLLOWING, cross, settle_crossings
from pipeline.analysis.branches.cycles import crossings_of, cycle_family, cycles_from
from pipeline.analysis.branches.following import (
    Branch,
    doubled_start,
    first_point,
    half_branch,
    half_orbit,
    joined,
    opposite,
    problem_of,
)
from pipeline.analysis.branches.known import Start, fixed, gap, lie_on, same_others
from pipeline.analysis.branches.lockstep import run_together
from pipeline.analysis.branches.normal_forms import judge
from pipeline.analysis.branches.problems import Family

AT_HOPF = 0.05
"""Largest scaled distance of the last cycle of a branch from the Hopf point at which it ends."""

CLEAR = 2
"""Points of a branch by which cycles are away from where they touch a section."""


@dataclass(frozen=True, eq=False)
class Scope:
    """Limits within which branches are explored: parameter interval, longest period, number of generations.

    Attributes
    ----------
    low, high : float
        Interval of the parameter.
    max_period : int
        Longest period of a branch [drive periods].
    max_generations : int
        Most generations of branches that bifurcate from branches.
    settings : Settings
        Settings of the traces.
    """

    low: float
    high: float
    max_period: int = 8
    max_generations: int = 3
    settings: Settings = field(default_factory=Settings)


def explore(starts: Sequence[Start], scope: Scope) -> list[Branch]:
    """Follow the branches of all starting orbits, and the branches that start at the bifurcations on them.

    Returns
    -------
    list of Branch
        Branches of the starts in their order, then those of each generation.
    """
    branches: list[Branch] = []
    _follow_starts(starts, branches, scope)
    for generation in range(scope.max_generations):
        n_known = len(branches)
        _follow_starts(_adopt(branches), branches, scope)
        _adopt(branches)
        _switch(branches, scope, f"{FOLLOWING} that spring from others, round {generation + 1}")
        _leave_equilibria(branches, scope)
        if len(branches) == n_known:
            break
    _adopt(branches)
    _adopt_cycles(branches)
    settle_crossings(branches)
    judge([(branch.family, one) for branch in branches for one in branch.bifurcations])
    return branches


def _follow_starts(starts: Sequence[Start], branches: list[Branch], scope: Scope) -> None:
    """Follow the branch of each starting orbit that lies on no known branch, and append it to `branches`.

    When a start is followed, so are the others at its value, and the first start of each other attractor, on
    lanes that would be idle. Most of these are needed later; one that turns out to lie on a known branch is
    dropped.
    """
    values = {value: i for i, value in enumerate(dict.fromkeys(start.value for start in starts))}
    starts = [s for s in starts if s.family.period <= scope.max_period]
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
            followed |= zip(here, _both_ways([starts[k] for k in here], scope, what), strict=True)
        branch = followed[i]
        if branch is not None:
            branches.append(branch)


def _first_of_each(starts: Sequence[Start], followed: set[int]) -> list[int]:
    """Return, for each attractor and period that is not followed yet, the index of its first starting orbit."""
    kinds = [(start.attractor, start.family.period) for start in starts]
    done = {kinds[i] for i in followed}
    firsts = {kind: i for i, kind in reversed(list(enumerate(kinds))) if kind[0] >= 0 and kind not in done}
    return sorted(firsts.values())


def _both_ways(starts: Sequence[Start], scope: Scope, what: str) -> list[Branch | None]:
    firsts = run_together(
        [first_point(problem_of(s.family), s.family.unknowns(s.state, [s.value]), scope.settings) for s in starts]
    )
    pairs = [(s.family, p) for s, p in zip(starts, firsts, strict=True) if p is not None]
    halves = run_together(
        [
            half_branch(family, way, scope.low, scope.high, scope.settings)
            for family, point in pairs
            for way in (opposite(point), point)
        ],
        what,
    )
    found = iter(joined(family, *halves[2 * i : 2 * i + 2]) for i, (family, _) in enumerate(pairs))
    return [None if p is None else next(found) for p in firsts]


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
    the end.
    """
    end, inner = (branch.points[0], branch.points[1]) if which == 0 else branch.points[:-3:-1]
    reach = 3.0 * max(float(np.linalg.norm(end.u - inner.u)), 1e-3)
    best, nearest = None, reach
    for other in branches:
        if 2 * other.family.period != branch.family.period or not same_others(other.family, branch.family):
            continue
        for one in other.bifurcations:
            if one.kind == DOUBLING:
                away = max(gap(branch.family, end.u, one.point), abs(end.u[-1] - one.point.u[-1]))
                if away < nearest:
                    best, nearest = one, away
    return best


def _half_orbit(branch: Branch, which: int) -> Start:
    state, value = half_orbit(branch.family, branch.points[-which])
    return Start(replace(branch.family, period=branch.family.period // 2), state, value)


def _criticality(at: Bifurcation, child: Branch, end: int) -> str:
    """Decide whether a period doubling is sub- or supercritical, from the side on which the doubled branch lies."""
    worse_above = (at.n_unstable_after > at.n_unstable_before) == at.rises_before
    inner = child.points[end + 3 if end == 0 else end - 3]
    return "supercritical" if (inner.u[-1] > at.point.u[-1]) == worse_above else "subcritical"


def _switch(branches: list[Branch], scope: Scope, what: str) -> None:
    """Follow the new branches that start at period doublings and branch points of the known branches."""
    open_ends = [
        (branch, one)
        for branch in branches
        for one in branch.bifurcations
        if one.child is None
        and (one.kind == BRANCHING or (one.kind == DOUBLING and 2 * branch.family.period <= scope.max_period))
    ]
    doublings = [(b, one) for b, one in open_ends if one.kind == DOUBLING]
    starts = run_together([doubled_start(b.family, one) for b, one in doublings])
    ready = [(b, one, s) for (b, one), s in zip(doublings, starts, strict=True) if s is not None]
    halves = run_together(
        [
            half_branch(
                replace(b.family, period=2 * b.family.period), start, scope.low, scope.high, scope.settings, True
            )
            for b, _, start in ready
        ],
        what,
    )
    for (parent, one, _), half in zip(ready, halves, strict=True):
        if len(half.trace.points) < 5 or one.child is not None:
            continue
        family = replace(parent.family, period=2 * parent.family.period)
        child = Branch(family, half.trace.points, half.bifurcations, ("start", half.trace.end), one)
        one.child, one.criticality = child, _criticality(one, child, 0)
        branches.append(child)
        if child.ends[1] == "period_halving":
            other = _doubling_at(branches, child, 1)
            if other is not None:
                other.child, other.criticality = child, _criticality(other, child, -1)
    crossings = [(b, one) for b, one in open_ends if one.kind == BRANCHING]
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
    near = [
        (max(gap(cycles.family, end.u, one.point), abs(end.u[-1] - one.point.u[-1])), one)
        for other in branches
        if not other.family.period and other.family.free == cycles.family.free
        for one in other.bifurcations
        if one.kind == HOPF
    ]
    away, nearest = min(near, key=lambda pair: pair[0], default=(np.inf, None))
    return nearest if away < AT_HOPF else None


def _leave_equilibria(branches: list[Branch], scope: Scope) -> None:
    """Follow the limit cycles that start at Hopf points, if no known branch of limit cycles ends there."""
    _adopt_cycles(branches)
    points = [
        (branch, one) for branch in branches for one in branch.bifurcations if one.kind == HOPF and one.child is None
    ]
    families = [cycle_family(branch.family, one) for branch, one in points]
    ready = [(*point, family) for point, family in zip(points, families, strict=True) if family is not None]
    halves = run_together(
        [cycles_from(family, one, scope.low, scope.high, scope.settings) for _, one, family in ready], FOLLOWING
    )
    for (rest, one, family), half in zip(ready, halves, strict=True):
        if half is not None and len(half.trace.points) > 2 and one.child is None:
            child = Branch(family, half.trace.points, half.bifurcations, ("start", half.trace.end), one)
            parts = _without_known(child, rest.family, branches, scope)
            one.child = parts[0] if parts else None
            branches += parts


def _without_known(cycles: Branch, own: Family, branches: list[Branch], scope: Scope) -> list[Branch]:
    """Return those parts of a branch of limit cycles that are not yet known from another Poincare section.

    Diagrams show the section of the run, `own`. So cycles that cross it are followed there, unless they have
    been, and are left out here.
    """
    wanted = np.ones(len(cycles.points), bool)
    for section in _other_sections(cycles, own, branches):
        crossings = crossings_of(cycles, section, scope.max_period)
        starts = {}
        for first, last in _equal_runs(np.where(wanted, [period for _, period in crossings], 0)):
            state, period = crossings[min(first + CLEAR, last)]
            value = float(cycles.values[min(first + CLEAR, last)])
            starts[first, last] = Start(replace(section, period=period), state, value)
        if section is own:
            _follow_starts(list(starts.values()), branches, scope)
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
