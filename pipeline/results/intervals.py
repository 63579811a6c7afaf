"""Compute confidence intervals of probabilities and of mean lifetimes."""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import special
from scipy.special import chdtri, gammaincinv, stdtrit

Interval = Literal["wilson", "clopper-pearson"]

REFERENCES = {
    "wilson": "Wilson, J. Am. Stat. Assoc. 22, 209 (1927)",
    "clopper-pearson": "Clopper and Pearson, Biometrika 26, 404 (1934)",
}


def binomial_interval(
    count: npt.ArrayLike, n: npt.ArrayLike, *, confidence: float = 0.95, method: Interval = "wilson"
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the confidence interval of a probability from `count` hits in `n` independent trials.

    Wilson's score interval (J. Am. Stat. Assoc. 22, 209, 1927) covers the truth at the stated rate on
    average over the probability. The interval of Clopper and Pearson (Biometrika 26, 404, 1934) covers it
    at least at the stated rate for every probability, and is wider. Brown, Cai and DasGupta (Stat. Sci. 16,
    101, 2001) compare them. Neither interval collapses to a point at 0 or `n` hits.

    Parameters
    ----------
    count, n
        Hits and trials, arrays that broadcast; ``n = 0`` gives (0, 1).
    confidence
        Two-sided level, between 0 and 1.
    method
        ``"wilson"`` or ``"clopper-pearson"``.

    Returns
    -------
    low, high
        Ends of the intervals, within [0, 1]. Independence of the trials is not validated.

    Raises
    ------
    ValueError
        If the level or the method is unknown, or hits are not between 0 and the trials.
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence is {confidence}, not between 0 and 1: give 0.95 for 95 %")
    k, trials = (np.asarray(x, dtype=np.float64) for x in np.broadcast_arrays(count, n))
    if np.any(k < 0) or np.any(k > trials):
        raise ValueError(f"count {k.tolist()} is not within 0 and n {trials.tolist()}: count hits among n")
    tail = 0.5 * (1.0 - confidence)
    safe = np.maximum(trials, 1.0)
    if method == "wilson":
        z2 = special.ndtri(1.0 - tail) ** 2
        centre = k + 0.5 * z2
        half = np.sqrt(z2 * (k * (safe - k) / safe + 0.25 * z2))
        low, high = (centre - half) / (safe + z2), (centre + half) / (safe + z2)
    elif method == "clopper-pearson":
        # arguments of 0 are replaced by 1 here; the ends that need them are set below
        low = special.betaincinv(np.maximum(k, 1.0), safe - k + 1.0, tail)
        high = special.betaincinv(k + 1.0, np.maximum(safe - k, 1.0), 1.0 - tail)
    else:
        raise ValueError(f"method is {method!r}: use one of {sorted(REFERENCES)}")
    low = np.where(k == 0.0, 0.0, np.clip(low, 0.0, 1.0))
    high = np.where(k == trials, 1.0, np.clip(high, 0.0, 1.0))
    return low, high


def lifetime_interval(n_left: int, time_at_risk: float, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the confidence interval of the mean lifetime on a transient set, from the number of escapes and the total
    time that trajectories spent on it.

    Escape from a chaotic saddle forgets the past, so lifetimes beyond the first few periods are exponential
    (Kantz and Grassberger, Physica D 17 (1985) 75; Lai and Tel, Transient Chaos, 2011, ch. 1). Let r be the
    number of escapes and T the time at risk, summed over all sampled cells. The mean lifetime is T/r, and its
    interval at confidence 1 - a runs from ``2 T/chi2(1 - a/2; 2 r + 2)`` to ``2 T/chi2(a/2; 2 r)`` (Epstein and
    Sobel, J. Am. Stat. Assoc. 48 (1953) 486, and Garwood, Biometrika 28 (1936) 437, for observation that ends at
    a given time). If none leaves, the one-sided bound is ``T/(-ln a)``, a third of T at 95 %.

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


def half_width(parts: npt.ArrayLike) -> float:
    """Compute half of Student's 95 % interval of a mean, from independent values of it."""
    values = np.asarray(parts, np.float64)
    return float(stdtrit(len(values) - 1, 0.975) * values.std(ddof=1) / np.sqrt(len(values)))


def _quantile(share: float, n: int) -> float:
    """Return the quantile of the chi-squared distribution with `n` degrees of freedom.

    `scipy.stats` has it as well, but its import takes a second.
    """
    return 2.0 * float(gammaincinv(0.5 * n, share))
