"""Compute section points and quantities of trajectories under a recorded drive, interval by interval.

A branch of `engine.entry.integrate` is a sequence of points, each with its drive frequency and parameters; state and
step size pass from one point to the next. A recorded drive is integrated as such a branch: each interval is a point
whose drive period is the interval's length, with its own duty cycle or linear torque. So a recorded drive with equal
intervals gives the same numbers as an ordinary run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from magpend_core.defaults import ATOL, CLOSURE, LONGEST_PERIOD, MOST_STEPS, MOST_STEPS_BETWEEN, RTOL
from magpend_core.engine.driven import LEVEL, with_recorded_drive
from magpend_core.engine.entry import N_LANES, check_quantities, integrate
from magpend_core.engine.lanes import Cells
from magpend_core.engine.observers import FIRST_TURN, RECORD, Settings
from magpend_core.engine.system import System
from magpend_core.extension import judge_of
from magpend_core.models.model import Parameters
from magpend_core.pointwise import evaluate_packed
from magpend_core.sampling import Drive, sample
from magpend_core.sections import Sections
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_states, check_tolerance

CHUNK_NUMBERS = 4_000_000
"""Parameter values of the points of one call of the engine: 32 MB."""


def driven_system(system: System, drive: Drive) -> System:
    """Return the system to integrate under a drive: unchanged, or with its forcing replaced by a recorded torque."""
    return with_recorded_drive(system) if LEVEL in drive.names else system


def _padded(packed: np.ndarray, system: System) -> np.ndarray:
    more = len(system.parameter_names) - packed.shape[-1]
    return np.pad(packed, [(0, 0)] * (packed.ndim - 1) + [(0, more)])


def recorded_sections(
    parameters: np.ndarray,
    drive: Drive,
    initial_states: np.ndarray,
    *,
    ends: np.ndarray | None = None,
    n_transient: int,
    n_keep: int,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_steps_per_period: int = MOST_STEPS,
    closure_tolerance: float = CLOSURE,
    max_orbit_period: int = LONGEST_PERIOD,
    system: System,
    n_lanes: int = N_LANES,
    quantities: Sequence[str] | None = None,
    n_points: int | None = None,
) -> Sections:
    """Return the section points of many trajectories under one recorded drive, from its start.

    Parameters
    ----------
    parameters
        Packed parameters of each trajectory, shape (branch, len(system.parameter_names)) [SI].
    drive
        See `Drive.from_edges` and `Drive.from_torque`; it starts at 0 in its first interval.
    initial_states
        States at the drive's start, shape (branch, n_states).
    ends
        For each section the number of the interval at whose end it lies, rising; by default every interval
        ends with a section.
    n_transient, n_keep
        Sections that are passed, and sections that are kept after them.
    rtol, atol, closure_tolerance, max_orbit_period, n_lanes
        As for `run_branches`. A recording repeats itself to its jitter alone: an orbit that closes on itself
        within the tolerance is one for these sections, and no more is said.
    max_steps_per_period
        Limit on the attempted steps in one interval of the drive.
    system
        What is integrated; its forcing is replaced where the drive is a torque.
    quantities
        As for `run_branches`, where every interval ends with a section.
    n_points
        Intervals per call of the engine; no number depends on it.

    Returns
    -------
    Sections
        With leading dims (branch, point), one point.

    Raises
    ------
    ValueError
        If a shape does not fit, the drive is too short for the sections asked for, or quantities are asked
        for and sections are further apart than intervals.
    """
    own = driven_system(system, drive)
    n_transient, n_keep = check_count("n_transient", n_transient, 0), check_count("n_keep", n_keep, 1)
    total, n_intervals = n_transient + n_keep, len(drive.durations_s)
    marks = np.arange(n_intervals) if ends is None else np.asarray(ends, np.int64)
    _check_marks(marks, total, n_intervals, drive.start_s)
    if quantities is not None and not np.array_equal(marks[:total], np.arange(total)):
        raise ValueError("quantities: their extremes are taken over intervals; each must end with a section.")
    packed = _padded(check_array("parameters", parameters, 2), own)
    initial = check_states(initial_states, 2, system.n_states, "initial_states")
    max_orbit_period = check_count("max_orbit_period", max_orbit_period, 1)
    settings = Settings(
        n_transient,
        n_keep,
        max_orbit_period,
        check_tolerance("closure_tolerance", closure_tolerance),
        max(64, 4 * max_orbit_period),
    )
    walk = _Walk(own, packed, initial, marks[:total], settings, len(quantities or ()))
    most = n_points or max(1, CHUNK_NUMBERS // max(1, packed.size))
    for first, stop in _chunks(int(marks[n_transient]) + 1, int(marks[total - 1]) + 1, most):
        if not len(walk.alive):
            break
        points, frequency = _points(own, drive, packed[walk.alive], slice(first, stop))
        cells = integrate(
            own,
            RECORD,
            Settings(0, 1, 1, settings.tolerance, 1),
            parameters=points,
            frequency_hz=frequency,
            initial_states=walk.state[walk.alive],
            n_keep=1,
            n_measures=FIRST_TURN + own.n_states,
            rtol=rtol,
            atol=atol,
            max_steps_per_period=max_steps_per_period,
            step_size=walk.step[walk.alive],
            n_lanes=n_lanes,
            quantities=quantities,
        )
        walk.take(cells, first)
    return walk.outcome(quantities is not None)


def _check_marks(marks: np.ndarray, total: int, n_intervals: int, start_s: float) -> None:
    if start_s:
        raise ValueError(f"the drive starts {start_s:g} s into its first interval; it must start at 0.")
    if total > len(marks):
        raise ValueError(f"{total} sections are asked for, and the drive has {len(marks)}.")
    if (np.diff(marks) <= 0).any() or marks[0] < 0 or marks[-1] >= n_intervals:
        raise ValueError(f"ends must rise, and name intervals of the drive, 0 to {n_intervals - 1}.")


def _chunks(first_kept: int, last: int, most: int) -> Iterator[tuple[int, int]]:
    """Split the intervals of a drive into ranges of limited length, with a cut at the first section point to store."""
    for begin, end in ((0, first_kept), (first_kept, last)):
        for first in range(begin, end, most):
            yield first, min(first + most, end)


def _points(system: System, drive: Drive, packed: np.ndarray, part: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return parameter vectors and frequencies, shape (trajectory, interval, ...), for the intervals of a drive."""
    durations = drive.durations_s[part]
    shape = (len(packed), len(durations))
    points = np.repeat(packed[:, None], len(durations), axis=1)
    for name, values in zip(drive.names, drive.values[part].T, strict=True):
        points[..., system.parameter_names.index(name)] = values
    return points, np.broadcast_to(1.0 / durations, shape).copy()


class _Walk:
    """Progress of the integration under a recorded drive: current states of the trajectories, and results so far."""

    def __init__(
        self,
        system: System,
        packed: np.ndarray,
        initial: np.ndarray,
        marks: np.ndarray,
        settings: Settings,
        n_watched: int,
    ) -> None:
        n, total = len(initial), len(marks)
        self.system, self.settings, self.marks = system, settings, marks
        self.alive, self.state, self.step = np.arange(n), initial.copy(), np.zeros(n)
        # what closes is judged on more sections than may be kept
        self.first_seen = total - min(total, max(settings.n_keep, settings.window))
        self.seen = np.full((n, total - self.first_seen, system.n_states), np.nan)
        self.watched = np.full((n, settings.n_keep, n_watched, 3), np.nan)
        self.status = np.full(n, int(Status.BOUNDED))
        self.turns = np.zeros((n, system.n_states), np.int64)
        self.n_periods, self.n_steps, self.n_rejected = (np.zeros(n, np.int64) for _ in range(3))
        if len(packed) != n:
            raise ValueError(f"parameters has {len(packed)} rows; initial_states has {n}.")

    def take(self, cells: Cells, first: int) -> None:
        """Store the engine's results for the drive intervals from number `first` on."""
        alive, n = self.alive, cells.status.shape[1]
        good = np.isin(cells.status, (Status.PERIODIC, Status.BOUNDED))
        number = np.searchsorted(self.marks, np.arange(first, first + n))
        ends = number < len(self.marks)
        ends[ends] = self.marks[number[ends]] == np.arange(first, first + n)[ends]
        for point in np.flatnonzero(ends):
            place = number[point] - self.first_seen
            if place >= 0:
                self.seen[alive, place] = cells.section[:, point, 0]
            kept = number[point] - self.settings.n_transient
            if kept >= 0:
                self.watched[alive, kept] = cells.watched[:, point, 0]
        self.n_periods[alive] += (good & ends).sum(axis=1)
        self.n_steps[alive] += cells.n_steps.sum(axis=1)
        self.n_rejected[alive] += cells.n_rejected.sum(axis=1)
        if first > self.marks[self.settings.n_transient]:
            self.turns[alive] += cells.turns
        self.state[alive], self.step[alive] = cells.state, cells.step_size
        failed = ~good.all(axis=1)
        self.status[alive[failed]] = cells.status[failed, good[failed].argmin(axis=1)]
        self.alive = alive[~failed]

    def outcome(self, with_extremes: bool) -> Sections:
        failed = self.status != Status.BOUNDED
        self.seen[failed], self.watched[failed], self.turns[failed] = np.nan, np.nan, 0
        period = np.zeros(len(failed), np.int64)
        ring = np.ascontiguousarray(self.seen[:, -self.settings.window :])
        if not failed.all():
            settings = self.settings._replace(window=ring.shape[1])
            period[~failed] = closed_periods(ring[~failed], settings, self.system)
        status = np.where(period > 0, int(Status.PERIODIC), self.status)
        angles = [i for i, angle in enumerate(self.system.is_angle) if angle]
        return Sections(
            section=self.seen[:, None, -self.settings.n_keep :],
            turns=self.turns[:, None, angles].astype(np.int32),
            status=status[:, None].astype(np.int8),
            orbit_period=period[:, None].astype(np.int16),
            n_periods=self.n_periods[:, None].astype(np.int32),
            n_steps=self.n_steps[:, None].astype(np.int32),
            n_rejected=self.n_rejected[:, None].astype(np.int32),
            final_state=self.state[:, None],
            step_size=np.where(failed, np.nan, self.step)[:, None],
            extremes=self.watched[:, None] if with_extremes else None,
        )


def closed_periods(sections: np.ndarray, settings: Settings, system: System) -> np.ndarray:
    """Return the period of each trajectory's section points, or 0 if aperiodic; see `observers.closed_period`.

    Parameters
    ----------
    sections
        Shape (cell, section, n_states).
    settings
        Settings of the observer; `window` is the number of sections.
    system
        System that was integrated.
    """
    out = np.zeros(len(sections), np.int64)
    flat = np.ascontiguousarray(sections.reshape(len(sections), -1))
    judge_of((system.recorded_for or system).plain)(flat, settings.window, settings, out)
    return out


def recorded_trajectory(
    parameters: Parameters,
    drive: Drive,
    initial_state: np.ndarray,
    times: np.ndarray,
    *,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_steps_per_interval: int = MOST_STEPS_BETWEEN,
) -> np.ndarray:
    """Return the states of one trajectory on a time grid, under a recorded drive.

    Parameters
    ----------
    parameters
        See `Model.load`.
    drive
        See `Drive.from_edges` and `Drive.from_torque`.
    initial_state
        At the drive's start, shape (n_states,).
    times
        Rising times since the drive's start [s], shape (n,).
    rtol, atol, max_steps_per_interval
        As for `sample`.

    Returns
    -------
    ndarray
        Shape (n, n_states); angles are not wrapped.

    Raises
    ------
    ValueError
        If an argument is out of bounds or the drive does not cover the times.
    ArithmeticError
        If the trajectory diverges or meets the step limit; the message is the sentence of the `Status`.
    """
    model = parameters.model
    own = driven_system(model.system, drive)
    state = check_states(initial_state, 1, own.n_states, "initial_state")
    found = sample(
        own,
        _padded(parameters.pack(), own)[None],
        state[None],
        [times],
        drives=[drive],
        rtol=rtol,
        atol=atol,
        max_steps_per_interval=max_steps_per_interval,
    )
    if found.status[0] != Status.BOUNDED:
        raise ArithmeticError(f"The trajectory ended early: {Status(int(found.status[0])).advice}.")
    return np.asarray(found.states[0])


def evaluate_recorded(
    names: Sequence[str], t: np.ndarray, state: np.ndarray, parameters: Parameters, drive: Drive
) -> np.ndarray:
    """Compute named quantities of a model under a recorded drive, at given times and states.

    Parameters
    ----------
    names
        Among ``parameters.model.quantities``.
    t
        Rising times since the drive's start [s], shape (n,). An instant at which an interval ends counts to
        the next one, but for the last.
    state
        Shape (n, n_states).
    parameters, drive
        As for `recorded_trajectory`.

    Returns
    -------
    ndarray
        Shape (n, len(names)), in the quantities' units.

    Raises
    ------
    ParameterError
        If a name is unknown.
    ValueError
        If the drive does not cover the times.
    """
    own = driven_system(parameters.model.system, drive)
    columns = check_quantities([parameters.model.quantity(name).name for name in names], own)
    columns = tuple(i - own.n_states for i in columns)
    times, states = check_array("t", t, 1), check_states(state, 2, own.n_states)
    ends = np.cumsum(drive.durations_s) - drive.start_s
    if len(times) and (times[0] < 0.0 or times[-1] > ends[-1] + 1e-9):
        raise ValueError(f"the drive covers 0 s to {ends[-1]:g} s, not {times[0]:g} s to {times[-1]:g} s.")
    # sums of durations round: what is written at an interval's end begins the next one
    interval = np.minimum(np.searchsorted(ends, times + 1e-9, side="right"), len(ends) - 1)
    begins = ends - drive.durations_s
    packed = _padded(parameters.pack(), own)
    out = np.empty((len(times), len(own.quantity_names)))
    for number in np.unique(interval):
        first, stop = np.searchsorted(interval, [number, number + 1])
        for name, value in zip(drive.names, drive.values[number] if drive.names else (), strict=True):
            packed[own.parameter_names.index(name)] = value
        duration = float(drive.durations_s[number])
        local = np.clip(times[first:stop] - begins[number], 0.0, duration)
        evaluate_packed(own, local, states[first:stop], packed, 1.0 / duration, out[first:stop])
    return out[:, list(columns)]
