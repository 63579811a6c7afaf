"""Follow curves of homoclinic orbits in the plane of two parameters, from the ends of branches of cycles.

On a curve, with the saddle's leading eigenvalues l_u > 0 > l_s (Champneys and Kuznetsov, Int. J. Bifurcation Chaos 4,
1994, 785):

=========================== ==================================================================================
point                       where
=========================== ==================================================================================
``neutral_saddle``          the saddle quantity l_u + l_s vanishes: the cycles change their stability
``bogdanov_takens``         both eigenvalues vanish, and the orbit shrinks to a point: the curve ends
``saddle_node_homoclinic``  one of them vanishes: the saddle meets a node, on the fold curve of the equilibria; the
                            curve ends, and beyond it the cycles end at saddle nodes on a circle
=========================== ==================================================================================

Both parameters are carried on to the end of the curve by polynomials of the eigenvalue that vanishes. The curve also
ends where the orbit comes near another equilibrium: ``heteroclinic``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import xarray as xr

from magpend_core.equilibria import find_equilibria
from magpend_core.models.model import Parameters
from magpend_core.orbits import wrap_angles
from magpend_core.pointwise import jacobian_at, rates_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point, Settings, correct, trace
from pipeline.analysis.branches.bifurcations import find_root
from pipeline.analysis.branches.center_manifold import Rest
from pipeline.analysis.branches.codimension_two import BT, NEUTRAL, NONCENTRAL, SpecialPoint
from pipeline.analysis.branches.equilibrium_curves import SINGULAR
from pipeline.analysis.branches.following import leading_of, opposite
from pipeline.analysis.branches.homoclinic import (
    HomoclinicProblem,
    HomoclinicSettings,
    Loop,
    homoclinic_point,
    lay_nodes,
    loop_of,
)
from pipeline.analysis.branches.kinds import HOMOCLINIC, SNIC
from pipeline.analysis.branches.lockstep import Steps, run_together, within
from pipeline.analysis.branches.problems import Family
from pipeline.results.tabular import words_of
from pipeline.results.tolerances import BRANCH_RTOL

HETEROCLINIC = "heteroclinic"
"""End of a curve of homoclinic orbits near another equilibrium."""


Bounds = tuple[tuple[float, float], tuple[float, float]]
"""Intervals of both parameters."""


@dataclass(frozen=True, eq=False)
class HomoclinicCurve:
    """Curve of homoclinic orbits: its points as equilibria of two parameters, the reasons for its ends."""

    family: Family
    points: list[Point]
    ends: tuple[str, str]
    special: list[SpecialPoint]
    n_missed: int
    middle: np.ndarray  # (n_states,): mean distance of the first orbit from its saddle [scaled]


@dataclass(eq=False)
class Arm:
    """One direction of a curve of homoclinic orbits: its points as equilibria of two parameters, and its end."""

    points: list[Point] = field(default_factory=list)
    special: list[SpecialPoint] = field(default_factory=list)
    end: str = ""
    n_missed: int = 0


def follow_homoclinic(
    problem: HomoclinicProblem,
    start: Point,
    bounds: Bounds,
    settings: HomoclinicSettings = HomoclinicSettings(),
    takens: SpecialPoint | None = None,
) -> Steps[Arm]:
    """Follow homoclinic orbits in the plane of two parameters in the direction of the tangent of a start.

    Points of the arm have the saddle as their state. Its end is ``bound``, ``closed``, ``max_points``, ``budget``,
    ``stuck``, ``bogdanov_takens`` and ``saddle_node_homoclinic`` where leading eigenvalues vanish, or ``heteroclinic``
    where the orbit comes near another saddle. Neutral saddles and these ends are among its special points. `takens` is
    the Bogdanov-Takens point from which the start was predicted.
    """
    arm = Arm([as_rest(problem, start)])
    if (yield from within(settings.to_follow, _along(arm, problem, start, bounds, settings, takens))) is None:
        arm.end = "budget"
    if arm.end == BT and takens is not None and _nears(takens, arm.points):
        _end_at(takens, problem.family, arm)
    elif arm.end in (BT, NONCENTRAL):
        _carry_on(problem.family, arm)
    return arm


def _along(
    arm: Arm,
    problem: HomoclinicProblem,
    here: Point,
    bounds: Bounds,
    settings: HomoclinicSettings,
    takens: SpecialPoint | None,
) -> Steps[Arm]:
    """Add points to one arm of a curve of homoclinic orbits until it ends."""
    step = settings.first_step
    while not arm.end:
        watch = _Watch(problem, settings, bounds, arm, takens)
        size = np.full(problem.size, max(1.0, problem.extent))
        size[-3:] = 1.0  # time and parameters
        rest = replace(settings, first_step=step, max_points=settings.at_once, size=size)
        found = yield from trace(problem, here, rest, watch.stop, watch.between)
        if found.end != "max_points" or len(arm.points) >= settings.max_points:
            arm.end = found.end
            break
        before, here = found.points[-2:]
        step = float(np.linalg.norm(here.u - before.u))
        if meets_another(loop_of(problem, here.u, settings)):
            arm.end = HETEROCLINIC
        elif (laid := (yield from _laid_anew(problem, here, settings))) is None:
            arm.end = "stuck"
        else:
            problem, here = laid
    return arm


def _laid_anew(
    problem: HomoclinicProblem, here: Point, settings: HomoclinicSettings
) -> Steps[tuple[HomoclinicProblem, Point] | None]:
    """Distribute the nodes of an orbit anew, and carry the curve's direction over to them."""
    laid = lay_nodes(loop_of(problem, here.u, settings), settings.cuts[0], settings)
    if laid is None:
        return None
    fresh, u = laid
    n = problem.system.n_states
    normal = np.zeros(fresh.size)
    normal[-n - 3 :] = here.tangent[-n - 3 :]
    normal /= np.linalg.norm(normal)
    found = yield from correct(fresh, u, normal, settings)
    return None if found is None else (fresh, found)


@dataclass(eq=False)
class _Watch:
    """Rule that ends a curve of homoclinic orbits, and detector of its neutral saddles."""

    problem: HomoclinicProblem
    settings: Settings
    bounds: Bounds
    arm: Arm
    takens: SpecialPoint | None

    def stop(self, points: list[Point]) -> str:
        here = as_rest(self.problem, points[-1])
        if not self._is_inside(here):
            return "bound"
        self.arm.points.append(here)
        if self.takens is not None and _nears(self.takens, self.arm.points):
            return BT
        return vanished(self.arm.points) or ("closed" if _is_closed(self.arm.points) else "")

    def _is_inside(self, rest: Point) -> bool:
        values = self.problem.family.values(rest.u)
        return all(low <= v <= high for v, (low, high) in zip(values, self.bounds, strict=True))

    def between(self, a: Point, b: Point) -> Steps[bool]:
        """Locate a neutral saddle between two points; refuse a step on which the saddle is lost."""
        before, after = saddle_quantity(a.value.monodromy), saddle_quantity(b.value.monodromy)
        if not np.isfinite(after):
            return False
        if before * after < 0.0:
            ends = yield from find_root(self.problem, (a, before), (b, after), _neutral, self.settings)
            if ends is None:
                self.arm.n_missed += 1
                return True
            (low, at_low), (high, at_high) = ((as_rest(self.problem, point), value) for point, value in ends)
            family = self.problem.family
            bracket = np.abs(family.values(high.u) - family.values(low.u))
            nearest = low if abs(at_low) <= abs(at_high) else high
            if self._is_inside(nearest):
                self.arm.special.append(SpecialPoint(NEUTRAL, family, nearest, bracket))
        return True


def _neutral(point: Point) -> Steps[float]:
    yield from ()  # it asks for nothing
    return saddle_quantity(point.value.monodromy)


def saddle_quantity(jacobian: np.ndarray) -> float:
    """Return the sum of the real parts of a saddle's leading eigenvalues [1/s]; NaN if it is no saddle."""
    values = np.linalg.eigvals(jacobian)
    if not values.real.min() < 0.0 < values.real.max():
        return float("nan")
    return float(sum(one.real for one in leading_of(values)))


def as_rest(problem: HomoclinicProblem, point: Point) -> Point:
    """Return a point of a curve of homoclinic orbits as the equilibrium and its two parameters."""
    n = problem.system.n_states
    keep = [*range(problem.size - n - 3, problem.size - 3), problem.size - 2, problem.size - 1]
    residual = np.array([point.residual])
    return Point(point.u[keep], point.tangent[keep], replace(point.value, residual=residual), point.n_iterations)


def _is_closed(points: Sequence[Point]) -> bool:
    last, before = points[-1].u, points[-2].u
    return len(points) > 5 and bool(np.linalg.norm(last - points[0].u) < 0.7 * np.linalg.norm(last - before))


def _leading(point: Point) -> np.ndarray:
    """Return the sizes of the leading unstable and stable eigenvalue of a saddle [1/s]."""
    return np.array([abs(one.real) for one in leading_of(np.linalg.eigvals(point.value.monodromy))])


def vanished(points: Sequence[Point]) -> str:
    """Return which leading eigenvalues have vanished at the end of a curve: the end's name, or an empty text."""
    vanishes = 0.08  # a leading eigenvalue has vanished if it is below this share of its largest value on the curve
    rates = np.array([_leading(one) for one in points])
    small = rates[-1] < vanishes * rates.max(axis=0)
    if small.all():
        return BT
    return NONCENTRAL if small.any() and rates[-1].min() < vanishes * rates[-1].max() else ""


def meets_another(loop: Loop) -> bool:
    """Return whether a homoclinic orbit comes near another equilibrium than its own."""
    # distance from another equilibrium at which the orbit ends as heteroclinic, in units of the orbit's size
    meets = 1e-3
    family, system = loop.family, loop.family.system
    scales = np.asarray(system.scales)
    packed = family.rows(family.unknowns(loop.saddle, loop.values)[None]).parameters[0]
    away = np.linalg.norm(wrap_angles(loop.states - loop.saddle, system) / scales, axis=1)
    speed = np.linalg.norm(rates_at(system, loop.states, packed) / scales, axis=1)
    inner = (speed[1:-1] < speed[:-2]) & (speed[1:-1] < speed[2:]) & (away[1:-1] > 0.1 * away.max())
    slow = 1 + np.flatnonzero(inner)
    if not len(slow):
        return False
    found = find_equilibria(system, loop.states[slow], packed)
    gaps = np.linalg.norm(wrap_angles(loop.states[slow] - found.states, system) / scales, axis=1)
    return bool((found.converged & (gaps < meets * away.max())).any())


def _nears(takens: SpecialPoint, points: Sequence[Point]) -> bool:
    """Return whether a curve has come near to the Bogdanov-Takens point from which its first point was predicted."""
    nears = 0.1  # distance from it, in units of that of the first point
    first, last = (float(np.linalg.norm(points[k].u[-2:] - takens.point.u[-2:])) for k in (0, -1))
    return last < nears * first


def _end_at(takens: SpecialPoint, family: Family, arm: Arm) -> None:
    """End a curve at the Bogdanov-Takens point from which it was predicted."""
    u = np.concatenate([takens.point.u[: family.system.n_states], takens.point.u[-2:]])
    end = replace(takens.point, u=u, tangent=arm.points[-1].tangent)
    arm.points.append(end)
    arm.special.append(SpecialPoint(BT, family, end, takens.bracket))


def _carry_on(family: Family, arm: Arm) -> None:
    """Carry a curve on to where leading eigenvalues vanish, by polynomials of them through its last points."""
    # range of the vanishing eigenvalue, as a factor, over which both parameters are fitted, and the number of points
    reach, fitted = 6.0, 7
    rates = np.array([_leading(one) for one in arm.points])
    size = rates.mean(axis=1) if arm.end == BT else rates[:, rates[-1].argmin()]
    wanted, falls = size[-1] * np.geomspace(1.0, reach, fitted), int(size.argmax())  # it may have vanished before, too
    chosen = np.unique([falls + int(np.abs(size[falls:] - one).argmin()) for one in wanted])[::-1]
    x, u = size[chosen], np.array([arm.points[k].u for k in chosen])
    last = _at_zero(x, u)
    away = np.array([_at_zero(x[:-1], u[:-1]), _at_zero(x[1:], u[1:])]) - last
    before = arm.points[-1]
    rows = family.rows(last[None])
    value = replace(
        before.value,
        residual=np.abs(away).max(keepdims=True).ravel(),
        images=rows.states,
        monodromy=jacobian_at(family.system, rows.states, rows.parameters[0])[0],
        seconds=np.inf,
    )
    end = Point(last, before.tangent, value, 0)
    arm.points.append(end)
    error = np.abs(away).max(axis=0)[-2:] * np.asarray(family.scales)
    arm.special.append(SpecialPoint(arm.end, family, end, error))


def _at_zero(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the value at 0 of the polynomial through points, by Lagrange's formula."""
    weights = [np.prod([other / (other - own) for other in x if other != own]) for own in x]
    return np.asarray(np.array(weights) @ u)


# ---- starts ------------------------------------------------------------------------------------


def loops_of(branches: xr.Dataset, parameters: Parameters, second: str, bounds: Bounds, max_period: int) -> list[Loop]:
    """Return the last cycles of all branches that end as ``homoclinic``, as approximate homoclinic orbits.

    The value of the second parameter is that of the run's parameters. Bounds are the interval of the branches'
    parameter, and that of the second; cycles of more returns than `max_period` are left out.
    """
    found = []
    for one, end, family in _ends_of(branches, HOMOCLINIC, parameters, second, bounds, max_period):
        last = one.isel(point=(int(one["n_points"]) - 1) * end, phase=0)
        here = float(parameters[second])
        values, limit = np.array([[float(last["parameter"]), here], [float(one["limit_value"][end]), here]])
        saddle = one["limit_state"].values[end, 0]
        found.append(_cycle(family, last["section"].values, values, float(last["period_s"]), saddle, limit))
    return found


def saddle_nodes_of(
    branches: xr.Dataset, parameters: Parameters, second: str, bounds: Bounds, max_period: int
) -> list[tuple[Family, np.ndarray]]:
    """Return the saddle nodes at which branches end as ``snic``: families of equilibria and their unknowns.

    They are folds of equilibria, whose curve goes on also where the saddle node is on no circle. The parameters are
    those of `loops_of`.
    """
    return [
        (family, family.unknowns(rest, [float(one["limit_value"][end]), parameters[second]]))
        for one, end, family in _ends_of(branches, SNIC, parameters, second, bounds, max_period)
        for rest in one["limit_state"].values[end]
        if np.isfinite(rest).all()
    ]


def _ends_of(
    branches: xr.Dataset, kind: str, parameters: Parameters, second: str, bounds: Bounds, max_period: int
) -> Iterator[tuple[xr.Dataset, int, Family]]:
    """Yield the branches that have an end of a kind, the number of this end, and the family of its equilibria."""
    if "limit_value" not in branches or second not in parameters.names:
        return
    names = (str(branches.attrs["parameter"]), second)
    (low, high), (second_low, second_high) = bounds
    for branch, end in np.argwhere(np.isfinite(branches["limit_value"].values)).tolist():
        one = branches.isel(branch=branch)
        code = one[("first_end", "last_end")[end]]
        if words_of(code)[int(code)] == kind and int(one["orbit_period"]) <= max_period:
            own = parameters.replace(**{n: float(one[n]) for n in parameters.names if n in one})
            scales = (high - low, second_high - second_low)
            yield one, end, Family(parameters.model.system, 0, 1.0, own.pack(), names, scales)


def _cycle(
    family: Family, start: np.ndarray, values: np.ndarray, seconds: float, saddle: np.ndarray, limit: np.ndarray
) -> Loop:
    """Return a cycle from where it is nearest to a saddle until it is there again."""
    samples = 8000
    system = family.system
    packed = family.rows(family.unknowns(start, values)[None]).parameters
    times, drive = np.linspace(0.0, seconds, samples), Drive(np.array([seconds]))
    orbit = sample(system, packed, start[None], [times], drives=[drive], **tolerances_at(BRANCH_RTOL)).states[0]
    away = np.linalg.norm(wrap_angles(orbit - saddle, system) / np.asarray(system.scales), axis=1)
    first = int(away[:-1].argmin())
    states = np.concatenate([orbit[first:-1], orbit[: first + 1] + (orbit[-1] - orbit[0])])
    return Loop(family, times, states, saddle, limit)


def homoclinic_curves(
    loops: Sequence[Loop],
    bounds: Bounds,
    settings: HomoclinicSettings = HomoclinicSettings(),
    lost: list[Loop] | None = None,
) -> list[HomoclinicCurve]:
    """Follow homoclinic orbits in both directions in the plane of two parameters, no curve twice.

    Loops are approximate orbits, such as those of `loops_of`, or predictions from Bogdanov-Takens points. Those that
    could not be refined are left out; `lost` gets them, unless another prediction from the same point could be.
    """
    what = "following homoclinic orbits"
    firsts = run_together([within(settings.to_start, homoclinic_point(loop, settings)) for loop in loops], what)
    found: list[HomoclinicCurve] = []
    for k, (loop, first) in enumerate(zip(loops, firsts, strict=True)):
        if first is None or any(_passes(curve, *first) for curve in found):
            continue
        problem, start = first
        ways = [follow_homoclinic(problem, way, bounds, settings, loop.takens) for way in (opposite(start), start)]
        back, ahead = run_together(ways, f"{what}, curve {k + 1} of {len(loops)}")
        if back.end == "closed":
            ahead = Arm([back.points[0]], end="closed")
        points = [opposite(p) for p in reversed(back.points)] + ahead.points[1:]
        ends, special, n_missed = (back.end, ahead.end), back.special + ahead.special, back.n_missed + ahead.n_missed
        found.append(HomoclinicCurve(loop.family, points, ends, special, n_missed, _middle(problem, start)))
    if lost is not None:
        known = [loop.takens for loop, first in zip(loops, firsts, strict=True) if first is not None and loop.takens]
        lost += [
            loop
            for loop, first in zip(loops, firsts, strict=True)
            if first is None and not any(loop.takens is one for one in known)
        ]
    return found


def _middle(problem: HomoclinicProblem, point: Point) -> np.ndarray:
    """Return the mean distance of an orbit's nodes from the saddle, which tells mirror images apart."""
    parts, scales = problem.parts(point.u), np.asarray(problem.system.scales)
    away = wrap_angles((parts.nodes - parts.saddle) * scales, problem.system) / scales
    return np.asarray(away.mean(axis=0))


def _passes(curve: HomoclinicCurve, problem: HomoclinicProblem, first: Point) -> bool:
    """Return whether a curve passes through a homoclinic orbit, or starts at its mirror image's parameters."""
    middle, here = _middle(problem, first), as_rest(problem, first).u
    if middle @ curve.middle < 0.5 * float(np.linalg.norm(middle) * np.linalg.norm(curve.middle)):
        return False
    for a, b in pairwise(np.array([p.u for p in curve.points])):
        chord = b - a
        share = float((here - a) @ chord) / max(float(chord @ chord), 1e-300)
        if -0.01 <= share <= 1.01 and np.linalg.norm(here - a - share * chord) < 0.02 * np.linalg.norm(chord) + 1e-6:
            return True
    return False


# ---- starts at Bogdanov-Takens points ----------------------------------------------------------


def loops_beside(takens: SpecialPoint) -> list[Loop]:
    """Predict the homoclinic orbit at two distances from a Bogdanov-Takens point at which the prediction is good."""
    farthest, nearest, closer = 0.2, 1e-4, 0.25  # distances that are tried, and the second one in units of the first
    # largest strain of a loop that counts as near to that of the leading order, and the strain that is aimed at
    good, aim = 0.3, 0.2
    away, found = farthest, list[Loop]()
    while away > nearest and len(found) < 2:
        pair = _pair_beside(takens, away)
        if pair is not None and pair.strain <= good:
            found.append(pair.loop(takens))
        # the strain grows with the root of the distance
        away *= closer if pair is None or found else min(0.5, (aim / pair.strain) ** 2)
    return found


def loop_near(takens: SpecialPoint, away: float) -> Loop | None:
    """Predict the homoclinic orbit at a small distance from a Bogdanov-Takens point.

    To leading order the orbit is the loop x = x_s + 3/2 (x_f - x_s) sech(k t)**2 about the focus x_f beside the saddle
    x_s, with 4 k**2 = -l_u l_s. The damping, which is linear in x, does no work on it where a seventh of the trace of
    the critical eigenvalues at x_s and six sevenths of that at x_f add up to 0 (Melnikov's integral). None if no
    direction in the plane of the parameters fulfils the condition. Distances are in units of the parameters' scales.
    """
    pair = _pair_beside(takens, away)
    return None if pair is None else pair.loop(takens)


def _pair_beside(takens: SpecialPoint, away: float) -> _Pair | None:
    """Find the saddle and the focus at a distance from a Bogdanov-Takens point on whose loop the damping does no
    work.
    """
    angles, narrowest = 36, 1e-6  # directions that are tried, and the width to which they are narrowed [rad]
    known = [(angle, _pair_at(takens, away, angle)) for angle in np.linspace(0.0, 2.0 * np.pi, angles + 1)]
    for one, other in pairwise(known):
        (inner, pair), (outer, beyond) = (one, other) if one[1] is not None else (other, one)
        if pair is None or (beyond is not None and pair.work * beyond.work > 0.0):
            continue
        # where the equilibria meet there is no pair; the work may change its sign just before
        while abs(outer - inner) > narrowest:
            middle = 0.5 * (inner + outer)
            found = _pair_at(takens, away, middle)
            if found is None or found.work * pair.work < 0.0:
                outer, beyond = middle, found
            else:
                inner, pair = middle, found
        if beyond is not None:
            return pair
    return None


@dataclass(frozen=True, eq=False)
class _Pair:
    """Saddle and focus beside a Bogdanov-Takens point [scaled], with the Jacobian at the saddle."""

    saddle: np.ndarray
    focus: np.ndarray
    jacobian: np.ndarray  # at the saddle, scaled [1/s]
    across: np.ndarray  # direction that the Jacobian at the point takes to the one from saddle to focus, scaled
    work: float  # of the damping on the loop about the focus, to leading order [1/s]
    values: np.ndarray  # (2,): scaled parameters

    @property
    def rate(self) -> float:
        """Rate k of the loop of the leading order [1/s]."""
        unstable, stable = (one.real for one in leading_of(np.linalg.eigvals(self.jacobian)))
        return 0.5 * float(np.sqrt(-unstable * stable))

    @property
    def strain(self) -> float:
        """Size of the damping at the saddle, over the loop's rate: 0 where the leading order is exact."""
        return 0.5 * abs(sum(one.real for one in leading_of(np.linalg.eigvals(self.jacobian)))) / self.rate

    def loop(self, takens: SpecialPoint) -> Loop:
        """Return the loop of the leading order about the focus."""
        family = takens.family
        half, samples = 6.0, 2000  # length of the loop, in units of its time 1/k, and its instants
        k = self.rate
        along = self.focus - self.saddle
        t = np.linspace(-half / k, half / k, samples)
        bow = 1.5 / np.cosh(k * t) ** 2
        states = self.saddle + bow[:, None] * along + (-2.0 * k * np.tanh(k * t) * bow)[:, None] * self.across
        scales = np.asarray(family.system.scales)
        return Loop(
            family, t - t[0], states * scales, self.saddle * scales, self.values * np.asarray(family.scales), takens
        )


def _pair_at(takens: SpecialPoint, away: float, angle: float) -> _Pair | None:
    """Find the saddle and the focus beside a Bogdanov-Takens point in one direction of the plane of parameters."""
    family, system, n = takens.family, takens.family.system, takens.family.system.n_states
    scales = np.asarray(system.scales)
    at = takens.point.u[:n]
    values = takens.point.u[-2:] + away * np.array([np.cos(angle), np.sin(angle)])
    packed = family.rows(np.append(at, values)[None]).parameters[0]
    left, sizes, right = np.linalg.svd(family.scaled(takens.point.value.monodromy))
    rest, q = Rest(family, np.append(at, takens.point.u[-2:]), takens.point.value.monodromy), right[-1]
    bend = rest.second(*2 * [q * scales / rest.units]).real * rest.units / scales
    rate = rates_at(system, (at * scales)[None], packed)[0] / scales
    slope = family.scaled(jacobian_at(system, (at * scales)[None], packed)[0]) @ q
    # along q, with p the left null vector, the rates are to leading order p.f + p.A q s + p.B(q, q) s**2 / 2
    constant, linear, square = (left[:, -1] @ np.column_stack([rate, slope, 0.5 * bend])).tolist()
    is_mirrored = abs(square) <= SINGULAR * float(np.linalg.norm(bend))  # as at a pitchfork, the cubic term decides
    roots = np.array([0.0]) if is_mirrored else np.roots([square, linear, constant]).real
    reach = np.sqrt(away) if is_mirrored else max(np.sqrt(abs(constant / square)), abs(linear / square))
    guesses = np.concatenate([reach * np.array([-1.0, -0.3, 0.3, 1.0]), roots])
    with np.errstate(all="ignore"):
        found = find_equilibria(system, (at + np.outer(guesses, q)) * scales, packed, max_iterations=20)
    good = found.converged & (np.abs(found.states / scales - at).max(axis=1) < 4.0 * reach)
    ends: dict[bool, tuple[np.ndarray, np.ndarray, float]] = {}
    for state, jacobian in zip(found.states[good] / scales, found.jacobians[good], strict=True):
        values_here = np.linalg.eigvals(jacobian)
        critical = values_here[np.argsort(np.abs(values_here))[:2]]
        ends[bool(np.prod(critical).real < 0.0)] = state, family.scaled(jacobian), float(critical.sum().real)
    if len(ends) < 2:
        return None
    (saddle, jacobian, of_saddle), (focus, _, of_focus) = ends[True], ends[False]
    # the null direction is exact at the point alone: beside it, the least singular value depends on the units
    across = right[:-1].T @ ((left[:, :-1].T @ (focus - saddle)) / sizes[:-1])
    return _Pair(saddle, focus, jacobian, across, (of_saddle + 6.0 * of_focus) / 7.0, values)
