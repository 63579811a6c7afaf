"""Find windows (frequency ranges with one regime) in a sweep, and compare the frequencies at which they end on the rig
and in the model.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from pipeline.rig.measured.computed import Computed

CONFIDENT = 0.8
"""Least confidence of a step's period; other steps do not enter windows."""

Regime = tuple[int, int]
"""Period, 0 if unclosed, and code of the side."""


@dataclass(frozen=True)
class Window:
    """Window: successive frequency steps of one recording, swept in one direction, with the same regime."""

    regime: Regime
    steps: tuple[int, ...]
    recording: int
    direction: str


@dataclass(frozen=True)
class WindowEdge:
    """End of a measured window, with the frequency at which the same regime ends in the model."""

    direction: str
    # regimes on the rig
    before: Regime
    after: Regime
    # middle between the last step before and the first after the edge, and half their distance
    measured_hz: float
    measured_error_hz: float
    # the same in the model, for the attractor that is nearest within the window. NaN if none has that regime, or if the
    # regime continues to the end of the run's axis.
    computed_hz: float
    computed_error_hz: float
    note: str  # reason for a missing number, or a caveat

    @property
    def shift_hz(self) -> float:
        """Frequency at which the regime ends on the rig minus that at which it ends in the model [Hz]."""
        return self.measured_hz - self.computed_hz

    @property
    def shift_error_hz(self) -> float:
        """Bound on the error of the shift [Hz]: half the measured plus half the computed frequency step. It is not a
        standard error.
        """
        return self.measured_error_hz + self.computed_error_hz


def regime_of(measured: xr.Dataset, step: int) -> Regime:
    """Return the regime of a frequency step: period and class of motion."""
    side = int(measured["side"].values[step]) if "side" in measured else 0
    return int(measured["orbit_period"].values[step]), side


def words_for(regime: Regime, words: tuple[str, ...]) -> str:
    """Return a regime (period and class of motion) in words."""
    period = f"period {regime[0]}" if regime[0] else "unclosed"
    return f"{period}, {words[regime[1]]}" if regime[1] and words else period


def windows_of(measured: xr.Dataset) -> list[Window]:
    """Return the windows of all recordings. A window is a run of consecutive frequency steps with the same regime
    (period and class of motion).
    """
    keys = list(zip(measured["recording"].values.tolist(), measured["direction"].values.tolist(), strict=True))
    sure = [i for i in range(len(keys)) if measured["confidence"].values[i] >= CONFIDENT]
    labelled = itertools.groupby(sure, key=lambda i: (keys[i], regime_of(measured, i)))
    return [Window(regime, tuple(steps), *key) for (key, regime), steps in labelled]


def window_edges(measured: xr.Dataset, winners: np.ndarray, computed: Computed) -> list[WindowEdge]:
    """Return the ends of the measured windows, each with the frequency at which the same regime ends in the model.

    Parameters
    ----------
    measured
        Result of `pipeline.rig.measured.measuring.measure`, with sides if the model has a classifier.
    winners
        Id of the nearest attractor of each step, -1 for none.
    computed
        Attractors of the model.
    """
    windows = windows_of(measured)
    found = []
    for one, two in itertools.pairwise(windows):
        if (one.recording, one.direction) != (two.recording, two.direction):
            continue
        f = measured["frequency"].values
        last, first = float(f[one.steps[-1]]), float(f[two.steps[0]])
        computed_hz, error, note = _computed_end(one, measured, winners, computed)
        if not one.regime[0] and not note:
            note = "an unclosed motion may be a transient, which ends by chance"
        found.append(
            WindowEdge(
                one.direction,
                one.regime,
                two.regime,
                0.5 * (last + first),
                0.5 * abs(first - last),
                computed_hz,
                error,
                note,
            )
        )
    return found


def _computed_end(
    window: Window, measured: xr.Dataset, winners: np.ndarray, computed: Computed
) -> tuple[float, float, str]:
    """Return the frequency at which the regime of a measured window ends in the model, in the direction of the
    sweep.
    """
    f = measured["frequency"].values
    with_side = "side" in measured
    chosen = {}
    for step in window.steps:
        place = computed.place(float(f[step]))
        regime = computed.regime(place, int(winners[step])) if place >= 0 and winners[step] >= 0 else None
        if regime is not None and _same(regime, window.regime, with_side):
            chosen[step] = (place, int(winners[step]))
    if not chosen:
        return math.nan, math.nan, "the model's nearest attractor has another regime all along"
    number = Counter(n for _, n in chosen.values()).most_common(1)[0][0]
    middle = window.steps[len(window.steps) // 2]
    start = min((s for s, (_, n) in chosen.items() if n == number), key=lambda s: abs(s - middle))
    place, sign = chosen[start][0], 1 if window.direction != "down" else -1
    return _walk(place, sign, computed, lambda i: _is(computed.regime(i, number), window.regime, with_side))


def _walk(place: int, sign: int, computed: Computed, holds: Callable[[int], bool]) -> tuple[float, float, str]:
    """Follow a regime along the computed frequencies. Return the frequency at which it ends [Hz], half the frequency
    step there, and a note if it does not end.
    """
    f = computed.frequencies
    while 0 <= place + sign < f.size:
        if not holds(place + sign):
            return 0.5 * float(f[place] + f[place + sign]), 0.5 * abs(float(f[place + sign] - f[place])), ""
        place += sign
    return math.nan, math.nan, f"in the model it goes on beyond {f[place]:g} Hz"


def _is(regime: Regime | None, wanted: Regime, with_side: bool) -> bool:
    return regime is not None and _same(regime, wanted, with_side)


def _same(a: Regime, b: Regime, with_side: bool) -> bool:
    return a == b if with_side else a[0] == b[0]
