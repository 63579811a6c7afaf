"""Residuals and slopes of a whole population of unknowns, in one call of the engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magpend_core.sampling import sample
from magpend_core.status import Status
from pipeline.rig.identify.problem import Problem

Array = NDArray[np.float64]

STEP = 1e-5
"""Step of the differences, in units of an unknown's size: measured against the variational equations."""

SLOPES_RTOL = 1e-9
"""Largest tolerance where differences are taken."""

LOST = 1e6
"""Residual, in units of the noise, where a trajectory has diverged."""


@dataclass(frozen=True)
class Evaluation:
    """A member of a population.

    Attributes
    ----------
    residuals : tuple of ndarray, (n, n_channels)
        Measured less computed, piece by piece [SI]; NaN where nothing was measured.
    rows : ndarray, (m,)
        Residuals in units of the noise; with slopes, compressed by an orthogonal transformation per piece, so
        that ``rows @ rows / 2`` is the cost all the same.
    jacobian : ndarray, (m, n_free + n_piece*n_states)
        Slopes of `rows`: the unknowns first, then the starts, piece by piece; empty without slopes.
    failed : int
        Pieces whose trajectory did not reach its end.
    """

    residuals: tuple[Array, ...]
    rows: Array
    jacobian: Array
    failed: int

    @property
    def cost(self) -> float:
        """Half the sum of squares, in units of the noise."""
        return float(0.5 * self.rows @ self.rows)


class _Lanes(NamedTuple):
    """Which trajectory is what: of each member, its pieces, each as it is and with one thing changed."""

    theta: Array  # (member, change, n_free)
    start: Array  # (member, change, n_piece, n_states)
    steps: Array  # (member, change): 0 for the first, which changes nothing


def evaluate(problem: Problem, thetas: Array, starts: Array, *, slopes: bool) -> list[Evaluation]:
    """Evaluate a population.

    Parameters
    ----------
    problem
    thetas
        Unknowns, shape (n, n_free) [SI].
    starts
        Starts of the pieces, shape (n, n_piece, n_states) [SI].
    slopes
        Whether slopes are wanted; they are differences between lanes, one-sided.

    Returns
    -------
    list of Evaluation
    """
    lanes = _lanes(problem, thetas, starts, slopes)
    states, failed = _integrate(problem, lanes)
    found = []
    for i in range(len(thetas)):
        blocks = [
            _block(problem, k, lanes, i, states[i, :, k], bool(failed[i, :, k].any()), slopes)
            for k in range(len(problem.pieces))
        ]
        blocks += _gaps(problem, lanes, i, states[i], failed[i], slopes)
        residuals = tuple(
            p.measured - _read(problem, k, states[i, 0, k], thetas[i]) for k, p in enumerate(problem.pieces)
        )
        rows, jacobian = _with_priors(problem, thetas[i], blocks, slopes)
        found.append(Evaluation(residuals, rows, jacobian, int(failed[i, 0].sum())))
    return found


def _lanes(problem: Problem, thetas: Array, starts: Array, slopes: bool) -> _Lanes:
    """Set the unknowns and starts of all trajectories; steps stay within the bounds."""
    n, n_states = len(thetas), len(problem.model.states)
    changes = [*problem.moving, *range(len(problem.free), len(problem.free) + n_states)] if slopes else []
    theta = np.repeat(thetas[:, None], 1 + len(changes), axis=1)
    start = np.repeat(starts[:, None], 1 + len(changes), axis=1)
    steps = np.zeros((n, 1 + len(changes)))
    for j, change in enumerate(changes, 1):
        if change < len(problem.free):
            f = problem.free[change]
            h = STEP * np.maximum(np.abs(thetas[:, change]), f.size)
            h = np.where(thetas[:, change] + h > f.upper, -h, h)
            theta[:, j, change] += h
            steps[:, j] = theta[:, j, change] - thetas[:, change]
        else:
            s = change - len(problem.free)
            h = STEP * problem.model.scales[s]
            start[:, j, :, s] += h
            steps[:, j] = h
    return _Lanes(theta, start, steps)


def _integrate(problem: Problem, lanes: _Lanes) -> tuple[Array, NDArray[np.bool_]]:
    """States (member, change, piece, time, n_states), and which trajectories failed."""
    shape = lanes.start.shape[:3]
    n_pieces = shape[2]
    packed = problem.pack(lanes.theta.reshape(shape[0] * shape[1], len(problem.free)))
    piece = np.tile(np.arange(n_pieces), shape[0] * shape[1])
    grids = [_grid(problem, k) for k in range(n_pieces)]
    drives = [p.drive for p in problem.pieces]
    tolerance = min(problem.rtol, SLOPES_RTOL) if shape[1] > 1 else problem.rtol
    found = sample(
        problem.system, np.repeat(packed, n_pieces, axis=0), lanes.start.reshape(len(piece), -1), grids,
        piece=piece, drives=drives if any(d is not None for d in drives) else None,
        columns=None if problem.continuity is not None else problem.columns, rtol=tolerance, atol=tolerance,
    )  # fmt: skip
    states = found.states.reshape(*shape, *found.states.shape[1:])
    return states, (found.status != int(Status.BOUNDED)).reshape(shape)


def _grid(problem: Problem, k: int) -> Array:
    """Times of a piece, and the start of the one that continues it where that counts."""
    time = problem.pieces[k].time
    if problem.continuity is None or not any(p.follows == k for p in problem.pieces):
        return time
    return np.append(time, 2 * time[-1] - time[-2])


def _read(problem: Problem, k: int, states: Array, theta: Array) -> Array:
    """What the sensors read of computed states, (..., n, n_channels)."""
    n = len(problem.pieces[k].time)
    offset = problem.zeros[problem.pieces[k].recording] @ theta
    read = states if problem.continuity is None else states[..., list(problem.columns)]
    return np.asarray(read[..., :n, :] + offset)


def _block(
    problem: Problem, k: int, lanes: _Lanes, i: int, states: Array, failed: bool, slopes: bool
) -> tuple[int, Array, Array]:
    """A piece's number, rows and slopes by the unknowns and its own start, compressed."""
    piece, n_free = problem.pieces[k], len(problem.free)
    n_own = n_free + len(problem.model.states)
    given = np.isfinite(piece.measured)
    base = _read(problem, k, states[0], lanes.theta[i, 0])
    z = ((piece.measured - base) / problem.noise)[given]
    if failed:
        rows = np.full(given.sum(), LOST)
        return k, (rows[: n_own + 1] if slopes else rows), np.zeros((min(len(rows), n_own + 1), n_own))
    rows, factor = _robust(z, problem)
    if not slopes:
        return k, rows, np.zeros((len(rows), n_own))
    jacobian = np.zeros((len(rows), n_own))
    order = [*problem.moving, *range(n_free, n_own)]
    for j, column in enumerate(order, 1):
        moved = _read(problem, k, states[j], lanes.theta[i, 0])
        jacobian[:, column] = ((base - moved) / problem.noise)[given] / lanes.steps[i, j] * factor
    zero = -problem.zeros[piece.recording] / problem.noise[:, None]
    jacobian[:, :n_free] += np.broadcast_to(zero, (*given.shape, n_free))[given] * factor[:, None]
    # an orthogonal transformation changes neither the cost nor the normal equations
    triangle: Array = np.linalg.qr(np.column_stack([jacobian, rows]), mode="r")  # type: ignore[assignment]
    return k, triangle[:, -1], triangle[:, :-1]


def _robust(z: Array, problem: Problem) -> tuple[Array, Array]:
    """Rows whose halved squares add up to the loss, and their slope by the residual `z`."""
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


def _gaps(
    problem: Problem, lanes: _Lanes, i: int, states: Array, failed: NDArray[np.bool_], slopes: bool
) -> list[tuple[int, Array, Array]]:
    """Rows of the gaps between stretches and their successors; slopes by the unknowns and by both starts."""
    if problem.continuity is None:
        return []
    n_free, n_states = len(problem.free), len(problem.model.states)
    weight = problem.continuity / problem.state_noise
    found = []
    for k, piece in enumerate(problem.pieces):
        j = piece.follows
        if j < 0:
            continue
        end = states[:, j, len(problem.pieces[j].time)]
        rows = np.full(n_states, LOST) if failed[:, j].any() else (end[0] - lanes.start[i, 0, k]) * weight
        jacobian = np.zeros((n_states, n_free + 2 * n_states))
        if slopes and not failed[:, j].any():
            order = [*problem.moving, *range(n_free, n_free + n_states)]
            for change, column in enumerate(order, 1):
                jacobian[:, column] = (end[change] - end[0]) * weight / lanes.steps[i, change]
            jacobian[:, n_free + n_states :] = -np.diag(weight)
        found.append((-1 - k, rows, jacobian))
    return found


def _with_priors(
    problem: Problem, theta: Array, blocks: list[tuple[int, Array, Array]], slopes: bool
) -> tuple[Array, Array]:
    """Stack the blocks, each at its columns, and the independent measurements below them."""
    priors = [(i, f) for i, f in enumerate(problem.free) if f.has_prior]
    last = np.array([(f.prior_mean - theta[i]) / f.prior_sd for i, f in priors])
    rows = np.concatenate([*(b[1] for b in blocks), last])
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
    for row, (i, f) in enumerate(priors, at):
        jacobian[row, i] = -1.0 / f.prior_sd
    return rows, jacobian
