"""Compute dense output of one trajectory on a given time grid."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from magpend_core.defaults import ATOL, MOST_STEPS, RTOL
from magpend_core.models.model import Parameters
from magpend_core.sampling import Drive, sample
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_frequency, check_states

MOST_PERIODS = 1e7
"""Drive periods that a trajectory may take, since it cannot be interrupted: some minutes."""


def trajectory(
    parameters: Parameters,
    frequency_hz: float,
    initial_state: ArrayLike,
    times: ArrayLike,
    *,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_steps_per_period: int = MOST_STEPS,
    method: str | None = None,
) -> np.ndarray:
    """Return the states of one trajectory on a time grid, started at the drive's rising edge.

    Parameters
    ----------
    parameters
        See `load_preset`.
    frequency_hz
        Drive frequency [Hz].
    initial_state
        The model's states in their order at time 0, in their units; shape (n_states,).
    times
        Rising times [s], the first at least 0; shape (n,). Of a map counts of iterations, at a frequency of 1.
    rtol, atol
        Relative and absolute tolerance of the error control; `rtol` at least 1e-13.
    max_steps_per_period
        Limit on the attempted steps in one drive period.
    method
        ``"dopri5"``, or ``"rodas5p"`` for stiff equations; None for that of the model.

    Returns
    -------
    ndarray
        States at the times, in their units, shape (n, n_states); angles are not wrapped. Between steps the
        values are those of the method's continuous extension of order 4.

    Raises
    ------
    ValueError
        If an argument is out of bounds.
    ArithmeticError
        If the trajectory diverges or meets the step limit before the last time; the message is
        the sentence of the `Status`.
    """
    system = parameters.model.system
    if method is not None:
        system = replace(system, method=method)
    frequency = float(check_frequency(frequency_hz, ndim=0))
    state = check_states(initial_state, 1, system.n_states, "initial_state")
    if system.is_map and frequency != 1.0:
        raise ValueError(f"frequency_hz = {frequency:g}: {system.name} is a map, whose iterations are counted; give 1.")
    grid = check_array("times", times, 1)
    if len(grid) and (grid[0] < 0.0 or np.any(np.diff(grid) <= 0.0)):
        raise ValueError("times must start at 0 or later and rise from entry to entry.")
    if len(grid) and not grid[-1] * frequency <= MOST_PERIODS:
        raise ValueError(
            f"times end at {grid[-1]:g} s, after {grid[-1] * frequency:.3g} periods at {frequency:g} Hz; a "
            f"trajectory has at most {MOST_PERIODS:g}: end earlier, and go on from the last state."
        )
    attempts = check_count("max_steps_per_period", max_steps_per_period, 1)
    if not len(grid):
        return np.empty((0, system.n_states))
    # a time at a section may lie past it by rounding
    n_periods = max(1, math.ceil(grid[-1] * frequency * (1.0 - 1e-12)))
    found = sample(
        system,
        parameters.pack()[None],
        state[None],
        [grid],
        drives=[Drive(np.full(n_periods, 1.0 / frequency))],
        rtol=rtol,
        atol=atol,
        max_steps_per_interval=attempts,
        limits_first_step=False,
    )
    if found.status[0] != Status.BOUNDED:
        raise ArithmeticError(f"The trajectory ended early: {Status(found.status[0]).advice}.")
    return found.states[0]
