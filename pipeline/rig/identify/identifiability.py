"""Analyse which parameters the data determine: directions in parameter space with their standard errors, and warnings
in words.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.rig.identify.statistics import Covariance

LOOSE = 0.5
"""Standard error along a direction, relative to the parameters' sizes, above which it is not determined."""

SHOWN = 0.15
"""Component, relative to the largest, from which on a parameter is named in a direction."""

ALIKE = 0.99
"""Correlation above which two estimates are reported as known better together than apart."""

BY_PRIOR = 0.9
"""Ratio of standard error to the prior's above which an estimate rests on its prior alone."""

NEVER = 1e-6
"""Ratio to the largest singular value below which one counts as zero."""


@dataclass(frozen=True)
class Direction:
    """Direction in parameter space with its singular value and standard error; each parameter is in units of its
    typical size.
    """

    # norm of the change of all residuals, in standard deviations of the noise, for a step of one size. Priors do not
    # count.
    singular_value: float
    error: float  # standard error along the direction, relative to the sizes; infinite if the data do not determine it
    vector: np.ndarray  # (n_free,) unit vector

    @property
    def is_loose(self) -> bool:
        """Whether the standard error along the direction is so large that the data do not determine it."""
        return self.error > LOOSE


def sizes_of(
    theta: np.ndarray, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, sensed: np.ndarray
) -> np.ndarray:
    """Return a typical size of each parameter, the unit in which its changes are measured.

    Parameters
    ----------
    theta, start, lower, upper
        (n_free,) Estimates, starts and bounds.
    sensed
        (n_free,) Size of the measured quantity for parameters that are its offset and may be 0; NaN for
        others.

    Returns
    -------
    ndarray (n_free,)
        The larger of the estimate and the start; if both are 0, the width of the bounds, or 1.
    """
    size = np.maximum(np.abs(theta), np.abs(start))
    width = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return np.where(np.isfinite(sensed), sensed, np.where(size > 0, size, width))


def directions_of(information: np.ndarray, scale: np.ndarray, inflation: float) -> list[Direction]:
    """Return the eigenvectors of the scaled information matrix as directions, the best determined one first.

    Parameters
    ----------
    information
        Information of the data alone, (n_free, n_free).
    scale
        Sizes of the parameters, (n_free,), see `sizes_of`.
    inflation
        Factor on standard errors, see `Covariance`.
    """
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    found = []
    for value, vector in zip(singular, vectors.T[::-1], strict=True):
        sign = np.sign(vector[np.argmax(np.abs(vector))]) or 1.0
        never = value <= NEVER * singular[0]
        error = np.inf if never else inflation / value
        found.append(Direction(float(value), float(error), vector * sign))
    return found


def invisible(information: np.ndarray, names: Sequence[str]) -> list[str]:
    """Return the names of the parameters that the residuals do not depend on."""
    own = np.diag(information)
    return [name for name, value in zip(names, own, strict=True) if not value > 0.0]


def warnings_of(
    names: Sequence[str],
    directions: Sequence[Direction],
    covariance: Covariance,
    prior_sd: np.ndarray,
    at_bound: Sequence[str],
) -> list[str]:
    """Return warnings about parameters and combinations that the data do not determine, and about estimates at a bound
    or set by a prior.

    Parameters
    ----------
    names
        Names of the parameters.
    directions
        Directions from the data alone.
    covariance
        Covariance with priors included.
    prior_sd
        Standard deviations of priors, (n_free,); NaN where there is none.
    at_bound
        For each parameter, the bound at which the estimate lies: ``lower``, ``upper`` or an empty text.
    """
    found = [_loose(names, d, prior_sd) for d in directions if d.is_loose]
    errors = covariance.errors
    for i, name in enumerate(names):
        if at_bound[i]:
            found.append(
                f"{name} ended at its {at_bound[i]} bound: its interval says little, and the model may lack "
                "what would have moved it further. Widen the bound if it may be passed, and look at the "
                "residuals."
            )
        if np.isfinite(prior_sd[i]) and errors[i] > BY_PRIOR * prior_sd[i]:
            found.append(
                f"{name} is as its prior says: the recordings add nothing (standard error {errors[i]:.3g}, "
                f"that of the prior {prior_sd[i]:.3g})."
            )
    return found + _alike(names, covariance.correlations)


def _loose(names: Sequence[str], direction: Direction, prior_sd: np.ndarray) -> str:
    weight = direction.vector / np.abs(direction.vector).max()
    order = np.argsort(-np.abs(weight), kind="stable")
    shown = [int(i) for i in order if abs(weight[i]) >= SHOWN]
    known = np.isfinite(direction.error)
    share = f"standard error {_percent(direction.error)} of its size"
    error = share if known else "the fit is the same for any value"
    held = [names[i] for i in shown if np.isfinite(prior_sd[i])]
    remedy = (
        f"Here the prior of {_and(held)} decides."
        if held
        else "Fix one of them, tie them, or give one a prior."
        if len(shown) > 1
        else "Fix it, give it a prior, or add a recording in which it matters."
    )
    if len(shown) == 1:
        return f"the data do not determine {names[shown[0]]} ({error}). {remedy}"
    changes = _and([f"{names[i]} {10 * weight[i]:+.2g} %" for i in shown])
    if known:
        words = f"together {changes} hardly change the fit (standard error {_percent(direction.error)})"
    else:
        words = f"together {changes} leave the fit as it is"
    return (
        f"the data do not determine {_and([names[i] for i in shown])} apart, only combinations of them: "
        f"{words}. {remedy}"
    )


def _alike(names: Sequence[str], correlations: np.ndarray) -> list[str]:
    pairs = [
        (i, j)
        for i in range(len(names))
        for j in range(i)
        if np.isfinite(correlations[i, j]) and abs(correlations[i, j]) > ALIKE
    ]
    return [
        f"{names[j]} and {names[i]} are known better together than apart: their correlation is "
        f"{correlations[i, j]:+.4f}."
        for i, j in pairs
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share < 100 else f"{share:.2g} times"


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
