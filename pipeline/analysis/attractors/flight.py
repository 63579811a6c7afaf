"""Integrate trajectories a few sections at a time, as the run integrates its cells."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from magpend_core.engine.system import System
from magpend_core.extension import more_sections, orbit_periods
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.cell_blocks import Block


class Flight:
    """Trajectories that advance by some sections at a time, with the bits of one integration.

    Parameters
    ----------
    system
        System to integrate.
    packed, frequency
        Packed parameters and frequency [Hz] of each trajectory, or of all: shapes (n, parameter) and (n,), or
        (parameter,) and a number.
    states, step
        Initial states (n, state), and the step sizes (n,) [s] that continue earlier trajectories; with 0 the engine
        chooses.
    rtol, atol, max_steps
        Tolerances, and most attempted steps per period.
    closure, longest
        Closure tolerance, and the longest orbit period that is looked for.
    most
        Number of last sections that are remembered.

    Attributes
    ----------
    start, state, step, status : ndarray, (n, state), (n, state), (n,), (n,)
        Initial state of each trajectory, its state and its step size now; ``BOUNDED`` for those that go on, else
        what ended them.
    rows : ndarray of int
        Numbers of the trajectories that are integrated; see `keep`.
    section, seconds : ndarray, (row, k, state), (row, k)
        Last sections of these, and the time from the previous section to each [s].
    """

    def __init__(
        self,
        system: System,
        packed: np.ndarray,
        frequency: np.ndarray | float,
        states: np.ndarray,
        *,
        rtol: float,
        atol: float,
        max_steps: int,
        closure: float,
        longest: int,
        most: int,
        step: np.ndarray | None = None,
    ) -> None:
        n = len(states)
        self._packed = np.broadcast_to(packed, (n, packed.shape[-1]))
        self._frequency = np.broadcast_to(frequency, (n,))
        self._options = {"rtol": rtol, "atol": atol, "max_steps_per_period": max_steps}
        self._system, self._closure, self._longest, self._most = system, closure, longest, most
        self.start, self.state = states, np.array(states, np.float64)
        self.step = np.zeros(n) if step is None else np.array(step)
        self.status = np.full(n, int(Status.BOUNDED), np.int8)
        self.rows = np.arange(n)
        self.section = np.zeros((n, 0, self.state.shape[1]))
        self.seconds = np.zeros((n, 0))

    @property
    def flying(self) -> np.ndarray:
        """Whether each of the trajectories `rows` goes on."""
        return np.asarray(self.status[self.rows] == Status.BOUNDED)

    def keep(self, which: np.ndarray) -> None:
        """Integrate only some of the trajectories `rows` further."""
        self.rows, self.section, self.seconds = self.rows[which], self.section[which], self.seconds[which]

    def advance(self, n: int) -> Block:
        """Integrate the trajectories `rows` over `n` sections; return these sections."""
        section, turns, seconds = self._integrated(n)
        return self.block(section, turns, self.closed(section), seconds)

    def legs(self, n: int, length: int) -> Block:
        """Integrate the trajectories `rows` over `n` legs of `length` sections. Return a block with a row for each leg
        of each trajectory, without turns.
        """
        section, _, seconds = self._integrated(n * length)
        section = section.reshape(-1, length, section.shape[2])
        whole = np.isfinite(section).all(axis=(1, 2))
        period = np.zeros(len(section), np.int16)
        period[whole] = self._periods(section[whole])
        status, state, step = (np.repeat(each[self.rows], n, axis=0) for each in (self.status, self.state, self.step))
        status[whole] = np.where(period[whole] > 0, int(Status.PERIODIC), int(Status.BOUNDED))
        return Block(
            slice(0, len(section)),
            np.where(whole[:, None, None], section, np.nan),
            status,
            period,
            np.zeros((len(section), sum(self._system.is_angle)), np.int64),
            np.where((status == Status.NO_RETURN)[:, None], state, np.nan),
            seconds.reshape(-1, length),
            step,
        )

    def _integrated(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Integrate the trajectories `rows` over `n` sections; return these, the turns over them, and their times."""
        section = np.full((len(self.rows), n, self.state.shape[1]), np.nan)
        seconds = np.repeat(1.0 / self._frequency[self.rows, None], n, axis=1)
        turns = np.zeros((len(self.rows), sum(self._system.is_angle)), np.int64)
        done = 0
        for k in self._calls(n):
            going = np.flatnonzero(self.flying)
            if not len(going):
                break
            rows, new = self.rows[going], slice(done, done + k)
            found = more_sections(
                self._packed[rows, None],
                self._frequency[rows, None],
                self.state[rows],
                self.step[rows],
                n_more=k,
                system=self._system,
                **self._options,  # type: ignore[arg-type]
            )
            section[going, new] = found.section[:, 0]
            turns[going] += found.turns[:, 0]
            if found.return_time is not None:
                seconds[going, new] = found.return_time[:, 0]
            self.status[rows], self.state[rows] = found.status[:, 0], found.final_state[:, 0]
            self.step[rows] = np.nan_to_num(found.step_size[:, 0])
            done += k
        self.section = np.concatenate([self.section, section], axis=1)[:, -self._most :]
        self.seconds = np.concatenate([self.seconds, seconds], axis=1)[:, -self._most :]
        return section, turns, seconds

    def _calls(self, n: int) -> Iterator[int]:
        """Yield the sections of each call of the engine, `n` in all."""
        yield n

    def closed(self, section: np.ndarray) -> np.ndarray:
        """Return the orbit period of each of the trajectories `rows` from their last sections; 0 if it has not closed
        on an orbit.
        """
        found, flying = np.zeros(len(self.rows), np.int16), self.flying
        if flying.any():
            found[flying] = self._periods(section[flying])
        return found

    def _periods(self, section: np.ndarray) -> np.ndarray:
        return orbit_periods(
            section, closure_tolerance=self._closure, max_orbit_period=self._longest, system=self._system
        )

    def block(
        self, section: np.ndarray, turns: np.ndarray, period: np.ndarray, seconds: np.ndarray | None = None
    ) -> Block:
        """Return sections of the trajectories `rows` as a block, with the status that cells of a run would have.

        Parameters
        ----------
        section, turns, period, seconds
            Sections, full turns over them, orbit periods, and times between the sections [s].
        """
        kept, status = self.flying, self.status[self.rows]
        return Block(
            slice(0, len(kept)),
            np.where(kept[:, None, None], section, np.nan),
            np.where(kept & (period > 0), np.int8(Status.PERIODIC), status),
            np.where(kept, period, 0).astype(np.int16),
            np.where(kept[:, None], turns, 0),
            np.where((status == Status.NO_RETURN)[:, None], self.state[self.rows], np.nan),
            seconds,
            self.step[self.rows],
        )
