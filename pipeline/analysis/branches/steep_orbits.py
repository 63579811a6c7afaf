"""Follow steep limit cycles by multiple shooting.

Where the tangents of a limit cycle grow by many orders over one period, an error of its section point grows as well,
and rounding decides whether the image comes back to the point. So the orbit is cut into segments, on each of which
tangents grow little. With nodes x_1 ... x_m in scaled states, the durations T_j of the returns to the section, and the
segments' shares s_k of these, the equations are

* phi(x_k, s_k T_j) = x_(k+1): the flow joins the nodes, and the last one to the first;
* the first node of each return lies on the section.

The unknowns are the nodes, the durations and the parameter. Multipliers are those of the product of the segments'
derivatives, which is never multiplied out: it is kept as triangular factors, so that the small multipliers have as many
digits as the large ones (see `graded_multipliers`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from magpend_core.engine.system import System
from magpend_core.engine.variational import with_tangents
from magpend_core.orbits import wrap_angles
from magpend_core.poincare import Section
from magpend_core.pointwise import rates_packed
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point, Settings, correct, kernel_of
from pipeline.analysis.branches.lockstep import Query, Steps, integrated
from pipeline.analysis.branches.problems import ONE_SIDED_STEP, Ends, Family, Rows, Value
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(frozen=True)
class CutSettings:
    """Settings of the cuts of an orbit."""

    # norm of the derivative of a return, by the scaled state and parameter, from which an orbit may be cut
    steep: float = 1e2
    # norms of a segment's derivative, in units of the orbit's extents: above the first it is halved, and above the
    # second all are looked at again; more growth makes fewer segments, from which Newton's method converges less far
    growth: float = 20.0
    most_growth: float = 200.0
    least_segments: int = 16
    most_segments: int = 400
    small: float = 0.15  # largest range of the nodes of an orbit that shrinks to an equilibrium [scales of the states]
    sweeps: int = 12  # most sweeps of `graded_multipliers`; each separates moduli by their ratio
    separated: float = 1e-8  # part of one subspace in the next at which the multipliers of both are told apart


def is_steep(point: Point, family: Family, cuts: CutSettings = CutSettings()) -> bool:
    """Return whether a limit cycle of a flow is too steep for shooting over its whole period."""
    if not family.period or family.system.section is None:
        return False
    return bool(np.linalg.norm(point.value.derivative, 2) > cuts.steep)


def is_steeper(point: Point, cuts: CutSettings = CutSettings()) -> bool:
    """Return whether a cut orbit needs more cuts."""
    assert isinstance(point.value, CutValue)
    return bool(point.value.steepest.max() > cuts.most_growth)


def is_small(point: Point, cuts: CutSettings = CutSettings()) -> bool:
    """Return whether a cut orbit is as small as one that shrinks to an equilibrium."""
    assert isinstance(point.value, CutValue)
    return bool(point.value.extents.max() < cuts.small)


def is_divided(problem: CutProblem, cuts: CutSettings = CutSettings()) -> bool:
    """Return whether tangents grow so much along an orbit that it was cut into more than the fewest segments."""
    return len(problem.shares) > cuts.least_segments


def flown(family: Family, rows: Rows, seconds: np.ndarray, atol: float) -> tuple[np.ndarray, np.ndarray]:
    """Return states after a time each, shape (m, n_states), and their derivatives by the start, (m, n_states,
    n_states).
    """
    n, sizes = family.system.n_states, np.asarray(family.system.sizes)
    system = replace(with_tangents(family.system, n), n_controlled=None)
    tangents = np.tile(np.diag(sizes).ravel(), (len(rows.states), 1))
    found = after(system, replace(rows, states=np.concatenate([rows.states, tangents], axis=1)), seconds, atol)
    return found[:, :n], found[:, n:].reshape(-1, n, n).transpose(0, 2, 1) / sizes


def after(system: System, rows: Rows, seconds: np.ndarray, atol: float) -> np.ndarray:
    """Return states after a time each, shape (m, n_states)."""
    times, which = np.unique(seconds, return_inverse=True)
    found = sample(
        system,
        rows.parameters,
        rows.states,
        [np.array([time]) for time in times],
        piece=which,
        drives=[Drive(np.array([time])) for time in times],
        rtol=BRANCH_RTOL,
        atol=atol,
    )
    return np.asarray(found.states[:, 0])


@dataclass(frozen=True, eq=False, kw_only=True)
class CutValue(Value):
    """Value of the equations of a cut orbit, with its segments: their first nodes (m, n), their derivatives by these
    (m, n, n) and by the parameter (m, n), and the rates at the nodes (m, n), all scaled.
    """

    nodes: np.ndarray
    tangents: np.ndarray
    slopes: np.ndarray
    speeds: np.ndarray

    @property
    def is_graded(self) -> bool:
        """Always: the multipliers come from the segments one by one."""
        return True

    @property
    def extents(self) -> np.ndarray:
        """Ranges of the nodes."""
        return np.asarray(np.ptp(self.nodes, axis=0))

    @property
    def steepest(self) -> np.ndarray:
        """Norms of the segments' derivatives, in units of the orbit's extents."""
        extents = np.where(self.extents > 0.0, self.extents, 1.0)
        return np.asarray(np.linalg.norm(self.tangents * extents / extents[:, None], 2, axis=(1, 2)))

    @cached_property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers by falling modulus; 0 stands for the flow's own."""
        return graded_multipliers(self.tangents, self.speeds)


def graded_multipliers(tangents: np.ndarray, speeds: np.ndarray, cuts: CutSettings = CutSettings()) -> np.ndarray:
    """Return the multipliers of a closed orbit of a flow from the derivatives of its segments.

    Sweeps of QR decompositions along the orbit turn an orthonormal basis, in the states modulo the flow's direction,
    until its first vectors span the directions that grow most (Dieci and Van Vleck, Numer. Algorithms 14, 1997). The
    product of the triangular factors then has the multipliers on its diagonal, in blocks of like moduli.

    Parameters
    ----------
    tangents
        Derivatives of the segments in their order, shape (segment, state, state).
    speeds
        Rates at their starts, shape (segment, state).
    cuts
        Numbers to choose.

    Returns
    -------
    ndarray of complex
        Shape (state,), by falling modulus; the last one is 0, for the flow's own direction.
    """
    n = tangents.shape[1]
    bases = np.concatenate([speeds[:, :, None], np.broadcast_to(np.eye(n), (len(speeds), n, n))], axis=2)
    across = np.linalg.qr(bases)[0][:, :, 1:]
    factors = np.roll(across, -1, axis=0).transpose(0, 2, 1) @ tangents @ across
    basis = np.eye(n - 1)
    for _ in range(cuts.sweeps):
        turned, product = basis, np.eye(n - 1)
        for factor in factors:
            turned, triangle = np.linalg.qr(factor @ turned)
            product = triangle @ product
        back = basis.T @ turned
        basis = turned
        if not (np.abs(np.tril(back, -1)) >= cuts.separated).any():
            break
    ends = [i for i in range(1, n - 1) if np.abs(back[i:, :i]).max() < cuts.separated]
    blocks = [slice(i, j) for i, j in zip([0, *ends], [*ends, n - 1], strict=True)]
    # what is left below the blocks is rounding, which the large factors would raise
    each = [np.linalg.eigvals(back[block, block] @ product[block, block]) for block in blocks]
    found = np.concatenate([*each, [0.0]]).astype(complex)
    return np.asarray(found[np.argsort(-np.abs(found), kind="stable")])


@dataclass(frozen=True, eq=False)
class CutProblem:
    """Equations of a limit cycle of a flow that is cut into segments, along one free parameter."""

    family: Family
    shares: np.ndarray  # (segment,): of the duration of its return
    returns: np.ndarray  # (segment,): number of its return
    unit: float  # duration that counts as 1 [s]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.shares) * self.system.n_states + self.family.period + 1

    @property
    def system(self) -> System:
        """System whose orbits they are."""
        return self.family.system

    @property
    def _weight(self) -> float:
        """Weight of the nodes in the arclength, which makes it their root mean square."""
        return 1.0 / float(np.sqrt(len(self.shares)))

    def packed_up(self, nodes: np.ndarray, seconds: np.ndarray, value: float) -> np.ndarray:
        """Return the vector of unknowns: scaled nodes, durations [s], and the scaled parameter."""
        return np.concatenate([self._weight * nodes.ravel(), seconds / self.unit, [value]])

    def parts(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return scaled nodes, the durations [s] and the scaled parameter from the unknowns, or a change of them."""
        m, n = len(self.shares), self.system.n_states
        return u[: m * n].reshape(m, n) / self._weight, u[m * n : -1] * self.unit, float(u[-1])

    def rows(self, u: np.ndarray) -> Rows:
        """Return no trajectories to a section: the segments last a given time."""
        return self.family.rows(np.zeros((0, self.system.n_states + 1)))

    def value(self, u: np.ndarray, ends: Ends) -> CutValue:
        """Compute the gaps between the segments and the distances of returns from the section, with derivatives; NaN
        if a return lasts longer than any may.
        """
        nodes, seconds, at = self.parts(u)
        m, n, scales = len(nodes), self.system.n_states, np.asarray(self.system.scales)
        if not (np.isfinite(u).all() and 0.0 < seconds.min() <= seconds.max() <= 1.0 / self.family.frequency_hz):
            nothing = np.full((self.size - 1, self.size), np.nan)
            derivative, image = nothing[:n, :n], nodes[:1] * scales
            return CutValue(
                nothing[:, 0], nothing, image, derivative, nodes=nodes, tangents=derivative, slopes=nodes, speeds=nodes
            )
        own = np.column_stack([nodes, np.full(m, at)])
        rows = self.family.rows(np.concatenate([own, own + ONE_SIDED_STEP * np.eye(n + 1)[-1]]))
        durations = np.tile(self.shares * seconds[self.returns], 2)
        images, tangents = flown(self.family, rows, durations, tolerances_at(BRANCH_RTOL)["atol"])
        here = replace(rows, states=np.concatenate([rows.states[:m], images[:m]]))
        rates = rates_packed(self.system, here.states, rows.parameters[np.r_[:m, :m]], rows.frequency_hz) / scales
        scaled = self.family.scaled(tangents[:m])
        slopes = self._wrapped((images[m:] - images[:m]) / scales) / ONE_SIDED_STEP
        by = self._by_unknowns(scaled, slopes, rates[m:])
        gaps = self._wrapped(images[:m] / scales - np.roll(nodes, -1, axis=0)).ravel()
        heights, by_heights = self._heights(nodes, rows.parameters[[0, m]])
        monodromy = self._monodromy(scaled, rates[0] * scales, rows.states[0], rows.parameters[0])
        return CutValue(
            self._weight * np.concatenate([gaps, heights]),
            self._weight * np.concatenate([by, by_heights]),
            self._sections(nodes),
            monodromy,
            float(seconds.sum()),
            nodes=nodes,
            tangents=scaled,
            slopes=slopes,
            speeds=rates[:m],
        )

    def _by_unknowns(self, tangents: np.ndarray, slopes: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Return the derivatives of the gaps, from those of the segments and the rates at their ends."""
        m, n = slopes.shape
        by, each = np.zeros((m, n, self.size)), np.arange(m)
        by_nodes = by[:, :, : m * n].reshape(m, n, m, n)  # a view
        by_nodes[each, :, each] += tangents / self._weight
        by_nodes[each, :, (each + 1) % m] -= np.eye(n) / self._weight
        by[each, :, m * n + self.returns] = speeds * self.shares[:, None] * self.unit
        by[:, :, -1] = slopes
        return by.reshape(m * n, -1)

    def _heights(self, nodes: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of the returns from the section, with their derivatives."""
        section, n, scales = Section(self.system), self.system.n_states, np.asarray(self.system.scales)
        firsts = np.searchsorted(self.returns, np.arange(self.family.period))
        states = nodes[firsts] * scales
        normals, lengths = section.scaled_normals(states, packed[0])
        by = np.zeros((len(firsts), self.size))
        for k, first in enumerate(firsts):
            by[k, n * first : n * (first + 1)] = normals[k] / self._weight
        if section.state is None:
            here, beside = (section.values(states, one) - section.levels(one) for one in packed)
            by[:, -1] = (beside - here) / lengths / ONE_SIDED_STEP
            return here / lengths, by
        levels = section.levels(packed) / lengths[0]
        away = np.zeros((len(firsts), n))
        away[:, section.state] = nodes[firsts, section.state] - levels[0]
        by[:, -1] = (levels[0] - levels[1]) / ONE_SIDED_STEP
        return self._wrapped(away)[:, section.state], by

    def _sections(self, nodes: np.ndarray) -> np.ndarray:
        firsts = np.searchsorted(self.returns, np.arange(self.family.period))
        return wrap_angles(np.roll(nodes[firsts], -1, axis=0) * np.asarray(self.system.scales), self.system)

    def _monodromy(self, tangents: np.ndarray, rates: np.ndarray, state: np.ndarray, packed: np.ndarray) -> np.ndarray:
        """Return the derivative of the return map, from the segments' derivatives and the rates at a section point."""
        scales, product = np.asarray(self.system.scales), np.eye(self.system.n_states)
        for one in tangents:
            product = one @ product
        section = Section(self.system)
        normals = section.normals(state[None], packed)
        return np.asarray(section.of_map((product * scales[:, None] / scales)[None], rates[None], normals, normals)[0])

    def _wrapped(self, difference: np.ndarray) -> np.ndarray:
        scales = np.asarray(self.system.scales)
        return np.asarray(wrap_angles(difference * scales, self.system) / scales)

    def halved(self, u: np.ndarray, chosen: np.ndarray) -> tuple[CutProblem, np.ndarray]:
        """Halve some segments of an orbit; return the new equations and the unknowns."""
        nodes, seconds, at = self.parts(u)
        own = np.flatnonzero(chosen)
        rows = self.family.rows(np.column_stack([nodes[own], np.full(len(own), at)]))
        halves = 0.5 * self.shares[own] * seconds[self.returns[own]]
        middles, _ = flown(self.family, rows, halves, tolerances_at(BRANCH_RTOL)["atol"])
        shares = np.insert(np.where(chosen, 0.5, 1.0) * self.shares, own + 1, 0.5 * self.shares[own])
        nodes = np.insert(nodes, own + 1, middles / np.asarray(self.system.scales), axis=0)
        problem = replace(self, shares=shares, returns=np.insert(self.returns, own + 1, self.returns[own]))
        return problem, problem.packed_up(nodes, seconds, at)

    def doubled(self, point: Point) -> tuple[CutProblem, np.ndarray, np.ndarray]:
        """Return the equations of the orbit at a period doubling, traversed twice, with its unknowns and the tangent of
        the branch of twice the period. Along the tangent, the second turn is displaced as the first, but backwards.
        """
        nodes, seconds, at = self.parts(point.u)
        returns = np.concatenate([self.returns, self.returns + self.family.period])
        family = replace(self.family, period=2 * self.family.period)
        problem = replace(self, family=family, shares=np.tile(self.shares, 2), returns=returns, unit=2.0 * self.unit)
        n, backwards = self.system.n_states, point.value.derivative[:, :-1].copy()
        last = (len(nodes) - 1) * n
        backwards[last : last + n, :n] *= -1.0
        away, longer, _ = self.parts(np.append(np.linalg.svd(backwards)[2][-1], 0.0))
        tangent = problem.packed_up(np.concatenate([away, -away]), np.concatenate([longer, -longer]), 0.0)
        u = problem.packed_up(np.tile(nodes, (2, 1)), np.tile(seconds, 2), at)
        return problem, u, tangent / np.linalg.norm(tangent)

    def plain(self, point: Point) -> Point:
        """Return a point in the unknowns of `OrbitProblem`: the section point and the parameter."""
        n, value = self.system.n_states, point.value
        assert isinstance(value, CutValue)
        found = [np.append(nodes[0], at) for nodes, _, at in (self.parts(point.u), self.parts(point.tangent))]
        by = np.eye(n, n + 1)
        for tangent, slope in zip(value.tangents, value.slopes, strict=True):
            by = tangent @ by
            by[:, -1] += slope
        by = self._of_map(by, value.speeds[0], found[0])
        gaps = np.abs(value.residual[: len(self.shares) * n] / self._weight).reshape(-1, n).max(axis=0)
        whole = Value(
            gaps, by - np.eye(n, n + 1), value.images, value.monodromy, value.seconds, graded=value.multipliers
        )
        return Point(found[0], found[1] / np.linalg.norm(found[1]), whole, point.n_iterations)

    def _of_map(self, by: np.ndarray, speed: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the scaled derivative of the return map by the section point and the parameter, from that of the flow
        over the orbit's period.
        """
        section, scales = Section(self.system), np.asarray(self.system.scales)
        if (crossed := section.state) is not None:
            by = by - np.outer(speed, by[crossed] / speed[crossed])
            by[crossed], by[:, crossed] = 0.0, 0.0
            return by
        rows = self.family.rows(np.stack([u, u + ONE_SIDED_STEP * np.eye(len(u))[-1]]))
        normals, here = section.normals(rows.states[:1], rows.parameters[:1]), rows.states[[0, 0]]
        column, across = int(section.moved_state(normals)[0]), np.append(normals[0] * scales, 0.0)
        # the parameter moves the section as well
        across[-1] = (
            np.diff(section.values(here, rows.parameters) - section.levels(rows.parameters))[0] / ONE_SIDED_STEP
        )
        by = by - np.outer(by[:, column], across / across[column])
        by[:, column] = 0.0
        crossing = across[:-1] @ by
        crossing[-1] += across[-1]
        return by - np.outer(speed, crossing / (across[:-1] @ speed))


def whole_orbit(family: Family, point: Point) -> tuple[CutProblem, np.ndarray]:
    """Return the equations of an orbit that is cut at the section alone, and the unknowns."""
    n, scales = family.system.n_states, np.asarray(family.system.scales)
    nodes = np.concatenate([point.u[None, :n], point.value.images[: family.period - 1] / scales])
    rows = family.rows(np.column_stack([nodes, np.full(len(nodes), point.u[-1])]))
    (ends,) = integrated([replace(rows, period=1)], family.system)
    seconds = ends.times[:, 0]
    problem = CutProblem(family, np.ones(len(nodes)), np.arange(len(nodes)), float(seconds.sum()))
    return problem, problem.packed_up(nodes, seconds, float(point.u[-1]))


def cut_where_steep(
    problem: CutProblem, u: np.ndarray, along: np.ndarray, settings: Settings, cuts: CutSettings = CutSettings()
) -> Steps[tuple[CutProblem, Point] | None]:
    """Halve the segments of an orbit on which tangents grow too much, and refine the orbit.

    `along` is the direction of the branch, in the unknowns of `OrbitProblem`. Returns None on failure.
    """
    value = yield Query(problem, u)
    while value.is_finite and isinstance(value, CutValue) and len(problem.shares) < cuts.most_segments:
        chosen = (value.steepest > cuts.growth) | (len(problem.shares) < cuts.least_segments)
        if not chosen.any():
            break
        problem, u = problem.halved(u, chosen)
        value = yield Query(problem, u)
    if not value.is_finite:
        return None
    tangent = kernel_of(value)
    nodes, _, at = problem.parts(tangent)
    tangent = tangent * (1.0 if np.append(nodes[0], at) @ along >= 0.0 else -1.0)
    point = yield from correct(problem, u, tangent, settings)
    return None if point is None else (problem, point)


def cut_doubled(single: Family, at: Point, settings: Settings) -> Steps[tuple[CutProblem, Point] | None]:
    """Return the start of the doubled branch at a period doubling, with the orbit cut where it is steep; None on
    failure.
    """
    cut = yield from cut_where_steep(*whole_orbit(single, at), at.tangent, settings)
    if cut is None:
        return None
    problem, u, tangent = cut[0].doubled(cut[1])
    value = yield Query(problem, u)
    return (problem, Point(u, tangent, value, 0)) if value.is_finite else None
