"""Decide whether a set attracts, from eigenvalues and their errors, and name the evidence.

==============  ======================================================================================
stability       evidence
==============  ======================================================================================
attracts        eigenvalues with negative real parts, multipliers inside the unit circle, by more than
                their error; for a degenerate orbit or equilibrium, trajectories on both sides that come
                nearer; for any other set, a sample of its cells that stayed long enough
unstable        an eigenvalue or a multiplier outside, by more than its error; for a half-stable equilibrium,
                trajectories of one side that leave
transient       cells of the set left it
not settled     none: the budget was too short, or Newton's method ended in vain (``step_limit``,
                ``no_return``, ``no_convergence``)
neutral         eigenvalues or multipliers on the axis or circle within their error, or a flow that
                preserves volume
==============  ======================================================================================

A sample has stayed long enough when each of its cells stayed ten times the longest transient seen at the
parameter point (the time before the last kept section counts as seen), or when the lower end of the
lifetime's 95 % interval is that long, and when the early and the late half of the extension fill the same
points (`clouds.mixing`).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from magpend_core.status import Status
from pipeline.layout.vocabulary import ATTRACTS, EVIDENCE, NEUTRAL, UNSTABLE

(BY_NOTHING, BY_EIGENVALUES, BY_MULTIPLIERS, BY_APPROACH, BY_STAYING, BY_LEAVING, BY_VOLUME, BY_ONE_SIDE) = range(8)
"""Values of `evidence`."""


def largest_error(matrix: np.ndarray, size: float, *, real: bool = False) -> float:
    """Estimate the error of the leading eigenvalue of a matrix whose entries have errors up to `size`.

    The matrix is perturbed a few times. So a multiple eigenvalue, which moves by a root of the perturbation,
    gets its larger error.

    Parameters
    ----------
    matrix
        Matrix, shape (n, n).
    size
        Absolute error of an entry.
    real
        Whether the leading eigenvalue has the largest real part; else the largest modulus.

    Returns
    -------
    float
        Largest change of that real part or modulus; NaN if the matrix is not finite.
    """
    if not np.isfinite(matrix).all():
        return float("nan")
    values = np.linalg.eigvals(np.concatenate([matrix[None], matrix + size * _signs(matrix.shape)]))
    leading = (values.real if real else np.abs(values)).max(axis=1)
    return float(np.abs(leading[1:] - leading[0]).max())


@cache
def _signs(shape: tuple[int, ...]) -> np.ndarray:
    trials = 8
    return np.random.default_rng(0).choice([-1.0, 1.0], (trials, *shape))


def by_failure(status: int) -> int:
    """Return the evidence code of a set on which Newton's method ended with a `Status`; 0 stands for not tried."""
    if not status:
        return BY_NOTHING
    words = {Status.STEP_LIMIT: "step_limit", Status.STEP_UNDERFLOW: "step_limit", Status.NO_RETURN: "no_return"}
    return EVIDENCE.index(words.get(Status(status), "no_convergence"))


def by_margin(leading: float, bound: float, error: float) -> int:
    """Return a stability code: attracting if the leading eigenvalue is below the bound, unstable if above, neutral if
    within its error.

    Within the error of the bound, return `NEUTRAL`.
    """
    if leading < bound - error:
        return ATTRACTS
    return UNSTABLE if leading > bound + error else NEUTRAL
