"""Continue trajectories from their last stored section point, with the same bits as one longer run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from magpend_core.engine import observers
from magpend_core.engine.entry import integrate
from magpend_core.engine.jit import bound_part, entry
from magpend_core.engine.observers import FIRST_TURN, RECORD, Settings, closed_period, window_of
from magpend_core.engine.system import System
from magpend_core.sections import Sections


def more_sections(
    parameters: np.ndarray,
    frequency_hz: np.ndarray,
    last: np.ndarray,
    step_size: np.ndarray,
    *,
    n_more: int,
    rtol: float,
    atol: float,
    max_steps_per_period: int,
    system: System,
    quantities: Sequence[str] | None = None,
) -> Sections:
    """Continue trajectories from their last section point, and return the section points of the drive periods that
    follow.

    Parameters
    ----------
    parameters, frequency_hz
        As for `run_branches`, of one point for each branch.
    last
        Last section of each cell, shape (cell, n_states).
    step_size
        What the error control would have tried next, shape (cell,) [s].
    n_more
        Sections to add.
    rtol, atol, max_steps_per_period, system, quantities
        As for `run_branches`.

    Returns
    -------
    Sections
        With leading dims (cell, 1). ``turns`` are those since `last`; what closes is not looked at:
        ``orbit_period`` is 0, and a cell that did not fail is ``BOUNDED``. See `orbit_periods`.
    """
    # a window of no sections: nothing closes on them
    settings = Settings(0, n_more, 0, 0.0, 1)
    cells = integrate(
        system,
        RECORD,
        settings,
        parameters=parameters,
        frequency_hz=frequency_hz,
        initial_states=last,
        n_keep=n_more,
        n_measures=FIRST_TURN + system.n_states,
        rtol=rtol,
        atol=atol,
        max_steps_per_period=max_steps_per_period,
        step_size=step_size,
        quantities=quantities,
    )
    angles = [i for i, is_angle in enumerate(system.is_angle) if is_angle]
    return Sections(
        section=cells.section,
        turns=cells.turns[:, None, angles].astype(np.int32),
        status=cells.status.astype(np.int8),
        orbit_period=np.zeros(cells.status.shape, np.int16),
        n_periods=cells.n_periods.astype(np.int32),
        n_steps=cells.n_steps.astype(np.int32),
        n_rejected=cells.n_rejected.astype(np.int32),
        final_state=cells.final_state,
        step_size=cells.next_step,
        extremes=cells.watched if quantities is not None else None,
        return_time=cells.return_times if system.section is not None else None,
    )


def orbit_periods(
    sections: np.ndarray, *, closure_tolerance: float, max_orbit_period: int, system: System
) -> np.ndarray:
    """Return the orbit period found in each trajectory's section points, by the rule of `run_branches`; 0 if aperiodic.

    Parameters
    ----------
    sections
        Last section points of each cell, shape (cell, n, n_states); n is `observers.window_of`, or the number of drive
        periods if that is smaller.
    closure_tolerance, max_orbit_period
        As for `run_branches`.
    system
        System that was integrated.

    Returns
    -------
    ndarray of int16, shape (cell,)
    """
    window = window_of(max_orbit_period)
    settings = Settings(0, 0, max_orbit_period, closure_tolerance, window)
    rings = np.zeros((len(sections), window * system.n_states))
    # the compiled test divides by the units
    last = sections[:, -window:] * _per_scale(system)
    rings[:, : last.shape[1] * system.n_states] = last.reshape(len(last), last.shape[1] * system.n_states)
    found = np.zeros(len(sections), np.int16)
    judge_of(system.plain)(rings, min(sections.shape[1], window), settings, found)
    return found


def judge(rings: Any, last: int, settings: Settings, found: Any) -> None:
    """Write the orbit period of each row of section points to `found`; 0 if the points show no period."""
    for i in range(len(rings)):
        found[i] = closed_period(rings[i], last, settings)


def _per_scale(system: System) -> np.ndarray:
    """Return the unit of each state in scales of the motion; 1 for angles, which are compared on their circle."""
    return np.where(system.is_angle, 1.0, np.asarray(system.units) / np.asarray(system.scales))


@cache
def judge_of(system: System) -> Callable[..., None]:
    """Compile `judge`, the test for periodic orbits, for a system with its angles and scales."""
    bindings: dict[str, Any] = {
        "N": system.n_states,
        "IS_ANGLE": np.array(system.is_angle, np.int64),
        "SCALES": np.array(system.units),
    }
    for key in observers.HELPERS:
        bindings[key] = bound_part(getattr(observers, key), bindings, True)
    return entry(judge, system.label, bindings)
