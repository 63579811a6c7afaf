"""Detect the edges of a measured drive signal; estimate its frequency, jitter and duty cycle.

A recording shows when the motor of a rig did switch. The sections lie at the times at which the signal rises
through its middle. The slope of a line through these times against their number is the drive period. With n
edges its error falls as n^-3/2; that of counting periods is one sampling interval over n.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.specification.problems import SpecError

Floats = npt.NDArray[np.float64]

DRIVE = "drive"


class Timing(NamedTuple):
    """Frequency, jitter and duty cycle of a drive signal, from a line through the times of its rising edges.

    Errors are standard errors.
    """

    frequency_hz: float
    frequency_error_hz: float
    jitter_s: float  # root mean square distance of the edges from the line [s]
    # fraction of the period in the high state; NaN if no falling edge lies between rising ones
    duty_cycle: float
    duty_cycle_error: float
    n_periods: int  # number of periods from the first edge to the last


@dataclass(frozen=True)
class Edges:
    """The times at which a drive signal crosses the middle between its two levels."""

    # times of the edges [s], in rising order
    rising: Floats
    falling: Floats
    # sampling interval if the signal switches between two samples, so that an edge is only known to lie between them
    # [s]; 0 if samples lie on the flanks
    resolution_s: float = 0.0
    noise_s: float = 0.0  # standard error of an edge's time from the signal's noise on its flanks [s]

    @property
    def error_s(self) -> float:
        """Standard error of an edge's time [s] from sampling and noise, without the jitter of the drive."""
        return math.hypot(self.resolution_s / math.sqrt(12), self.noise_s)

    def between(self, start_s: float, end_s: float) -> Edges:
        """Return the edges in ``start_s <= t < end_s``."""
        rising, falling = ((t[(t >= start_s) & (t < end_s)]) for t in (self.rising, self.falling))
        return replace(self, rising=rising, falling=falling)

    def frequency(self) -> Timing:
        """Fit a line through the times of the rising edges against their numbers; return frequency, jitter and duty
        cycle.

        Missing edges are counted by the median distance of neighbours. The standard errors assume independent jitter.
        They include the rounding to samples: if edges fall on the same few places between samples, their scatter does
        not reveal an offset of up to half a sampling interval. Raise `SpecError` if there are fewer than three rising
        edges, or they scatter by more than a fifth of a period.
        """
        most = 0.2  # jitter of a periodic drive, as a fraction of its period
        rising = self.rising
        if rising.size < 3:
            raise SpecError(f"drive: {rising.size} rising edges; a frequency needs 3: choose a longer window.")
        number = _numbers(rising)
        start, period = _line(number, rising)
        fitted = start + period * number
        residual = rising - fitted
        jitter = math.sqrt(float(residual @ residual) / (rising.size - 2))
        if jitter > most * period:
            raise SpecError(
                f"drive: its rising edges scatter by {jitter:.3g} s about a period of {period:.3g} s, so it "
                "is not periodic here: choose a window of one frequency, or a larger hysteresis."
            )
        spread = number - number.mean()
        error = self._error(fitted, spread / (spread @ spread), jitter)
        duty, duty_error = self._duty_cycle(fitted, period, jitter)
        return Timing(1 / period, error / period**2, jitter, duty, duty_error, int(number[-1]))

    def _duty_cycle(self, fitted: Floats, period: float, jitter: float) -> tuple[float, float]:
        """Return the mean duty cycle and its error; a falling edge is paired with the last rising edge before it."""
        before = np.searchsorted(self.rising, self.falling, side="right") - 1
        high = np.where(before >= 0, self.falling - self.rising[before], np.inf)
        before, high = before[high < period], high[high < period]
        if high.size < 2:
            return math.nan, math.nan
        mean, even = float(high.mean()), np.full(high.size, 1 / high.size)
        # assume equal jitter for both kinds of edges, unless the high states scatter more
        each = max(jitter, float(high.std(ddof=1)) / math.sqrt(2))
        errors = [self._error(t, even, each) for t in (fitted[before], fitted[before] + mean)]
        return mean / period, math.hypot(*errors) / period

    def common_error(self, fitted: Floats, scatter: float) -> float:
        """Return the standard error [s] of the time offset of a line fitted through the edges.

        `fitted` are the times of the rising edges on the line [s], `scatter` the root mean square distance of the edges
        from it [s].
        """
        return self._error(fitted, np.full(fitted.size, 1 / fitted.size), scatter, drifts=1)

    def _error(self, fitted: Floats, weights: Floats, scatter: float, drifts: int = 9) -> float:
        """Return the standard error [s] of a weighted sum of edge times, with correlated rounding errors.

        A time known to one sample is rounded to the middle of the interval. The rounding error is a sawtooth
        in the time, so it is not independent from edge to edge. Its harmonics have unknown phase; their
        powers are added, damped by the jitter. The rest of the scatter is independent. The line itself is
        known to about one sample, so the result is averaged over `drifts` slopes that differ by up to one
        sample.
        """
        n_harmonics = 40  # of the sawtooth that describes the rounding of edge times to samples
        step = self.resolution_s
        if not step:
            return scatter * math.sqrt(float(weights @ weights))
        blur = math.sqrt(max(scatter**2 - step**2 / 12, 0.0)) / step
        k = np.arange(1, n_harmonics + 1)
        power = 0.5 * (step / (math.pi * k)) ** 2 * np.exp(-4 * (math.pi * k * blur) ** 2)
        place = (fitted - fitted[0]) / step
        share = np.linspace(-0.5, 0.5, fitted.size)
        turns = place + share * (np.linspace(-1, 1, drifts) if drifts > 1 else np.zeros(1))[:, None]
        sums = np.array([abs(np.exp(2j * np.pi * i * turns) @ weights) ** 2 for i in k]).mean(axis=1)
        rest = max(scatter**2 - float(power.sum()), 0.0)
        return math.sqrt(rest * float(weights @ weights) + float(power @ sums))


def find_edges(time: npt.ArrayLike, drive: npt.ArrayLike, *, hysteresis: float | None = None) -> Edges:
    """Return the times at which a drive signal crosses the middle between its two levels, by linear interpolation.

    An edge must cross a band about the middle, of the width `hysteresis` (by default half the distance of the levels),
    completely. If noise crosses the middle several times on one flank, the mean of the first and the last crossing
    counts. A crossing inside a gap of the sampling is left out.

    Raise `SpecError` if lengths differ, a value is not finite, time does not rise, or the band is not inside the
    levels; also for a constant drive, which has no two levels above its noise.
    """
    t, x = _checked(time, drive)
    return _found([(t, x)], _switch(x, hysteresis))


def edges_of(recording: xr.Dataset, *, hysteresis: float | None = None) -> Edges:
    """Return the edges of the drive signal in all pieces of a recording; edges in gaps between the pieces are left out.

    Raise `SpecError` if the recording has no drive, or no piece of it has an edge. See `find_edges`.
    """
    if DRIVE not in recording:
        name = recording.attrs.get("file", "the recording")
        raise SpecError(
            f"{name}: no drive channel, so neither its frequency nor its sections are known: add [drive] to "
            'the mapping, as in drive = { channel = "rig/motor", kind = "signal" }.'
        )
    time, drive = recording["time"].values, recording[DRIVE].values
    piece = recording["piece"].values if "piece" in recording.coords else np.zeros(time.size, np.int64)
    parts = [_checked(time[piece == k], drive[piece == k]) for k in np.unique(piece)]
    # the levels come from all pieces together: a short piece may stay at one level
    return _found(parts, _switch(np.concatenate([x for _, x in parts]), hysteresis))


@dataclass(frozen=True)
class _Switch:
    """Two-level signal: middle and distance of its levels, width of the hysteresis band, and noise of a sample."""

    middle: float
    span: float
    band: float
    noise: float


def _switch(x: Floats, hysteresis: float | None) -> _Switch:
    """Estimate the levels of a drive signal and its noise; raise SpecError if the noise hides their difference."""
    # least distance of the two levels in units of the noise; white noise alone splits into halves 1.35 apart
    contrast = 6.0
    low, high, noise = _levels(x)
    span = high - low
    if span <= contrast * noise or span <= 0:
        raise SpecError(
            f"drive: no edges; its levels {low:.4g} and {high:.4g} are within noise, {noise:.2g}: "
            'map the channel that switches, choose a window in which it runs, or say drive = "none".'
        )
    band = 0.5 * span if hysteresis is None else hysteresis
    if not 0 < band < span:
        raise SpecError(f"hysteresis = {band:g}: must be greater than 0 and less than the levels' distance, {span:g}.")
    return _Switch(0.5 * (low + high), span, band, noise)


def _found(parts: Sequence[tuple[Floats, Floats]], switch: _Switch) -> Edges:
    """Return the edges of a drive signal, in order, from its stretches (sample times, values)."""
    gap = 1.5  # step in time, in sampling intervals, from which on it is a gap; an edge inside a gap has no known time
    instants, rises, sharp, slopes, steps = [], [], [], [], [0.0]
    for t, x in parts:
        above = x - switch.middle
        state = np.where(above > switch.band / 2, 1, np.where(above < -switch.band / 2, -1, 0))
        decided = np.flatnonzero(state)
        turn = np.flatnonzero(np.diff(state[decided]))
        step = float(np.median(np.diff(t)))
        steps.append(step)
        for a, b in zip(decided[turn], decided[turn + 1], strict=True):
            if np.diff(t[a : b + 1]).max() < gap * step:
                instants.append(_crossing(t[a : b + 1], above[a : b + 1]))
                rises.append(above[b] > 0)
                slopes.append(abs(above[b] - above[a]) / (t[b] - t[a]))
                sharp.append(b == a + 1 and min(abs(above[a]), abs(above[b])) > 0.4 * switch.span)
    at, up = np.array(instants, np.float64), np.array(rises, bool)
    if not sharp or np.mean(sharp) > 0.5:
        return Edges(at[up], at[~up], max(steps) if sharp else 0.0)
    # an edge interpolated at a random place between two noisy samples has sqrt(2/3) of the noise of one
    return Edges(at[up], at[~up], 0.0, math.sqrt(2 / 3) * switch.noise / float(np.median(slopes)))


def _checked(time: npt.ArrayLike, drive: npt.ArrayLike) -> tuple[Floats, Floats]:
    t, x = np.asarray(time, np.float64), np.asarray(drive, np.float64)
    if t.ndim != 1 or t.shape != x.shape:
        raise SpecError(f"drive: shape {x.shape}, time {t.shape}; both must be (samples,), equally many.")
    if t.size < 2:
        raise SpecError(f"drive: {t.size} samples hold no edge; choose a longer window.")
    bad = int((~np.isfinite(x)).sum() + (~np.isfinite(t)).sum())
    if bad:
        raise SpecError(f"drive: {bad} values are not finite; choose a window without them.")
    if not (np.diff(t) > 0).all():
        raise SpecError("drive: time does not rise from sample to sample; sort or repair the recording.")
    return t, x


def _levels(x: Floats) -> tuple[float, float, float]:
    """Return the signal's lower level, upper level and noise; the noise is estimated from second differences."""
    ends = np.percentile(x, [2, 98])
    middle = ends.mean()
    if ends[0] == ends[1]:
        return float(ends[0]), float(ends[0]), 0.0
    low, high = np.median(x[x <= middle]), np.median(x[x > middle])
    noise = 1.4826 * np.median(np.abs(np.diff(x, 2))) / math.sqrt(6) if x.size > 2 else 0.0
    return float(low), float(high), float(noise)


def _crossing(t: Floats, above: Floats) -> float:
    """Return the time of a sign change by linear interpolation; of several, the mean of the first and the last."""
    at = np.flatnonzero((above[:-1] > 0) != (above[1:] > 0))[[0, -1]]
    share = above[at] / (above[at] - above[at + 1])
    return float((t[at] + share * (t[at + 1] - t[at])).mean())


def _numbers(rising: Floats) -> Floats:
    """Return the number of each rising edge from the first, counted in drive periods, missing edges included."""
    gaps = np.diff(rising)
    steps = np.maximum(np.rint(gaps / np.median(gaps)), 1.0)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _line(number: Floats, rising: Floats) -> tuple[float, float]:
    centred = number - number.mean()
    slope = float(centred @ (rising - rising.mean()) / (centred @ centred))
    return float(rising.mean() - slope * number.mean()), slope
