"""Periods of measured motions: which one, among noise and what is left of a transient, and how sure that is.

A motion of period k repeats every k sections. What differs after k sections is noise, and the rest of a
transient; a second difference at lag k, x[n + 2k] - 2 x[n + k] + x[n], keeps of a decay by a factor m per k
sections the share (1 - m)^2 alone, where a first difference keeps 1 - m. In units of the sections' own noise
its root mean square is 1 for a motion of period k, and as large as the motion for any other. The least k with
a small one is the period; how sure that is, is the share of resampled sections, and of limits between half
and twice the chosen one, that give the same answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

LIMIT = 2.5
"""Second differences below so many units of noise are a closed motion's."""
MAX_PERIOD = 16
_LEAST = 6
"""Second differences that a period needs at least."""
_RESAMPLES = 200


@dataclass(frozen=True)
class Regime:
    """What sections say of a motion's period.

    Attributes
    ----------
    orbit_period : int
        In drive periods; 0 if it closes at none that was looked at.
    confidence : float
        Share of resamples that give the same period, 0 to 1.
    closure : float
        Root mean square of the second differences at that period, in units of noise; at the best if there is
        none.
    margin : float
        By how much the nearest rival misses: the least of closure over the limit of shorter periods and limit
        over closure of this one; for no period, the best closure over the limit.
    max_period : int
        Longest that was looked at.
    """

    orbit_period: int
    confidence: float
    closure: float
    margin: float
    max_period: int


def find_period(
    points: Floats, noise: Floats, *, limit: float = LIMIT, max_period: int = MAX_PERIOD, seed: int = 0
) -> Regime:
    """Find the period of a motion from its sections.

    Parameters
    ----------
    points
        Consecutive sections, shape (n, component); angles run on, no wraps. A turn per period is a trend,
        which second differences do not see.
    noise
        Standard deviation of each, same shape, above 0.
    limit
        Of the closure, in units of noise.
    max_period
        Longest looked for; a period k needs 2 k + 6 sections.
    seed
        Of the resampling.

    Returns
    -------
    Regime
        With fewer than 8 sections no period is looked for: period 0 with confidence 0.
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
    """Mean square over components of the second differences at lag k, in units of their own noise."""
    difference = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    variance = noise[2 * k :] ** 2 + 4 * noise[k:-k] ** 2 + noise[: -2 * k] ** 2
    return np.asarray((difference**2 / variance).mean(axis=1))


def _closure(squares: Floats) -> Floats:
    """Root mean square by lag, of all sections or of the later half if that is less: a motion may settle."""
    known = np.isfinite(squares)
    values = np.where(known, squares, 0.0)
    later = np.zeros(squares.shape[1], bool)
    later[squares.shape[1] // 2 :] = True
    # a lag whose later half is too short is judged by all
    found = []
    for chosen in (np.ones_like(later), later):
        count = (known & chosen).sum(axis=1)
        mean = (values * chosen).sum(axis=1) / np.maximum(count, 1)
        found.append(np.where(count >= _LEAST, mean, np.inf))
    return np.asarray(np.sqrt(np.minimum(*found)))


def _least(closure: Floats, limit: float) -> int:
    """Row of the least period that closes; -1 if none does."""
    closed = np.flatnonzero(closure <= limit)
    return int(closed[0]) if closed.size else -1


def _share(squares: Floats, found: int, limit: float, rng: np.random.Generator) -> float:
    """Share of resamples that give the same row.

    Sections are drawn in blocks as long as the second differences overlap, all lags together; the limit is
    drawn between half and twice of what was chosen, evenly on a scale of ratios, since the noise is known to
    such a factor only.
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
