"""Integrate trajectories at a parameter point a few periods at a time, with the same bits as the cells of a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from magpend_core.engine.observers import window_of
from magpend_core.engine.system import System
from magpend_core.extension import more_sections, orbit_periods
from magpend_core.models.model import Model, Parameters
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.tolerances import EXTEND_CLOSURE, EXTEND_RTOL
from pipeline.explorer import RequestError
from pipeline.specification.tables import Integration

MOST_STEPS = 200_000
"""Attempted steps of a period beyond which a live trajectory is given up, if the run goes on longer."""

CALL_S, FIRST_CALL = 0.08, 4
"""Time that a call of the kernel is to take [s], and periods of the first: between calls one can cancel."""

MOST_KEPT, MOST_KEPT_OF_SLICE, MOST_TRANSIENT = 100_000, 512, 4096
"""Most sections that a live start keeps, and each cell of a slice; most periods before these."""

LEG = 32
"""Periods between two looks at the cells of a slice."""


class Ends(Protocol):
    """The methods of a catalog of attractors that an integration needs; see
    `pipeline.explorer.live.catalog.Catalog`.
    """

    model: Model

    def on_orbits(self, block: Block) -> np.ndarray:
        """Return the catalog number of the periodic orbit that each cell has reached; -1 for none."""

    def unsure(self, block: Block, numbers: np.ndarray) -> np.ndarray:
        """Return the undecided cells that are worth integrating further."""

    def conclude(self, block: Block, *, final: bool = True, strictly: bool = False) -> np.ndarray:
        """Return the catalog number of the attractor on which each cell ends."""


class CancelledError(Exception):
    """Raised inside a job that has been cancelled."""


Check = Callable[[], None]
"""Raises `CancelledError` if the job is to end."""


@dataclass(frozen=True, eq=False)
class Place:
    """A parameter point: parameters, frequency and, if it is a point of the run, its index there.

    Attributes
    ----------
    frequency : float
        As the engine takes it [Hz]: of the drive; of a flow seen at crossings one over the longest wait.
    index : tuple of int or None
        Index on each axis of the cube's parameters; None where the cube has no such point.
    """

    parameters: Parameters
    frequency: float
    index: tuple[int, ...] | None

    @property
    def key(self) -> tuple[float, ...]:
        """Frequency and parameter values, as a key for dictionaries."""
        return (self.frequency, *self.parameters.values())


def system_at(place: Place, integration: Integration) -> System:
    """Return the system at a parameter point, with the integration method of the run."""
    return replace(place.parameters.model.system, method=integration.method)


class Flight:
    """Trajectories at one parameter point that are integrated a few periods at a time.

    Parameters
    ----------
    place
        Where.
    integration
        The run's settings.
    starts
        Initial states, shape (n, n_states).
    check
        Asked before every call of the kernel.

    Attributes
    ----------
    status : ndarray of int8, (n,)
        ``BOUNDED`` for those that go on, else what ended them.
    state : ndarray, (n, n_states)
        Current state of each trajectory.
    """

    def __init__(self, place: Place, integration: Integration, starts: np.ndarray, check: Check) -> None:
        self._place, self._system, self._check = place, system_at(place, integration), check
        self._packed = place.parameters.pack()
        self.state = np.array(starts, np.float64)
        self._step = np.zeros(len(starts))
        self.status = np.full(len(starts), int(Status.BOUNDED), np.int8)
        self._options: dict[str, Any] = {
            "rtol": integration.rtol,
            "atol": integration.atol,
            "system": self._system,
            "max_steps_per_period": min(integration.max_steps_per_period, MOST_STEPS),
        }
        self._seconds = 0.0

    def advance(self, rows: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Integrate the trajectories `rows` over `n` periods, in short calls so that the job can be cancelled in
        between.

        Returns
        -------
        section : ndarray, (row, n, state)
            NaN from where a cell ended.
        turns : ndarray, (row, angle)
            Full turns since the section before.
        """
        section = np.full((len(rows), n, self.state.shape[1]), np.nan)
        turns = np.zeros((len(rows), sum(self._system.is_angle)), np.int64)
        done = 0
        while done < n:
            going = np.flatnonzero(self.status[rows] == Status.BOUNDED)
            if not len(going):
                break
            self._check()
            most = FIRST_CALL if not self._seconds else max(1, int(CALL_S / (self._seconds * len(going))))
            k = min(n - done, most)
            started = time.perf_counter()
            section[going, done : done + k], more = self._call(rows[going], k)
            self._seconds = max((time.perf_counter() - started) / (k * len(going)), 1e-9)
            turns[going] += more
            done += k
        return section, turns

    def _call(self, rows: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        m = len(rows)
        packed = np.tile(self._packed, (m, 1, 1))
        frequency = np.full((m, 1), self._place.frequency)
        found = more_sections(packed, frequency, self.state[rows], self._step[rows], n_more=n, **self._options)
        self.status[rows], self.state[rows] = found.status[:, 0], found.final_state[:, 0]
        self._step[rows] = np.nan_to_num(found.step_size[:, 0])
        return found.section[:, 0], found.turns[:, 0]

    def closed(self, section: np.ndarray, integration: Integration) -> np.ndarray:
        """Return the orbit period of each trajectory, from its last section points; 0 if it has not closed on an
        orbit.
        """
        return orbit_periods(
            section,
            closure_tolerance=integration.closure_tolerance,
            max_orbit_period=integration.max_orbit_period,
            system=self._system,
        )

    def block(self, rows: np.ndarray, section: np.ndarray, turns: np.ndarray, period: np.ndarray) -> Block:
        """Return trajectories as a `Block` for the analyses, with the status that cells of a run would have."""
        status = self.status[rows].copy()
        kept = status == Status.BOUNDED
        status[kept & (period > 0)] = Status.PERIODIC
        section = np.where(kept[:, None, None], section, np.nan)
        rest = np.where((status == Status.NO_RETURN)[:, None], self.state[rows], np.nan)
        own = np.where(kept, period, 0).astype(np.int16)
        return Block(slice(0, len(rows)), section, status, own, np.where(kept[:, None], turns, 0), rest)


Tell = Callable[[np.ndarray, int], None]
"""Is given new sections (k, n_states), and the number of periods done."""


def run_start(flight: Flight, integration: Integration, tell: Tell, periods: int | None = None) -> Block:
    """Integrate one initial state like a cell of the run, and report its section points as they are computed.

    Parameters
    ----------
    flight
        Integration of one cell.
    integration
        The run's settings.
    tell
        See `Tell`.
    periods
        Periods in all, if not those of the run.
    """
    n_keep = integration.n_keep if periods is None else min(integration.n_keep, periods)
    n_transient = integration.n_transient if periods is None else periods - n_keep
    if n_keep > MOST_KEPT:
        raise RequestError(
            f"the run keeps {n_keep} sections of each cell, and a live start at most {MOST_KEPT}; give periods."
        )
    only, early = np.array([0]), integration.stop_when_closed
    window = window_of(integration.max_orbit_period)
    last = flight.state[:, None][:, :0]
    done, period, leg = 0, 0, window // 4 if early else 2
    while done < n_transient and not period and flight.status[0] == Status.BOUNDED:
        n = min(leg - done % leg if early else leg, n_transient - done)
        section, _ = flight.advance(only, n)
        done += n
        last = np.concatenate([last, section], axis=1)[:, -window:]
        tell(section[0], done)
        if early and done >= window and done % leg == 0 and flight.status[0] == Status.BOUNDED:
            period = int(flight.closed(last, integration)[0])
        leg = leg if early else min(2 * leg, 64)
    kept, turns, left = last[:, :0], np.zeros((1, 0), np.int64), n_keep
    while left:
        n = min(64, left) if kept.shape[1] else 1
        section, more = flight.advance(only, n)
        # turns count from the first section that is kept
        turns = turns + more if kept.shape[1] else np.zeros_like(more)
        kept, done, left = np.concatenate([kept, section], axis=1), done + n, left - n
        tell(section[0], done)
    if not period and flight.status[0] == Status.BOUNDED:
        period = int(flight.closed(np.concatenate([last, kept], axis=1)[:, -window:], integration)[0])
    return flight.block(only, kept, turns, np.array([period]))


def taken(block: Block, rows: np.ndarray) -> Block:
    """Select the cells at the indices `rows` of a block."""
    rest = None if block.rest is None else block.rest[rows]
    return Block(
        slice(0, len(rows)), block.section[rows], block.status[rows], block.orbit_period[rows], block.turns[rows], rest
    )


RUN_ON_LEGS = 32
"""How long cells that come back near are run on, in legs of `RUN_ON_LEG` periods."""

RUN_ON_LEG = 64
"""Periods between two looks at cells that are run on."""


def run_on(
    place: Place,
    integration: Integration,
    ends: Ends,
    block: Block,
    states: np.ndarray,
    check: Check,
    tell: Tell | None = None,
) -> np.ndarray:
    """Integrate undecided cells further until they reach a known orbit; return catalog numbers, -1 if they reach none.

    As long, and as exactly, as the analysis of attractors runs its spirals on.

    Parameters
    ----------
    place, integration
        Where, and the run's settings.
    ends
        Catalog of the attractors at the parameter point.
    block
        The undecided cells.
    states
        Their last sections.
    check, tell
        See `Flight` and `Tell`; sections of the first cell are told.
    """
    settings = integration.model_copy(
        update={"rtol": EXTEND_RTOL, "atol": EXTEND_RTOL, "closure_tolerance": EXTEND_CLOSURE}
    )
    flight = Flight(place, settings, states, check)
    numbers = np.full(len(states), -1, np.int64)
    rows, last = np.arange(len(states)), block.section[:, :0]
    window = window_of(settings.max_orbit_period)
    for leg in range(RUN_ON_LEGS):
        section, _ = flight.advance(rows, RUN_ON_LEG)
        last = np.concatenate([last, section], axis=1)[:, -window:]
        if tell is not None and len(rows) and rows[0] == 0:
            tell(section[0], (leg + 1) * RUN_ON_LEG)
        numbers[rows] = _look(flight, rows, last, settings, ends, strictly=True)
        going = (numbers[rows] < 0) & (flight.status[rows] == Status.BOUNDED)
        rows, last = rows[going], last[going]
        if not len(rows):
            break
    return numbers


def _look(
    flight: Flight, rows: np.ndarray, last: np.ndarray, integration: Integration, ends: Ends, *, strictly: bool = False
) -> np.ndarray:
    """Return the catalog number of the orbit that each trajectory has reached; -1 if it is not decided yet."""
    no_turns = np.zeros((len(rows), sum(ends.model.is_angle)), np.int64)
    period = np.zeros(len(rows), np.int16)
    alive = flight.status[rows] == Status.BOUNDED
    period[alive] = flight.closed(last[alive], integration)
    block = flight.block(rows, last, no_turns, period)
    if ends.model.autonomous:  # an equilibrium is told at the end alone
        return ends.on_orbits(block)
    return ends.conclude(block, final=False, strictly=strictly)


def settle_cells(place: Place, integration: Integration, ends: Ends, starts: np.ndarray, check: Check) -> np.ndarray:
    """Return the catalog number of the attractor (or class of cells) that each initial state reaches.

    A cell is given up as soon as it is on an orbit that is known, or certain to end there; the others go on
    for as long as the run's own cells, and then on as the analysis of attractors runs them on.

    Parameters
    ----------
    place, integration
        Where, and the run's settings.
    ends
        Catalog of the attractors at the parameter point; new ones are added.
    starts
        Initial states, shape (n, n_states).
    check
        See `Flight`.
    """
    flight = Flight(place, integration, starts, check)
    numbers = np.full(len(starts), -1, np.int64)
    rows, last = np.arange(len(starts)), np.zeros((len(starts), 0, starts.shape[1]))
    window, done = window_of(integration.max_orbit_period), 0
    n_transient = min(integration.n_transient, MOST_TRANSIENT)
    while done < n_transient and len(rows):
        n = min(LEG, n_transient - done)
        section, _ = flight.advance(rows, n)
        last, done = np.concatenate([last, section], axis=1)[:, -window:], done + n
        numbers[rows] = _look(flight, rows, last, integration, ends)
        going = (numbers[rows] < 0) & (flight.status[rows] == Status.BOUNDED)
        rows, last = rows[going], last[going]
    kept = min(integration.n_keep, MOST_KEPT_OF_SLICE)
    first, _ = flight.advance(rows, 1)
    section, turns = flight.advance(rows, kept - 1)
    section = np.concatenate([first, section], axis=1)
    ring = np.concatenate([last, section], axis=1)[:, -window:]
    blank = np.full((len(starts), kept, starts.shape[1]), np.nan)
    all_turns = np.zeros((len(starts), turns.shape[1]), np.int64)
    period = np.zeros(len(starts), np.int16)
    blank[rows], all_turns[rows] = section, turns
    alive = rows[flight.status[rows] == Status.BOUNDED]
    if len(alive):
        period[alive] = flight.closed(ring[flight.status[rows] == Status.BOUNDED], integration)
    rest = np.flatnonzero(numbers < 0)
    block = flight.block(rest, blank[rest], all_turns[rest], period[rest])
    numbers[rest] = conclude(place, integration, ends, block, flight.state[rest], check)
    return numbers


def conclude(
    place: Place,
    integration: Integration,
    ends: Ends,
    block: Block,
    states: np.ndarray,
    check: Check,
    tell: Tell | None = None,
) -> np.ndarray:
    """Return the catalog number for each cell; undecided cells that may reach an orbit are integrated further first."""
    numbers = ends.conclude(block, final=False)
    unsure = np.flatnonzero(ends.unsure(block, numbers))
    if len(unsure):
        numbers[unsure] = run_on(place, integration, ends, taken(block, unsure), states[unsure], check, tell)
    left = np.flatnonzero(numbers < 0)
    if len(left):
        numbers[left] = ends.conclude(taken(block, left))
    return numbers
