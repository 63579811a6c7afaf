"""Solve nonlinear least squares to rounding error, with standard errors of the estimates."""

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
    """Result of a converged least-squares fit: estimates, standard errors, Jacobian and residuals."""

    x: np.ndarray  # estimates, (n_free,)
    errors: np.ndarray  # standard errors, (n_free,)
    jacobian: np.ndarray  # derivatives of the residuals, (n, n_free)
    residuals: np.ndarray  # measured minus computed (n,)

    @property
    def correlation(self) -> np.ndarray:
        """Correlation matrix of the estimates, for readings with equal noise."""
        normal = _inverse(self.jacobian)
        size = np.sqrt(np.diag(normal))
        return np.asarray(normal / size[:, None] / size)


@dataclass(frozen=True)
class Quality:
    """Quality of a fit: R squared, and root mean square of the residuals."""

    r2: float  # 1 - residual over total sum of squares about the mean
    rms: float  # root mean square of the residuals [N m]

    @classmethod
    def of(cls, measured: np.ndarray, residuals: np.ndarray) -> Quality:
        """Compute the quality of a fit from the readings and their residuals."""
        total = float(((measured - measured.mean()) ** 2).sum())
        left = float(residuals @ residuals)
        return cls(1.0 - left / total if total > 0.0 else math.nan, math.sqrt(left / len(residuals)))


def solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    start: Sequence[float],
    what: str,
) -> Solution:
    """Solve a nonlinear least-squares problem by the Levenberg-Marquardt method, with tolerances at the level of
    rounding errors.

    Parameters
    ----------
    residuals, slopes
        Measured minus computed (n,), and its derivatives (n, n_free).
    start
        First guess.
    what
        Name of the fit, for error messages.

    Raises
    ------
    ArithmeticError
        If it does not converge, or the readings do not determine all free parameters.
    """
    with np.errstate(all="ignore"):
        found = least_squares(
            residuals,
            start,
            slopes,
            method="lm",
            x_scale="jac",
            ftol=4 * _EPS,
            xtol=4 * _EPS,
            gtol=4 * _EPS,
            max_nfev=MAX_EVALUATIONS,
        )
        finite = bool(np.isfinite(found.x).all() and np.isfinite(found.fun).all())
        if found.status < 1 or not finite:
            raise ArithmeticError(f"{what}: the fit did not converge ({found.message}), so there is no result.")
        jacobian = slopes(found.x)
        variance = found.fun @ found.fun / max(len(found.fun) - len(found.x), 1)
        try:
            errors = np.sqrt(np.diag(_inverse(jacobian)) * variance)
        except np.linalg.LinAlgError:
            errors = np.full(len(found.x), np.nan)
    if not np.isfinite(errors).all():
        raise ArithmeticError(f"{what}: the readings do not determine all fitted parameters, so there is no result.")
    return Solution(found.x, errors, jacobian, found.fun)


def _inverse(jacobian: np.ndarray) -> np.ndarray:
    """Return the inverse of the normal matrix ``J.T @ J``. The columns of the Jacobian ``J`` are scaled to equal size
    for accuracy.
    """
    size = np.linalg.norm(jacobian, axis=0)
    _, s, right = np.linalg.svd(jacobian / size, full_matrices=False)
    if not s[-1] > len(jacobian) * _EPS * s[0]:
        raise np.linalg.LinAlgError
    half = right.T / s / size[:, None]
    return np.asarray(half @ half.T)


def errors_by_cluster(found: Solution, clusters: Sequence[np.ndarray]) -> np.ndarray:
    """Return the standard errors of fitted parameters by a jackknife over clusters of readings. Residuals may be
    correlated within a cluster.

    This is the jackknife over clusters about the fit to all readings (CR3): each cluster is left out in turn,
    to first order. Unlike the plain sandwich, its errors are not too small with few clusters: MacKinnon,
    Nielsen & Webb, J. Econometrics 232 (2023) 272-299.

    Parameters
    ----------
    found
        Solution of the fit.
    clusters
        Rows of each cluster; every row belongs to one cluster.

    Returns
    -------
    ndarray
        One error for each parameter; all NaN if one cluster alone determines some of them.
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
