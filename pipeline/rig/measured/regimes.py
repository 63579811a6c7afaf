"""Estimate the periods of measured motions from noisy section points, each with a confidence.

A motion of period k repeats every k sections, up to noise and the rest of a transient. Second differences at
lag k, x[n + 2k] - 2 x[n + k] + x[n], suppress a transient: if it decays by a factor m per k sections, they
keep the fraction (1 - m)^2 of it, while first differences keep 1 - m. In units of the sections' own noise
their root mean square is 1 for a motion of period k, and as large as the motion for any other. The least k
with a small value is the period. Its confidence is the fraction of resampled sections, with limits between
half and twice the chosen one, that give the same period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.products.measured import MAX_PERIOD

Floats = npt.NDArray[np.float64]

LIMIT = 2.5
"""Root mean square of second differences, in units of noise, below which a motion is closed."""
_LEAST = 6
"""Fewest second differences that decide on a period."""
_RESAMPLES = 200


@dataclass(frozen=True)
class Regime:
    """The estimated period of a motion, with its confidence."""

    orbit_period: int  # period in drive periods; 0 if the motion closes at no tested period
    confidence: float  # fraction of resamples that give the same period, 0 to 1
    # root mean square of the second differences at that period, in units of noise. Without a period, the least over all
    # tested periods.
    closure: float
    # ratio by which the decision clears the limit: the least of closure/limit over all shorter periods, and of
    # limit/closure at this period. Without a period, the least closure/limit.
    margin: float
    max_period: int


def find_period(
    points: Floats, noise: Floats, *, limit: float = LIMIT, max_period: int = MAX_PERIOD, seed: int = 0
) -> Regime:
    """Estimate the period of a motion from its noisy section points.

    Parameters
    ----------
    points
        Consecutive sections, shape (n, component), angles not wrapped. A full turn per period is a trend,
        which cancels in second differences.
    noise
        Standard deviation of each section, same shape, above 0.
    limit
        Largest closure of a closed motion, in units of noise.
    max_period
        Longest tested period; a period k needs 2 k + 6 sections.
    seed
        Seed of the resampling.

    Returns
    -------
    Regime
        With fewer than 8 sections, period 0 with confidence 0.
    """
    n = len(points)
    periods = [k for k in range(1, max_period + 1) if n - 2 * k >= _LEAST]
    if not periods:
        return Regime(0, 0.0, np.inf, 0.0, 0)
    squares = np.full((len(periods), n), np.nan)
    for row, k in enumerate(periods):
        squares[row, : n - 2 * k] = _second(points, noise, k)
    closure = _closure(squares)
    found = _least(closure, limit)
    share = _share(squares, found, limit, np.random.default_rng(seed))
    if found < 0:
        best = float(closure.min())
        return Regime(0, share, best, best / limit, periods[-1])
    rivals = closure[:found] / limit
    margin = min(limit / float(closure[found]), float(rivals.min()) if found else np.inf)
    return Regime(periods[found], share, float(closure[found]), margin, periods[-1])


def _second(points: Floats, noise: Floats, k: int) -> Floats:
    """Return the squared second differences of section points at lag `k`, in units of their noise, averaged over the
    states.
    """
    difference = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    variance = noise[2 * k :] ** 2 + 4 * noise[k:-k] ** 2 + noise[: -2 * k] ** 2
    return np.asarray((difference**2 / variance).mean(axis=1))


def _closure(squares: Floats) -> Floats:
    """Return the rms second difference of the section points for each tested period. It is computed for all points and
    for the later half, and the smaller value is kept.
    """
    known = np.isfinite(squares)
    values = np.where(known, squares, 0.0)
    later = np.zeros(squares.shape[1], bool)
    later[squares.shape[1] // 2 :] = True
    # a lag whose later half is too short is judged by all sections
    found = []
    for chosen in (np.ones_like(later), later):
        count = (known & chosen).sum(axis=1)
        mean = (values * chosen).sum(axis=1) / np.maximum(count, 1)
        found.append(np.where(count >= _LEAST, mean, np.inf))
    return np.asarray(np.sqrt(np.minimum(*found)))


def _least(closure: Floats, limit: float) -> int:
    """Return the index of the least tested period at which the motion closes, or -1 if it closes at none."""
    closed = np.flatnonzero(closure <= limit)
    return int(closed[0]) if closed.size else -1


def _share(squares: Floats, found: int, limit: float, rng: np.random.Generator) -> float:
    """Return the fraction of bootstrap resamples of the section points that give the same period as all points do.

    Sections are drawn in blocks as long as second differences overlap, for all lags together. The limit is
    drawn log-uniformly between half and twice the chosen one, since the noise is known only to about a factor
    of two.
    """
    n = squares.shape[1]
    block = min(max(4, squares.shape[0]), n)
    number = -(-n // block)
    same = 0
    for _ in range(_RESAMPLES):
        begins = rng.integers(0, n, number)
        chosen = (begins[:, None] + np.arange(block)).ravel() % n
        closure = _closure(squares[:, np.sort(chosen)])
        same += _least(closure, limit * 2.0 ** rng.uniform(-1, 1)) == found
    return same / _RESAMPLES
