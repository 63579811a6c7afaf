"""Compute the section points of many trajectories, stroboscopic or at crossings of a level, with the engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magpend_core.crossing import Crossing
from magpend_core.defaults import ATOL, CLOSURE, LONGEST_PERIOD, MOST_STEPS, RTOL
from magpend_core.engine.entry import N_LANES, integrate
from magpend_core.engine.observers import FIRST_TURN, ORBIT_PERIOD, RECORD, Settings, window_of
from magpend_core.engine.system import System
from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import sectioned
from magpend_core.sizes import LEVEL
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_flag, check_frequency, check_states, check_tolerance


@dataclass(frozen=True)
class Sections:
    """Section points, orbit periods, status and step counts of trajectories, from `run_branches` or `sections`.

    Leading dims are (branch, point) from `run_branches` and (cell,) from `sections`.

    Attributes
    ----------
    section : ndarray, (..., n_keep, n_states)
        Kept states at the ends of consecutive drive periods, angles in (-pi, pi] [rad, rad/s]; NaN
        for cells that failed.
    turns : ndarray of int32, (..., n_angles)
        Full turns of each angle between the first and the last kept section; 0 for cells that failed.
    status : ndarray of int8
        Codes of `Status`.
    orbit_period : ndarray of int16
        Period of the closed orbit in drive periods; 0 if not closed.
    n_periods, n_steps, n_rejected : ndarray of int32
        Drive periods integrated, accepted steps and rejected attempts, per cell.
    final_state : ndarray, (..., n_states)
        State in which each cell ended, angles in (-pi, pi]; NaN where the branch had ended before.
    step_size : ndarray
        Step size that the error control would try next [s]: with the `final_state` of the same cell it
        continues a branch bit for bit. NaN where the branch ends with the cell, or has ended before.
    extremes : ndarray, (..., n_keep, n_quantities, 3), or None
        Least and largest value and mean of each watched quantity over the drive period that ends at the
        section; NaN for cells that failed, None if nothing was watched. See `engine.watching`.
    return_time : ndarray, (..., n_keep), or None
        Time from the crossing before to each kept one [s], with a section by crossing; None without.
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
    extremes: np.ndarray | None = None
    return_time: np.ndarray | None = None


def run_branches(
    parameters: np.ndarray,
    frequency_hz: np.ndarray | None,
    initial_states: np.ndarray,
    *,
    n_transient: int,
    n_keep: int,
    rtol: float,
    atol: float,
    max_steps_per_period: int = MOST_STEPS,
    stop_when_closed: bool = False,
    closure_tolerance: float = CLOSURE,
    max_orbit_period: int = LONGEST_PERIOD,
    step_size: np.ndarray | None = None,
    system: System,
    n_lanes: int = N_LANES,
    quantities: Sequence[str] | None = None,
    method: str | None = None,
    section: Crossing | None = None,
) -> Sections:
    """Integrate many branches, each a sequence of parameter points; each point starts where the previous one ended.

    A sweep is the case of one point per branch. All start at the drive's rising edge. The numbers of
    a branch depend on that branch alone, to the last bit: not on its neighbours, `n_lanes` or the
    CPU.

    Parameters
    ----------
    parameters
        Packed parameters of each point, shape (branch, point, len(system.parameter_names)) [SI]; see
        `Parameters.pack`.
    frequency_hz
        Drive frequency of each point, shape (branch, point) [Hz]; None with a section by crossing.
    initial_states
        Shape (branch, n_states) [rad, rad/s].
    n_transient
        Drive periods that each point runs before its sections are kept.
    n_keep
        Sections kept per point, one per drive period.
    rtol, atol
        Relative and absolute tolerance of the error control; `rtol` at least 1e-13.
    max_steps_per_period
        Limit on the attempted steps in one drive period; beyond it a cell ends as ``STEP_LIMIT``.
    stop_when_closed
        Keep sections as soon as the orbit has closed, `n_transient` periods at the latest. What
        closed means, and what is not excluded, is said in `observers.closed_period`.
    closure_tolerance
        Largest distance from the orbit at which it counts as closed (rates in units of 10 rad/s).
        Below about ten times `rtol` the integration's own errors stand in the way.
    max_orbit_period
        Longest orbit period looked for [drive periods].
    step_size
        First step of each branch, shape (branch,) [s]; 0 or None lets the engine choose. With the
        values and states at the last points of an earlier result the branch goes on bit for bit.
    system
        What is integrated.
    n_lanes
        Trajectories in flight.
    quantities
        Names of quantities and states of the system whose extremes and means are wanted over each
        period that ends in a kept section. They change no other number. Angles are counted on from
        their value in (-pi, pi] at the begin of the period.
    section
        What ends a period instead of the drive: then "drive period" above means the time between two
        crossings, and the system must be without forcing. A start need not be on the section.

    method
        ``"dopri5"`` of order 5, ``"dop853"`` of order 8 for smooth equations, or ``"rodas5p"`` for stiff ones; None
        for that of `system`, ``"dopri5"`` by default: only a run decides by itself. See `System.method`.

    Returns
    -------
    Sections
        With leading dims (branch, point).

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds.
    """
    n_transient = check_count("n_transient", n_transient, 0)
    n_keep = check_count("n_keep", n_keep, 1)
    max_orbit_period = check_count("max_orbit_period", max_orbit_period, 1)
    tolerance = check_tolerance("closure_tolerance", closure_tolerance)
    settings = Settings(
        n_transient,
        n_keep,
        max_orbit_period,
        # the compiled test divides by the units
        tolerance * min(1.0, *np.asarray(system.scales) / np.asarray(system.units)),
        window_of(max_orbit_period),
        check_flag("stop_when_closed", stop_when_closed),
    )
    if method is not None:
        system = replace(system, method=method)
    if section is not None:
        if frequency_hz is not None:
            raise ValueError("frequency_hz must be None with a section by crossing: its periods are returns.")
        system, parameters, frequency_hz = section.applied(check_array("parameters", parameters, 3), system)
    cells = integrate(
        system,
        RECORD,
        settings,
        parameters=parameters,
        frequency_hz=frequency_hz,
        initial_states=initial_states,
        n_keep=n_keep,
        n_measures=FIRST_TURN + system.n_states,
        rtol=rtol,
        atol=atol,
        max_steps_per_period=max_steps_per_period,
        step_size=step_size,
        n_lanes=n_lanes,
        quantities=quantities,
    )
    angles = [FIRST_TURN + i for i, angle in enumerate(system.is_angle) if angle]
    # where a cell fails between its kept sections, what the observer has noted is no count
    kept = np.isin(cells.status, (Status.PERIODIC, Status.BOUNDED))
    return Sections(
        section=cells.section,
        turns=np.where(kept[..., None], cells.measures[..., angles], 0).astype(np.int32),
        status=cells.status.astype(np.int8),
        orbit_period=cells.measures[..., ORBIT_PERIOD].astype(np.int16),
        n_periods=cells.n_periods.astype(np.int32),
        n_steps=cells.n_steps.astype(np.int32),
        n_rejected=cells.n_rejected.astype(np.int32),
        final_state=cells.final_state,
        step_size=cells.next_step,
        extremes=cells.watched if quantities is not None else None,
        return_time=cells.return_times if system.section is not None else None,
    )


def sections(
    parameters: Parameters | Sequence[Parameters],
    frequency_hz: ArrayLike | None,
    initial_states: ArrayLike,
    *,
    n_transient: int,
    n_keep: int,
    rtol: float = RTOL,
    atol: float = ATOL,
    **options: Any,
) -> Sections:
    """Return the stroboscopic section points of many independent trajectories of one model.

    Parameters
    ----------
    parameters
        Of all cells, or one set for each: ``load_model(...).load(...)``.
    frequency_hz
        Drive frequency of each cell, shape (n,), or one number for all [Hz]; None with a section by
        crossing, and of a map, whose sections are its iterations.
    initial_states
        Shape (n, n_states), in the order of the model's `state_names` and in SI units, at the instant t = 0
        of the drive.
    n_transient, n_keep, rtol, atol
        As for `run_branches`.
    options
        Further keywords of `run_branches`. `section` can be a level of an expression, if the model is a text.

    Returns
    -------
    Sections
        With leading dim (cell,): ``section`` is (n, n_keep, n_states).

    Raises
    ------
    ValueError
        If an argument has the wrong shape or is out of bounds, or the sets of parameters are of two models.

    Examples
    --------
    >>> result = sections(load_preset(), [2.2], [[0.2, 0.2, 0.0, 0.0]], n_transient=0, n_keep=1)
    >>> result.section.shape
    (1, 1, 4)
    """
    several = [parameters] if isinstance(parameters, Parameters) else list(parameters)
    crossing = options.pop("section", None)
    if crossing is not None:
        if frequency_hz is not None:
            raise ValueError("frequency_hz must be None with a section by crossing: its periods are returns.")
        several = [Parameters(sectioned(one.model, crossing), {**one, LEVEL: crossing.value}) for one in several]
        frequency_hz = crossing.frequency_hz
    models = {one.model.name: one.model for one in several}
    if len(models) != 1 or any(one.model.system != several[0].model.system for one in several):
        raise ValueError(f"parameters: must be of one model, and are of {len(models)}: {', '.join(models)}.")
    system = several[0].model.system
    initial = check_states(initial_states, 2, system.n_states, "initial_states")
    if system.is_map:
        if frequency_hz is not None:
            raise ValueError(f"frequency_hz = {frequency_hz}: {several[0].model.name} is a map; give None.")
        frequency_hz = 1.0
    if frequency_hz is None:
        raise ValueError("frequency_hz = None: give the drive's frequency, or a section by crossing.")
    frequency = check_frequency(frequency_hz, (0, 1))
    frequency = np.full(len(initial), frequency) if frequency.ndim == 0 else frequency
    frequency = frequency[:, None]
    n = len(frequency)
    if len(several) not in (1, n):
        raise ValueError(f"parameters: {len(several)} sets for {n} cells; give one, or one for each cell.")
    rows = np.stack([one.pack() for one in several])[:, None]
    packed = np.broadcast_to(rows, (n, *rows.shape[1:]))
    result = run_branches(
        packed,
        frequency,
        initial,
        n_transient=n_transient,
        n_keep=n_keep,
        rtol=rtol,
        atol=atol,
        system=system,
        **options,
    )
    found = {f.name: getattr(result, f.name) for f in fields(result)}
    return replace(result, **{name: value[:, 0] for name, value in found.items() if value is not None})
