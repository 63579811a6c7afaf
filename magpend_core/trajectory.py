"""Compute dense output of one trajectory on a given time grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, wraps
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.checks import check_system
from magpend_core.engine.entry import check_tolerances, slack_of
from magpend_core.engine.jit import bound_part, entry, keeping
from magpend_core.engine.lanes import (
    CROSSED,
    DIVERGED,
    ENDS_IN_CHATTER,
    FIRST_STEP,
    REACHED,
    STEP_LIMIT,
    STEP_UNDERFLOW,
    TOO_MANY_STEPS,
    UNDERFLOW,
    ZERO,
    engine_bindings,
    rows_of,
)
from magpend_core.engine.modes import CHATTERED
from magpend_core.engine.observers import RECORD
from magpend_core.engine.simd import WIDTH
from magpend_core.engine.system import System
from magpend_core.engine.tableau import DENSE, N_STAGES
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.parameters import Parameters
from magpend_core.status import Status
from magpend_core.validation import check_array, check_count, check_frequency, check_states

MOST_PERIODS = 1e7
"""Drive periods that a trajectory may take, since it cannot be interrupted: some minutes."""


class Desk(NamedTuple):
    """Arrays that `follow` works on."""

    rows: Any  # float64, of one group
    scratch: Any  # float64, for constants
    section: Any  # float64 (n_states,)
    edge_table: Any  # float64 (3, n_edges), see `lanes.Work`
    y0: Any  # float64 (n_states,): states before an attempt
    k0: Any  # float64 (n_states,): their slopes
    events: Any  # int64 (1,)
    n_watching: Any  # int64 (1,)
    turns: Any  # int64 (n_states,)


def desk_for(system: System) -> Desk:
    """Allocate the arrays of one trajectory."""
    n = system.n_states
    return Desk(
        np.zeros(rows_of(system).size),
        np.zeros(max(system.n_constants + system.n_modes, n)),
        np.zeros(n),
        np.zeros((3, max(system.n_edges, 1))),
        np.zeros(n),
        np.zeros(n),
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        np.zeros(n, np.int64),
    )


def prepare(w: Any, frequency: float, p: Any, state: Any, slack: float, scratch: Any, edge_table: Any) -> None:
    """Fill the rows of one group: the trajectory in lane 0, idle copies in the other lanes."""
    for lane in range(WIDTH):
        load_cell(w, 0, lane, frequency, p, slack, scratch, edge_table)
        for i in range(N):
            w[ROWS.state + i * WIDTH + lane] = state[i]
        w[ROWS.fresh + lane] = 1.0
        w[ROWS.wish + lane] = FIRST_STEP * w[ROWS.period + lane]


def fill(w: Any, y0: Any, k0: Any, t0: float, times: Any, begin: float, turns: Any, done: int, out: Any) -> int:
    """Write all states that fall into lane 0's last accepted step; return how many are written."""
    h = w[ROWS.step]
    while done < len(times) and times[done] - begin <= w[ROWS.time]:
        # a step of size 0 only fills the first slope; at the start that is what is due
        x = (times[done] - begin - t0) / h if h > 0.0 else 0.0
        for i in range(N):
            total = 0.0
            for s in range(N_STAGES):
                slope = k0[i] if s == 0 else w[ROWS.slopes + (s * N + i) * WIDTH]
                p = ((DENSE[s, 3] * x + DENSE[s, 2]) * x + DENSE[s, 1]) * x + DENSE[s, 0]
                total += slope * p * x
            out[done, i] = y0[i] + h * total + TWO_PI * turns[i]
        done += 1
    return done


def follow(
    desk: Desk,
    frequency: float,
    p: Any,
    state: Any,
    times: Any,
    rtol: float,
    atol: float,
    slack: float,
    max_attempts: float,
    out: Any,
) -> int:
    """Fill `out` (len(times), N) at rising `times`; return 0, or the status of a failure."""
    w, section, edge_table, turns = desk.rows, desk.section, desk.edge_table, desk.turns
    y0, k0, events, n_watching = desk.y0, desk.k0, desk.events, desk.n_watching
    prepare(w, frequency, p, state, slack, desk.scratch, edge_table)
    edge = begin_period(w, 0, 0, edge_table)
    if not take_section(w, 0, 0, section, turns):
        return DIVERGED
    if HAS_EVENTS:
        begin_events(w, 0, 0)
    done, i_period = ZERO, ZERO
    while done < len(times):
        t0 = w[ROWS.time]
        for i in range(N):
            y0[i] = w[ROWS.state + i * WIDTH]
            k0[i] = w[ROWS.slopes + i * WIDTH]
        attempt(w, events, n_watching, 1, slack, rtol, atol, max_attempts)
        if w[ROWS.event] == TOO_MANY_STEPS:
            return STEP_LIMIT
        if w[ROWS.event] == UNDERFLOW:
            return STEP_UNDERFLOW
        if w[ROWS.after_rejection] == 0.0:
            begin = i_period * w[ROWS.period]
            done = fill(w, y0, k0, t0, times, begin, turns, done, out)
        if HAS_EVENTS and w[ROWS.event] == CROSSED:
            act_on_events(w, 0, 0)
            if HAS_IMPACTS and w[ROWS.event] == CHATTERED:
                return ENDS_IN_CHATTER
        if w[ROWS.event] == REACHED and edge < NE:
            edge = begin_segment(w, 0, 0, edge_table, edge + 1)
        elif w[ROWS.event] == REACHED:
            if HAS_CONTACTS:
                hold_contacts(w, 0, 0)
            if not take_section(w, 0, 0, section, turns):
                return DIVERGED
            i_period += 1
            edge = begin_period(w, 0, 0, edge_table)
    return 0


@cache
def _follower(system: System) -> Callable[..., int]:
    system = replace(system, method="dopri5")
    bindings = engine_bindings(system, RECORD)
    for template in (prepare, fill):
        bindings[template.__name__] = bound_part(template, bindings, False)
    compiled = entry(follow, system.label, bindings, keeping(*system.functions))

    @wraps(compiled)
    def follower(*arguments: Any) -> int:
        code: int = compiled(desk_for(system), *arguments)
        return code

    return follower


def trajectory(
    parameters: Parameters,
    frequency_hz: float,
    initial_state: np.ndarray,
    times: np.ndarray,
    *,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    max_steps_per_period: int = 20_000,
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
        Rising times [s], the first at least 0; shape (n,).
    rtol, atol
        Relative and absolute tolerance of the error control; `rtol` at least 1e-13.
    max_steps_per_period
        Limit on the attempted steps in one drive period.

    Returns
    -------
    ndarray
        States at the times, in their units, shape (n, n_states); angles are not wrapped. Between steps the
        values are those of the Dormand-Prince pair's continuous extension of order 4.

    Raises
    ------
    ValueError
        If an argument is out of bounds.
    ArithmeticError
        If the trajectory diverges or meets the step limit before the last time; the message is
        the sentence of the `Status`.
    """
    system = parameters.model.system
    frequency = float(check_frequency(frequency_hz, ndim=0))
    state = check_states(initial_state, 1, system.n_states, "initial_state")
    grid = check_array("times", times, 1)
    if len(grid) and (grid[0] < 0.0 or np.any(np.diff(grid) <= 0.0)):
        raise ValueError("times must start at 0 or later and rise from entry to entry.")
    if len(grid) and not grid[-1] * frequency <= MOST_PERIODS:
        raise ValueError(
            f"times end at {grid[-1]:g} s, after {grid[-1] * frequency:.3g} periods at {frequency:g} Hz; a "
            f"trajectory has at most {MOST_PERIODS:g}: end earlier, and go on from the last state."
        )
    rtol, atol = check_tolerances(rtol, atol)
    attempts = check_count("max_steps_per_period", max_steps_per_period, 1)
    packed = parameters.pack()
    check_system(system, packed[None], np.array([frequency]), state[None])
    out = np.empty((len(grid), system.n_states))
    slack = slack_of(rtol, atol)
    code = _follower(system)(frequency, packed, state, grid, rtol, atol, slack, float(attempts), out)
    if code:
        raise ArithmeticError(f"The trajectory ended early: {Status(code).sentence}.")
    return out
