"""Compute rotation numbers of many trajectories of driven systems: mean turns per drive period.

The turns of a trajectory in each drive period come from its dense output. Their mean is a weighted Birkhoff
average, whose error on a quasi-periodic orbit falls faster than any power of the number of periods (Das, Saiki,
Sander and Yorke, Nonlinearity 30, 2017, 4111). On a closed orbit the sum is a whole number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core.defaults import ATOL, RTOL
from magpend_core.engine.system import System
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_frequency, check_states

MOST_NUMBERS = 2**22
"""Numbers that the sampled states in one call of the engine may have."""

SAMPLES, FINER, MOST_REFINEMENTS = 32, 4, 3
"""Samples of a plane in each drive period, the factor by which they are refined, and how often at most."""

EARLY = 1.0 / 8.0
"""A further sample comes soon after each sample, after this share of the step to the next one.

It shows how fast the point turns, since whole turns between evenly spaced samples would go unseen.
"""

WIDEST_TURN = 0.75 * np.pi
"""Largest angle between two samples whose direction of turning counts as known [rad]."""

CLOSED_TURNS = 0.05
"""Largest distance of the turns over a closed orbit from a whole number."""


@dataclass(frozen=True)
class TurningState:
    """Angle whose turns are counted: an angle of the model, or the polar angle of two states about a centre.

    Attributes
    ----------
    states : tuple of int
        Index of the angle, or of the two states of the plane.
    center : tuple of float
        Centre in the plane [the states' units].
    of_section : bool
        Whether to count turns of the section points about their mean, not of the trajectory about `center`.
    """

    states: tuple[int, ...]
    center: tuple[float, float] = (0.0, 0.0)
    of_section: bool = False

    def angles(self, sampled: np.ndarray) -> np.ndarray:
        """Return the angle at each sample [rad], from states with shape (..., len(states)).

        In a plane it grows clockwise, as a point with the coordinates position and velocity turns.
        """
        if len(self.states) == 1:
            return np.asarray(sampled[..., 0])
        x, y = sampled[..., 0] - self.center[0], sampled[..., 1] - self.center[1]
        return np.asarray(np.arctan2(-y, x))


@dataclass(frozen=True)
class RotationNumbers:
    """Rotation numbers with errors and status; the first dimension is the trajectory.

    Attributes
    ----------
    rotation : ndarray, (cell,)
        Mean turns per drive period; of section points in [0, 1). NaN for cells that failed.
    error : ndarray, (cell,)
        Of a closed orbit the distance of its turns from a whole number, per drive period. Else the difference
        of the averages over the two halves of the time, which overestimates the error of a quasi-periodic orbit.
    widest_turn : ndarray, (cell,)
        Largest angle between two samples in the plane [rad]; turns may be miscounted if it is above
        `WIDEST_TURN`. 0 for an angle.
    status : ndarray of int8, (cell,)
        ``BOUNDED`` if all went well, or how the trajectory failed.
    """

    rotation: np.ndarray
    error: np.ndarray
    widest_turn: np.ndarray
    status: np.ndarray


def rotation_numbers(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    initial_states: np.ndarray,
    *,
    system: System,
    turning: TurningState,
    n_periods: int,
    orbit_period: np.ndarray | None = None,
    rtol: float = RTOL,
    atol: float = ATOL,
) -> RotationNumbers:
    """Return the rotation numbers of many trajectories that start on their attractors.

    Parameters
    ----------
    parameters
        Packed parameters of each trajectory, shape (cell, n_parameters) [SI].
    frequency_hz
        Drive frequency, shape (cell,) [Hz].
    initial_states
        Section points, shape (cell, n_states).
    system
        What is integrated.
    turning
        The angle or plane whose turns are counted.
    n_periods
        Drive periods over which turns are averaged, at least 8; a closed orbit needs its own period only.
    orbit_period
        Period of each closed orbit [drive periods], shape (cell,); 0 where the orbit is not closed.
    rtol, atol
        Relative and absolute tolerance of the error control.

    Returns
    -------
    RotationNumbers

    Raises
    ------
    ValueError
        If a shape does not fit or an argument is out of bounds.
    """
    initial = check_states(initial_states, 2, system.n_states, "initial_states")
    packed = check_array("parameters", parameters, 2)
    frequency = check_frequency(frequency_hz, 1)
    check_count("n_periods", n_periods, 8)
    closed = np.zeros(len(initial), np.int64) if orbit_period is None else np.asarray(orbit_period, np.int64)
    lengths = np.where(closed > 0, closed, n_periods)
    unknown, n = np.full(len(initial), np.nan), len(initial)
    found = RotationNumbers(unknown, unknown.copy(), np.zeros(n), np.zeros(n, np.int8))
    for cells in _batches(lengths, turning):
        rows = packed[cells], frequency[cells], initial[cells]
        turns, widest, status = _turns(system, turning, rows, int(lengths[cells[0]]), rtol, atol)
        found.rotation[cells], found.error[cells] = _averaged(turns, turning, closed[cells] > 0)
        found.widest_turn[cells], found.status[cells] = widest, status
        failed = cells[status != Status.BOUNDED]
        found.rotation[failed] = found.error[failed] = np.nan
    return found


def _batches(lengths: np.ndarray, turning: TurningState) -> list[np.ndarray]:
    batches: list[np.ndarray] = []
    for length in np.unique(lengths):
        cells = np.flatnonzero(lengths == length)
        per_cell = int(length) * len(turning.states) * (2 * SAMPLES if _is_plane(turning) else 1)
        most = max(1, MOST_NUMBERS // per_cell)
        batches += [cells[i : i + most] for i in range(0, len(cells), most)]
    return batches


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Packed parameters, frequencies [Hz] and initial states of trajectories."""


def _turns(
    system: System, turning: TurningState, rows: Rows, n_periods: int, rtol: float, atol: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the turns in each drive period (cell, period), the widest angle between samples, and the status.

    Trajectories that turn too far between two samples are sampled more finely.
    """
    per_period = SAMPLES if _is_plane(turning) else 1
    turns, widest, status = _sampled_turns(system, turning, rows, n_periods, per_period, rtol, atol)
    for _ in range(MOST_REFINEMENTS):
        coarse = np.flatnonzero(widest > WIDEST_TURN)
        per_period *= FINER
        most = max(1, MOST_NUMBERS // (4 * n_periods * per_period))
        for some in (coarse[i : i + most] for i in range(0, len(coarse), most)):
            part = tuple(array[some] for array in rows)
            turns[some], widest[some], _ = _sampled_turns(system, turning, part, n_periods, per_period, rtol, atol)
    return turns, widest, status


def _sampled_turns(
    system: System, turning: TurningState, rows: Sequence[np.ndarray], n_periods: int, n: int, rtol: float, atol: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample trajectories `n` times per drive period and count their turns in each period."""
    packed, frequency, states = rows
    steps = np.arange(n_periods * n + 1) / n
    if _is_plane(turning):
        steps = np.concatenate([np.stack([steps[:-1], steps[:-1] + EARLY / n], axis=1).ravel(), steps[-1:]])
    found = sample(
        system,
        packed,
        states,
        [steps / f for f in frequency],
        drives=[Drive(np.full(n_periods, 1.0 / f)) for f in frequency],
        columns=turning.states,
        rtol=rtol,
        atol=atol,
        limits_first_step=False,
    )
    widest = np.zeros(len(states))
    if turning.of_section:
        return section_turns(found.states), widest, found.status
    moved = np.diff(turning.angles(found.states), axis=1)
    if _is_plane(turning):
        moved = _wrapped(moved).reshape(len(states), -1, 2)
        widest = np.nan_to_num(np.abs(moved) / [EARLY, 1.0]).max(axis=(1, 2))
    return moved.reshape(len(states), n_periods, -1).sum(axis=2) / (2.0 * np.pi), widest, found.status


def _is_plane(turning: TurningState) -> bool:
    return len(turning.states) == 2 and not turning.of_section


def section_turns(points: np.ndarray) -> np.ndarray:
    """Return the turns of section points (cell, period + 1, 2) about their mean, in each period."""
    around = points - points.mean(axis=1, keepdims=True)
    moved = np.diff(np.arctan2(-around[..., 1], around[..., 0]), axis=1)
    # angles on both sides of a cut would average to nonsense: the cut is put opposite to the mean direction
    middle = np.angle(np.exp(1j * moved).mean(axis=1))[:, None]
    return np.asarray((middle % (2.0 * np.pi) + _wrapped(moved - middle)) / (2.0 * np.pi))


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _averaged(turns: np.ndarray, turning: TurningState, is_closed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n = turns.shape[1]
    if is_closed.all():
        total = turns.sum(axis=1)
        whole = np.round(total)
        off = np.abs(total - whole)
        return np.where(off <= CLOSED_TURNS, whole, total) / n, off / n
    halves = turns[:, : n // 2] @ weights(n // 2), turns[:, n - n // 2 :] @ weights(n // 2)
    mean = turns @ weights(n)
    return mean % 1.0 if turning.of_section else mean, np.abs(halves[0] - halves[1])


def weights(n: int) -> np.ndarray:
    """Return the weights of a weighted Birkhoff average over `n` steps, with sum 1."""
    share = (np.arange(n) + 0.5) / n
    bump = np.exp(-1.0 / (share * (1.0 - share)))
    return np.asarray(bump / bump.sum())
