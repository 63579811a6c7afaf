"""Define observers: functions that run after each period, record section points, and can end a trajectory.

An observer consists of the following functions, which get values for their free names at compile time. (A *cell* is
one trajectory at one parameter point.)

``observe(section, turns, i_period, memory, record, measures, settings) -> status``
    Called after period number `i_period` (1, 2, ...) of a cell. `section` is the state, with angles in
    (-pi, pi]; `turns` counts the full turns of each angle since the branch's start. `memory` is a scratch
    vector of the cell, zero at the start; with a section by level crossing it has one more entry at the end, the
    time since the previous section [s]. The outputs of the cell are `record` (n_keep, n_states) and `measures`,
    which holds zeros or values from the caller at first. Return ``PENDING`` to go on, any other status to end.
``memory_size(settings, n_states) -> int``
    Length of `memory`.
``n_kept(memory) -> int`` and ``keeps_next(i_period, memory, settings) -> bool``, only if sections are recorded
    Number of sections recorded so far, and whether the section after the next period (number `i_period` + 1) will be
    recorded. The engine tracks minimum, maximum and mean of quantities over such periods.
``renew(state, memory, settings)``, only if the observer changes states
    Called at each forcing edge within a period, after a step that leaves the last state below `renew_below`, and before
    `observe` at the end of a period. It changes `state` in place, and the trajectory goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from magpend_core.engine.jit import inline
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.status import Status

PENDING, PERIODIC, BOUNDED = int(Status.PENDING), int(Status.PERIODIC), int(Status.BOUNDED)

ORBIT_PERIOD = 0
"""Column of `measures`: period of the orbit in drive periods, 0 if not closed."""
FIRST_TURN = 1
"""Columns of `measures` from here: turns of each state over the kept periods."""


class Settings(NamedTuple):
    """Settings of the recording observers: lengths of transient and record, largest period searched for, and
    tolerance.
    """

    n_transient: int
    n_keep: int
    max_orbit_period: int
    tolerance: float
    window: int
    stops_early: bool = False


def window_of(max_orbit_period: int) -> int:
    """Return the number of last section points that are examined to find whether an orbit is periodic."""
    return max(64, 4 * max_orbit_period)


def _leave(state: Any, memory: Any, settings: Any) -> None:
    """Leave the states as they are: the default of `Observer.renew`."""


@inline
def _none_kept(memory: Any) -> int:
    return 0


@inline
def _keeps_none(i_period: int, memory: Any, settings: Any) -> bool:
    return False


@dataclass(frozen=True)
class Observer:
    """Functions that the engine calls after each period of a trajectory, to record or to end it.

    They are plain Python functions, compiled for each system. In them, `N` is the number of states, `IS_ANGLE` (0 or
    1) and `SCALES` are arrays of the system, and `bindings` defines further free names. They run once per period of a
    trajectory, not per step, on plain numbers and arrays.

    Attributes
    ----------
    name : str
        Name of the compiled code; equal names must mean equal functions and bindings.
    observe, memory_size, renew : callable
        See the text of this module.
    bindings : mapping
        Values of free names: numbers, tuples of numbers, compiled functions.
    renew_below : float
        `renew` is also called after a step that leaves the last state below this.

    Examples
    --------
    Count the periods that end with a first state above 0, and stop after `n` periods:

    >>> class Settings(NamedTuple):
    ...     n: int
    >>> def observe(section, turns, i_period, memory, record, measures, settings):
    ...     measures[0] += section[0] > 0.0
    ...     return BOUNDED if i_period == settings.n else PENDING
    >>> def memory_size(settings, n_states):
    ...     return 0
    >>> codes = {"PENDING": PENDING, "BOUNDED": BOUNDED}
    >>> positive = Observer("positive", observe, inline(memory_size), codes)

    `entry.integrate(system, positive, Settings(100), n_keep=0, n_measures=1, ...)` runs it.
    """

    name: str
    observe: Callable[..., int]
    memory_size: Callable[..., int]
    bindings: Mapping[str, Any] = field(default_factory=dict, hash=False)
    renew: Callable[..., None] = _leave
    renew_below: float = -math.inf
    n_kept: Callable[..., int] = _none_kept
    keeps_next: Callable[..., bool] = _keeps_none

    @property
    def rewrites(self) -> bool:
        """Whether this observer has a `renew` that can change the states."""
        return self.renew is not _leave


HELPERS = ("_lag_distance", "_largest_lag", "_smallest_divisor", "closed_period")
"""Templates of this module that an observer may call; callees come first."""

# layout of an observer's memory: three numbers, then a ring of the last `window` sections
_SETTLED, _PERIOD, _KEPT, _RING = 0, 1, 2, 3


def _lag_distance(ring: Any, i: int, j: int, window: int) -> float:
    """Return the largest scaled difference between the states at section points number `i` and `j` (1, 2, ...); angles
    mod 2 pi.
    """
    a, b = ((i - 1) % window) * N, ((j - 1) % window) * N
    largest = 0.0
    for k in range(N):
        x = abs(ring[a + k] - ring[b + k])
        if IS_ANGLE[k] == 1:
            x = min(x, abs(TWO_PI - x))
        largest = max(largest, x / SCALES[k])
    return largest


def closed_period(ring: Any, last: int, settings: Settings) -> int:
    """Return the period of the periodic orbit that the last section points approach, or 0.

    For each candidate period p, the distances between sections p periods apart are split into an older and a younger
    half of the window, with largest values D1 and D2. If the distances continue to shrink by r = D2/D1 per half
    window, their sum bounds the distance of the last section from the orbit:

        D2 + m D2 r/(1 - r),   m = ceil(half window/p).

    The orbit counts as periodic if this bound is at most `tolerance`, or if D1 and D2 are both below a hundredth of
    `tolerance` (then integration error hides the decay). So a slow spiral is not mistaken for the orbit that it
    approaches: with multipliers of modulus 0.96, the distance to the orbit is about 20 times the distance between
    successive sections.

    The rule fails in three cases: a trajectory passes an unstable orbit at a distance far below the tolerance; the
    decay becomes slower later; or the trajectory approaches along a stretched spiral that turns by less than 0.05 rad
    per period. In the last case the distance can be twice the tolerance at moduli of 0.96 to 0.99, and eight times the
    tolerance above.
    """
    n = min(last, settings.window)
    for p in range(1, min(settings.max_orbit_period, n // 4) + 1):
        half = (n - p) // 2
        younger = _largest_lag(ring, last - half, last, p, settings)
        if younger > settings.tolerance:
            continue
        older = _largest_lag(ring, last - 2 * half, last - half, p, settings)
        steps = (half + p - 1) // p
        hidden = max(older, younger) <= 0.01 * settings.tolerance
        shrinking = younger < older
        if hidden or (shrinking and younger * (1.0 + steps * younger / (older - younger)) <= settings.tolerance):
            return _smallest_divisor(ring, last, half, p, settings)
    return 0


def _largest_lag(ring: Any, first: int, last: int, p: int, settings: Settings) -> float:
    """Return the largest distance between section points `p` periods apart, where the later point is one of `first` + 1
    to `last`.
    """
    largest = 0.0
    for i in range(first + 1, last + 1):
        largest = max(largest, _lag_distance(ring, i, i - p, settings.window))
    return largest


def _smallest_divisor(ring: Any, last: int, half: int, p: int, settings: Settings) -> int:
    """Return the smallest divisor of the period `p` that is also a period of the orbit.

    Along a slow spiral, sections p periods apart can converge before sections q apart do. All points of the younger
    half lie within a few tolerances of the orbit, so a limit of ten tolerances distinguishes the periods.
    """
    for q in range(1, p):
        if p % q == 0 and _largest_lag(ring, last - half, last, q, settings) <= 10.0 * settings.tolerance:
            return q
    return p


def _record(
    section: Any, turns: Any, i_period: int, memory: Any, record: Any, measures: Any, settings: Settings
) -> int:
    """Record `n_keep` section points after the transient, then find whether the orbit is periodic.

    The transient lasts `n_transient` periods. With `stops_early` it ends earlier if the orbit becomes periodic, which
    `closed_period` tests after every quarter of the window.
    """
    ring = memory[_RING:]
    slot = ((i_period - 1) % settings.window) * N
    for k in range(N):
        ring[slot + k] = section[k]
    if i_period <= settings.n_transient and memory[_SETTLED] == 0.0:
        if settings.stops_early and i_period >= settings.window and i_period % (settings.window // 4) == 0:
            memory[_PERIOD] = closed_period(ring, i_period, settings)
            memory[_SETTLED] = min(memory[_PERIOD], 1.0)
        return PENDING
    kept = int(memory[_KEPT])
    memory[_KEPT] += 1.0
    for k in range(N):
        record[kept, k] = section[k]
        if kept == 0:
            measures[FIRST_TURN + k] = -turns[k]
    if kept + 1 < settings.n_keep:
        return PENDING
    if memory[_PERIOD] == 0.0:
        memory[_PERIOD] = closed_period(ring, i_period, settings)
    measures[ORBIT_PERIOD] = memory[_PERIOD]
    for k in range(N):
        measures[FIRST_TURN + k] += turns[k]
    return PERIODIC if memory[_PERIOD] > 0.0 else BOUNDED


@inline
def _memory_size(settings: Settings, n_states: int) -> int:
    return _RING + settings.window * n_states


@inline
def _n_kept(memory: Any) -> int:
    return int(memory[_KEPT])


@inline
def _keeps_next(i_period: int, memory: Any, settings: Settings) -> bool:
    return i_period >= settings.n_transient or memory[_SETTLED] != 0.0


RECORD = Observer("record", _record, _memory_size, n_kept=_n_kept, keeps_next=_keeps_next)
"""Observer that records `n_keep` sections after the transient, see `_record`."""


class MapSettings(NamedTuple):
    """Settings of the observer `MAP`. The number of periods is not among them, because each trajectory has its own."""

    n_memory: int = 1


def _keep_all(
    section: Any, turns: Any, i_period: int, memory: Any, record: Any, measures: Any, settings: MapSettings
) -> int:
    """Record the section point of every period; end the trajectory after ``measures[0]`` periods."""
    for k in range(N):
        record[i_period - 1, k] = section[k]
    memory[0] = float(i_period)
    return BOUNDED if i_period >= measures[0] else PENDING


@inline
def _map_memory(settings: MapSettings, n_states: int) -> int:
    return settings.n_memory


@inline
def _n_mapped(memory: Any) -> int:
    return int(memory[0])


@inline
def _keeps_every(i_period: int, memory: Any, settings: MapSettings) -> bool:
    return True


MAP = Observer("map", _keep_all, _map_memory, n_kept=_n_mapped, keeps_next=_keeps_every)
"""Observer that records every section; each cell ends after the number of periods in its ``measures[0]``."""


def _keep_lifted(
    section: Any, turns: Any, i_period: int, memory: Any, record: Any, measures: Any, settings: MapSettings
) -> int:
    """Record the section point of every period with angles that run on; end after ``measures[0]`` periods."""
    for k in range(N):
        record[i_period - 1, k] = section[k] + TWO_PI * turns[k]
    memory[0] = float(i_period)
    return BOUNDED if i_period >= measures[0] else PENDING


LIFT = Observer("lift", _keep_lifted, _map_memory, n_kept=_n_mapped, keeps_next=_keeps_every)
"""Observer like `MAP`, with the full turns of the angles since the start added to them."""
