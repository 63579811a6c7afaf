"""Find the returns of a time series to its maxima, their return map, and the period of the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from pipeline.analysis.series.embedding import N_BLOCKS, Floats, Series
from pipeline.analysis.series.surrogates import repeats_by_chance
from pipeline.results.intervals import half_width


@dataclass(frozen=True)
class ReturnSettings:
    """Numbers of the search for returns, and of the test for a closed orbit."""

    prominence: float = 0.1  # least height of a maximum over the minima beside it, in standard deviations
    # the same in standard deviations of the noise that smoothing leaves: lower maxima may be two peaks of one
    above_noise: float = 6.0
    fewest: int = 12  # fewest returns from which a period is taken
    irregular: float = 0.4  # scatter of return times, as a share of their mean, from which on they are no period
    most_in_cycle: int = 8  # most maxima in a cycle
    exact: float = 0.01  # scatter of the maxima of a closed orbit in standard deviations: without noise, and with noise
    close: float = 0.12
    # fewest cycles of a closed orbit with noise: chaos may stay near an unstable orbit for as long as that
    fewest_cycles: int = 20


@dataclass(frozen=True)
class Returns:
    """Maxima of a series in the order of time, and the mean time between them."""

    time: Floats  # since the beginning of the piece [s]
    height: Floats
    piece: np.ndarray
    mean: float = np.nan  # time between maxima [s]
    low: float = np.nan
    high: float = np.nan
    scatter: float = np.nan  # standard deviation of a time between maxima [s]
    in_cycle: int = 0  # maxima in a closed orbit; 0 if it is not closed, or not decided
    reason: str = ""

    def pairs(self, apart: int = 1) -> np.ndarray:
        """Return the maxima that have another one so many returns later in their piece."""
        return np.flatnonzero(self.piece[apart:] == self.piece[:-apart])


def returns_of(series: Series, delay: int, settings: ReturnSettings = ReturnSettings()) -> Returns:
    """Return the maxima of a series, and its mean period.

    The series is smoothed by parabolas over a delay [samples], about a quarter of a period, and a maximum is refined by
    a parabola through three samples. The interval is that of Student from the mean times in `N_BLOCKS` stretches.
    """
    time, height, piece = _maxima(series, delay, settings)
    plain = Returns(time, height, piece)
    firsts = plain.pairs()
    if len(firsts) < settings.fewest:
        return replace(plain, reason=f"{len(firsts)} returns, fewer than {settings.fewest}")
    times = time[firsts + 1] - time[firsts]
    mean, scatter = float(times.mean()), float(times.std(ddof=1))
    # a cycle with several maxima has as many times between them: whole cycles are compared
    cycle = _in_cycle(plain, float(series.values.std()), settings)
    apart = max(cycle, 1)
    of_cycles = plain.pairs(apart)
    spans = (time[of_cycles + apart] - time[of_cycles]) / apart
    half = half_width([part.mean() for part in np.array_split(spans, N_BLOCKS)])
    irregular = cycle == 0 and scatter > settings.irregular * mean
    reason = f"times between maxima scatter by {scatter / mean:.0%}" if irregular else ""
    value = float(spans.mean()) if cycle else mean
    return Returns(time, height, piece, value, value - half, value + half, float(np.std(spans)), cycle, reason)


def _maxima(series: Series, delay: int, settings: ReturnSettings) -> tuple[Floats, Floats, np.ndarray]:
    least = settings.prominence * float(series.values.std())
    window = max(5, delay // 2 * 2 + 1)
    own = float(signal.savgol_coeffs(window, 2)[window // 2])  # weight of a sample in its smoothed value
    found = []
    for number, piece in enumerate(series.pieces()):
        if len(piece) <= window:
            continue
        smooth = signal.savgol_filter(piece, window, 2)
        noise = float((piece - smooth).std()) * np.sqrt(own / (1.0 - own))
        peaks = signal.find_peaks(smooth, prominence=max(least, settings.above_noise * noise))[0]
        before, at, after = smooth[peaks - 1], smooth[peaks], smooth[peaks + 1]
        curvature = np.minimum(before - 2.0 * at + after, -1e-300)
        shift = np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
        found.append((peaks + shift, at - 0.25 * (before - after) * shift, np.full(len(peaks), number)))
    if not found:
        return np.empty(0), np.empty(0), np.empty(0, np.int64)
    place, height, piece = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return place * series.step, height, piece


def _in_cycle(returns: Returns, size: float, settings: ReturnSettings) -> int:
    """Return the number of maxima after which heights repeat but for noise without memory; 0 if they do not."""
    scatter = np.full(settings.most_in_cycle + 1, np.inf)
    for k in range(1, min(settings.most_in_cycle, len(returns.height) // 4) + 1):
        firsts = returns.pairs(k)
        if len(firsts) >= settings.fewest // 2:
            scatter[k] = np.sqrt(np.mean((returns.height[firsts + k] - returns.height[firsts]) ** 2) / 2.0) / size
    exact = np.flatnonzero(scatter < settings.exact)
    if len(exact):
        return int(exact[0])
    k = int(np.flatnonzero(scatter <= 1.5 * scatter.min() + settings.exact)[0])
    if (
        not scatter[k] <= settings.close
        or len(returns.height) < settings.fewest_cycles * k
        or np.ptp(returns.piece) > 0
    ):
        return 0
    rest = returns.height.copy()
    for phase in range(k):
        rest[phase::k] -= rest[phase::k].mean()
    return k if repeats_by_chance(rest) else 0
