"""Call the engine: check the arguments, allocate the arrays, integrate all branches."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np

from magpend_core.engine.checks import check_system
from magpend_core.engine.lanes import Cells, engine_of
from magpend_core.engine.observers import Observer
from magpend_core.engine.symbolic import check_implicit
from magpend_core.engine.system import System
from magpend_core.validation import check_array, check_count, check_frequency, check_states, check_tolerance

N_LANES = 64
"""Number of lanes computed at the same time: four groups, whose numbers just fit into the first-level cache."""

SLACK = 1e4
"""Product of slack and tolerance in the step limiter (see `lanes.step_ratio`), chosen on the pendulum.

For 2 to 2.8 Hz and tolerances from 1e-6 to 1e-11, this value needs nearly the fewest steps for a given error, and at
most 6 % of the attempts are rejected. A value ten times larger or smaller costs 10 to 20 % more.
"""

LOOSE = 2e-6
"""Sum of the tolerances above which the slack grows with their third power.

At loose tolerances a step is much longer than a layer is wide and does not resolve it; error control alone then
chooses the step. With the third power, a median error of 1e-4 needs 10 to 18 % fewer attempts.
"""

LEAST_RTOL = 1e-13
"""Smallest relative tolerance; below it, rounding errors dominate and the step size becomes too small."""


FAR = 10.0
"""Largest absolute value of the motion, in units of the scale, up to which the relative tolerance is taken as given."""


def rtol_of_motion(system: System, rtol: float) -> float:
    """Return the relative tolerance with which errors are as given relative to the motion of a system, where this is
    far from zero; it is not below `LEAST_RTOL`.
    """
    return rtol if system.farthest <= FAR else max(rtol / system.farthest, min(rtol, LEAST_RTOL))


def slack_of(rtol: float, atol: float) -> float:
    """Return the slack for given tolerances: the constant that limits steps near boundary layers and forcing edges."""
    tolerance = rtol + atol
    return SLACK * tolerance * max(1.0, tolerance / LOOSE) ** 2


def check_tolerances(rtol: Any, atol: Any) -> tuple[float, float]:
    """Check the relative and the absolute tolerance, and return both as floats.

    Raises
    ------
    ValueError
        If one is out of bounds.
    """
    return check_tolerance("rtol", rtol, LEAST_RTOL), check_tolerance("atol", atol)


def check_quantities(names: Sequence[str] | None, system: System) -> tuple[int, ...]:
    """Return the indices of the named states and quantities in ``state_names + quantity_names``.

    Raises
    ------
    ValueError
        If the system has no such quantities; the message names those that it has.
    """
    if isinstance(names, str):
        raise ValueError(f"quantities = {names!r} is one string; give a sequence of names: [{names!r}].")
    known = system.state_names + system.quantity_names
    unknown = [name for name in names or () if name not in known]
    if unknown:
        near = [match for name in unknown for match in get_close_matches(str(name), known, n=2)]
        hint = f"did you mean {', '.join(dict.fromkeys(near))}? " if near else ""
        raise ValueError(
            f"quantities: {system.name} has no {', '.join(map(repr, unknown))}; {hint}It has {', '.join(known)}."
        )
    return tuple(known.index(name) for name in names or ())


def integrate(
    system: System,
    observer: Observer,
    settings: Any,
    *,
    parameters: Any,
    frequency_hz: Any,
    initial_states: Any,
    n_keep: int,
    n_measures: int,
    rtol: float,
    atol: float,
    max_steps_per_period: int,
    step_size: Any = None,
    n_lanes: int = N_LANES,
    quantities: Sequence[str] | None = None,
    measures: np.ndarray | None = None,
) -> Cells:
    """Integrate branches and let an observer record them. A branch is a sequence of parameter points, each started from
    the last state of the previous one.

    Parameters
    ----------
    system
        System to integrate.
    observer, settings
        Observer to call after each period, and its settings, a named tuple of numbers.
    parameters
        Shape (branch, point, len(system.parameter_names)).
    frequency_hz
        Shape (branch, point).
    initial_states
        Shape (branch, n_states).
    n_keep
        Number of rows (of n_states numbers) that the observer may write per cell; unwritten rows are NaN.
    n_measures
        Number of further numbers that the observer may write per cell.
    rtol, atol, max_steps_per_period, step_size, n_lanes, quantities
        As for `magpend_core.sections.run_branches`.
    measures
        Initial values of the observer's `measures`, shape (branch, point, n_measures); 0 by default.

    Returns
    -------
    Cells
        Input and output arrays, with the outputs filled.

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds.
    SystemCheckError
        If the functions of the system contradict its declaration (see `check_system`).
    """
    rtol, atol = check_tolerances(rtol, atol)
    rtol = rtol_of_motion(system, rtol)
    watched = check_quantities(quantities, system)
    if watched and not system.tableau.is_continuous:
        raise ValueError(f"quantities are not watched with method {system.method!r}; choose dopri5 or rodas5p.")
    check_implicit(system)
    attempts = float(check_count("max_steps_per_period", max_steps_per_period, 1))
    n_lanes = check_count("n_lanes", n_lanes, 1)
    frequency = check_frequency(frequency_hz, 2)
    packed = check_array("parameters", parameters, 3)
    wanted = (*frequency.shape, len(system.parameter_names))
    if packed.shape != wanted:
        raise ValueError(
            f"parameters has shape {packed.shape}; frequency_hz of shape {frequency.shape} and "
            f"{system.name} with {wanted[2]} parameters ask for {wanted}."
        )
    initial = check_states(initial_states, 2, system.n_states, "initial_states")
    n_branches = len(frequency)
    # numba has another type for read-only arrays and would compile the engine again
    frequency, packed = (np.require(a, requirements="W") for a in (frequency, packed))
    first_step = np.zeros(n_branches) if step_size is None else check_array("step_size", step_size, 1)
    for name, array in (("initial_states", initial), ("step_size", first_step)):
        if len(array) != n_branches:
            raise ValueError(f"{name} has {len(array)} rows; frequency_hz has {n_branches} branches.")
    check_system(system, packed, frequency, initial)
    per_cell = frequency.shape
    cells = Cells(
        frequency=frequency,
        parameters=packed,
        slack=slack_of(rtol, atol),
        state=initial.copy(),
        step_size=first_step.copy(),
        turns=np.zeros(initial.shape, np.int64),
        final_state=np.full((*per_cell, system.n_states), np.nan),
        next_step=np.full(per_cell, np.nan),
        section=np.full((*per_cell, n_keep, system.n_states), np.nan),
        measures=np.zeros((*per_cell, n_measures)) if measures is None else np.array(measures, np.float64),
        status=np.zeros(per_cell, np.int64),
        n_periods=np.zeros(per_cell, np.int64),
        n_steps=np.zeros(per_cell, np.int64),
        n_rejected=np.zeros(per_cell, np.int64),
        watched=np.full((*per_cell, n_keep, len(watched), 3), np.nan),
        return_times=np.full((*per_cell, n_keep if system.section else 0), np.nan),
    )
    if cells.status.size:
        engine_of(system, observer, watched)(cells, n_lanes, rtol, atol, attempts, settings)
    return cells
