"""Estimate the largest Lyapunov exponent of a time series from the divergence of neighbours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.analysis.series.embedding import N_BLOCKS, Embedding, Floats, Ints, slope
from pipeline.results.intervals import half_width


@dataclass(frozen=True)
class DivergenceSettings:
    """Numbers of the growth of distances between neighbours, and of the fit of the exponent."""

    n_references: int = 1600  # vectors whose neighbours are followed; more err less, and take longer
    periods: int = 12  # mean periods for which neighbours are followed
    # distance of the end of a range below passes at the same phase [nats]; nearer, the curve bends towards them
    saturated: float = 1.3
    least_growth: float = 1.2  # least growth over a range for a positive exponent [nats]
    least_periods: float = 1.5  # shortest range of a positive exponent [mean periods]
    # largest difference of the slopes of two halves of a range, relative to the slope of the whole
    straight: float = 0.3
    # error of a slope at finite distances, as a share of it. Distances that are not small part at another rate than the
    # exponent's: for series of Roessler's and Lorenz's systems with 4000 samples the slope is 0.76 to 1.27 times the
    # exponent.
    finite: float = 0.25
    no_growth: float = 0.15  # largest growth over all `periods` that counts as none [nats]
    # distance of passes at the same phase, below random pairs, from which on they coincide [nats]: of a closed orbit,
    # and of any motion
    repeated: float = -1.0
    thin: float = -2.5
    # how much closer neighbours stay than passes at the same phase where a motion is regular [nats]
    closer: float = 1.3


@dataclass(frozen=True)
class Divergence:
    """Mean logarithm of the distance between neighbours over time, and the largest exponent that is fitted to it."""

    time: Floats  # [s]
    curve: Floats  # mean log distance, of random pairs 0

    value: float = np.nan  # exponent [1/s], nan if not decided
    low: float = np.nan
    high: float = np.nan
    fit: tuple[float, float] = (np.nan, np.nan)  # range of the fit [s]
    offset: float = np.nan  # value of the fitted line at time 0
    reason: str = ""  # why it is not decided

    @property
    def grows(self) -> bool:
        """Whether neighbours move apart exponentially: the interval of the rate lies above 0."""
        return self.low > 0.0 and not self.reason


def divergence(
    embedding: Embedding, period: int, is_closed: bool, settings: DivergenceSettings = DivergenceSettings()
) -> Divergence:
    """Follow nearest neighbours, and fit the rate at which they part.

    As Rosenstein, Collins and De Luca (Physica D 65, 117, 1993): the mean over pairs of the logarithm of their
    distance. Distances are measured across the flow: of the difference of two vectors the part along the neighbour's
    velocity is left out. It neither grows nor shrinks, and would hide the growth of the rest in short series. The curve
    is averaged over a mean period, because growth varies along an orbit.

    The range of the fit is the longest one that is straight (slopes of its halves differ by less than `straight`) after
    the first embedding window and before the distances come within `saturated` of those of passes at the same phase.
    The interval is that of Student from `N_BLOCKS` stretches of the series, widened by the difference of the halves and
    by `finite`. The period [samples] is the mean one. In a closed orbit, whose maxima repeat but for noise, neighbours
    may be as far apart as other passes.
    """
    horizon = min(settings.periods * period, len(embedding.series.values) // 6)
    side = max(1, embedding.delay // 3)
    references, nearest, _ = embedding.neighbours(settings.n_references, horizon + side + period)
    there = (references >= side) & (nearest[:, 0] >= side)
    first, second = references[there], nearest[there, 0]
    n_steps = horizon - period
    if len(first) < 20 * N_BLOCKS or n_steps < 2.0 * period:
        return Divergence(np.empty(0), np.empty(0), reason="too few vectors that can be followed")
    stride = max(1, period // 32)
    lags = np.arange(0, horizon + 1, stride)
    size, at_phase = _sizes(embedding, side, period)
    logs = np.stack([_log(_across(embedding, first + lag, second + lag, side), size) for lag in lags])
    blocks = np.stack([part.mean(axis=1) for part in np.array_split(logs, N_BLOCKS, axis=1)])
    width = period // stride
    smooth = np.stack([np.convolve(block, np.full(width, 1.0 / width), "valid") for block in blocks])
    time: Floats = (lags[: smooth.shape[1]] + 0.5 * stride * (width - 1)).astype(np.float64) * embedding.series.step
    curve: Floats = np.asarray(smooth.mean(axis=0), np.float64)
    plain = Divergence(time, curve)
    start = min(int(np.ceil(max(embedding.span - 0.5 * period, 0) / stride)), len(time) // 4)
    chosen = _range(
        time, curve, start, period * embedding.series.step, min(at_phase, 0.0) - settings.saturated, settings
    )
    if chosen is not None:
        return _fitted(plain, smooth, *chosen, settings=settings)
    growth = float(curve[-1] - curve[start])
    if abs(growth) >= settings.no_growth:
        return replace(plain, reason=f"no straight range of {settings.least_growth} nats below the size of the set")
    is_closer = curve[-1] < min(at_phase, -0.5) - settings.closer
    if not is_closer and at_phase > (settings.repeated if is_closed else settings.thin):
        return replace(plain, reason="neighbours are no closer than other passes: noise, or too few vectors")
    return _fitted(plain, smooth, start, len(time) - 1, settings)


def _across(embedding: Embedding, first: Ints, second: Ints, side: int) -> Floats:
    """Return the distances of vectors from others, without the part along the velocity of the others."""
    apart = embedding.vectors(first) - embedding.vectors(second)
    flow = embedding.vectors(second + side) - embedding.vectors(second - side)
    speed = np.maximum((flow**2).sum(axis=1), 1e-300)
    return np.asarray(np.sqrt(((apart - ((apart * flow).sum(axis=1) / speed)[:, None] * flow) ** 2).sum(axis=1)))


def _log(distance: Floats, size: float) -> Floats:
    floor = 1e-9  # least distance relative to the size of the set; below it is rounding
    return np.asarray(np.log(np.maximum(distance / size, floor)))


def _sizes(embedding: Embedding, side: int, period: int) -> tuple[float, float]:
    """Return the mean distance of random pairs, and the log of the distance of passes at the same phase over it.

    A pass at the same phase is the nearest vector within a mean period of a random one.
    """
    starts = embedding.series.starts(embedding.span + period + side)
    starts = starts[starts >= side]
    first, second = np.random.default_rng(0).choice(starts, (2, 1200))
    apart = np.abs(first - second) > embedding.theiler + period
    first, second = first[apart], second[apart]
    size = float(np.exp(np.log(np.maximum(_across(embedding, first, second, side), 1e-300)).mean()))
    shifts = np.arange(0, period + 1, max(1, period // 64))
    passes = [np.linalg.norm(embedding.vectors(first) - embedding.vectors(second + s), axis=1) for s in shifts]
    nearest = second + shifts[np.argmin(passes, axis=0)]
    return size, float(_log(_across(embedding, first, nearest, side), size).mean())


def _slopes(time: Floats, curve: Floats, start: int, end: int) -> tuple[float, float]:
    """Return the slope of a range, and the difference between those of its halves."""
    middle = (start + end) // 2
    parts = slice(start, end + 1), slice(start, middle + 1), slice(middle, end + 1)
    whole, early, late = (slope(time[part], curve[part]) for part in parts)
    return whole, abs(early - late)


def _range(
    time: Floats, curve: Floats, start: int, period: float, end: float, settings: DivergenceSettings
) -> tuple[int, int] | None:
    """Return the ends of the longest straight range of growth; None if there is none."""
    high = np.flatnonzero(curve >= end)
    last = int(high[0]) if len(high) else len(curve) - 1
    step = max(1, len(time) // 48)
    best: tuple[int, int] | None = None
    for a in range(start, last, step):
        for b in range(last, a, -step):
            if best is not None and b - a <= best[1] - best[0]:
                break
            if curve[b] - curve[a] < settings.least_growth or time[b] - time[a] < settings.least_periods * period:
                break
            whole, bend = _slopes(time, curve, a, b)
            if bend <= settings.straight * whole:
                best = (a, b)
                break
    return best


def _fitted(plain: Divergence, blocks: Floats, start: int, end: int, settings: DivergenceSettings) -> Divergence:
    """Return a curve with the slope of a range, and its interval."""
    time, curve, inside = plain.time, plain.curve, slice(start, end + 1)
    value, bend = _slopes(time, curve, start, end)
    half = half_width([slope(time[inside], block[inside]) for block in blocks]) + bend + settings.finite * abs(value)
    offset = float(curve[inside].mean() - value * time[inside].mean())
    ends = (float(time[start]), float(time[end]))
    return replace(plain, value=value, low=value - half, high=value + half, fit=ends, offset=offset)
