"""Integrate trajectories at a parameter point a few periods at a time, with the same bits as the cells of a run."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from magpend_core.engine.observers import window_of
from magpend_core.engine.system import System
from magpend_core.models.model import Model, Parameters
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.flight import Flight
from pipeline.explorer import RequestError
from pipeline.results.tolerances import EXTEND_CLOSURE, EXTEND_RTOL
from pipeline.specification.tables import Integration


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
    """A parameter point: parameters, frequency and, if it is a point of the run, its index there."""

    parameters: Parameters
    frequency: float  # as the engine takes it [Hz]: of the drive; of a flow seen at crossings one over the longest wait
    index: tuple[int, ...] | None  # index on each axis of the cube's parameters; None where the cube has no such point

    @property
    def key(self) -> tuple[float, ...]:
        """Frequency and parameter values, as a key for dictionaries."""
        return (self.frequency, *self.parameters.values())


def system_at(place: Place, integration: Integration) -> System:
    """Return the system at a parameter point, with the integration method of the run."""
    return replace(place.parameters.model.system, method=integration.method)


class LiveFlight(Flight):
    """Trajectories of a live job, which are integrated in short calls so that the job can be cancelled in between.

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
    """

    def __init__(self, place: Place, integration: Integration, starts: np.ndarray, check: Check) -> None:
        super().__init__(
            system_at(place, integration),
            place.parameters.pack(),
            place.frequency,
            starts,
            rtol=integration.rtol,
            atol=integration.atol,
            max_steps=min(
                integration.max_steps_per_period, 200_000
            ),  # more attempts for a period give a live trajectory up
            closure=integration.closure_tolerance,
            longest=integration.max_orbit_period,
            most=window_of(integration.max_orbit_period),
        )
        self._check, self._call_s = check, 0.0

    def _calls(self, n: int) -> Iterator[int]:
        # time that a call of the kernel is to take [s], and periods of the first: between calls one can cancel
        call_s, first = 0.08, 4
        done = 0
        while done < n:
            self._check()
            going = self.flying.sum()
            most = first if not self._call_s else max(1, int(call_s / (self._call_s * max(going, 1))))
            k, started = min(n - done, most), time.perf_counter()
            yield k
            self._call_s = max((time.perf_counter() - started) / (k * going), 1e-9)
            done += k

    def look(self, ends: Ends, *, strictly: bool = False) -> np.ndarray:
        """Return the catalog number of the orbit that each trajectory has reached; -1 if it is not decided yet."""
        no_turns = np.zeros((len(self.rows), sum(ends.model.is_angle)), np.int64)
        block = self.block(self.section, no_turns, self.closed(self.section))
        if ends.model.clock.has_equilibria:  # an equilibrium is told at the end alone
            return ends.on_orbits(block)
        return ends.conclude(block, final=False, strictly=strictly)


Tell = Callable[[np.ndarray, int], None]
"""Is given new sections (k, n_states), and the number of periods done."""


def run_start(flight: LiveFlight, integration: Integration, tell: Tell, periods: int | None = None) -> Block:
    """Integrate one initial state like a cell of the run, and report its section points as they are computed.

    Parameters
    ----------
    flight
        Trajectory of one cell.
    integration
        The run's settings.
    tell
        See `Tell`.
    periods
        Periods in all, if not those of the run.
    """
    most = 100_000  # sections that a live start keeps
    n_keep = integration.n_keep if periods is None else min(integration.n_keep, periods)
    n_transient = integration.n_transient if periods is None else periods - n_keep
    if n_keep > most:
        raise RequestError(
            f"the run keeps {n_keep} sections of each cell, and a live start at most {most}; give periods."
        )
    early, window = integration.stop_when_closed, window_of(integration.max_orbit_period)
    done, leg, period = 0, window // 4 if early else 2, np.zeros(1, np.int16)
    while done < n_transient and not period[0] and flight.flying[0]:
        n = min(leg - done % leg if early else leg, n_transient - done)
        section = flight.advance(n).section
        done += n
        tell(section[0], done)
        if early and done >= window and done % leg == 0 and flight.flying[0]:
            period = flight.closed(flight.section)
        leg = leg if early else min(2 * leg, 64)
    kept, turns, left = flight.section[:, :0], np.zeros((1, 0), np.int64), n_keep
    while left:
        n = min(64, left) if kept.shape[1] else 1
        new = flight.advance(n)
        # turns count from the first section that is kept
        turns = turns + new.turns if kept.shape[1] else np.zeros_like(new.turns)
        kept, done, left = np.concatenate([kept, new.section], axis=1), done + n, left - n
        tell(new.section[0], done)
    return flight.block(kept, turns, period if period[0] else flight.closed(flight.section))


def run_on(
    place: Place, integration: Integration, ends: Ends, states: np.ndarray, check: Check, tell: Tell | None = None
) -> np.ndarray:
    """Integrate undecided cells further until they reach a known orbit; return catalog numbers, -1 if they reach none.

    As long, and as exactly, as the analysis of attractors runs its spirals on.

    Parameters
    ----------
    place, integration
        Where, and the run's settings.
    ends
        Catalog of the attractors at the parameter point.
    states
        Their last sections.
    check, tell
        See `LiveFlight` and `Tell`; sections of the first cell are told.
    """
    n_legs, n_periods = 32, 64  # how long cells that come back near are run on, and periods between two looks at them
    settings = integration.model_copy(
        update={"rtol": EXTEND_RTOL, "atol": EXTEND_RTOL, "closure_tolerance": EXTEND_CLOSURE}
    )
    flight = LiveFlight(place, settings, states, check)
    numbers = np.full(len(states), -1, np.int64)
    for leg in range(n_legs):
        section = flight.advance(n_periods).section
        if tell is not None and flight.rows[0] == 0:
            tell(section[0], (leg + 1) * n_periods)
        numbers[flight.rows] = flight.look(ends, strictly=True)
        flight.keep((numbers[flight.rows] < 0) & flight.flying)
        if not len(flight.rows):
            break
    return numbers


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
        See `LiveFlight`.
    """
    leg = 32  # periods between two looks at the cells
    most_kept, most_before = 512, 4096  # most sections that each cell keeps, and most periods before these
    flight = LiveFlight(place, integration, starts, check)
    numbers = np.full(len(starts), -1, np.int64)
    done, n_transient = 0, min(integration.n_transient, most_before)
    while done < n_transient and flight.flying.any():
        n = min(leg, n_transient - done)
        flight.advance(n)
        done += n
        numbers[flight.rows] = flight.look(ends)
        flight.keep(numbers[flight.rows] < 0)
    first, rest = flight.advance(1), flight.advance(min(integration.n_keep, most_kept) - 1)
    section = np.concatenate([first.section, rest.section], axis=1)
    block = flight.block(section, rest.turns, flight.closed(flight.section))
    numbers[flight.rows] = conclude(place, integration, ends, block, flight.state[flight.rows], check)
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
        numbers[unsure] = run_on(place, integration, ends, states[unsure], check, tell)
    left = np.flatnonzero(numbers < 0)
    if len(left):
        numbers[left] = ends.conclude(block.take(left))
    return numbers
