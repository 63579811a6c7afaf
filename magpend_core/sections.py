"""Stroboscopic sections of many trajectories: the door to the engine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core.lanes import Cells, engine_of
from magpend_core.observers import FIRST_TURN, ORBIT_PERIOD, RECORD_CLOSED, RECORD_LAST, Settings
from magpend_core.parameters import Parameters
from magpend_core.pendulum import PENDULUM_FITTED, system_of
from magpend_core.system import System

N_LANES = 64
"""Lanes in flight: four groups, whose numbers just fit the first-level caches."""


@dataclass(frozen=True)
class Sections:
    """Outcome of `run_branches` and `sections`.

    Leading dims are (branch, point) from `run_branches` and (cell,) from `sections`.

    Attributes
    ----------
    section : ndarray, (..., n_keep, n_states)
        Kept states at the ends of consecutive drive periods, angles in (-pi, pi] [rad, rad/s]; NaN
        for cells that failed.
    turns : ndarray of int32, (..., n_angles)
        Full turns of each angle between the first and the last kept section.
    status : ndarray of int8
        Codes of `Status`.
    orbit_period : ndarray of int16
        Period of the closed orbit in drive periods; 0 if not closed.
    n_periods, n_steps, n_rejected : ndarray of int32
        Drive periods integrated, accepted steps and rejected attempts, per cell.
    final_state : ndarray, (branch, n_states)
        State at the end of each branch, angles in (-pi, pi].
    step_size : ndarray, (branch,)
        Step size that the error control would try next [s]: with `final_state` it continues a
        branch bit for bit.
    """

    section: np.ndarray
    turns: np.ndarray
    status: np.ndarray
    orbit_period: np.ndarray
    n_periods: np.ndarray
    n_steps: np.ndarray
    n_rejected: np.ndarray
    final_state: np.ndarray
    step_size: np.ndarray


SLACK = 1.0


def run_branches(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    initial_states: np.ndarray,
    *,
    n_transient: int,
    n_keep: int,
    rtol: float,
    atol: float,
    max_steps_per_period: int = 20_000,
    stop_when_closed: bool = False,
    closure_tolerance: float = 1e-6,
    max_orbit_period: int = 16,
    step_size: np.ndarray | None = None,
    system: System = PENDULUM_FITTED,
    n_lanes: int = N_LANES,
    _slack=SLACK,
) -> Sections:
    frequency = _array(frequency_hz, 2)
    initial = _array(initial_states, 2)
    packed = _array(parameters, 3)
    n_branches, n_points = frequency.shape
    shape = (n_branches, n_points)
    window = max(64, 4 * max_orbit_period)
    settings = Settings(int(n_transient), int(n_keep), int(max_orbit_period), float(closure_tolerance), window)
    n = system.n_states
    cells = Cells(
        frequency=frequency,
        parameters=packed,
        slack=_slack * (rtol + atol),
        state=initial.copy(),
        step_size=np.zeros(n_branches) if step_size is None else _array(step_size, 1).copy(),
        turns=np.zeros((n_branches, n), np.int64),
        section=np.full((*shape, n_keep, n), np.nan),
        measures=np.zeros((*shape, 1 + n)),
        status=np.zeros(shape, np.int64),
        n_periods=np.zeros(shape, np.int64),
        n_steps=np.zeros(shape, np.int64),
        n_rejected=np.zeros(shape, np.int64),
    )
    engine = engine_of(system, RECORD_CLOSED if stop_when_closed else RECORD_LAST)
    if n_branches * n_points > 0:
        engine(cells, int(n_lanes), float(rtol), float(atol), float(max_steps_per_period), settings)
    angles = [FIRST_TURN + i for i, angle in enumerate(system.is_angle) if angle]
    return Sections(
        section=cells.section,
        turns=cells.measures[..., angles].astype(np.int32),
        status=cells.status.astype(np.int8),
        orbit_period=cells.measures[..., ORBIT_PERIOD].astype(np.int16),
        n_periods=cells.n_periods.astype(np.int32),
        n_steps=cells.n_steps.astype(np.int32),
        n_rejected=cells.n_rejected.astype(np.int32),
        final_state=cells.state,
        step_size=cells.step_size,
    )


def _array(values: Any, ndim: int) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float64)
