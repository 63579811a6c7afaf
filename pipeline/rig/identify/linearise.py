"""Linearise a fit for its statistics: compute residuals and their derivatives at each sample, and eliminate the initial
states.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.orbit_rows import OrbitRows, orbit_rows
from pipeline.rig.identify.problem import Problem
from pipeline.rig.identify.statistics import Linearised, eliminate_starts, robust_weights

STEP = 1e-4
"""Step of the central differences in units of the sizes; their error is about its square."""

RTOL = 1e-10
"""Tolerance of the integration under the differences; a slope's noise is this over `STEP`."""

MAD = 1.4826
"""Ratio of the standard deviation of Gaussian noise to its median absolute value."""


def linearise(problem: Problem, fit: Fit) -> Linearised:
    """Return the residuals at a fit's optimum and their derivatives by the parameters, with the initial states
    eliminated.

    The fit's own slopes are compressed piece by piece. Statistics of autocorrelated residuals need them along
    time.
    """
    n_free, n_states = len(problem.free), len(problem.model.states)
    scale = loss_scale_of(problem, fit)
    full = sample_slopes(problem, fit) if problem.pieces else []
    joined = problem.continuity is not None
    follow = eliminate_starts(fit.jacobian, n_free)[1] if joined else None
    slopes, following = [], []
    for k, own in enumerate(full):
        flat = own.reshape(-1, own.shape[-1])
        # free starts are eliminated piece by piece here: the fit's one-sided differences are less exact
        moves = eliminate_starts(flat, n_free)[1] if follow is None else follow[k * n_states : (k + 1) * n_states]
        slopes.append(own[..., :n_free] - own[..., n_free:] @ moves)
        following.append(-moves)
    prior = np.array([f.prior_sd**-2 if f.has_prior else 0.0 for f in problem.free])
    residuals = tuple(r / problem.noise for r in fit.residuals)
    of_orbits = _at_orbits(problem, fit)
    information = _information(problem, fit, slopes, residuals, prior, scale)
    if of_orbits is not None and not joined:
        information = information + of_orbits.jacobian.T @ of_orbits.jacobian
    return Linearised(
        information,
        prior,
        residuals,
        tuple(slopes),
        groups_of(problem),
        fit.starts.size,
        problem.loss,
        scale,
        np.array(following),
        None if of_orbits is None else of_orbits.jacobian,
        None if of_orbits is None else of_orbits.rows,
    )


def _at_orbits(problem: Problem, fit: Fit) -> OrbitRows | None:
    if not problem.orbits:
        return None
    return orbit_rows(problem.with_orbits(fit.known), fit.theta[None], slopes=True)[0]


def _information(
    problem: Problem,
    fit: Fit,
    slopes: list[np.ndarray],
    residuals: tuple[np.ndarray, ...],
    prior: np.ndarray,
    scale: float,
) -> np.ndarray:
    """Return the information matrix of the unknowns, summed over samples, or from the whole Jacobian if pieces are
    coupled.
    """
    if problem.continuity is not None:
        return eliminate_starts(fit.jacobian, len(problem.free))[0]
    total = np.diag(prior)
    for r, own in zip(residuals, slopes, strict=True):
        there = np.isfinite(r)
        bend = np.where(there, robust_weights(np.where(there, r, 0.0) / scale, problem.loss)[1], 0.0)
        known = np.where(there[..., None], own, 0.0)
        total = total + np.einsum("tcp,tc,tcq->pq", known, bend, known)
    return total


def loss_scale_of(problem: Problem, fit: Fit) -> float:
    """Return the residual, in units of the noise, above which a robust loss grows slower than the square; see
    `fit_local`.
    """
    if problem.loss == "linear":
        return 1.0
    z = np.concatenate(fit.residuals) / problem.noise
    return max(MAD * float(np.nanmedian(np.abs(z))), 1.0)


def groups_of(problem: Problem) -> tuple[int, ...]:
    """Return the group number of each piece. Consecutive pieces tied by a continuity weight form one group; any other
    piece forms a group alone.
    """
    found: list[int] = []
    for k, piece in enumerate(problem.pieces):
        joined = problem.continuity is not None and 0 <= piece.follows < k
        found.append(found[piece.follows] if joined else k)
    return tuple(found)


def sample_slopes(problem: Problem, fit: Fit) -> list[np.ndarray]:
    """Return, for each piece, the derivatives of the residuals at each sample by the unknowns and by the piece's
    initial state, in units of the noise.

    They are central differences from one call of the engine. The starts of all pieces are changed at once,
    since no piece depends on another's start. At a bound the differences are one-sided.
    """
    n_free, scales = len(problem.free), problem.model.scales
    thetas, starts, widths = [], [], []
    for i, free in enumerate(problem.free):
        h = STEP * max(abs(float(fit.theta[i])), free.size)
        ends = np.clip(fit.theta[i] + h * np.array([1.0, -1.0]), free.lower, free.upper)
        for end in ends:
            theta = fit.theta.copy()
            theta[i] = end
            thetas.append(theta)
            starts.append(fit.starts)
        widths.append(float(ends[0] - ends[1]))
    for s, scale in enumerate(scales):
        for sign in (1.0, -1.0):
            moved = fit.starts.copy()
            moved[:, s] += sign * STEP * scale
            thetas.append(fit.theta)
            starts.append(moved)
        widths.append(2 * STEP * scale)
    exact = replace(problem, rtol=min(problem.rtol, RTOL), continuity=None, orbits=())
    found = evaluate(exact, np.array(thetas), np.array(starts), slopes=False)
    slopes = []
    for k in range(len(problem.pieces)):
        own = [
            (found[2 * j].residuals[k] - found[2 * j + 1].residuals[k]) / (widths[j] * problem.noise)
            for j in range(n_free + len(scales))
        ]
        slopes.append(np.nan_to_num(np.stack(own, axis=-1)))
    return slopes
