"""Least squares to rounding, and what its residuals say of the numbers found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

_EPS = np.finfo(np.float64).eps
MAX_EVALUATIONS = 4000


@dataclass(frozen=True)
class Solution:
    """A converged fit by least squares.

    Attributes
    ----------
    x : ndarray
    errors : ndarray
        Standard errors.
    jacobian : ndarray
        Of the residuals, (n, n_free).
    residuals : ndarray
        Measured minus computed (n,).
    """

    x: np.ndarray
    errors: np.ndarray
    jacobian: np.ndarray
    residuals: np.ndarray

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the numbers, as far as the readings' noise is even."""
        normal = _inverse(self.jacobian)
        size = np.sqrt(np.diag(normal))
        return np.asarray(normal / size[:, None] / size)


@dataclass(frozen=True)
class Quality:
    """How well a fit meets the readings.

    Attributes
    ----------
    r2 : float
        1 - residual over total sum of squares about the mean.
    rms : float
        Of the residuals [N m].
    """

    r2: float
    rms: float

    @classmethod
    def of(cls, measured: np.ndarray, residuals: np.ndarray) -> Quality:
        """Compare residuals with what was measured."""
        total = float(((measured - measured.mean()) ** 2).sum())
        left = float(residuals @ residuals)
        return cls(1.0 - left / total if total > 0.0 else math.nan, math.sqrt(left / len(residuals)))


def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    start: Sequence[float],
    what: str,
) -> Solution:
    """Least squares by Levenberg and Marquardt, to rounding.

    Parameters
    ----------
    residuals, slopes
        Measured minus computed (n,), and its derivatives (n, n_free).
    start
        First guess.
    what
        Name of the fit, for its error.

    Raises
    ------
    ArithmeticError
        If it did not converge, or the readings do not determine all that is free.
    """
    with np.errstate(all="ignore"):
        found = least_squares(
            residuals, start, slopes, method="lm", x_scale="jac", ftol=4 * _EPS, xtol=4 * _EPS, gtol=4 * _EPS,
            max_nfev=MAX_EVALUATIONS,
        )  # fmt: skip
        finite = bool(np.isfinite(found.x).all() and np.isfinite(found.fun).all())
        if found.status < 1 or not finite:
            raise ArithmeticError(f"{what}: the fit did not converge ({found.message}); it is no result.")
        jacobian = slopes(found.x)
        variance = found.fun @ found.fun / max(len(found.fun) - len(found.x), 1)
        try:
            errors = np.sqrt(np.diag(_inverse(jacobian)) * variance)
        except np.linalg.LinAlgError:
            errors = np.full(len(found.x), np.nan)
    if not np.isfinite(errors).all():
        raise ArithmeticError(f"{what}: the readings do not determine all that is fitted; it is no result.")
    return Solution(found.x, errors, jacobian, found.fun)


def _inverse(jacobian: np.ndarray) -> np.ndarray:
    """Inverse of the normal matrix, with columns of one size on the way."""
    size = np.linalg.norm(jacobian, axis=0)
    _, s, right = np.linalg.svd(jacobian / size, full_matrices=False)
    if not s[-1] > len(jacobian) * _EPS * s[0]:
        raise np.linalg.LinAlgError
    half = right.T / s / size[:, None]
    return np.asarray(half @ half.T)


def errors_by_cluster(found: Solution, clusters: Sequence[np.ndarray]) -> np.ndarray:
    """Standard errors that allow for any likeness of residuals within a cluster.

    The jackknife over clusters, about the fit to all (CR3): what leaving out each of them does to the
    numbers, to first order. Unlike the plain sandwich it is not too small with few clusters: MacKinnon,
    Nielsen & Webb, J. Econometrics 232 (2023) 272-299.

    Parameters
    ----------
    found
        The fit.
    clusters
        Rows of each cluster; together all of them, each once.

    Returns
    -------
    ndarray
        One for each number; NaN if one cluster alone determines some of them.
    """
    normal = _inverse(found.jacobian)
    squares = np.zeros(len(found.x))
    for rows in clusters:
        own = found.jacobian[rows]
        rest = np.eye(len(rows)) - own @ normal @ own.T
        if np.linalg.cond(rest) > 1.0 / (len(found.jacobian) * _EPS):
            return np.full(len(found.x), np.nan)
        squares += (normal @ own.T @ np.linalg.solve(rest, found.residuals[rows])) ** 2
    return np.asarray(np.sqrt(squares * (len(clusters) - 1) / len(clusters)))
