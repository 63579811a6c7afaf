"""Sort the forcing edges of a drive period by time. Generated code calls these functions."""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline


@inline
def rank(at: Any, i: int) -> int:
    """Return the rank (0, 1, ...) of switching instant `i` when the instants of a drive period are sorted by time; ties
    keep their order.
    """
    place = 0
    for j in range(len(at)):
        if at[j] < at[i] or (at[j] == at[i] and j < i):
            place += 1
    return place


@inline
def set_times(at: Any, period: float, times: Any) -> None:
    """Write the switching instants of a drive period to `times` in rising order, each at least a little after the one
    before.
    """
    for i in range(len(at)):
        times[rank(at, i)] = at[i]
    gap = 1e-12 * period
    for i in range(1, len(at)):
        times[i] = max(times[i], times[i - 1] + gap)
    last = period - gap
    for i in range(len(at) - 1, -1, -1):
        times[i] = min(times[i], last)
        last = times[i] - gap


@inline
def within(time: float, period: float) -> float:
    """Return a switching instant of a drive period unchanged, or 0 if it coincides with the start or the end of the
    period.
    """
    near = 1e-9 * period
    return 0.0 if time < near or time > period - near else time
