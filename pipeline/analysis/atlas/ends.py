"""Follow orbits from one parameter point towards a neighbouring one, to the bifurcation at which they end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from magpend_core.equilibria import is_held
from magpend_core.models.model import Parameters
from pipeline.analysis.atlas.plane import Plane
from pipeline.analysis.branches.arclength import Point, Settings, correct, kernel_of
from pipeline.analysis.branches.bifurcations import Bifurcation, n_unstable
from pipeline.analysis.branches.exploring import first_of
from pipeline.analysis.branches.following import (
    Branch,
    first_point,
    half_branch,
    half_orbit,
    half_way,
    opposite,
    problem_of,
)
from pipeline.analysis.branches.kinds import BRANCHING, DOUBLING, FOLD, HOPF, LIMITS
from pipeline.analysis.branches.known import Start, at_value
from pipeline.analysis.branches.limits import settle_limits
from pipeline.analysis.branches.lockstep import Query, Steps, run_together
from pipeline.analysis.branches.normal_forms import judge
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.starting_orbits import family_of
from pipeline.analysis.events.grazing import grazing_of
from pipeline.analysis.events.kinds import LIVES_ON, UNDECIDED
from pipeline.analysis.events.lines import Line
from pipeline.layout.vocabulary import EQUILIBRIUM, frequency_of

TRACE = Settings(beyond=2)
"""Settings of the branches: they end soon beyond the stable part."""

GOES_ON, SHRINKS, TOUCHES = "goes_on", "shrinks", "touches"
"""The orbit goes on under another id, or a cycle ends: it shrinks to an equilibrium, or touches the
section, where the number of its returns changes."""

WHAT = {"equilibrium": SHRINKS, "tangent": TOUCHES, "other_section": TOUCHES}


@dataclass(frozen=True, eq=False)
class End:
    """End of the stable part of a branch, on the way to the neighbouring point."""

    what: str
    value: float = np.nan  # of the parameter along the way
    error: float = np.nan
    period: int = 0  # of the orbit at the bifurcation
    state: np.ndarray | None = None  # a section point of it, or of the orbit at the neighbouring point
    why: str = ""


def at_node(plane: Plane, node: int, base: Parameters) -> tuple[float, np.ndarray]:
    """Return the drive frequency [Hz] and the packed parameters at a point of the plane."""
    scalars = {str(name): float(v) for name, v in plane.sets.coords.items() if not v.ndim and v.dtype.kind == "f"}
    scalars |= dict(zip(plane.names, plane.values[node].tolist(), strict=True))
    own = {name: value for name, value in scalars.items() if name in base.names}
    return frequency_of(base.model, scalars), base.replace(**own).pack()


def start_of(plane: Plane, row: int, axis: int, base: Parameters) -> Start | None:
    """Return an attractor as the start of a branch along one parameter; None if it is no refined orbit."""
    system, state, period = base.model.system, plane.points[row][0], int(plane.period[row])
    frequency, packed = at_node(plane, int(plane.node[row]), base)
    is_rest = plane.kind[row] == EQUILIBRIUM
    if is_rest and system.section is None and is_held(system, state, packed):
        period = 1  # its rates do not vanish, but the map at instants leaves it in place
    if not plane.is_polished[row] or not (period or is_rest):
        return None
    family = family_of(system, period, frequency, packed, plane.names[axis], float(plane.size[axis]))
    return Start(family, state, float(plane.values[plane.node[row], axis]), int(plane.attractor[row]))


def follow_all(starts: Sequence[tuple[Start, float]], what: str = "") -> list[End]:
    """Follow orbits until they are not stable any more, at most to a value of the parameter given with each.

    Returns
    -------
    list of End
        `LIVES_ON` for an orbit that is stable up to the given value.
    """
    branches = run_together([_towards(start, target) for start, target in starts], what)
    found = [branch for branch in branches if branch is not None]
    settle_limits(found)
    judge([(b.family, one) for b in found for one in _lost(b)[:1] if one.kind == BRANCHING])
    ends = [_end(branch, target) for branch, (_, target) in zip(branches, starts, strict=True)]
    shrunk = {k: b for k, (b, one) in enumerate(zip(branches, ends, strict=True)) if b and one.what == SHRINKS}
    located = run_together([_hopf_at(branch, ends[k]) for k, branch in shrunk.items()])
    for k, end in zip(shrunk, located, strict=True):
        ends[k] = end
    return ends


def _hopf_at(branch: Branch, cycle: End) -> Steps[End]:
    """Return the Hopf point at which cycles shrink to an equilibrium; their end itself if there is none nearby."""
    near = 0.05  # largest distance of the Hopf point from the last cycle [scale of the parameter]
    family = replace(branch.family, period=0)
    away = near * family.scales[0]
    assert cycle.state is not None
    u = family.unknowns(cycle.state, [cycle.value])
    point = yield from first_point(problem_of(family), u, Settings())
    found = []
    for way in () if point is None else (opposite(point), point):
        half = yield from half_branch(family, way, cycle.value - away, cycle.value + away, Settings())
        found += [one for one in half.bifurcations if one.kind == HOPF]
    if not found:
        return cycle
    one = min(found, key=lambda one: abs(one.point.u[-1] - u[-1]))
    return End(HOPF, float(family.values(one.point.u)[0]), one.bracket, 0, family.state(one.point.u))


def _towards(start: Start, target: float) -> Steps[Branch | None]:
    found = yield from first_of(start, TRACE)
    if found is None:
        return None
    family, point = found
    if n_unstable(point) and family.period != start.family.period:
        # just beyond a doubling the orbit of half the period, which is not stable, is as near as the errors
        family, longer = start.family, (yield from first_point(problem_of(start.family), start.unknowns, TRACE))
        point = longer or point
    if n_unstable(point) == 0 and (there := (yield from _at_once(family, point, target))) is not None:
        return Branch(family, [point, there], [], ("start", "bound"))
    # the starting orbit lies on no bound: its value is known up to rounding
    low, high = sorted((2.0 * start.value - target, target))
    half = yield from half_branch(family, point if target > start.value else opposite(point), low, high, TRACE)
    return Branch(family, half.trace.points, half.bifurcations, ("start", half.trace.end))


def _at_once(family: Family, point: Point, target: float) -> Steps[Point | None]:
    """Return the stable orbit at a value of the parameter to which one step along the tangent leads; None if the
    tangents of both orbits do not lead to each other.
    """
    near = 0.1  # largest error of a step along a tangent, in units of the step
    move = target / family.scales[0] - point.u[-1]
    there, step = None, _step(point, move)
    if step is not None:
        there = yield from at_value(family, point.u + step)
    back = None if there is None or n_unstable(there) else _step(there, -move)
    if there is None or step is None or back is None:
        return None
    errors = np.linalg.norm(there.u - point.u - step), np.linalg.norm(point.u - there.u - back)
    return there if max(errors) <= near * np.linalg.norm(step) else None


def _step(point: Point, move: float) -> np.ndarray | None:
    """Return the step along the tangent that moves the parameter by so much; None where the tangent is too steep."""
    longest = 0.3  # scaled
    if abs(point.tangent[-1]) < abs(move) / longest:
        return None
    return np.asarray(point.tangent * (move / point.tangent[-1]))


def _lost(branch: Branch) -> list[Bifurcation]:
    """Return the bifurcations at which a stable branch ceases to be, or turns back as at a pitchfork."""
    back = branch.ends[1] == "bound" and (branch.values[-1] - branch.values[0]) * branch.points[0].tangent[-1] < 0.0
    return [
        one
        for one in branch.bifurcations
        if one.n_unstable_before == 0 and (one.n_unstable_after > 0 or (back and one.kind in (BRANCHING, FOLD)))
    ]


def _end(branch: Branch | None, target: float) -> End:
    if branch is None:
        return End(UNDECIDED, why="Newton's method finds no orbit there")
    family, last, end = branch.family, branch.points[-1], branch.ends[1]
    lost = _lost(branch)
    if n_unstable(branch.points[0]):
        return End(UNDECIDED, why="the orbit on which cells end is not stable")
    if (halved := _halved(branch, lost[0] if lost else None)) is not None:
        return halved
    if lost:
        one = lost[0]
        value = float(family.values(one.point.u)[0])
        return End(one.kind, value, one.bracket, family.period, family.state(one.point.u))
    value = float(family.values(last.u)[0])
    if end == "bound" and abs(value - target) < 0.5 * abs(target - branch.values[0]):
        return End(LIVES_ON, value, 0.0, family.period, family.state(last.u))
    if end == "period_halving":
        state, value = half_orbit(family, last)
        step = abs(family.values(last.u)[0] - family.values(branch.points[-2].u)[0])
        return End(DOUBLING, value, float(step), family.period // 2, state)
    if end in LIMITS:
        limit = branch.limits[1]
        assert limit is not None
        return End(end, limit.value, limit.error, family.period, limit.states[0])
    if end in WHAT:
        return End(WHAT[end], value, abs(value - float(branch.values[-2])), family.period, family.state(last.u))
    return _touch(branch) or End(UNDECIDED, value, np.nan, family.period, family.state(last.u), why=_why(branch))


def _halved(branch: Branch, lost: Bifurcation | None) -> End | None:
    """Return the end of an orbit that shrinks onto one of half its period: where it turns back there, or where a step
    led along the shorter orbit.
    """
    family, points = branch.family, branch.points
    if not family.period or family.period % 2:
        return None
    merged = 0.01  # of the first distance between section points half a period apart
    first = np.linalg.norm(half_way(family, points[0]))
    last = len(points) if lost is None else lost.after + 1
    passed = (k for k in range(1, last) if np.linalg.norm(half_way(family, points[k])) < merged**2 * first)
    if (k := next(passed, -1)) > 0:
        state, value = half_orbit(family, points[k - 1])
        return End(DOUBLING, value, abs(float(branch.values[k]) - value), family.period // 2, state)
    if lost is not None and np.linalg.norm(half_way(family, lost.point)) < merged * first:
        state, value = half_orbit(family, lost.point)
        return End(DOUBLING, value, lost.bracket, family.period // 2, state)
    return None


def _touch(branch: Branch) -> End | None:
    """Return the end of an orbit that begins to touch a surface of impacts or switches."""
    family, n = branch.family, len(branch.points)
    states = np.array([family.state(point.u) for point in branch.points])[:, None]
    nodes, stable = np.full(n, -1), np.ones(n - 1, bool)
    line = Line(0, family.period, branch.values, states, nodes, nodes, stable, branch.ends)
    found = grazing_of(line, n - 1, family)
    return None if found is None else End(found[0], found[1], found[2], family.period, states[-1, 0], found[3])


def _why(branch: Branch) -> str:
    name = branch.family.free[0]
    value = float(branch.values[-1])
    reasons = {
        "stuck": "Newton's method finds no next orbit",
        "max_points": "the branch has as many points as it may",
        "closed": "the branch closes",
        "bound": "the branch turns back without a bifurcation",
        "unstable": "the branch loses its stability where no bifurcation could be located",
    }
    return f"{reasons.get(branch.ends[1], branch.ends[1])} at {name} = {value:.9g}"


def beside_all(places: Sequence[tuple[Family, np.ndarray, tuple[float, float]]]) -> list[list[End]]:
    """Follow the stable orbits that begin at bifurcations, along one parameter up to the bounds given with each.

    Parameters
    ----------
    places
        Family of the orbits at the bifurcation, their unknowns, and the values of the parameter on both sides.

    Returns
    -------
    list of list of End
        Of each bifurcation the ends of the stable orbits beside it, see `follow_all`.
    """
    return [
        [_end(branch, target) for branch, target in found]
        for found in run_together([_beside(*place) for place in places])
    ]


def _beside(family: Family, u: np.ndarray, bounds: tuple[float, float]) -> Steps[list[tuple[Branch, float]]]:
    """Follow both parts of the branch through a bifurcation; return those that begin as stable orbits."""
    problem = problem_of(family)
    value = yield Query(problem, u)
    point = (yield from correct(problem, u, kernel_of(value), TRACE)) if value.is_finite else None
    found = []
    for way in () if point is None else (opposite(point), point):
        half = yield from half_branch(family, way, *bounds, TRACE, from_bifurcation=True)
        points = half.trace.points
        if len(points) > 2 and not n_unstable(points[1]):
            passed = [replace(one, after=one.after - 1) for one in half.bifurcations if one.after]
            branch = Branch(family, points[1:], passed, ("start", half.trace.end))
            found.append((branch, bounds[int(branch.values[-1] > branch.values[0])]))
    return found
