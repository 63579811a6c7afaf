"""Compute residuals and their derivatives for many sets of unknowns in one call of the engine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magpend_core.engine.system import System
from magpend_core.engine.variational import MINUS, PLUS, with_parameter_tangent
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from pipeline.analysis.branches.carrying import OrbitData
from pipeline.rig.identify.orbit_residuals import LOST, OrbitRows, orbit_rows
from pipeline.rig.identify.problem import Problem

Array = NDArray[np.float64]

DIFFERENCE_STEP = 1e-5
"""Step of the differences in units of an unknown's size; slopes are accurate to 1e-5 to 1e-3."""

VARIATIONAL = "variational"
"""Value of `Problem.slopes` for slopes by variational equations."""


@dataclass(frozen=True)
class Evaluation:
    """Residuals, and on request their derivatives, for one set of unknowns."""

    # (n, n_channels) measured less computed, piece by piece [SI]; NaN where nothing was measured
    residuals: tuple[Array, ...]
    # (m,) residuals in units of the noise. With slopes they are compressed by an orthogonal transformation per piece,
    # which keeps the cost, ``rows @ rows / 2``.
    rows: Array
    # (m, n_free + n_piece*n_states) slopes of `rows`: the unknowns first, then the starts, piece by piece; empty
    # without slopes
    jacobian: Array
    failed: int  # number of pieces whose trajectory did not reach its end, and of measured orbits that were not found
    orbits: tuple[OrbitData, ...] = ()  # measured orbits, with the computed ones of these unknowns

    @property
    def cost(self) -> float:
        """Cost of the fit: half the sum of the squared residuals, in units of the noise."""
        return float(0.5 * self.rows @ self.rows)


class _Motions(NamedTuple):
    """Computed trajectories of all pieces, and their derivatives by the unknowns and initial states."""

    states: Array  # (member, piece, time, column)
    slopes: Array  # (member, change, piece, time, column): by the moving unknowns, then by the own start
    failed: NDArray[np.bool_]  # (member, piece)


def evaluate(problem: Problem, thetas: Array, starts: Array, *, slopes: bool) -> list[Evaluation]:
    """Compute the residuals of a fit, and on request their derivatives, for each row of a matrix of unknowns.

    `thetas` are unknowns, (n, n_free) [SI], and `starts` those of the pieces, (n, n_piece, n_states) [SI].
    `Problem.slopes` selects the method of slopes.
    """
    of_orbits = orbit_rows(problem, thetas, slopes=slopes) if problem.orbits else [None] * len(thetas)
    if not problem.pieces:
        motions = _no_motions(len(thetas))
    elif not slopes:
        motions = _without_slopes(problem, thetas, starts)
    elif problem.slopes == VARIATIONAL:
        motions = _by_tangents(problem, thetas, starts)
    else:
        motions = _by_differences(problem, thetas, starts)
    found = []
    for i in range(len(thetas)):
        member = _Motions(motions.states[i], motions.slopes[i], motions.failed[i])
        blocks = [_block(problem, k, thetas[i], member, slopes) for k in range(len(problem.pieces))]
        blocks += _gaps(problem, starts[i], member, slopes)
        residuals = tuple(
            p.measured - _read(problem, k, member.states[k]) - problem.offsets(p) @ thetas[i]
            for k, p in enumerate(problem.pieces)
        )
        orbits = of_orbits[i]
        rows, jacobian = _with_priors(problem, thetas[i], blocks, orbits, slopes)
        failed = int(member.failed.sum()) + (orbits.lost if orbits is not None else 0)
        found.append(Evaluation(residuals, rows, jacobian, failed, orbits.tables if orbits is not None else ()))
    return found


def _no_motions(n: int) -> _Motions:
    none = np.zeros((n, 0))
    return _Motions(none, none, np.zeros((n, 0), bool))


def _without_slopes(problem: Problem, thetas: Array, starts: Array) -> _Motions:
    states, failed = _integrate(problem, problem.pack(thetas)[:, None], starts[:, None], problem.rtol)
    return _Motions(states[:, 0], np.zeros((len(thetas), 0)), failed[:, 0])


def _steps(problem: Problem, thetas: Array) -> Array:
    """Return finite-difference steps, within the bounds, for the unknowns on which trajectories depend."""
    found = np.zeros((len(thetas), len(problem.sloped)))
    for j, i in enumerate(problem.sloped):
        f, values = problem.free[i], thetas[:, i]
        h = DIFFERENCE_STEP * np.maximum(np.abs(values), f.size)
        h = np.where(values + h > f.upper, -h, h)
        found[:, j] = (values + h) - values
    return found


def _changed(problem: Problem, thetas: Array, steps: Array) -> Array:
    """Return packed model parameters for finite differences: each set of unknowns with one changed at a time."""
    members = []
    for theta, own in zip(thetas, steps, strict=True):
        rows = np.tile(theta, (len(own), 1))
        rows[np.arange(len(own)), list(problem.sloped)] += own
        members.append(problem.pack(rows))
    return np.stack(members)


def _by_differences(problem: Problem, thetas: Array, starts: Array) -> _Motions:
    """Compute trajectories, and their derivatives with one unknown or component of the start changed at a time."""
    least = 1e-9  # largest tolerance of the integration if slopes are differences
    steps, n = _steps(problem, thetas), len(problem.model.states)
    moves = DIFFERENCE_STEP * np.diag(problem.model.scales)
    packed = problem.pack(thetas)[:, None]
    n_moving = len(problem.sloped)
    parameters = np.concatenate([packed, _changed(problem, thetas, steps), np.repeat(packed, n, axis=1)], axis=1)
    start = np.repeat(starts[:, None], 1 + n_moving + n, axis=1)
    start[:, 1 + n_moving :] += moves[:, None, :]
    tolerance = min(problem.rtol, least)
    states, failed = _integrate(problem, parameters, start, tolerance)
    sizes = np.concatenate([steps, np.tile(np.diag(moves), (len(thetas), 1))], axis=1)
    slopes = (states[:, 1:] - states[:, :1]) / sizes[:, :, None, None, None]
    return _Motions(states[:, 0], slopes, np.asarray(failed.any(axis=1)))


def _by_tangents(problem: Problem, thetas: Array, starts: Array) -> _Motions:
    """Compute trajectories, and their derivatives by variational equations, one tangent vector for each."""
    system, steps = with_parameter_tangent(problem.system), _steps(problem, thetas)
    n, n_moving = len(problem.model.states), len(problem.sloped)
    same = np.repeat(problem.pack(thetas)[:, None], n_moving + n, axis=1)
    plus, minus = same.copy(), same.copy()
    plus[:, :n_moving] = _changed(problem, thetas, steps)
    minus[:, :n_moving] = _changed(problem, thetas, -steps)
    per_step = np.zeros((*same.shape[:2], 1))
    per_step[:, :n_moving, 0] = 0.5 / steps
    parameters = np.concatenate([same, plus, minus, per_step], axis=2)
    start = np.zeros((len(thetas), n_moving + n, len(problem.pieces), 2 * n))
    start[..., :n] = starts[:, None]
    start[:, n_moving:, :, n:] = np.eye(n)[:, None]
    states, failed = _integrate(problem, parameters, start, problem.rtol, system)
    half = states.shape[-1] // 2
    return _Motions(states[:, 0, ..., :half], states[..., half:], np.asarray(failed.any(axis=1)))


def _integrate(
    problem: Problem, parameters: Array, starts: Array, tolerance: float, system: System | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Integrate all pieces for each set of unknowns and each change; return the states, and which failed."""
    shape, n = starts.shape[:3], len(problem.model.states)
    n_pieces = shape[2]
    columns = list(problem.columns) if problem.continuity is None else list(range(n))
    if system is not None:
        columns += [n + c for c in columns]
    own = problem.system if system is None else system
    flat = parameters.reshape(-1, parameters.shape[-1])
    packed, turns = np.split(flat, [len(own.parameter_names)], axis=1)
    # members that differ in the phase of a known drive have drives of their own
    pieces, which = list(problem.pieces), np.zeros(len(flat), np.int64)
    if turns.shape[1]:
        different, which = np.unique(turns, axis=0, return_inverse=True)
        pieces = [p.turned(*turn.reshape(-1, 2)[p.recording]) for turn in different for p in problem.pieces]
    drives = [p.drive if system is None else _thrice(p.drive) for p in pieces]
    found = sample(
        own,
        np.repeat(packed, n_pieces, axis=0),
        starts.reshape(-1, starts.shape[-1]),
        [_grid(problem, k) for k in range(n_pieces)] * (len(pieces) // n_pieces),
        piece=(which.reshape(-1, 1) * n_pieces + np.arange(n_pieces)).ravel(),
        drives=drives if any(d is not None for d in drives) else None,
        columns=columns,
        rtol=tolerance,
        atol=tolerance,
    )
    states = found.states.reshape(*shape, *found.states.shape[1:])
    return states, (found.status != int(Status.BOUNDED)).reshape(shape)


def _thrice(drive: Drive | None) -> Drive | None:
    """Return a drive with its parameter values plain, increased and decreased, for `with_parameter_tangent`."""
    if drive is None or not drive.names:
        return drive
    names = tuple(f"{name}{end}" for end in ("", PLUS, MINUS) for name in drive.names)
    return replace(drive, names=names, values=np.tile(drive.values, 3))


def _grid(problem: Problem, k: int) -> Array:
    """Return the sample times of a piece, then the start of the next piece if the fit penalises their gap."""
    time = problem.pieces[k].time
    if problem.continuity is None or not any(p.follows == k for p in problem.pieces):
        return time
    return np.append(time, 2 * time[-1] - time[-2])


def _read(problem: Problem, k: int, states: Array) -> Array:
    """Return the computed values of the measured states at the sample times of a piece, shape (..., n, n_channels)."""
    n = len(problem.pieces[k].time)
    read = states if problem.continuity is None else states[..., list(problem.columns)]
    return np.asarray(read[..., :n, :])


def _block(problem: Problem, k: int, theta: Array, member: _Motions, slopes: bool) -> tuple[int, Array, Array]:
    """Return a piece's number, its compressed residuals, and their derivatives by the unknowns and its start."""
    piece, n_free = problem.pieces[k], len(problem.free)
    n_own = n_free + len(problem.model.states)
    given = np.isfinite(piece.measured)
    if member.failed[k]:
        rows = np.full(min(int(given.sum()), n_own + 1) if slopes else int(given.sum()), LOST)
        return k, rows, np.zeros((len(rows), n_own))
    offsets = problem.offsets(piece)
    z = ((piece.measured - _read(problem, k, member.states[k]) - offsets @ theta) / problem.noise)[given]
    rows, factor = _robust(z, problem)
    if not slopes:
        return k, rows, np.zeros((len(rows), n_own))
    jacobian = np.zeros((len(rows), n_own))
    zero = -offsets / problem.noise[:, None]
    jacobian[:, :n_free] = np.broadcast_to(zero, (*given.shape, n_free))[given]
    moved = -_read(problem, k, member.slopes[:, k]) / problem.noise
    jacobian[:, [*problem.sloped, *range(n_free, n_own)]] += moved[:, given].T
    # an orthogonal transformation changes neither the cost nor the normal equations
    whole = np.column_stack([jacobian * factor[:, None], rows])
    triangle: Array = np.asarray(np.linalg.qr(whole, mode="r"))
    return k, triangle[:, -1], triangle[:, :-1]


def _robust(z: Array, problem: Problem) -> tuple[Array, Array]:
    """Return residuals whose half sum of squares is the robust loss, and the derivative of each."""
    if problem.loss == "linear":
        return z, np.ones_like(z)
    scale = problem.loss_scale
    x = (z / scale) ** 2
    if problem.loss == "soft_l1":
        rho, slope = 2 * (np.sqrt(1 + x) - 1), 1 / np.sqrt(1 + x)
    elif problem.loss == "huber":
        root = np.sqrt(np.maximum(x, 1e-300))
        rho, slope = np.where(x <= 1, x, 2 * root - 1), np.where(x <= 1, 1.0, 1 / root)
    else:
        rho, slope = np.log1p(x), 1 / (1 + x)
    rows = scale * np.sign(z) * np.sqrt(rho)
    # d(rows)/dz = slope z/rows, which is 1 at 0
    safe = np.where(rows == 0.0, 1.0, rows)
    return rows, np.where(rows == 0.0, 1.0, slope * z / safe)


def _gaps(problem: Problem, starts: Array, member: _Motions, slopes: bool) -> list[tuple[int, Array, Array]]:
    """Return the gaps between a stretch's end and the next one's start as residuals, with derivatives."""
    if problem.continuity is None:
        return []
    n_free, n_states = len(problem.free), len(problem.model.states)
    weight = problem.continuity / problem.state_noise
    found = []
    for k, piece in enumerate(problem.pieces):
        j = piece.follows
        if j < 0:
            continue
        at, lost = len(problem.pieces[j].time), member.failed[j]
        rows = np.full(n_states, LOST) if lost else (member.states[j, at] - starts[k]) * weight
        jacobian = np.zeros((n_states, n_free + 2 * n_states))
        if slopes and not lost:
            columns = [*problem.sloped, *range(n_free, n_free + n_states)]
            jacobian[:, columns] = (member.slopes[:, j, at] * weight).T
            jacobian[:, n_free + n_states :] = -np.diag(weight)
        found.append((-1 - k, rows, jacobian))
    return found


def _with_priors(
    problem: Problem, theta: Array, blocks: list[tuple[int, Array, Array]], orbits: OrbitRows | None, slopes: bool
) -> tuple[Array, Array]:
    """Stack the residuals of pieces, orbits and priors, and place their derivatives in the whole Jacobian."""
    priors = [(i, f) for i, f in enumerate(problem.free) if f.has_prior]
    last = np.array([(f.prior_mean - theta[i]) / f.prior_sd for i, f in priors])
    measured = orbits.rows if orbits is not None else np.zeros(0)
    rows = np.concatenate([*(b[1] for b in blocks), measured, last])
    if not slopes:
        return rows, np.zeros((0, 0))
    n_free, n_states = len(problem.free), len(problem.model.states)
    jacobian = np.zeros((len(rows), n_free + len(problem.pieces) * n_states))
    at = 0
    for k, own, block in blocks:
        here = slice(at, at + len(own))
        jacobian[here, :n_free] = block[:, :n_free]
        owners = [k] if k >= 0 else [problem.pieces[-1 - k].follows, -1 - k]
        for place, owner in enumerate(owners):
            columns = n_free + owner * n_states
            part = block[:, n_free + place * n_states : n_free + (place + 1) * n_states]
            jacobian[here, columns : columns + n_states] = part
        at += len(own)
    if orbits is not None:
        jacobian[at : at + len(measured), :n_free] = orbits.jacobian
        at += len(measured)
    for row, (i, f) in enumerate(priors, at):
        jacobian[row, i] = -1.0 / f.prior_sd
    return rows, jacobian
