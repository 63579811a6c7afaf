"""Continue homoclinic orbits of a saddle as curves in the plane of two parameters, by the split of its manifolds.

The orbit leaves the saddle x0 in its unstable eigenspace and returns in its stable one (Beyn, IMA J. Numer. Anal. 10,
1990, 379; Champneys, Kuznetsov and Sandstede, Int. J. Bifurcation Chaos 6, 1996, 867). In scaled states, with nodes
y_0 ... y_M at equal intervals of the time T, rows L_s and L_u that span the left stable and unstable eigenspaces of
x0, and a small radius r, the equations are

* phi(y_k, T/M) = y_(k+1): the flow joins the nodes (multiple shooting);
* f(x0) = 0;
* L_s (y_0 - x0) = 0 and L_u (y_M - x0) = 0: y_0 lies in the unstable eigenspace, y_M in the stable one;
* |y_0 - x0| = |y_M - x0| = r, which fix the phase of the orbit and T.

The unknowns are the nodes, x0, ln T and the two parameters, one more than there are equations. The manifolds are
replaced by their tangents within r, which moves the curve by the order of r**2 and less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm, lu_factor, lu_solve, schur
from scipy.optimize import brentq

from magpend_core.engine.system import System
from magpend_core.equilibria import find_equilibria
from magpend_core.orbits import wrap_angles
from magpend_core.pointwise import jacobian_at, rates_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.codimension_two import SpecialPoint
from pipeline.analysis.branches.lockstep import Query, Steps
from pipeline.analysis.branches.problems import PARAMETER_STEP, Ends, Family, Rows, Value
from pipeline.analysis.branches.steep_orbits import after, flown
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(frozen=True, eq=False)
class HomoclinicSettings(Settings):
    """Settings of curves of homoclinic orbits: of their continuation, of the nodes of an orbit and of its first guess.

    Newton's method mostly ends far below the tolerance.
    """

    first_step: float = 5e-3
    longest_step: float = 0.04
    max_points: int = 400
    tolerance: float = 1e-9
    max_iterations: int = 8
    at_once: int = 8  # points that are followed before the nodes are laid anew
    # distance r from the saddle at which its manifolds are replaced by their tangents, in units of the orbit's size;
    # less errs less, and makes longer orbits
    radius: float = 1e-5
    least_radius: float = 1e-6  # in scaled states; within less, rounding of the states shows
    stretch: float = 1.0  # logarithm of the growth on one segment of the orbit; less converges further, and costs more
    least_segments: int = 12
    most_segments: int = 120
    per_segment: int = 25  # samples on each segment from which new nodes are laid
    # distances from the saddle, in units of the least one of the guess, within which its flow is taken as linear; tried
    # in turn, the first one where nodes are laid anew
    cuts: tuple[float, ...] = (3.0, 10.0, 30.0)
    damped: int = 30  # most damped Newton steps from a rough guess, and the residual at which they end
    near: float = 1e-4
    # most evaluations of the equations to find the first orbit of a curve, and to follow the curve in one direction
    to_start: int = 200
    to_follow: int = 1000


TIME_UNIT = 0.1
"""Share of ln T that counts as 1 in the arclength."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Approximate homoclinic orbit: its states over time, from near the saddle until near the saddle again."""

    family: Family  # equilibria (period 0) with two free parameters
    times: np.ndarray  # (m,) [s], rising
    states: np.ndarray  # (m, n_states), angles not wrapped
    saddle: np.ndarray  # (n_states,)
    values: np.ndarray  # (2,): the free parameters
    takens: SpecialPoint | None = None  # Bogdanov-Takens point from which it is predicted


@dataclass(frozen=True, eq=False)
class Parts:
    """Unknowns of a homoclinic orbit, in scaled states and units of the parameters' scales."""

    nodes: np.ndarray  # (M + 1, n)
    saddle: np.ndarray  # (n,)
    seconds: float  # T [s]
    values: np.ndarray  # (2,): scaled parameters


@dataclass(frozen=True, eq=False)
class HomoclinicProblem:
    """Equations of homoclinic orbits along two free parameters, on a given number of segments."""

    family: Family
    n_segments: int
    radius: float  # r, in scaled states
    extent: float  # size of the orbit, in scaled states: the unit of the gaps between segments
    bases: tuple[np.ndarray, np.ndarray]  # (n, n_s), (n, n_u): left stable and unstable eigenvectors to compare with
    unit: float  # time that makes the rates dimensionless [s]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.system.n_states * (self.n_segments + 2) + 3

    @property
    def system(self) -> System:
        """System whose orbits they are."""
        return self.family.system

    @property
    def _weight(self) -> float:
        """Weight of the nodes in the arclength, which makes it their root mean square."""
        return 1.0 / float(np.sqrt(self.n_segments + 1))

    @property
    def atol(self) -> float:
        """Absolute tolerance of the integrations."""
        return tolerances_at(BRANCH_RTOL)["atol"] * min(1.0, self.extent)

    @property
    def _step(self) -> float:
        """Step of central differences, shorter for small orbits, which respond to small changes."""
        return PARAMETER_STEP * min(1.0, self.extent)

    def packed_up(self, parts: Parts) -> np.ndarray:
        """Return the vector of unknowns."""
        time = TIME_UNIT * np.log(parts.seconds)
        return np.concatenate([self._weight * parts.nodes.ravel(), parts.saddle, [time], parts.values])

    def parts(self, u: np.ndarray) -> Parts:
        """Return the unknowns in `u` by name."""
        n = self.system.n_states
        nodes = u[: -n - 3].reshape(-1, n) / self._weight
        return Parts(nodes, u[-n - 3 : -3], float(np.exp(u[-3] / TIME_UNIT)), u[-2:])

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectories to a section: those between the nodes last a fixed time."""
        return self.family.rows(np.zeros((0, self.system.n_states + 2)))

    def value(self, u: np.ndarray, ends: Ends) -> Value:
        """Compute the equations and their derivatives; NaN if the equilibrium is no saddle of the same dimensions."""
        parts = self.parts(u)
        if not np.isfinite(u).all():
            nothing = np.full((self.size - 1, self.size), np.nan)
            return Value(nothing[:, 0], nothing, parts.saddle[None], nothing[:, :0], is_rest=True)
        joins, by_joins = self._joins(parts)
        at_ends, by_ends = self._at_ends(parts)
        rest, by_rest, jacobian = self._rest(parts)
        return Value(
            np.concatenate([joins, at_ends, rest]),
            np.vstack([by_joins, by_ends, by_rest]),
            (parts.saddle * np.asarray(self.system.scales))[None],
            jacobian,
            parts.seconds,
            is_rest=True,
        )

    def _joins(self, parts: Parts) -> tuple[np.ndarray, np.ndarray]:
        """Return the gaps between the segments of the orbit, and their derivatives."""
        m, n, scales = self.n_segments, self.system.n_states, np.asarray(self.system.scales)
        shifts = self._step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        own, *beside = [np.column_stack([parts.nodes[:-1], np.tile(parts.values + s, (m, 1))]) for s in (0.0, *shifts)]
        seconds = np.full(5 * m, parts.seconds / m)
        ends, tangents = flown(self.family, self.family.rows(own), seconds[:m], self.atol)
        others = after(self.system, self.family.rows(np.concatenate(beside)), seconds[m:], self.atol)
        image, images = ends / scales, (others / scales).reshape(4, m, n)
        here = self.family.rows(np.append(parts.nodes[0], parts.values)[None]).parameters[0]
        speeds = rates_at(self.system, ends, here) / scales
        by = np.zeros((m, n, self.size))
        for k in range(m):
            by[k, :, n * k : n * (k + 1)] = self.family.scaled(tangents[k]) / self._weight
            by[k, :, n * (k + 1) : n * (k + 2)] = -np.eye(n) / self._weight
        by[:, :, -3] = speeds * (parts.seconds / m / TIME_UNIT)
        by[:, :, -2] = (images[0] - images[1]) / (2.0 * self._step)
        by[:, :, -1] = (images[2] - images[3]) / (2.0 * self._step)
        gaps = (image - parts.nodes[1:]).ravel()
        return gaps / self.extent, by.reshape(m * n, -1) / self.extent

    def _at_ends(self, parts: Parts) -> tuple[np.ndarray, np.ndarray]:
        """Return the conditions at both ends of the orbit, projections and distances, with their derivatives."""
        n = self.system.n_states
        first, last = (self._away(parts.nodes[k], parts.saddle) for k in (0, -1))
        at = np.concatenate([parts.saddle, parts.values])
        onto = self._projections(at)
        steps = self._step * np.eye(n + 2)
        sides = [(self._projections(at + h), self._projections(at - h), 2.0 * h.max()) for h in steps]
        turns = [[(up[i] - down[i]) / width for i in (0, 1)] for up, down, width in sides]
        found = np.concatenate([onto[0].T @ first, onto[1].T @ last])
        by = np.zeros((n + 2, self.size))
        n_s = onto[0].shape[1]
        by[:n_s, :n], by[n_s:n, -2 * n - 3 : -n - 3] = onto[0].T / self._weight, onto[1].T / self._weight
        columns = [*range(self.size - n - 3, self.size - 3), self.size - 2, self.size - 1]
        for column, (first_turn, last_turn) in zip(columns, turns, strict=True):
            by[:n, column] = np.concatenate([first_turn.T @ first, last_turn.T @ last])
        by[:n_s, -n - 3 : -3] -= onto[0].T
        by[n_s:n, -n - 3 : -3] -= onto[1].T
        for row, place, away in ((n, slice(0, n), first), (n + 1, slice(-2 * n - 3, -n - 3), last)):
            by[row, place] = 2.0 * away / self._weight
            by[row, -n - 3 : -3] = -2.0 * away
        lengths = np.array([first @ first, last @ last]) / self.radius**2 - 1.0
        by[:n] /= self.radius
        by[n:] /= self.radius**2
        return np.concatenate([found / self.radius, lengths]), by

    def _away(self, node: np.ndarray, saddle: np.ndarray) -> np.ndarray:
        scales = np.asarray(self.system.scales)
        return np.asarray(wrap_angles((node - saddle) * scales, self.system) / scales)

    def _projections(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bases of the left stable and unstable eigenspaces at a state and parameters, turned to `bases`."""
        found = left_spaces(self.family, at)
        if any(one.shape != known.shape for one, known in zip(found, self.bases, strict=True)):
            return tuple(np.full_like(known, np.nan) for known in self.bases)  # type: ignore[return-value]
        return tuple(_turned(one, known) for one, known in zip(found, self.bases, strict=True))  # type: ignore[return-value]

    def _rest(self, parts: Parts) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the scaled rates at the saddle, their derivatives, and the Jacobian [1/s]."""
        n, scales = self.system.n_states, np.asarray(self.system.scales)
        shifts = self._step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        rows = self.family.rows(np.column_stack([np.tile(parts.saddle, (5, 1)), parts.values + shifts]))
        rates = [rates_at(self.system, rows.states[:1], p)[0] / scales for p in rows.parameters]
        jacobian = jacobian_at(self.system, rows.states[:1], rows.parameters[0])[0]
        by = np.zeros((n, self.size))
        by[:, -n - 3 : -3] = self.family.scaled(jacobian)
        by[:, -2] = (rates[1] - rates[2]) / (2.0 * self._step)
        by[:, -1] = (rates[3] - rates[4]) / (2.0 * self._step)
        return rates[0] * self.unit / self.radius, by * self.unit / self.radius, jacobian


def left_spaces(family: Family, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal bases of the left stable and unstable eigenspaces, at scaled states and parameters."""
    rows = family.rows(at[None])
    jacobian = family.scaled(jacobian_at(family.system, rows.states, rows.parameters[0])[0])
    if not np.isfinite(jacobian).all():
        empty = np.zeros((len(jacobian), 0))
        return empty, empty
    spaces = [schur(jacobian.T, output="real", sort=side) for side in ("lhp", "rhp")]
    return spaces[0][1][:, : spaces[0][2]], spaces[1][1][:, : spaces[1][2]]


def _turned(basis: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Turn an orthonormal basis within its space as near as possible to another one."""
    left, _, right = np.linalg.svd(basis.T @ known)
    return np.asarray(basis @ left @ right)


# ---- starting ----------------------------------------------------------------------------------


def homoclinic_point(
    loop: Loop, settings: HomoclinicSettings = HomoclinicSettings()
) -> Steps[tuple[HomoclinicProblem, Point] | None]:
    """Refine an approximate homoclinic orbit by Newton's method, at a fixed value of the second parameter.

    Parameters
    ----------
    loop
        Approximate orbit, for example a cycle of long period, or a prediction from a Bogdanov-Takens point. It begins
        and ends where it is nearest to the saddle.
    settings
        Distances from the saddle, nodes, tolerance and number of Newton steps.

    Returns
    -------
    tuple or None
        The equations with their nodes, and the orbit with a tangent along which the second parameter rises; None if
        Newton's method fails, or the equilibrium is no saddle.
    """
    for cut in settings.cuts:
        laid = lay_nodes(loop, cut, settings)
        if laid is None:
            return None
        problem, u = laid
        normal = np.zeros(problem.size)
        normal[-1] = 1.0
        near = yield from _damped(problem, u, normal, settings)
        found = yield from correct(problem, near, normal, settings)
        if found is not None:
            return problem, found
    return None


def _damped(
    problem: HomoclinicProblem, u: np.ndarray, normal: np.ndarray, settings: HomoclinicSettings
) -> Steps[np.ndarray]:
    """Bring a rough guess near to the solution by Newton's method, with steps that shorten the next one.

    The residual itself may grow on the way: errors at the nodes grow with the flow (Deuflhard, Newton Methods for
    Nonlinear Problems, 2004, section 3.3).
    """
    value = yield Query(problem, u)
    for _ in range(settings.damped):
        if not value.is_finite or np.linalg.norm(value.residual) < settings.near:
            break
        factors = lu_factor(np.vstack([value.derivative, normal]), check_finite=False)
        step = -lu_solve(factors, np.append(value.residual, 0.0))
        if not np.isfinite(step).all():
            break
        step *= min(1.0, TIME_UNIT / max(abs(float(step[-3])), 1e-300))  # T by a factor of e at most
        for share in 0.5 ** np.arange(8):
            there = yield Query(problem, u + share * step)
            ahead = lu_solve(factors, np.append(there.residual, 0.0), check_finite=False)
            if np.linalg.norm(ahead) < (1.0 - 0.3 * share) * np.linalg.norm(step):
                break
        else:
            break
        u, value = u + share * step, there
    return u


def lay_nodes(loop: Loop, cut: float, settings: HomoclinicSettings) -> tuple[HomoclinicProblem, np.ndarray] | None:
    """Lay nodes at equal intervals of time along an approximate homoclinic orbit; None if there is no saddle.

    Within `cut` times the least distance of the orbit from the saddle, the flow is replaced by its linear part: there
    the orbit is carried on in the unstable and the stable eigenspace to the radius at which it begins and ends.
    """
    family, scales = loop.family, np.asarray(loop.family.system.scales)
    at = family.unknowns(loop.saddle, loop.values)
    rows = family.rows(at[None])
    rest = find_equilibria(family.system, rows.states, rows.parameters[0])
    if not (rest.converged[0] and rest.eigenvalues[0].real.min() < 0.0 < rest.eigenvalues[0].real.max()):
        return None
    saddle, jacobian = rest.states[0] / scales, family.scaled(rest.jacobians[0])
    at[: len(saddle)] = saddle
    away = wrap_angles(loop.states - rest.states[0], family.system) / scales
    distance = np.linalg.norm(away, axis=1)
    extent = float(distance.max())
    radius = max(settings.radius * extent, settings.least_radius)
    outside = np.flatnonzero(distance > max(cut * distance[[0, -1]].max(), radius))
    if not len(outside):
        return None
    bases = left_spaces(family, at)
    first, last = int(outside[0]), int(outside[-1])
    arriving, leaving = _linear_flows(jacobian, bases, away[last], away[first])
    before, after = _time_to(lambda t: leaving(-t), radius), _time_to(arriving, radius)
    inner = loop.times[last] - loop.times[first]
    seconds = before + inner + after
    fastest = float(np.abs(rest.eigenvalues[0].real).max())
    n_segments = int(
        np.clip(np.ceil(fastest * seconds / settings.stretch), settings.least_segments, settings.most_segments)
    )
    nodes = np.empty((n_segments + 1, len(saddle)))
    for k, t in enumerate(np.linspace(0.0, seconds, n_segments + 1)):
        if t < before:
            nodes[k] = loop.states[first] / scales + leaving(t - before) - away[first]
        elif t > before + inner:
            nodes[k] = loop.states[last] / scales + arriving(t - before - inner) - away[last]
        else:
            here = loop.times[first] + t - before
            nodes[k] = [np.interp(here, loop.times, column) for column in loop.states.T / scales[:, None]]
    unit = 1.0 / float(np.linalg.norm(jacobian))
    problem = HomoclinicProblem(family, n_segments, radius, extent, bases, unit)
    return problem, problem.packed_up(Parts(nodes, saddle, seconds, at[-2:]))


def _linear_flows(
    jacobian: np.ndarray, bases: tuple[np.ndarray, np.ndarray], arriving: np.ndarray, leaving: np.ndarray
) -> list[Callable[[float], np.ndarray]]:
    """Return the linear flows of two distances from a saddle within its stable and its unstable eigenspace."""
    right = np.linalg.inv(np.hstack(bases).T)
    n_s = bases[0].shape[1]

    def flow(left: np.ndarray, own: np.ndarray, start: np.ndarray) -> Callable[[float], np.ndarray]:
        inside = left.T @ jacobian @ own
        return lambda t: np.asarray(own @ expm(inside * t) @ (left.T @ start))

    return [flow(bases[0], right[:, :n_s], arriving), flow(bases[1], right[:, n_s:], leaving)]


def _time_to(flow: Callable[[float], np.ndarray], radius: float) -> float:
    """Return the time after which a distance that shrinks in the end is a radius; 0 if it is within."""

    def excess(t: float) -> float:
        return float(np.log(np.linalg.norm(flow(t)) / radius))

    if excess(0.0) <= 0.0:
        return 0.0
    longest = 1.0
    while excess(longest) > 0.0:
        longest *= 2.0
    return float(brentq(excess, 0.0, longest))


def loop_of(problem: HomoclinicProblem, u: np.ndarray, settings: HomoclinicSettings) -> Loop:
    """Integrate the segments of a homoclinic orbit, and return its states at many instants."""
    family, parts, scales = problem.family, problem.parts(u), np.asarray(problem.system.scales)
    m = problem.n_segments
    rows = family.rows(np.column_stack([parts.nodes[:-1], np.tile(parts.values, (m, 1))]))
    step = parts.seconds / m
    times = np.linspace(0.0, step, settings.per_segment + 1)
    found = sample(
        family.system,
        rows.parameters,
        rows.states,
        [times],
        piece=np.zeros(m, np.int64),
        drives=[Drive(np.array([step]))],
        rtol=BRANCH_RTOL,
        atol=problem.atol,
    )
    states = np.concatenate([found.states[:, :-1].reshape(-1, family.system.n_states), parts.nodes[-1:] * scales])
    every = np.append((step * np.arange(m)[:, None] + times[:-1]).ravel(), parts.seconds)
    return Loop(family, every, states, parts.saddle * scales, parts.values * np.asarray(family.scales))
