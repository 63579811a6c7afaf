"""What the data determine and what they do not, in numbers and in plain words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.rig.identify.statistics import Covariance

LOOSE = 0.5
"""Standard error along a direction, as a share of the parameters' sizes, from which it is not determined."""

SHOWN = 0.15
"""Share of its largest component from which on a parameter is named in a direction."""

ALIKE = 0.99
"""Correlation from which on two estimates are said to move together."""

BY_PRIOR = 0.9
"""Share of a prior's standard deviation above which an estimate is its prior's."""

NEVER = 1e-6
"""Share of the largest singular value below which one is zero to rounding."""


@dataclass(frozen=True)
class Direction:
    """A direction in the space of the parameters, each in units of its size.

    Attributes
    ----------
    singular_value : float
        Of the scaled slopes of the residuals: by how many standard deviations of the noise they move, all
        together, for a step of one size. The data alone; priors do not count.
    error : float
        Standard error along it, as a share of the sizes; infinite where the data say nothing.
    vector : ndarray (n_free,)
        Of length 1.
    """

    singular_value: float
    error: float
    vector: np.ndarray

    @property
    def is_loose(self) -> bool:
        """Whether the data do not determine it."""
        return self.error > LOOSE


def sizes_of(
    theta: np.ndarray, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, sensed: np.ndarray
) -> np.ndarray:
    """Size of each parameter, that changes are compared with.

    Parameters
    ----------
    theta, start, lower, upper
        (n_free,) Estimates, starts and bounds.
    sensed
        (n_free,) Size of a measured quantity for parameters that are offsets of one, which may well be 0;
        NaN for others.

    Returns
    -------
    ndarray (n_free,)
        The larger of the estimate and the start; if both are 0, the width of the bounds, or 1.
    """
    size = np.maximum(np.abs(theta), np.abs(start))
    width = np.where(np.isfinite(upper - lower), upper - lower, 1.0)
    return np.where(np.isfinite(sensed), sensed, np.where(size > 0, size, width))


def directions_of(information: np.ndarray, scale: np.ndarray, inflation: float) -> list[Direction]:
    """Singular values and vectors of the scaled slopes, the best determined direction first.

    Parameters
    ----------
    information
        (n_free, n_free), of the data alone.
    scale
        (n_free,), see `sizes_of`.
    inflation
        See `Covariance`.
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
    """Names of the parameters that no residual depends on."""
    own = np.diag(information)
    return [name for name, value in zip(names, own, strict=True) if not value > 0.0]


def warnings_of(
    names: Sequence[str],
    directions: Sequence[Direction],
    covariance: Covariance,
    prior_sd: np.ndarray,
    at_bound: Sequence[str],
) -> list[str]:
    """Say in plain words what the data do not determine.

    Parameters
    ----------
    names
        Of the parameters.
    directions
        Of the data alone.
    covariance
        Priors included.
    prior_sd
        (n_free,), NaN where there is none.
    at_bound
        For each parameter ``lower``, ``upper`` or nothing: at which of its bounds the estimate lies.
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
