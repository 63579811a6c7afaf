"""Follow one branch of periodic orbits from a given orbit to both of its ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from magpend_core.poincare import Section
from pipeline.analysis.branches.arclength import Point, Settings, Trace, correct, crawls, kernel_of, trace
from pipeline.analysis.branches.bifurcations import Bifurcation, Watch, n_unstable, settle_sides
from pipeline.analysis.branches.kinds import FOLD, LIMITS
from pipeline.analysis.branches.lockstep import Query, Steps
from pipeline.analysis.branches.problems import EquilibriumProblem, Family, OneParameter, OrbitProblem, Problem
from pipeline.analysis.branches.resting import RestSettings, last_orbit, saddles_near
from pipeline.analysis.branches.steep_orbits import (
    CutProblem,
    cut_doubled,
    cut_where_steep,
    is_divided,
    is_small,
    is_steep,
    is_steeper,
    whole_orbit,
)
from pipeline.analysis.branches.strobe import other_side

ENDS = (
    *("bound", "closed", "period_halving", "max_points", "stuck", "start", "equilibrium", "tangent", "other_section"),
    *LIMITS,
    "unstable",
)
"""Reasons why a branch ends: ``tangent`` where its cycles touch the section, ``other_section`` where it goes on as
a branch on another section, ``homoclinic`` and ``snic`` where their period grows without bound, ``unstable`` beyond a
stable part where no more is followed."""


_MORE_CUTS = "more_cuts"
"""End of a part of a branch of cut orbits, where they need more cuts."""


def problem_of(family: Family) -> OneParameter:
    """Return the equations of a family of orbits or equilibria, as a new problem for one computation."""
    return OrbitProblem(family) if family.period else EquilibriumProblem(family)


def leading_of(eigenvalues: np.ndarray) -> tuple[complex, complex]:
    """Return the unstable and the stable eigenvalue of a saddle that are nearest to the imaginary axis."""
    unstable, stable = (eigenvalues[sign * eigenvalues.real > 0.0] for sign in (1.0, -1.0))
    return complex(unstable[np.argmin(unstable.real)]), complex(stable[np.argmax(stable.real)])


@dataclass(frozen=True, eq=False)
class Limit:
    """End of a branch of limit cycles whose period grows without bound, at an equilibrium."""

    kind: str  # of `LIMITS`
    value: float  # limit of the parameter
    error: float  # of this value
    states: np.ndarray  # equilibria at which the cycles come to rest, (rest, state); several by symmetry
    eigenvalues: np.ndarray  # of the first of them [1/s], by falling real part
    # slope of the period over -ln|p - p_h| [s], or over 1/sqrt|p - p_h| at a saddle node on a circle
    slope: float  # fitted to the periods of the branch
    slope_error: float
    expected: float  # computed from the equilibria


@dataclass(eq=False)
class Branch:
    """A branch: orbits of one period, or equilibria, along one parameter."""

    family: Family  # period, system and parameters of the orbits
    points: list[Point]  # orbits in order
    bifurcations: list[Bifurcation]  # located bifurcations in the order of the points
    # reasons for the first and the last end, of `ENDS`; ``start`` stands for the bifurcation at its origin
    ends: tuple[str, str]
    origin: Bifurcation | None = None  # bifurcation from which it branches
    limits: tuple[Limit | None, Limit | None] = (None, None)  # of the ends named in `LIMITS`

    def __post_init__(self) -> None:
        settle_sides(self.points, self.bifurcations)

    @property
    def values(self) -> np.ndarray:
        """Parameter values at the points of the branch."""
        return np.array([self.family.values(p.u)[0] for p in self.points])


@dataclass(eq=False)
class Half:
    """One half of a branch: the points and bifurcations in one direction from its start."""

    trace: Trace
    bifurcations: list[Bifurcation] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Stop:
    """Rule that ends a branch at a parameter bound, when it closes, at an equilibrium or at a period halving, or
    `beyond` points after it was stable.
    """

    family: Family
    low: float
    high: float
    beyond: int = 0
    may_close: bool = True

    def __call__(self, points: list[Point]) -> str:
        here = points[-1]
        if not self.low <= self.family.values(here.u)[0] <= self.high:
            return "bound"
        if self.may_close and self._is_closed(points):
            return "closed"
        if self.family.period and (end := end_of_crossings(self.family, here)):
            return end
        if len(points) > 2 and has_halved(self.family, points):
            return "period_halving"
        last = points[-self.beyond :] if self.beyond else []
        return "unstable" if len(last) == self.beyond > 0 and all(map(n_unstable, last)) else ""

    def _is_closed(self, points: list[Point]) -> bool:
        """Return whether the last step of a branch came back to the branch's start, at any section point of the
        orbit.
        """
        if len(points) < 5:
            return False
        first, before, here = points[0], points[-2], points[-1]
        if first.tangent[-1] * here.tangent[-1] <= 0.0 and abs(first.tangent[-1]) > 0.2:
            return False
        step = here.u - before.u
        for image in first.value.images:
            offset = self._difference(image, first.u[-1], before.u)
            share = float(offset @ step) / float(step @ step)
            away = np.linalg.norm(offset - share * step)
            if 0.0 < share <= 1.0 and away < 0.05 * np.linalg.norm(step):
                return True
        return False

    def _difference(self, state: np.ndarray, parameter: float, u: np.ndarray) -> np.ndarray:
        return np.append(self.family.mismatch(u, state), parameter - u[-1])


def end_of_crossings(family: Family, point: Point) -> str:
    """Return why a limit cycle cannot be followed on its Poincare section: ``tangent`` or ``equilibrium``; empty if it
    can be.
    """
    # crossing speed times the period below which a branch may end, and the largest such product of a state that is at
    # rest there [scales of the states]
    touching, rest = 0.01, 0.5
    # least crossing speed times the period, in units of the cycle's extent across the section, of a cycle that shrinks:
    # pi on an ellipse whose centre is on the section, much less where a large cycle touches it or passes a saddle
    shrinks = 0.5
    if family.system.section is None:
        return ""
    across, most = _reach(family, point)
    if across >= touching:
        return ""
    if most >= rest:
        return "tangent"
    if abs(across) >= shrinks * _extent(family, point):
        return "equilibrium"
    return "tangent" if across * rest < touching * most else ""


def _reach(family: Family, point: Point) -> tuple[float, float]:
    """Return the crossing speed of a cycle times its period, positive in the section's direction, and the largest such
    product of all states [scales of the states].
    """
    (speed,), (rates,) = family.crossing_speeds(point.u[None])
    return float(speed * point.value.seconds), float(np.abs(rates * point.value.seconds).max())


def _extent(family: Family, point: Point) -> float:
    """Return the extent of a cycle across the section [scales of the states]."""
    rows = family.rows(point.u[None])
    (normal,), _ = Section(family.system).scaled_normals(rows.states, rows.parameters)
    states = last_orbit(family, point, RestSettings())
    return float(np.ptp(states / np.asarray(family.system.scales) @ normal))


def has_halved(family: Family, points: list[Point]) -> bool:
    """Return whether the last step of a branch passed an orbit of half the period."""
    # largest distance between an orbit's section points half a period apart, at two neighbouring points of a branch, at
    # which the branch may pass through the orbit of half the period: scaled, and in units of the step between the two
    near_half, passed = 0.2, 4.0
    if not family.period or family.period % 2 or len(points) < 2:
        return False
    before, here = (half_way(family, p) for p in points[-2:])
    near = max(near_half, passed * float(np.linalg.norm(points[-1].u - points[-2].u)))
    return bool(float(before @ here) < 0.0 and max(np.linalg.norm(before), np.linalg.norm(here)) < near)


def half_way(family: Family, point: Point) -> np.ndarray:
    """Return the scaled distance to the section point half a period later."""
    return family.mismatch(point.u, point.value.images[family.period // 2 - 1])


def half_orbit(family: Family, point: Point) -> tuple[np.ndarray, float]:
    """Return a section point and the parameter value of the orbit of half the period that a branch has nearly
    reached.
    """
    u = point.u.copy()
    u[:-1] += 0.5 * half_way(family, point)
    return family.state(u), float(family.values(u)[0])


def first_point(problem: Problem, u: np.ndarray, settings: Settings) -> Steps[Point | None]:
    """Refine an orbit at a fixed parameter value, and direct its tangent to rising parameter values."""
    normal = np.zeros(problem.size)
    normal[-1] = 1.0
    found = yield from correct(problem, u, normal, settings)
    if found is None:
        return None
    tangent = kernel_of(found.value)
    return Point(found.u, tangent * (1.0 if tangent[-1] >= 0.0 else -1.0), found.value, found.n_iterations)


def half_branch(
    family: Family,
    start: Point,
    low: float,
    high: float,
    settings: Settings,
    from_bifurcation: bool = False,
    tell: Callable[[Bifurcation], None] = lambda _: None,
    single: Point | None = None,
) -> Steps[Half]:
    """Follow a branch from a point in one direction to its end. If the last point is beyond a parameter bound, move it
    onto the bound. `tell` is called with each bifurcation as soon as it is located. At a period doubling, `single` is
    the orbit of half the period.
    """
    if not family.period:
        settings = replace(settings, longest_step=settings.longest_at_rest)
    problem = problem_of(family)
    watch = Watch(problem, settings, from_bifurcation, tell=tell, halves=lambda *step: has_halved(family, [*step]))
    stop = _Stop(family, low, high, settings.beyond)
    found = yield from trace(
        problem,
        start,
        settings,
        lambda points: stop(points) or ("stuck" if leads_nowhere(family, points) else ""),
        watch.between,
        lambda here: beyond_strobe(problem, here, settings),
    )
    steep = yield from _past_steep(family, found, watch, stop, settings, single)
    n_last = len(found.points) - 2
    if found.end == "bound":
        own: Problem = problem if steep is None else steep[0]
        before, beyond = found.points[-2:] if steep is None else steep[1]
        on_it = yield from _cut(own, family, before, beyond, (low, high), settings)
        found.points.pop()
        if on_it is not None:
            found.points.append(on_it if steep is None else steep[0].plain(on_it))
        inside = [low <= family.values(b.point.u)[0] <= high for b in watch.found]
        watch.found = [b for b, good in zip(watch.found, inside, strict=True) if good]
    elif found.end == "equilibrium":
        # the map is not smooth where the orbit shrinks to a point of the section
        watch.found = [b for b in watch.found if b.after < n_last]
    elif found.end == "period_halving":
        # the half-period orbit is a singular point of these equations: drop what was located there
        found.points.pop()
        watch.found = [b for b in watch.found if b.after < n_last]
    elif found.end == "tangent" and _reach(family, found.points[-1])[0] < 0.0:
        # cut orbits have passed the touch: the last one starts where it crosses the section against its direction
        found.points.pop()
        watch.found = [b for b in watch.found if b.after < n_last]
    elif found.end == "closed":
        # the last step repeats the first one
        watch.found = [b for b in watch.found if b.after < n_last or not _is_known(b, watch.found)]
    return Half(found, watch.found)


def leads_nowhere(family: Family, points: list[Point]) -> bool:
    """Return whether a branch crawls. One that may be followed on with cuts is left soon; the others may come nearer to
    what stops them, such as a touch. Those whose period grows are followed, for its law.
    """
    soon, late = 20, 100  # steps
    return crawls(points, soon if is_steep(points[-1], family) else late) and not _nears_rest(points)


def _past_steep(
    family: Family, found: Trace, watch: Watch, stop: _Stop, settings: Settings, single: Point | None
) -> Steps[tuple[CutProblem, list[Point]] | None]:
    """Follow a branch on by multiple shooting where it is stuck since its orbits are steep; in place. A doubled branch
    that is stuck beside its doubling begins there anew, as its points are too near to each other to tell its direction.

    Returns the last equations with the last points in their unknowns; None if the branch is not followed on.
    """
    last: tuple[CutProblem, list[Point]] | None = None
    is_cut = found.end == "stuck" and _may_be_cut(family, found.points)
    if single is not None and not _is_beside(found.points[-1], found.points[0], settings):
        single = None
    if is_cut and single is not None:
        found.points[1:], watch.found = [], []
    while is_cut:
        begins = single if last is None else None
        if begins is not None:
            cut = yield from cut_doubled(replace(family, period=family.period // 2), begins, settings)
        else:
            problem, u = whole_orbit(family, found.points[-1]) if last is None else (last[0], last[1][-1].u)
            cut = yield from cut_where_steep(problem, u, found.points[-1].tangent, settings)
        found.end = "stuck"
        if cut is None:
            break
        problem, start = cut
        if last is None and not (is_steep(found.points[-1], family) or is_divided(problem)):
            break  # the period grows, but not on a canard
        if begins is not None:
            # a section point does not tell canards apart, and a doubled branch comes back to its start by halving
            found.points, stop = [problem.plain(start)], replace(stop, may_close=False)
        own = Watch(problem, settings, begins is not None, n_steps=len(found.points) - 1, halves=_halves(problem))
        n_left = settings.max_points - len(found.points) + 1
        rest = replace(settings, max_points=n_left, longest_step=settings.longest_cut)
        piece = yield from trace(problem, start, rest, _StopCut(problem, stop, found.points), own.between)
        found.end, is_cut = piece.end.replace(_MORE_CUTS, "stuck"), piece.end == _MORE_CUTS
        watch.found += [replace(one, point=problem.plain(one.point)) for one in own.found]
        last = problem, piece.points[-2:]
    return last


def _halves(problem: CutProblem) -> Callable[[Point, Point], bool]:
    """Return `has_halved` for a step of cut orbits."""
    return lambda a, b: has_halved(problem.family, [problem.plain(a), problem.plain(b)])


def _is_beside(point: Point, start: Point, settings: Settings) -> bool:
    """Return whether a branch is no further from its start than its first step leads."""
    return bool(np.linalg.norm(point.u - start.u) < settings.first_step)


@dataclass(frozen=True, eq=False)
class _StopCut:
    """Rule that ends a part of a branch whose orbits are cut, as `stop` does or where they need more cuts.

    It adds the points to `points`, those of the branch so far in the unknowns of `OrbitProblem`.
    """

    problem: CutProblem
    stop: _Stop
    points: list[Point]

    def __call__(self, points: list[Point]) -> str:
        self.points.append(self.problem.plain(points[-1]))
        end = self.stop(self.points)
        if end == "equilibrium" and not is_small(points[-1]):
            return "tangent"
        if not end and (crawls(points) or _nears_saddle(self.stop.family, self.points)):
            return "stuck"
        return end or (_MORE_CUTS if is_steeper(points[-1]) else "")


def _may_be_cut(family: Family, points: list[Point]) -> bool:
    """Return whether a branch may go on with its orbits in segments: they are limit cycles that are steep, or whose
    period grows as near a canard.
    """
    if not family.period or family.system.section is None:
        return False
    return (is_steep(points[-1], family) or _nears_rest(points)) and not _nears_saddle(family, points)


def _nears_rest(points: list[Point]) -> bool:
    """Return whether the period grows towards the end of a branch as if without bound."""
    return grows_without_bound(np.array([p.u for p in points]), np.array([p.value.seconds for p in points]))


def _nears_saddle(family: Family, points: list[Point]) -> bool:
    """Return whether the period grows as if without bound towards the end of a branch, and a saddle is near: no cuts
    lead on. Near a canard the period grows as well.
    """
    if not _nears_rest(points):
        return False
    settings = RestSettings()
    return len(saddles_near(family, points[-1], last_orbit(family, points[-1], settings), settings)[0]) > 0


def grows_without_bound(unknowns: np.ndarray, seconds: np.ndarray) -> bool:
    """Return whether the period grows towards the end of a branch as it does towards infinity.

    The slope of the period along the branch must rise towards the end, by a large factor, and the growth
    that this takes must not fade.

    Parameters
    ----------
    unknowns
        Section points and parameter values, scaled, shape (point, unknown), in order to the end.
    seconds
        Period at the points, shape (point,) [s].
    """
    # natural logarithm of the factor by which the period's slope along the branch rises, if the period grows without
    # bound; and the least growth of the period over the second half of this rise, in units of that over the first half.
    # Towards a homoclinic orbit both are equal, since the period grows by the same time whenever the distance in the
    # parameter halves. Towards an end with a finite period, as at a square root, the second is many times less.
    steeper, keeps_growing = 6.0, 0.6
    growth, middle = np.diff(seconds), 0.5 * (seconds[1:] + seconds[:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        steepness = np.log(growth / np.linalg.norm(np.diff(unknowns, axis=0), axis=1))
    rises = np.isfinite(steepness) & (growth > 0.0)
    rises[:-1] &= steepness[1:] > steepness[:-1]
    first = len(rises) - int(np.argmin(np.append(rises[::-1], False)))
    steepness, middle = steepness[first:], middle[first:]
    far = np.flatnonzero(steepness[-1:] - steepness >= steeper)
    if len(steepness) < 3 or not len(far):
        return False
    begin = min(int(far[-1]), len(steepness) - 3)
    ends = np.array([steepness[begin], 0.5 * (steepness[begin] + steepness[-1]), steepness[-1]])
    first_half, second_half = np.diff(np.interp(ends, steepness, middle))
    return bool(second_half >= keeps_growing * first_half)


def beyond_strobe(problem: OneParameter, here: Point, settings: Settings) -> Steps[tuple[Point, Point] | None]:
    """Return the last point of a branch and the next one, both on the other side of an impact that coincides with the
    strobe; None if there is no such impact.
    """
    behind = here.u - settings.across * settings.shortest_step * here.tangent
    beyond = [_other_unknowns(problem.family, u) for u in (here.u, behind)]
    if beyond[0] is None or beyond[1] is None:
        return None
    along = beyond[0] - beyond[1]
    # the instant of the impact must be passed, by as short a step as can be
    for longer in range(1, round(settings.first_step / np.linalg.norm(along)) + 1):
        guess = beyond[0] + longer * along
        found = yield from correct(problem, guess, along / np.linalg.norm(along), settings)
        if found is not None and np.linalg.norm(found.u - guess) < 0.5 * longer * np.linalg.norm(along):
            return Point(beyond[0], here.tangent, here.value, 0), found
    return None


def _other_unknowns(family: Family, u: np.ndarray) -> np.ndarray | None:
    """Return the unknowns of an orbit with its section point on the other side of an impact at the strobe."""
    if not family.period:
        return None
    rows = family.rows(u[None])
    state = other_side(family.system, rows.states[0], rows.parameters[0], float(rows.frequency_hz[0]), family.period)
    return None if state is None else family.unknowns(state, family.values(u))


def _is_known(one: Bifurcation, found: list[Bifurcation]) -> bool:
    return any(
        b.kind == one.kind and b.after < one.after and abs(b.point.u[-1] - one.point.u[-1]) < 1e-6 for b in found
    )


def _cut(
    problem: Problem, family: Family, before: Point, beyond: Point, bounds: tuple[float, float], settings: Settings
) -> Steps[Point | None]:
    """Return the solution on a parameter bound, between a point and the next one, which is beyond the bound; None if
    it is the first of them, or Newton's method fails.
    """
    low, high = bounds
    values = [family.values(p.u)[0] for p in (before, beyond)]
    bound = low if values[1] < low else high
    share = (bound - values[0]) / (values[1] - values[0])
    normal = np.zeros(problem.size)
    normal[-1] = 1.0
    guess = before.u + share * (beyond.u - before.u)
    guess[-1] = bound / family.scales[0]
    on_it = yield from correct(problem, guess, normal, settings, along=before.tangent)
    return on_it if share > 1e-9 else None


def joined(family: Family, backward: Half, forward: Half) -> Branch:
    """Join the two halves of a branch, followed from one start in both directions."""
    if forward.trace.end == "closed":
        return Branch(family, forward.trace.points, forward.bifurcations, ("closed", "closed"))
    back = [Point(p.u, -p.tangent, p.value, p.n_iterations) for p in reversed(backward.trace.points)]
    n = len(back) - 1
    turned = [
        replace(
            b,
            point=opposite(b.point),
            n_unstable_before=b.n_unstable_after,
            n_unstable_after=b.n_unstable_before,
            rises_before=b.rises_before != (b.kind != FOLD),
            after=n - 1 - b.after,
        )
        for b in reversed(backward.bifurcations)
    ]
    for one in forward.bifurcations:
        one.after += n
    return Branch(
        family, back + forward.trace.points[1:], turned + forward.bifurcations, (backward.trace.end, forward.trace.end)
    )


def opposite(point: Point) -> Point:
    """Return the same point of a solution curve with its tangent reversed."""
    return Point(point.u, -point.tangent, point.value, point.n_iterations)


def doubled_start(family: Family, at: Bifurcation) -> Steps[Point | None]:
    """Return the start of the doubled branch at a period doubling: the same orbit traversed twice, with the new
    branch's tangent.
    """
    value = yield Query(OrbitProblem(replace(family, period=2 * family.period)), at.point.u)
    if not value.is_finite:
        return None
    matrix = family.scaled(at.point.value.monodromy)
    multipliers, vectors = np.linalg.eig(matrix)
    direction = vectors[:, np.argmin(np.abs(multipliers + 1.0))].real
    tangent = np.append(direction / np.linalg.norm(direction), 0.0)
    return Point(at.point.u, tangent, value, 0)


def crossing_half(
    family: Family, at: Bifurcation, own: np.ndarray, way: float, low: float, high: float, settings: Settings
) -> Steps[Half]:
    """Follow the second branch through a branch point in one direction.

    At a branch point the derivative's kernel has two dimensions, and the other branch's tangent lies in it.
    The known branch does not meet a plane at a small distance along the kernel's normal to it, so Newton's
    method in this plane finds the other branch. `own` is the direction of the known branch from its
    neighbouring points, since rounding errors determine the tangent at the branch point itself.
    """
    kernel = np.linalg.svd(at.point.value.derivative)[2][-2:]
    own = kernel @ own
    normal = kernel.T @ np.array([-own[1], own[0]])
    normal *= way / np.linalg.norm(normal)
    start = Point(at.point.u, normal, at.point.value, 0)
    problem = problem_of(family)
    # at a pitchfork the parameter stands still
    level = kernel.T @ np.array([-kernel[1, -1], kernel[0, -1]])
    slanted = float(level @ normal)
    ways = ([level / slanted] if abs(slanted) > 0.1 * np.linalg.norm(level) else []) + [normal]
    for step, direction in product(settings.first_step * np.array(settings.crossing_steps), ways):
        first = yield from correct(problem, at.point.u + step * direction, normal, settings)
        # far away the plane meets the known branch again
        if first is not None and np.linalg.norm(first.u - at.point.u) < settings.near_crossing * step:
            found = yield from half_branch(family, first, low, high, settings)
            found.trace.points.insert(0, start)
            for one in found.bifurcations:
                one.after += 1
            return found
    return Half(Trace([start], "stuck"))
