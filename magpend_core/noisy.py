"""Compute the section points of many trajectories with white noise, their first passages out of a region, and the error
of their steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core.engine.checks import check_system
from magpend_core.engine.entry import N_LANES
from magpend_core.engine.noise import Noise
from magpend_core.engine.noisy import NoisyCells, noisy_engine_of
from magpend_core.engine.observers import FIRST_TURN, RECORD, Settings
from magpend_core.engine.passage import PASSAGE, PassageSettings, Region
from magpend_core.engine.random_numbers import MAX_SEED, key_words
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_frequency, check_states

MOST_STEPS = 10_000_000
"""Most steps per period."""

LARGEST_COUNT = 2**51
"""Most steps of a cell in all: the counter of the random numbers has so many digits."""


@dataclass(frozen=True)
class NoisySections:
    """Section points of noisy trajectories, with status, turns and the error of the step size.

    Attributes
    ----------
    section : ndarray, (cell, n_keep, n_states)
        Kept states at the ends of consecutive periods, angles in (-pi, pi]; NaN for cells that failed.
    turns : ndarray of int32, (cell, n_angles)
        Full turns of each angle between the first and the last kept section.
    turns_since_start : ndarray of int32, (cell, n_angles)
        Full turns of each angle since the start.
    status : ndarray of int8, (cell,)
        ``BOUNDED`` or ``DIVERGED``, see `Status`.
    n_periods : ndarray of int32, (cell,)
        Periods integrated here.
    strong_error : ndarray, (cell,)
        Largest difference, in units of the states' scales, by which the end of the last period changes if its
        steps are halved on the same path of the noise; NaN for cells that failed.
    """

    section: np.ndarray
    turns: np.ndarray
    turns_since_start: np.ndarray
    status: np.ndarray
    n_periods: np.ndarray
    strong_error: np.ndarray


def cell_words(parameters: np.ndarray, frequency_hz: np.ndarray, initial_states: np.ndarray) -> np.ndarray:
    """Return two words that identify each cell by all bits of its inputs, shape (cell, 2); see `engine.words`.

    Cells that differ in any bit have different words, but for one in 2**64 pairs: so adding cells to a run leaves
    the noise of the others as it is.
    """
    rows = [parameters, np.reshape(frequency_hz, (-1, 1)), initial_states]
    columns = np.concatenate([np.ascontiguousarray(row, np.float64) for row in rows], axis=1).view(np.uint64)
    mark = np.zeros(len(columns), np.uint64)
    for column in columns.T:
        # the finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) after each column
        mark = mark * np.uint64(0x9E3779B97F4A7C15) + column
        mark = (mark ^ (mark >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mark = (mark ^ (mark >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mark = mark ^ (mark >> np.uint64(31))
    halves = np.stack([mark & np.uint64(0xFFFFFFFF), mark >> np.uint64(32)], axis=1)
    return np.ascontiguousarray(halves).view(np.float64)


def noisy_sections(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    initial_states: np.ndarray,
    *,
    system: System,
    noise: Noise,
    seed: int,
    steps_per_period: np.ndarray | int,
    n_transient: int,
    n_keep: int,
    first_period: np.ndarray | int = 0,
    words: np.ndarray | None = None,
    checks_step: bool = True,
    n_lanes: int = N_LANES,
) -> NoisySections:
    """Integrate cells with white noise over drive periods, and return their section points.

    A cell's numbers depend on its own inputs and the seed alone, to the last bit: not on its neighbours,
    `n_lanes` or the CPU. See `engine.noisy` for the method and its order.

    Parameters
    ----------
    parameters
        Packed parameters of each cell, shape (cell, len(system.parameter_names)) [SI].
    frequency_hz
        Drive frequency, shape (cell,) [Hz]; for a system without forcing one over the time between sections.
    initial_states
        Shape (cell, n_states), at the instant t = 0 of the drive.
    system, noise
        What is integrated: a system that `engine.noise.with_strengths` has made of this noise.
    seed
        From 0 to 2**64 - 1.
    steps_per_period
        Steps that divide a period, one number or shape (cell,).
    n_transient, n_keep
        Periods before sections are kept, and sections kept.
    first_period
        Periods that the cells have behind them, one number or shape (cell,). With this, the last section as
        `initial_states` and the `words` of the first call, cells go on bit for bit.
    words
        What identifies the cells to the noise; by default `cell_words` of the inputs.
    checks_step
        Whether `strong_error` is computed, at the cost of two periods.
    n_lanes
        Trajectories in flight.

    Returns
    -------
    NoisySections

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds.
    """
    settings = _settings(n_transient, n_keep)
    given = parameters, frequency_hz, initial_states, words, first_period, steps_per_period
    cells = _checked(system, *given, settings.n_transient + settings.n_keep, settings.n_keep)
    n_cells = len(cells.frequency)
    engine, keys = noisy_engine_of(system, noise, RECORD), _keys(seed)
    if n_cells:
        engine(cells, check_count("n_lanes", n_lanes, 1), keys, settings, False)
    angles = [i for i, is_angle in enumerate(system.is_angle) if is_angle]
    is_kept = cells.status == Status.BOUNDED
    counted = np.where(is_kept[:, None], cells.measures[:, FIRST_TURN:], 0.0).astype(np.int32)
    error = np.full(n_cells, np.nan)
    if checks_step and is_kept.any():
        error[is_kept] = _halved_error(system, engine, cells, np.flatnonzero(is_kept), keys)
    return NoisySections(
        section=cells.section,
        turns=counted[:, angles],
        turns_since_start=cells.turns[:, angles].astype(np.int32),
        status=cells.status.astype(np.int8),
        n_periods=cells.n_periods.astype(np.int32),
        strong_error=error,
    )


@dataclass(frozen=True)
class Passages:
    """First passages of noisy trajectories out of a region.

    Attributes
    ----------
    steps : ndarray, (cell,)
        Number of the step, from 1, in which a trajectory leaves; with halved steps a multiple of 1/2. Infinite for
        one that stays, or diverges in a step that cannot be told.
    place : ndarray, (cell, n_states)
        State at the end of that step; NaN for a trajectory that stays.
    status : ndarray of int8, (cell,)
        ``BOUNDED`` or ``DIVERGED``, see `Status`.
    n_periods : ndarray of int32, (cell,)
        Periods integrated here.
    """

    steps: np.ndarray
    place: np.ndarray
    status: np.ndarray
    n_periods: np.ndarray


def first_passages(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    states: np.ndarray,
    region: Region,
    *,
    system: System,
    noise: Noise,
    seed: int,
    steps_per_period: np.ndarray | int,
    n_periods: int,
    first_period: np.ndarray | int,
    words: np.ndarray,
    halves: bool = False,
) -> Passages:
    """Integrate cells as `noisy_sections` does, on the same path of the noise, until they leave a region.

    Passage is tested in every step, also between the step's ends, see `engine.passage`: the mean time to it has an
    error of the order of the step.

    Parameters
    ----------
    parameters, frequency_hz, system, noise, seed, steps_per_period, first_period, words
        See `noisy_sections`.
    states
        Shape (cell, n_states): inside the region, at the end of period `first_period`.
    region
        With an entry for each cell.
    n_periods
        Most periods of a cell.
    halves
        Whether each step is made as two of half its length, on the same path of the noise: what the times change by
        tells their error.
    """
    settings = PassageSettings(check_count("n_periods", n_periods, 1))
    given = parameters, frequency_hz, states, words, first_period, steps_per_period
    cells = _checked(system, *given, settings.n_periods, 0)
    cells = cells._replace(region=Region(*(np.require(part, np.float64, ["C", "W"]) for part in region)))
    if len(cells.frequency):
        noisy_engine_of(system, noise, PASSAGE)(cells, N_LANES, _keys(seed), settings, halves)
    return Passages(
        steps=cells.measures[:, 0] - cells.first_period * cells.n_steps,
        place=cells.measures[:, 1:].copy(),
        status=cells.status.astype(np.int8),
        n_periods=cells.n_periods.astype(np.int32),
    )


def _keys(seed: int) -> np.ndarray:
    seed = check_count("seed", seed, 0)
    if seed > MAX_SEED:
        raise ValueError(f"seed = {seed} is out of bounds: it must be at most {MAX_SEED}.")
    return key_words(seed)


def _checked(
    system: System,
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    states: np.ndarray,
    words: np.ndarray | None,
    first_period: np.ndarray | int,
    steps_per_period: np.ndarray | int,
    n_periods: int,
    n_keep: int,
) -> NoisyCells:
    """Check the arguments of a computation, and return the engine's arrays."""
    frequency = check_frequency(frequency_hz, 1)
    n_cells = len(frequency)
    packed = check_array("parameters", parameters, 2)
    initial = check_states(states, 2, system.n_states, "initial_states")
    if packed.shape != (n_cells, len(system.parameter_names)) or len(initial) != n_cells:
        raise ValueError(
            f"parameters has shape {packed.shape} and initial_states {initial.shape}; {n_cells} frequencies and "
            f"{system.name} ask for {(n_cells, len(system.parameter_names))} and {(n_cells, system.n_states)}."
        )
    steps = np.broadcast_to(np.asarray(steps_per_period, np.int64), (n_cells,)).copy()
    first = np.broadcast_to(np.asarray(first_period, np.int64), (n_cells,)).copy()
    if n_cells and not (steps.min() >= 1 and steps.max() <= MOST_STEPS):
        raise ValueError(f"steps_per_period must be from 1 to {MOST_STEPS}.")
    if n_cells and int((first + n_periods).max()) * int(steps.max()) >= LARGEST_COUNT:
        raise ValueError(f"cells of more than {LARGEST_COUNT} steps in all are too long; take fewer.")
    check_system(system, packed[:, None], frequency[:, None], initial)
    own = cell_words(packed, frequency, initial) if words is None else np.asarray(words, np.float64)
    return _cells(system, frequency, packed, initial, own, first, steps, n_keep)


def _settings(n_transient: int, n_keep: int) -> Settings:
    # a window of no sections: nothing closes on them
    return Settings(check_count("n_transient", n_transient, 0), check_count("n_keep", n_keep, 1), 0, 0.0, 1)


def _cells(
    system: System,
    frequency: np.ndarray,
    packed: np.ndarray,
    initial: np.ndarray,
    words: np.ndarray,
    first: np.ndarray,
    steps: np.ndarray,
    n_keep: int,
) -> NoisyCells:
    """Return the engine's input arrays with empty output arrays beside them."""
    n = len(frequency)

    def own(array: np.ndarray) -> np.ndarray:
        # memory that may not be written to is a type of its own to numba, and would compile the engine once more
        return np.require(array, requirements=["C", "W"])

    return NoisyCells(
        frequency=own(frequency),
        parameters=own(packed),
        initial=own(initial),
        words=own(words),
        first_period=own(first),
        n_steps=own(steps),
        section=np.full((n, n_keep, system.n_states), np.nan),
        measures=np.zeros((n, FIRST_TURN + system.n_states)),
        turns=np.zeros((n, system.n_states), np.int64),
        before=np.zeros((n, system.n_states)),
        status=np.zeros(n, np.int64),
        n_periods=np.zeros(n, np.int64),
        region=Region(*(np.zeros((0, 0)) for _ in Region._fields)),
    )


def _halved_error(system: System, engine: Any, cells: NoisyCells, rows: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Repeat the last period of some cells with halved steps on the same path; return how far its ends differ."""
    first = cells.first_period[rows] + cells.n_periods[rows] - 1
    inputs = (cells.frequency[rows], cells.parameters[rows], cells.before[rows], cells.words[rows], first)
    halved = _cells(system, *inputs, cells.n_steps[rows], 1)
    engine(halved, N_LANES, keys, _settings(0, 1), True)
    distance = np.abs(halved.section[:, 0] - cells.section[rows, -1])
    circle = np.array(system.is_angle)
    distance = np.where(circle, np.minimum(distance, np.abs(TWO_PI - distance)), distance)
    return np.asarray((distance / np.array(system.units)).max(axis=1))
