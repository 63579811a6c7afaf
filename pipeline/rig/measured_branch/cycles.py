"""Measure a recorded periodic motion: amplitude, mean, frequency and harmonics, with their scatter over the cycles."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

N_HARMONICS = 3
"""Harmonics that are measured, the first included."""

HYSTERESIS = 0.3
"""Band about the mean that a cycle must cross, in units of the signal's standard deviation: noise crosses less."""

LEAST_CYCLES = 3


class CyclesError(ValueError):
    """Error raised for a signal with too few whole cycles."""


@dataclass(frozen=True)
class Cycles:
    """Periodic motion in one signal: medians over its cycles, and the scatter of single cycles."""

    n: int
    # half of the peak-to-peak value [the signal's unit]
    amplitude: float
    amplitude_sd: float
    mean: float  # over a cycle
    mean_sd: float
    frequency: float  # [Hz]
    frequency_sd: float
    # (N_HARMONICS,) amplitudes of the Fourier components of a cycle, the first at the frequency itself
    harmonics: np.ndarray


def cycles_of(time: np.ndarray, values: np.ndarray) -> Cycles:
    """Measure the cycles of a signal. Each cycle lies between two upward crossings of the signal's mean.

    Parameters
    ----------
    time
        Rising, evenly spaced [s]; shape (n,).
    values
        The signal; shape (n,). Samples that are not finite end the signal.

    Raises
    ------
    CyclesError
        If there are fewer than `LEAST_CYCLES` whole cycles.
    """
    last = len(values) if np.isfinite(values).all() else int(np.argmin(np.isfinite(values)))
    time, values = time[:last], values[:last]
    starts = _upward_crossings(time, values)
    if len(starts) < LEAST_CYCLES + 1:
        raise CyclesError(f"the signal has {max(len(starts) - 1, 0)} whole cycles; at least {LEAST_CYCLES} are needed.")
    found = np.array([_cycle(time, values, a, b) for a, b in itertools.pairwise(starts)])
    middle, scatter = np.median(found, axis=0), np.std(found, axis=0, ddof=1)
    return Cycles(len(found), middle[0], scatter[0], middle[1], scatter[1], middle[2], scatter[2], middle[3:])


def _upward_crossings(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the times [s] at which a signal rises through its mean. Before each crossing, the signal must have been
    below a hysteresis band about the mean.
    """
    if len(values) < 2:
        return np.zeros(0)
    away = values - values.mean()
    band = HYSTERESIS * away.std()
    found, is_low = [], False
    for i in range(1, len(away)):
        is_low = is_low or away[i - 1] < -band
        if is_low and away[i - 1] < 0.0 <= away[i]:
            found.append(time[i - 1] - away[i - 1] * (time[i] - time[i - 1]) / (away[i] - away[i - 1]))
            is_low = False
    return np.array(found)


def _cycle(time: np.ndarray, values: np.ndarray, begin: float, end: float) -> np.ndarray:
    inside = (time > begin) & (time < end)
    n = max(64, int(inside.sum()))
    even = np.interp(begin + (end - begin) * np.arange(n) / n, time, values)
    lines = np.abs(np.fft.rfft(even)) / n
    peaks = values[inside]
    return np.array(
        [0.5 * np.ptp(peaks), lines[0] * np.sign(even.mean()), 1.0 / (end - begin), *2.0 * lines[1 : N_HARMONICS + 1]]
    )
