"""Sample many trajectories under recorded drives, at the sampling instants of the recordings to be fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from magpend_core.defaults import ATOL, MOST_STEPS_BETWEEN, RTOL
from magpend_core.engine import sampling as engine
from magpend_core.engine.checks import check_system
from magpend_core.engine.driven import with_recorded_drive
from magpend_core.engine.entry import N_LANES, check_tolerances, integrate, rtol_of_motion, slack_of
from magpend_core.engine.observers import LIFT, MapSettings
from magpend_core.engine.symbolic import check_implicit
from magpend_core.engine.system import System
from magpend_core.validation import check_array, check_count, check_states

__all__ = ["Drive", "Samples", "sample", "with_recorded_drive"]


@dataclass(frozen=True)
class Drive:
    """Recorded drive: consecutive time intervals, each with its duration and its values of some parameters.

    An interval is the period between two measured rising edges, with its duty cycle, or the time between two samples of
    a measured torque (for `with_recorded_drive`). Within an interval, the system's forcing is that of a drive whose
    period is the interval's length.

    Attributes
    ----------
    durations_s : ndarray, (interval,)
        Lengths of the intervals, above 0 [s].
    names : tuple of str
        Names of the parameters that change with the interval.
    values : ndarray, (interval, name)
        Their values; NaN: the parameter keeps the trajectory's value.
    start_s : float
        Start of the trajectory within the first interval [s].
    """

    durations_s: np.ndarray
    names: tuple[str, ...] = ()
    values: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    start_s: float = 0.0

    @classmethod
    def from_edges(
        cls, rising_s: np.ndarray, falling_s: np.ndarray, *, name: str = "duty_cycle", start_s: float = 0.0
    ) -> Drive:
        """Make a drive whose periods lie between measured rising edges.

        Parameters
        ----------
        rising_s
            Rising edges [s], at least two; shape (period + 1,).
        falling_s
            The falling edge in each period [s]; shape (period,).
        name
            Parameter that is the fraction of the period in the high state.
        start_s
            Where in the first period the trajectory starts [s].

        Raises
        ------
        ValueError
            If a falling edge does not lie between its rising ones.
        """
        rising, falling = check_array("rising_s", rising_s, 1), check_array("falling_s", falling_s, 1)
        if len(rising) < 2 or len(falling) != len(rising) - 1:
            raise ValueError(
                f"{len(rising)} rising and {len(falling)} falling edges: give two rising edges at least, and "
                "one falling edge between each two."
            )
        if not ((rising[:-1] < falling) & (falling < rising[1:])).all():
            raise ValueError("falling_s must lie between the rising edges, one in each period.")
        period = np.diff(rising)
        return cls(period, (name,), ((falling - rising[:-1]) / period)[:, None], start_s)

    @classmethod
    def from_torque(cls, times_s: np.ndarray, values: np.ndarray) -> Drive:
        """Make a drive that interpolates measured values linearly, for `with_recorded_drive`.

        Parameters
        ----------
        times_s
            Rising times [s], the first is the start; shape (n,), n at least 2.
        values
            Forcing at those times, in the unit of the system's own; shape (n,).

        Raises
        ------
        ValueError
            If the shapes do not fit or the times do not rise.
        """
        times, levels = check_array("times_s", times_s, 1), check_array("values", values, 1)
        steps = np.diff(times)
        if len(times) < 2 or len(times) != len(levels) or not (steps > 0.0).all():
            raise ValueError("times_s must rise, two at least, with as many values.")
        table = np.column_stack([levels[:-1], np.diff(levels) / steps])
        return cls(steps, ("recorded_drive", "recorded_drive_slope"), table)

    def window(self, begin_s: float, end_s: float) -> Drive:
        """Return the intervals of the drive that cover the times from `begin_s` to `end_s` [s since the first
        interval].

        Raises
        ------
        ValueError
            If the drive does not cover it.
        """
        ends = np.cumsum(self.durations_s)
        slack = engine.COINCIDENT * float(ends[-1])
        if begin_s < self.start_s - slack or end_s > ends[-1] + slack or end_s <= begin_s:
            raise ValueError(
                f"the drive covers {self.start_s:g} s to {ends[-1]:g} s, not {begin_s:g} s to {end_s:g} s."
            )
        first = min(int(np.searchsorted(ends, begin_s + slack, side="right")), len(ends) - 1)
        last = min(int(np.searchsorted(ends, end_s - slack)), len(ends) - 1)
        before = ends[first] - self.durations_s[first]
        kept = slice(first, last + 1)
        values = self.values[kept] if self.names else self.values
        return Drive(self.durations_s[kept], self.names, values, max(begin_s - before, 0.0))


@dataclass(frozen=True)
class Samples:
    """States of trajectories at the sampled instants, with status and step counts.

    Attributes
    ----------
    states : ndarray, (trajectory, longest, n_columns)
        At the times of each trajectory's piece; angles are not wrapped. NaN beyond a piece's end, and from
        where a trajectory failed.
    status : ndarray of int64, (trajectory,)
        Codes of `Status`; ``BOUNDED`` if all times were reached.
    n_steps : ndarray of int64, (trajectory,)
        Accepted steps.
    """

    states: np.ndarray
    status: np.ndarray
    n_steps: np.ndarray


def sample(
    system: System,
    parameters: np.ndarray,
    initial_states: np.ndarray,
    times: Sequence[np.ndarray],
    *,
    piece: np.ndarray | None = None,
    drives: Sequence[Drive | None] | None = None,
    columns: Sequence[int] | None = None,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_steps_per_interval: int = MOST_STEPS_BETWEEN,
    limits_first_step: bool = True,
    n_lanes: int = N_LANES,
) -> Samples:
    """Return the states of many trajectories at the sampling instants of recordings.

    Parameters
    ----------
    system
        What is integrated; of a map the times are counts of iterations, and drives and tolerances without effect.
    parameters
        Packed parameters of each trajectory, shape (trajectory, n_parameters) [SI].
    initial_states
        Shape (trajectory, n_states).
    times
        For each piece its instants [s since its start], rising, the first at least 0.
    piece
        Which piece's times and drive each trajectory has, shape (trajectory,); by default one each, in order.
    drives
        The drive of each piece; None for a system whose forcing is off or absent: then the piece counts as
        one interval.
    columns
        Numbers of the states that are wanted; by default all.
    rtol, atol
        Relative and absolute tolerance of the error control; `rtol` at least 1e-13.
    max_steps_per_interval
        Limit on the attempted steps in one interval of the drive.
    limits_first_step
        Whether a first step is at most the spacing of the times. An interval can be as long as a piece, and the
        first step is a share of the interval; not needed if intervals are drive periods.
    n_lanes
        Trajectories in flight; no number depends on it.

    Returns
    -------
    Samples

    Raises
    ------
    ValueError
        If a shape does not fit, an argument is out of bounds or a drive does not cover its piece.
    """
    rtol, atol = check_tolerances(rtol, atol)
    rtol = rtol_of_motion(system, rtol)
    check_implicit(system)
    packed = check_array("parameters", parameters, 2)
    initial = check_states(initial_states, 2, system.n_states, "initial_states")
    wanted = (len(initial), len(system.parameter_names))
    if packed.shape != wanted:
        raise ValueError(f"parameters has shape {packed.shape}; {system.name} asks for {wanted}.")
    grids = [_check_times(i, t) for i, t in enumerate(times)]
    which = np.arange(len(grids)) if piece is None else np.asarray(piece, np.int64)
    if which.shape != (len(initial),) or (len(which) and not 0 <= which.min() <= which.max() < len(grids)):
        raise ValueError(f"piece must give one of {len(grids)} pieces for each of {len(initial)} trajectories.")
    columns = range(system.n_states) if columns is None else columns
    if system.is_map:
        return _iterated(system, packed, initial, [grids[i] for i in which], list(columns), n_lanes)
    longest = max((len(t) for t in grids), default=0)
    table = _drive_table(system, grids, drives)
    samples = engine.Samples(
        packed,
        initial,
        which,
        np.concatenate([*grids, np.zeros(0)]),
        _offsets(grids),
        *table,
        np.array([spacing_of(grid) if limits_first_step else np.inf for grid in grids]),
        np.array(list(columns), np.int64),
        slack_of(rtol, atol),
        np.full((len(which), longest, len(columns)), np.nan),
        np.zeros(len(which), np.int64),
        np.zeros(len(which), np.int64),
    )
    if len(which):
        frequency = 1.0 / samples.durations[samples.first_interval[which]]
        check_system(system, packed, frequency, initial)
        attempts = float(check_count("max_steps_per_interval", max_steps_per_interval, 1))
        lanes = check_count("n_lanes", n_lanes, 1)
        engine.sampler_of(system)(samples, lanes, rtol, atol, attempts)
    return Samples(samples.out, samples.status, samples.n_steps)


def _iterated(
    system: System, packed: np.ndarray, initial: np.ndarray, grids: list[np.ndarray], columns: list[int], n_lanes: int
) -> Samples:
    """Return the states of trajectories of a map after given numbers of iterations, a row of `grids` for each."""
    if any((grid % 1.0 != 0.0).any() for grid in grids):
        raise ValueError(f"times: {system.name} is a map, which has states after whole numbers of iterations alone.")
    ends = np.array([max(grid[-1], 1.0) for grid in grids])
    cells = integrate(
        system,
        LIFT,
        MapSettings(),
        parameters=packed[:, None],
        frequency_hz=np.ones((len(grids), 1)),
        initial_states=initial,
        n_keep=int(ends.max(initial=1.0)),
        n_measures=1,
        measures=ends[:, None, None],
        rtol=RTOL,
        atol=ATOL,
        max_steps_per_period=1,
        n_lanes=n_lanes,
    )
    states = np.concatenate([initial[:, None], cells.section[:, 0]], axis=1)[:, :, columns]
    out = np.full((len(grids), max(map(len, grids), default=0), len(columns)), np.nan)
    for own, grid, row in zip(states, grids, out, strict=True):
        row[: len(grid)] = own[grid.astype(np.int64)]
    return Samples(out, cells.status[:, 0], cells.n_steps[:, 0])


def spacing_of(grid: np.ndarray) -> float:
    """Return the mean spacing of a time grid; infinite for a single time."""
    return float((grid[-1] - grid[0]) / (len(grid) - 1)) if len(grid) > 1 else np.inf


def _check_times(number: int, times: np.ndarray) -> np.ndarray:
    grid = check_array(f"times[{number}]", times, 1)
    if not len(grid) or grid[0] < 0.0 or (np.diff(grid) <= 0.0).any():
        raise ValueError(f"times[{number}] must start at 0 or later and rise from entry to entry.")
    return grid


def _offsets(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _drive_table(
    system: System, grids: list[np.ndarray], drives: Sequence[Drive | None] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the drives as flat arrays for the engine: durations, values, first intervals, changed parameters, start
    times.
    """
    given = [None] * len(grids) if drives is None else list(drives)
    if len(given) != len(grids):
        raise ValueError(f"{len(given)} drives for {len(grids)} pieces; give one for each.")
    names = next((d.names for d in given if d is not None), ())
    durations, values = [], []
    for i, (grid, drive) in enumerate(zip(grids, given, strict=True)):
        if drive is None:
            if names:
                raise ValueError(f"drives[{i}] is None, others are not; give all pieces a drive, or none.")
            # a sample at 0 alone needs an interval, too
            durations.append(np.array([grid[-1] or 1e-9]))
            values.append(np.zeros((1, 0)))
            continue
        durations.append(_check_drive(i, drive, names, grid[-1]))
        values.append(drive.values if names else np.zeros((len(drive.durations_s), 0)))
    unknown = [name for name in names if name not in system.parameter_names]
    if unknown:
        raise ValueError(f"the drive changes {unknown[0]!r}, which is no parameter of {system.name}.")
    changed = np.array([system.parameter_names.index(name) for name in names], np.int64)
    starts = np.array([0.0 if d is None else d.start_s for d in given])
    table = np.ascontiguousarray(np.concatenate([*values, np.zeros((0, len(names)))]), np.float64)
    return np.concatenate([*durations, np.zeros(0)]), table, _offsets(durations), changed, starts


def _check_drive(number: int, drive: Drive, names: tuple[str, ...], end_s: float) -> np.ndarray:
    durations = check_array(f"drives[{number}].durations_s", drive.durations_s, 1)
    if drive.names != names or (names and np.shape(drive.values) != (len(durations), len(names))):
        raise ValueError(
            f"drives[{number}] has values of shape {np.shape(drive.values)} for {drive.names}; all drives "
            f"need one row per interval and the same names {names}."
        )
    if not len(durations) or (durations <= 0.0).any() or not 0.0 <= drive.start_s < durations[0]:
        raise ValueError(f"drives[{number}]: durations must be above 0, and the start lie in the first interval.")
    covered = durations.sum() - drive.start_s
    if covered < end_s * (1.0 - engine.COINCIDENT):
        raise ValueError(
            f"drives[{number}] covers {covered:g} s of a piece of {end_s:g} s; give a longer drive or fewer times."
        )
    return durations
