"""Compute sections of trajectories while parameters move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from magpend_core.engine.entry import N_LANES, integrate
from magpend_core.engine.observers import RECORD, Settings, window_of
from magpend_core.engine.system import System
from magpend_core.extension import orbit_periods
from magpend_core.models.drift.ramps import STEEPNESS, Ramp, RampOfCells, motions_of
from magpend_core.models.drift.structure import moving_of, pieces_of
from magpend_core.models.drift.system import NEAR, Moving, with_moving_constants
from magpend_core.sections import Sections
from magpend_core.status import Status

CHUNK_NUMBERS = 4_000_000
"""Parameter values of the intervals of one call of the engine: 32 MB."""

GOOD = (Status.PERIODIC, Status.BOUNDED)


@dataclass(frozen=True)
class Drift:
    """The motion of a system's parameters, ready to be integrated.

    Attributes
    ----------
    ramps : tuple of Ramp
    names : tuple of str
        Names of the packed parameters: those of the system, then the ramps' numbers.
    moving : Moving
    """

    ramps: tuple[Ramp, ...]
    names: tuple[str, ...]
    moving: Moving

    @classmethod
    def of(
        cls, system: System, ramps: Sequence[Ramp], names: Sequence[str], packed: np.ndarray, frequency_hz: np.ndarray
    ) -> Drift:
        """Find out how the parameters of a system move.

        Parameters
        ----------
        system, names
            See `structure.moving_of`.
        packed, frequency_hz
            Parameters of cells that stand for all: the ends of every range.

        Raises
        ------
        DriftError
            See `structure.moving_of`.
        """
        motions = motions_of(ramps, names, packed, frequency_hz)
        return cls(tuple(ramps), tuple(names), moving_of(system, motions, packed, frequency_hz))


def drifting_sections(
    system: System,
    drift: Drift,
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    initial_states: np.ndarray,
    *,
    n_transient: int,
    n_keep: int,
    rtol: float,
    atol: float,
    max_steps_per_period: int,
    closure_tolerance: float,
    max_orbit_period: int,
    n_lanes: int = N_LANES,
    quantities: Sequence[str] | None = None,
    chunk_numbers: int = CHUNK_NUMBERS,
) -> Sections:
    """Return the sections of many trajectories while their parameters move.

    Steps end at the corners of the ramps. An orbit counts as closed only by sections after all ramps.

    Parameters
    ----------
    system
        The system, with its method.
    drift
        How its parameters move.
    parameters
        Packed values of ``drift.names``, shape (cell, len(drift.names)).
    frequency_hz
        Of the drive, or of the looks at a flow, shape (cell,).
    initial_states
        At time 0, shape (cell, n_states).
    n_transient, n_keep, rtol, atol, closure_tolerance, max_orbit_period, n_lanes, quantities
        As for `magpend_core.run_branches`.
    max_steps_per_period
        Limit on the attempted steps in a drive period, or in a part of one between two corners.
    chunk_numbers
        Parameter values of one call of the engine; no number depends on it.

    Returns
    -------
    Sections
        With leading dims (cell, 1).
    """
    window = window_of(max_orbit_period)
    walk = _Walk(system, drift, parameters, frequency_hz, initial_states, n_transient, n_keep, quantities, window)
    how = {"rtol": rtol, "atol": atol, "max_steps_per_period": max_steps_per_period, "n_lanes": n_lanes}
    width = len(walk.moved.parameter_names)
    for first, last in ((0, n_transient + 1), (n_transient + 1, n_transient + n_keep)):
        most = max(1, chunk_numbers // max(1, 2 * width * len(initial_states)))
        for begin in range(first, last, most):
            walk.go(begin, min(begin + most, last), how, counts_turns=begin > n_transient)
    return walk.outcome(closure_tolerance, max_orbit_period)


class _Timeline:
    """The intervals of one cell: its drive periods, divided at the corners of its ramps."""

    def __init__(
        self, motions: Sequence[RampOfCells], pieces: Sequence[int], cell: int, hz: float, n_periods: int
    ) -> None:
        cuts = np.concatenate([m.corners(cell, n) for m, n in zip(motions, pieces, strict=True)])
        cuts = np.unique(cuts[(cuts > 0.0) & (cuts * hz < n_periods)])
        near = np.abs(cuts * hz - np.round(cuts * hz)) <= NEAR * np.maximum(1.0, cuts * hz)
        cuts = cuts[~near]
        if len(cuts):
            cuts = cuts[np.append(True, np.diff(cuts) * hz > NEAR * np.maximum(1.0, cuts[1:] * hz))]
        self.hz, self.cuts = hz, cuts
        self.period = np.floor(cuts * hz).astype(np.int64)
        # where each cut stands among the begins of all intervals
        self.place = self.period + 1 + np.arange(len(cuts))

    def first(self, section: int) -> int:
        """Return the number of the interval that begins at a section."""
        return section + int(np.searchsorted(self.period, section))

    def times(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the drive period in which intervals begin, and the time from its begin to theirs [s]."""
        before = np.searchsorted(self.place, numbers, side="right")
        section = numbers - before
        offset = np.zeros(len(numbers))
        if len(self.cuts):
            last = np.maximum(before - 1, 0)
            is_cut = (before > 0) & (self.place[last] == numbers)
            section = np.where(is_cut, self.period[last], section)
            offset = np.where(is_cut, self.cuts[last] - self.period[last] / self.hz, 0.0)
        return section, offset


@dataclass
class _Walk:
    """Progress of the integration of many cells."""

    system: System
    drift: Drift
    parameters: np.ndarray
    frequency_hz: np.ndarray
    state: np.ndarray
    n_transient: int
    n_keep: int
    quantities: Sequence[str] | None
    window: int
    moved: System = field(init=False)

    def __post_init__(self) -> None:
        n, total = len(self.state), self.n_transient + self.n_keep
        self.moved = with_moving_constants(self.system, self.drift.moving)
        self.motions = motions_of(self.drift.ramps, self.drift.names, self.parameters, self.frequency_hz)
        pieces = pieces_of(self.system, self.drift.moving, self.motions, self.parameters)
        self.lines = [_Timeline(self.motions, pieces[i], i, float(self.frequency_hz[i]), total) for i in range(n)]
        self.state, self.step = self.state.copy(), np.zeros(n)
        # what closes is judged on more sections than may be kept
        self.first_seen = total - min(total, max(self.n_keep, self.window))
        self.seen = np.full((n, total - self.first_seen, self.system.n_states), np.nan)
        self.watched = np.full((n, self.n_keep, len(self.quantities or ()), 3), np.nan)
        self.status = np.full(n, int(Status.BOUNDED))
        self.turns = np.zeros((n, self.system.n_states), np.int64)
        self.n_periods, self.n_steps, self.n_rejected = (np.zeros(n, np.int64) for _ in range(3))

    def go(self, begin: int, end: int, how: dict[str, float], *, counts_turns: bool) -> None:
        """Integrate all cells that have not failed from one section to another."""
        alive = np.flatnonzero(self.status == Status.BOUNDED)
        counts = np.array([self.lines[i].first(end) - self.lines[i].first(begin) for i in alive])
        if not len(alive):
            return
        # shorter cells go on beyond their end, which nobody looks at; only turns are counted over the whole call
        exact = counts_turns and any(self.system.is_angle)
        for n in np.unique(counts) if exact else [counts.max()]:
            own = alive[counts == n] if exact else alive
            self._call(own, begin, end, int(n), how)

    def _call(self, own: np.ndarray, begin: int, end: int, n: int, how: dict[str, float]) -> None:
        points = np.empty((len(own), n, len(self.moved.parameter_names)))
        frequency = np.empty((len(own), n))
        ends = np.full((len(own), n), -1)
        for row, cell in enumerate(own):
            self._describe(cell, begin, points[row], frequency[row], ends[row])
        cells = integrate(
            self.moved,
            RECORD,
            Settings(0, 1, 1, 1e-9, 1),
            parameters=points,
            frequency_hz=frequency,
            initial_states=self.state[own],
            n_keep=1,
            n_measures=1 + self.system.n_states,
            step_size=self.step[own],
            quantities=self.quantities,
            rtol=how["rtol"],
            atol=how["atol"],
            max_steps_per_period=int(how["max_steps_per_period"]),
            n_lanes=int(how["n_lanes"]),
        )
        for row, cell in enumerate(own):
            mine = self.lines[cell].first(end) - self.lines[cell].first(begin)
            status = cells.status[row, :mine]
            good = np.isin(status, GOOD)
            self.n_steps[cell] += cells.n_steps[row, :mine].sum()
            self.n_rejected[cell] += cells.n_rejected[row, :mine].sum()
            at = np.flatnonzero((ends[row, :mine] >= 0) & good)
            self.n_periods[cell] += len(at)
            at = at[ends[row, at] >= self.first_seen]
            self.seen[cell, ends[row, at] - self.first_seen] = cells.section[row, at, 0]
            if self.quantities:
                self._watch(cell, ends[row, :mine], 1.0 / frequency[row, :mine], cells.watched[row, :mine, 0], begin)
            self.turns[cell] += cells.turns[row] if begin > self.n_transient else 0
            if not good.all():
                self.status[cell] = status[good.argmin()]
            self.state[cell] = cells.final_state[row, min(mine - 1, int(np.append(good, False).argmin()))]
            self.step[cell] = cells.next_step[row, mine - 1]

    def _describe(self, cell: int, begin: int, points: np.ndarray, frequency: np.ndarray, ends: np.ndarray) -> None:
        """Fill in the parameters of a cell's intervals, their frequencies, and the sections at their ends, or -1."""
        line, hz, m = self.lines[cell], float(self.frequency_hz[cell]), len(self.system.parameter_names)
        first = line.first(begin)
        section, offset = line.times(np.arange(first, first + len(points) + 1))
        is_section = offset == 0.0
        begins = np.where(is_section, section / hz, section / hz + offset)
        whole = is_section[:-1] & is_section[1:]
        length = np.where(is_section[1:], 1.0 / hz, offset[1:]) - offset[:-1]
        frequency[:] = np.where(whole, hz, 1.0 / length)
        ends[:] = np.where(is_section[1:], section[1:] - 1, -1)
        points[:, :m] = self.parameters[cell, :m]
        points[:, m], points[:, m + 1] = hz, offset[:-1]
        column = m + 2
        for motion, place in zip(self.motions, self.drift.moving.parameters, strict=True):
            values = motion.at(cell, begins)
            points[:, place] = values[:-1]
            if motion.ramp.is_smooth:
                x = STEEPNESS * (2.0 * motion.share(cell, begins) - 1.0)
                low, high = motion.begin[cell], motion.end[cell]
                points[:, column], points[:, column + 1] = x[:-1], x[1:]
                points[:, column + 2] = 0.5 * (low + high)
                points[:, column + 3] = 0.5 * (high - low) / np.tanh(STEEPNESS)
                column += 4
                continue
            points[:, column], points[:, column + 1] = values[:-1], values[1:]
            column += 2

    def _watch(self, cell: int, ends: np.ndarray, lengths: np.ndarray, watched: np.ndarray, begin: int) -> None:
        """Join the extremes over the parts of each kept drive period."""
        first = 0
        for last in np.flatnonzero(ends >= 0):
            kept = ends[last] - self.n_transient
            part = slice(first, last + 1)
            if kept >= 0:
                weights = lengths[part] / lengths[part].sum()
                self.watched[cell, kept, :, 0] = watched[part, :, 0].min(axis=0)
                self.watched[cell, kept, :, 1] = watched[part, :, 1].max(axis=0)
                mean = watched[last, :, 2] if first == last else (weights[:, None] * watched[part, :, 2]).sum(axis=0)
                self.watched[cell, kept, :, 2] = mean
            first = int(last) + 1

    def outcome(self, closure_tolerance: float, max_orbit_period: int) -> Sections:
        """Return the results; what closes is judged by the sections after all ramps."""
        failed, total = self.status != Status.BOUNDED, self.n_transient + self.n_keep
        end_s = np.max([m.end_s for m in self.motions], axis=0)
        after = total - np.ceil(end_s * self.frequency_hz * (1.0 - 1e-12) - 1e-9).astype(np.int64)
        n_after = np.where(failed, 0, np.clip(after + 1, 0, min(total, self.window)))
        period = np.zeros(len(failed), np.int16)
        for n in np.unique(n_after[n_after > 0]):
            own = n_after == n
            judged = replace(self.system.plain, method="dopri5")
            period[own] = orbit_periods(
                self.seen[own, -n:],
                system=judged,
                closure_tolerance=closure_tolerance,
                max_orbit_period=max_orbit_period,
            )
        kept = self.seen[:, -self.n_keep :].copy()
        kept[failed], self.watched[failed], self.turns[failed] = np.nan, np.nan, 0
        status = np.where(period > 0, int(Status.PERIODIC), self.status)
        angles = [i for i, angle in enumerate(self.system.is_angle) if angle]
        return Sections(
            section=kept[:, None],
            turns=self.turns[:, None, angles].astype(np.int32),
            status=status[:, None].astype(np.int8),
            orbit_period=period[:, None],
            n_periods=self.n_periods[:, None].astype(np.int32),
            n_steps=self.n_steps[:, None].astype(np.int32),
            n_rejected=self.n_rejected[:, None].astype(np.int32),
            final_state=self.state[:, None],
            step_size=np.where(failed, np.nan, self.step)[:, None],
            extremes=self.watched[:, None] if self.quantities else None,
        )
