"""Estimate the mean lifetime of trajectories on a transient set, with its confidence interval.

Escape from a chaotic saddle forgets the past, so lifetimes beyond the first few periods are exponential
(Kantz and Grassberger, Physica D 17 (1985) 75; Lai and Tel, Transient Chaos, 2011, ch. 1). Let r be the
number of escapes and T the time at risk, summed over all sampled cells. The mean lifetime is T/r, and its
interval at confidence 1 - a runs from ``2 T/chi2(1 - a/2; 2 r + 2)`` to ``2 T/chi2(a/2; 2 r)`` (Epstein and
Sobel, J. Am. Stat. Assoc. 48 (1953) 486, and Garwood, Biometrika 28 (1936) 437, for observation that ends at
a given time). If none leaves, the one-sided bound is ``T/(-ln a)``, a third of T at 95 %.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, gammaincinv


def lifetime_interval(n_left: int, time_at_risk: float, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the confidence interval of the mean lifetime on a transient set, from the number of escapes and the total
    time that trajectories spent on it.

    Parameters
    ----------
    n_left
        Number of escapes.
    time_at_risk
        Sum over cells of the time until escape or the end of observation, in any unit.
    confidence
        Confidence, between 0 and 1. The interval is two-sided if any cell left, else a lower bound.

    Returns
    -------
    low, high : float
        In the unit of `time_at_risk`; `high` is infinite if none left.

    Raises
    ------
    ValueError
        If `confidence` is out of bounds.

    Examples
    --------
    >>> low, high = lifetime_interval(0, 3000.0)
    >>> round(low), high
    (1001, inf)
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence = {confidence!r} is out of bounds: it must lie between 0 and 1.")
    if n_left == 0:
        return 2.0 * time_at_risk / _quantile(confidence, 2), np.inf
    tail = 0.5 * (1.0 - confidence)
    low = 2.0 * time_at_risk / float(chdtri(2 * n_left + 2, tail))
    return low, 2.0 * time_at_risk / _quantile(tail, 2 * n_left)


def _quantile(share: float, n: int) -> float:
    """Return the quantile of the chi-squared distribution with `n` degrees of freedom.

    `scipy.stats` has it as well, but its import takes a second.
    """
    return 2.0 * float(gammaincinv(0.5 * n, share))
