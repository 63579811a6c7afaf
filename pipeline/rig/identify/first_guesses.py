"""Fit the initial states of the pieces of recordings for given parameters, or eliminate these states from the fit."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.identify.objective import Evaluation, evaluate
from pipeline.rig.identify.problem import Problem

Array = NDArray[np.float64]

MAX_ITERATIONS = 40
FIRST_DAMPING, LESS, MORE, MOST_DAMPING = 1e-3, 0.1, 10.0, 1e12
N_PHASES = 12
"""Number of phases of a known drive from which the best one is chosen."""

SETTLED = 1e-10
"""Relative decrease of a piece's cost, predicted by its slopes, below which its start is found."""


class Starts(NamedTuple):
    """Fitted initial states of the pieces, and whether each has converged."""

    starts: Array  # (n_piece, n_states)
    settled: NDArray[np.bool_]  # (n_piece,)


class ManyStarts(NamedTuple):
    """Fitted initial states of the pieces for many sets of unknowns, whether each has converged, and the costs."""

    starts: Array  # (member, piece, n_states)
    settled: NDArray[np.bool_]  # (member, piece)
    costs: Array  # (member, piece)


def fit_starts(problem: Problem, theta: Array, starts: Array) -> Starts:
    """Fit the initial state of each piece by least squares (Levenberg-Marquardt), with the unknown parameters fixed.

    The engine integrates all pieces together; each has its own damping. Gaps between stretches do not count.

    Parameters
    ----------
    problem
        Least-squares problem of the identification.
    theta
        Unknowns, (n_free,).
    starts
        First guesses, (n_piece, n_states).

    Returns
    -------
    Starts
        No start is worse than its guess.
    """
    found = fit_many_starts(problem, theta[None], starts[None])
    return Starts(found.starts[0], found.settled[0])


def fit_many_starts(problem: Problem, thetas: Array, starts: Array) -> ManyStarts:
    """Fit the initial state of each piece, as `fit_starts`, for each row of unknowns in common calls of the engine.

    Parameters
    ----------
    problem
    thetas
        Unknowns, (member, n_free).
    starts
        First guesses, (member, piece, n_states).

    Returns
    -------
    ManyStarts
        No start is worse than its guess. Each member depends on its own unknowns and guesses alone.
    """
    held = replace(problem, continuity=None, orbits=(), held=True)
    found = np.array(starts)
    damping = np.full(found.shape[:2], FIRST_DAMPING)
    blocks = _blocks(held, thetas, found)
    moving = np.ones(found.shape[:2], bool)
    for _ in range(MAX_ITERATIONS):
        steps = np.zeros_like(found)
        for i, k in np.argwhere(moving):
            block = blocks[i][k]
            steps[i, k], gain = _step(block.jacobian, block.rows, damping[i, k])
            # below this gain, rounding decides and no step improves the start
            moving[i, k] = gain > SETTLED * _cost(block) and damping[i, k] < MOST_DAMPING
        members, pieces = np.flatnonzero(moving.any(axis=1)), np.flatnonzero(moving.any(axis=0))
        if not len(members):
            break
        part = replace(held, pieces=tuple(held.pieces[k] for k in pieces))
        trial = found[np.ix_(members, pieces)] + steps[np.ix_(members, pieces)]
        for i, own, fitted in zip(members, trial, _blocks(part, thetas[members], trial), strict=True):
            for k, start, block in zip(pieces, own, fitted, strict=True):
                if not moving[i, k]:
                    continue
                better = _cost(block) < _cost(blocks[i][k])
                damping[i, k] *= LESS if better else MORE
                if better:
                    found[i, k], blocks[i][k] = start, block
    costs = np.array([[_cost(block) for block in row] for row in blocks]).reshape(moving.shape)
    return ManyStarts(found, ~moving, costs)


def choose_phases(problem: Problem, theta: Array) -> Array:
    """Return the unknowns with the phase of each recording's known drive moved to the best of phases all round the
    circle, with initial states fitted for each.
    """
    if not problem.phases:
        return theta
    shifts = np.arange(N_PHASES) / N_PHASES
    thetas = np.tile(theta, (N_PHASES, 1))
    thetas[:, list(problem.phases.values())] += shifts[:, None]
    costs = fit_many_starts(problem, thetas, np.tile(problem.starts, (N_PHASES, 1, 1))).costs
    found = np.array(theta)
    for recording, i in problem.phases.items():
        own = [p.recording == recording for p in problem.pieces]
        found[i] += shifts[int(np.argmin(costs[:, own].sum(axis=1)))]
    return found


def block_rows(problem: Problem) -> list[slice]:
    """Return which rows of the compressed residual vector belong to each piece of the recordings, as slices."""
    n_own = len(problem.free) + len(problem.model.states)
    sizes = [min(int(np.isfinite(p.measured).sum()), n_own + 1) for p in problem.pieces]
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


class _Block(NamedTuple):
    """Residuals of one piece of a recording and their derivatives by its initial state, compressed to few rows by a QR
    decomposition.
    """

    jacobian: Array
    rows: Array


def _blocks(problem: Problem, thetas: Array, starts: Array) -> list[list[_Block]]:
    """Return the block of each piece for each row of unknowns."""
    n, n_free = len(problem.model.states), len(problem.free)
    return [
        [
            _Block(whole.jacobian[here, n_free + k * n : n_free + (k + 1) * n], whole.rows[here])
            for k, here in enumerate(block_rows(problem))
        ]
        for whole in evaluate(problem, thetas, starts, slopes=True)
    ]


def _cost(block: _Block) -> float:
    return float(0.5 * block.rows @ block.rows)


def _step(jacobian: Array, rows: Array, damping: float) -> tuple[Array, float]:
    """Return a damped Gauss-Newton step, and the decrease of the cost that an undamped step would give."""
    size = np.sqrt(damping) * np.linalg.norm(jacobian, axis=0)
    stacked = np.vstack([jacobian, np.diag(np.maximum(size, 1e-300))])
    right = np.concatenate([-rows, np.zeros(len(size))])
    within = np.linalg.qr(jacobian)[0].T @ rows
    return np.linalg.lstsq(stacked, right, rcond=None)[0], float(0.5 * within @ within)


def _own(problem: Problem, evaluation: Evaluation, k: int, here: slice) -> Array:
    """Return the Jacobian of one piece's residuals with respect to the initial state of that piece."""
    n, n_free = len(problem.model.states), len(problem.free)
    return evaluation.jacobian[here, n_free + k * n : n_free + (k + 1) * n]


def carry_starts(problem: Problem, evaluation: Evaluation, starts: Array, change: Array) -> Array:
    """Return the optimal initial states after a small change of the unknowns, by linearisation, (n_piece, n_states)."""
    found, n_free = np.array(starts), len(problem.free)
    for k, here in enumerate(block_rows(problem)):
        wanted = evaluation.rows[here] + evaluation.jacobian[here, :n_free] @ change
        found[k] -= np.linalg.lstsq(_own(problem, evaluation, k, here), wanted, rcond=None)[0]
    return found


def project_starts_out(problem: Problem, evaluation: Evaluation) -> tuple[Array, Array]:
    """Return residuals and their derivatives by the unknowns, with the directions of the initial states projected out.

    Parameters
    ----------
    problem
        Least-squares problem of the identification.
    evaluation
        Evaluation with slopes, at starts that are optimal for its unknowns.

    Returns
    -------
    tuple of ndarray
        (m,) and (m, n_free): ``rows @ rows / 2`` is the cost.
    """
    n, n_free, last = len(problem.model.states), len(problem.free), 0
    rows, slopes = [], []
    for k, here in enumerate(block_rows(problem)):
        full: Array = np.linalg.qr(_own(problem, evaluation, k, here), mode="complete")[0]
        rest = full[:, n:].T
        rows.append(rest @ evaluation.rows[here])
        slopes.append(rest @ evaluation.jacobian[here, :n_free])
        last = here.stop
    rows.append(evaluation.rows[last:])
    slopes.append(evaluation.jacobian[last:, :n_free])
    return np.concatenate(rows), np.vstack(slopes)
