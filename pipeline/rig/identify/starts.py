"""The pieces' starts for given parameters: small problems of their own, solved side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import Problem

Array = NDArray[np.float64]

MAX_ITERATIONS = 40
FIRST_DAMPING, LESS, MORE, MOST_DAMPING = 1e-3, 0.1, 10.0, 1e12
SETTLED = 1e-6
"""Relative decrease of a piece's cost at which its start counts as found."""


def fit_starts(problem: Problem, theta: Array, starts: Array) -> Array:
    """Least squares of each piece over its own start, the unknowns held (Levenberg and Marquardt).

    All pieces go together through the engine, each with its own damping; gaps between stretches and a robust
    loss do not count: this prepares a fit of everything.

    Parameters
    ----------
    problem
    theta
        Unknowns, (n_free,).
    starts
        First guesses, (n_piece, n_states).

    Returns
    -------
    ndarray, (n_piece, n_states)
        None of them worse than its guess.
    """
    held = replace(
        problem.without(dict(zip(problem.names, theta, strict=True))), continuity=None, loss="linear"
    )
    found = np.array(starts)
    damping = np.full(len(found), FIRST_DAMPING)
    costs, slopes = _blocks(held, found)
    moving = np.ones(len(found), bool)
    for _ in range(MAX_ITERATIONS):
        trial = found + _steps(slopes, damping) * moving[:, None]
        new_costs, new_slopes = _blocks(held, trial)
        better = moving & (new_costs < costs)
        settled = better & (costs - new_costs < SETTLED * costs)
        found[better], damping[better] = trial[better], damping[better] * LESS
        damping[moving & ~better] *= MORE
        costs = np.where(better, new_costs, costs)
        slopes = [new if b else old for new, old, b in zip(new_slopes, slopes, better, strict=True)]
        moving &= ~settled & (damping < MOST_DAMPING)
        if not moving.any():
            break
    return found


def _blocks(problem: Problem, starts: Array) -> tuple[Array, list[tuple[Array, Array]]]:
    """Cost of each piece, and its compressed slopes and rows."""
    n = len(problem.model.states)
    whole = evaluate(problem, np.zeros((1, 0)), starts[None], slopes=True)[0]
    blocks, at = [], 0
    for k, piece in enumerate(problem.pieces):
        size = min(int(np.isfinite(piece.measured).sum()), n + 1)
        here = slice(at, at + size)
        blocks.append((whole.jacobian[here, k * n : (k + 1) * n], whole.rows[here]))
        at += size
    return np.array([0.5 * rows @ rows for _, rows in blocks]), blocks


def _steps(blocks: list[tuple[Array, Array]], damping: Array) -> Array:
    """Damped Gauss-Newton steps, (n_piece, n_states)."""
    found = []
    for (jacobian, rows), weight in zip(blocks, damping, strict=True):
        size = np.sqrt(weight) * np.linalg.norm(jacobian, axis=0)
        stacked = np.vstack([jacobian, np.diag(np.maximum(size, 1e-300))])
        right = np.concatenate([-rows, np.zeros(len(size))])
        found.append(np.linalg.lstsq(stacked, right, rcond=None)[0])
    return np.array(found)
