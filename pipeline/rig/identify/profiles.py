"""Compute profile likelihoods: the increase of the cost when one parameter is fixed away from its estimate.

The growth is scaled by the covariance, autocorrelated residuals included. On a quadratic criterion the
profile's interval therefore equals the interval of the standard error. On any other criterion the profile's
interval is the better one (Raue et al., Bioinformatics 25, 2009, 1923).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pipeline.rig.identify.local import Fit
    from pipeline.rig.identify.problem import Problem

STEPS = (0.4, 0.8, 1.2, 1.6)
"""Distances at which a profile is computed on either side, in half widths of the interval."""

TOLERANCES = (1e-9, 1e-6)
"""Smallest and largest tolerance of the fits, see `pipeline.rig.identify.local.fit_local`."""

UNKNOWN_STEP = 0.1
"""Half width that is tried if the standard error is unknown, relative to the parameter's size."""


@dataclass(frozen=True)
class Profile:
    """Profile likelihood of one parameter: the scaled increase of the cost away from the estimate, and its 95 %
    interval.
    """

    name: str
    values: np.ndarray  # (n,) rising, in the parameter's unit; the estimate is among them
    # (n,) twice the growth of the cost over the best fit, scaled so that it is 1 at one standard error on a quadratic
    # criterion. NaN where a fit did not converge.
    growth: np.ndarray
    # 95 % interval; infinite where the profile does not rise far enough within the bounds
    interval: tuple[float, float]

    @property
    def lowest(self) -> float:
        """Least increase of the cost along the profile; negative if the profile found a better fit than the search
        did.
        """
        return float(np.nanmin(self.growth))


@dataclass(frozen=True)
class Curvature:
    """Quadratic approximation of the cost along one parameter near its estimate, and the scales of its profile."""

    error: float  # standard error; infinite if it is not known
    plain: float  # standard error for independent residuals as large as the noise
    critical: float  # half width of the interval in standard errors
    size: float
    others: np.ndarray  # (n_free,) derivative of the optimum of all parameters by this one
    starts: np.ndarray  # (n_piece, n_states) derivative of the optimum of the starts by this parameter


def profile(problem: Problem, best: Fit, name: str, about: Curvature, fit_local: Callable[..., Fit]) -> Profile:
    """Compute the profile likelihood of one parameter: at each of its values, all other unknowns are fitted again.

    Parameters
    ----------
    problem, best
        Problem that was fitted, and its best fit.
    name
        Name of the free parameter.
    about
        Curvature along the parameter.
    fit_local
        See `pipeline.rig.identify.local.fit_local`.
    """
    index = [f.name for f in problem.free].index(name)
    free = problem.free[index]
    estimate = float(best.theta[index])
    known = np.isfinite(about.error) and about.error > 0
    half = about.critical * about.error if known else UNKNOWN_STEP * about.size
    unit = (about.error / about.plain) ** 2 if known else 1.0
    # so that the cost is accurate to a hundredth of its growth at one standard error
    tolerance = float(np.clip(0.05 * unit / max(best.cost, 1e-300), *TOLERANCES))
    found = {estimate: 0.0}
    for side in (-1.0, 1.0):
        theta, starts, at = best.theta, best.starts, estimate
        for step in STEPS:
            value = float(np.clip(estimate + side * step * half, free.lower, free.upper))
            if value in found:
                break
            theta = theta + (value - at) * about.others
            starts = starts + (value - at) * about.starts
            fit = fit_local(problem, theta, starts=starts, fixed={name: value}, tolerance=tolerance)
            found[value] = 2.0 * (fit.cost - best.cost) / unit if fit.converged else np.nan
            theta, starts, at = fit.theta, fit.starts, value
    values = np.array(sorted(found))
    growth = np.array([found[float(v)] for v in values])
    return Profile(name, values, growth, interval_of(values, growth, estimate, about.critical))


def following(information: np.ndarray, index: int) -> np.ndarray:
    """Return the change of all optimal parameters per unit change of one parameter that is held fixed, shape
    (n_free,).
    """
    others = np.delete(np.arange(len(information)), index)
    moves = np.ones(len(information))
    both = information[np.ix_(others, others)]
    # scaled, so that small columns are not taken for singular ones
    size = np.sqrt(np.maximum(np.diag(both), 1e-300))
    inverse = np.linalg.pinv(both / np.outer(size, size), rcond=1e-10, hermitian=True)
    moves[others] = -(inverse @ (information[others, index] / size)) / size
    return moves


def interval_of(values: np.ndarray, growth: np.ndarray, estimate: float, critical: float) -> tuple[float, float]:
    """Return the ends of a parameter's interval: where the square root of its profile likelihood reaches the critical
    value.

    Parameters
    ----------
    values, growth
        See `Profile`.
    estimate
        Value at which the growth is 0.
    critical
        Half width of the interval in standard errors.
    """
    ends: list[Any] = []
    for side in (-1.0, 1.0):
        own = np.isfinite(growth) & (side * (values - estimate) >= 0)
        order = np.argsort(np.abs(values[own] - estimate))
        x, root = values[own][order], np.sqrt(np.maximum(growth[own][order], 0.0))
        over = np.flatnonzero(root >= critical)
        if not over.size:
            ends.append(side * np.inf)
            continue
        k = int(over[0])
        share = (critical - root[k - 1]) / (root[k] - root[k - 1])
        ends.append(float(x[k - 1] + share * (x[k] - x[k - 1])))
    return ends[0], ends[1]
