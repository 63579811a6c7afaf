"""Estimate rates of rare events with intervals, and fit Kramers' law to rates over the noise's strength."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

_MOST_ITERATIONS = 100
_CONVERGED = 1e-12
_LARGEST_STEP = 2.0
_LEAST_EVENTS, _LEAST_POINTS = 2, 3


def rate_interval(
    n_events: np.ndarray, n_risked: np.ndarray, interval: np.ndarray, confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a rate and its confidence interval from events that are seen at even instants, with censoring.

    `n_events` follow in `n_risked` intervals of time at whose begin a cell was still there. For a constant rate k
    the probability of an event in an interval is p = 1 - exp(-k T); the number of events is taken as Poisson's,
    with Garwood's exact interval (Biometrika 28, 437, 1936), which is conservative for the binomial number.

    Parameters
    ----------
    n_events, n_risked
        Numbers of events, and of intervals at risk, the censored ones included.
    interval
        Length T of an interval [s].
    confidence
        Two-sided level.

    Returns
    -------
    rate, low, high
        [1/s]; NaN without an interval at risk, a low end of 0 without events.
    """
    n, m, t = np.broadcast_arrays(np.asarray(n_events, float), np.asarray(n_risked, float), np.asarray(interval, float))
    tail = 0.5 * (1.0 - confidence)
    low = np.where(n > 0, stats.chi2.ppf(tail, np.maximum(2 * n, 1)) / 2, 0.0)
    high = stats.chi2.ppf(1.0 - tail, 2 * n + 2) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        rate, below, above = (-np.log1p(-np.minimum(x / m, 1.0)) / t for x in (n, low, high))
    known = m > 0
    return tuple(np.where(known, x, np.nan) for x in (rate, below, above))  # type: ignore[return-value]


def constancy(n_early: int, n_late: int, risked_early: int, risked_late: int) -> float:
    """Return the p-value of the hypothesis that the rate is the same early and late in the record; NaN without data."""
    if n_early + n_late == 0 or risked_early + risked_late == 0:
        return float("nan")
    share = risked_early / (risked_early + risked_late)
    return float(stats.binomtest(n_early, n_early + n_late, share).pvalue)


class KramersFit(NamedTuple):
    """Fit of Kramers' law, rate = factor exp(-slope/s**2), to rates over the noise's strength s.

    For dx = -U'(x) dt + s dW the slope is twice the height of the barrier of U.
    """

    slope: float
    low: float
    high: float
    log_factor: float  # of the rate in 1/s
    n_points: int
    misfit: float  # p-value of the deviance: small where the law does not hold


_NAN = float("nan")
NO_FIT = KramersFit(_NAN, _NAN, _NAN, _NAN, 0, _NAN)


def fit_kramers(
    strength: np.ndarray, n_events: np.ndarray, n_risked: np.ndarray, interval: np.ndarray, confidence: float
) -> KramersFit:
    """Fit Kramers' law by maximum likelihood, with the numbers of events as Poisson's.

    Parameters
    ----------
    strength
        Strengths of the noise; those that are 0 are left out.
    n_events, n_risked, interval, confidence
        See `rate_interval`; arrays over the strengths.

    Returns
    -------
    KramersFit
        `NO_FIT` unless three strengths have cells at risk and two of these have events. The interval of the slope
        is that of the likelihood's curvature.
    """
    strength, n, m = (np.asarray(x, np.float64) for x in (strength, n_events, n_risked))
    t = np.broadcast_to(np.asarray(interval, np.float64), n.shape)
    # where nearly every interval at risk has an event the rate is no rate any more
    use = (strength > 0) & (m > 0) & (n < 0.5 * m)
    if use.sum() < _LEAST_POINTS or (n[use] > 0).sum() < _LEAST_EVENTS:
        return NO_FIT
    x, n = -1.0 / strength[use] ** 2, n[use]
    # -m log(1 - n/m) events of a constant rate over the whole time at risk
    exposure = m[use] * t[use] * np.where(n > 0, n / (-m[use] * np.log1p(-n / m[use]) + (n == 0)), 1.0)
    design = np.stack([np.ones_like(x), x], axis=1)
    some = n > 0
    line = np.polyfit(x[some], np.log(n[some] / exposure[some]), 1)
    beta = np.array([line[1], line[0]])
    for _ in range(_MOST_ITERATIONS):
        mean = exposure * np.exp(np.clip(design @ beta, -700.0, 700.0))
        step = np.linalg.solve(design.T @ (mean[:, None] * design), design.T @ (n - mean))
        beta = beta + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        if np.abs(step).max() < _CONVERGED * (1.0 + np.abs(beta).max()):
            break
    mean = exposure * np.exp(design @ beta)
    error = float(np.sqrt(np.linalg.inv(design.T @ (mean[:, None] * design))[1, 1]))
    z = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    deviance = 2.0 * float(np.sum(np.where(some, n * np.log(np.where(some, n, 1.0) / mean), 0.0) - (n - mean)))
    misfit = float(stats.chi2.sf(deviance, len(n) - 2))
    slope = float(beta[1])
    return KramersFit(slope, slope - z * error, slope + z * error, float(beta[0]), len(n), misfit)
