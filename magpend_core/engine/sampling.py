"""Integrate many trajectories in SIMD lanes, and sample each at its own times by the engine's dense output.

`lanes.advance` records a trajectory once per period. This loop instead writes the states at given times, by the
continuous extension of the Dormand-Prince pair. And the drive may change from interval to interval: each interval has
its own length and its own values of some parameters. So a trajectory can be compared with a recording sample by sample.
As everywhere in the engine, its numbers depend only on its own inputs.

The functions here are templates, compiled for a system by `sampler_of` (see `lanes`). A *piece* is the time grid and
the drive of one recording; several trajectories may share it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, wraps
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.jit import bound_part, entry, keeping
from magpend_core.engine.lanes import (
    CROSSED,
    DIVERGED,
    ENDS_IN_CHATTER,
    FIRST_STEP,
    NOTHING,
    PENDING,
    REACHED,
    STEP_LIMIT,
    STEP_UNDERFLOW,
    TOO_MANY_STEPS,
    ZERO,
    engine_bindings,
    rows_of,
)
from magpend_core.engine.modes import CHATTERED
from magpend_core.engine.observers import RECORD
from magpend_core.engine.simd import WIDTH, load, store, take
from magpend_core.engine.system import System
from magpend_core.engine.threads import share
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.status import Status

BOUNDED = int(Status.BOUNDED)

COINCIDENT = 1e-11
"""Relative difference below which times since the start count as equal, as sums of drive intervals are rounded."""


class Samples(NamedTuple):
    """Input and output arrays of `follow_all`; the time grids and drives of all recordings are concatenated."""

    parameters: Any  # (trajectory, n_parameters)
    initial: Any  # (trajectory, n_states)
    piece: Any  # int64 (trajectory,)
    times: Any  # (time,) s since the piece's start, rising within a piece
    first_time: Any  # int64 (piece + 1,)
    durations: Any  # (interval,) s
    values: Any  # (interval, n_changed); NaN: the parameter keeps the trajectory's value
    first_interval: Any  # int64 (piece + 1,)
    changed: Any  # int64 (n_changed,): indices of the parameters in `values`
    start: Any  # (piece,) s, start of a piece within its first interval
    first_step: Any  # (piece,) s: upper bound of the first step
    columns: Any  # int64: indices of the states to write
    slack: float
    out: Any  # (trajectory, longest, n_columns)
    status: Any  # int64 (trajectory,)
    n_steps: Any  # int64 (trajectory,)


class Seats(NamedTuple):
    """Working arrays of the sampling loop: which trajectory, sample and drive interval each SIMD lane is at."""

    lanes: Any  # float64, the groups' rows
    before: Any  # float64: per group, the written states before the attempt, then their slopes
    clock: Any  # float64 (lanes, 2): time before the attempt, and start of the interval since that of the piece [s]
    trajectory: Any  # int64
    interval: Any  # int64
    done: Any  # int64, times written
    edge: Any  # int64
    turns: Any  # int64 (lanes, n_states)
    edge_table: Any  # float64 (lanes, 3, n_edges)
    p: Any  # float64 (n_parameters,), scratch
    weights: Any  # float64 (N_STAGES,), scratch
    scratch: Any  # float64, for constants
    events: Any  # int64 per group: whether one of its lanes has an event
    n_watching: Any  # int64 per group: 0
    queue: Any  # int64 (1,), the next trajectory: shared by all threads


def begin_interval(samples: Samples, seats: Seats, lane: int, scratch: Any) -> None:
    """Load the parameters and constants of a drive interval into a SIMD lane, and start at the interval's begin."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    w, at, p = seats.lanes, seats.interval[lane], seats.p
    steps, rejected = w[base + ROWS.steps + column], w[base + ROWS.rejected + column]
    for i in range(len(p)):
        p[i] = samples.parameters[seats.trajectory[lane], i]
    for i in range(len(samples.changed)):
        if samples.values[at, i] == samples.values[at, i]:
            p[samples.changed[i]] = samples.values[at, i]
    frequency = 1.0 / samples.durations[at]
    load_cell(w, base, column, frequency, p, samples.slack, scratch, seats.edge_table[lane])
    seats.edge[lane] = begin_period(w, base, column, seats.edge_table[lane])
    if HAS_SWITCHES:
        keep_switches(w, base, column)
    if HAS_CONTACTS:
        seat_contacts(w, base, column, False)
    w[base + ROWS.steps + column] = steps
    w[base + ROWS.rejected + column] = rejected


def begin_trajectory(samples: Samples, seats: Seats, lane: int, number: int, scratch: Any) -> None:
    """Load a trajectory's initial state into a SIMD lane, at its start time within the first drive interval."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    w, piece = seats.lanes, samples.piece[number]
    for i in range(N):
        w[base + ROWS.state + i * WIDTH + column] = samples.initial[number, i]
        seats.turns[lane, i] = 0
    w[base + ROWS.steps + column] = 0.0
    w[base + ROWS.rejected + column] = 0.0
    seats.trajectory[lane] = number
    seats.interval[lane] = samples.first_interval[piece]
    seats.done[lane] = 0
    begin_interval(samples, seats, lane, scratch)
    late = samples.start[piece]
    w[base + ROWS.time + column] = late
    while seats.edge[lane] < NE and w[base + ROWS.target + column] <= late:
        table = seats.edge_table[lane]
        seats.edge[lane] = begin_segment(w, base, column, table, seats.edge[lane] + 1)
    seats.clock[lane, 1] = -late
    take_section(w, base, column, scratch, seats.turns[lane])
    if HAS_EVENTS:
        begin_events(w, base, column)
    w[base + ROWS.fresh + column] = 1.0
    w[base + ROWS.after_rejection + column] = 0.0
    w[base + ROWS.event + column] = NOTHING
    cautious = FIRST_STEP * w[base + ROWS.period + column]
    w[base + ROWS.wish + column] = min(cautious, samples.first_step[piece])


def remember(samples: Samples, w: Any, before: Any, clock: Any, group: int) -> None:
    """Save the states and slopes at the begin of a step, which dense output needs and an accepted step overwrites."""
    base = group * ROWS.size
    n_columns = len(samples.columns)
    kept = group * 2 * n_columns * WIDTH
    for k in range(n_columns):
        row = base + samples.columns[k] * WIDTH
        store(before, kept + k * WIDTH, load(w, row + ROWS.state))
        store(before, kept + (n_columns + k) * WIDTH, load(w, row + ROWS.slopes))
    for column in range(WIDTH):
        clock[group * WIDTH + column, 0] = w[base + ROWS.time + column]


def write_due(samples: Samples, seats: Seats, lane: int, until: float) -> None:
    """Write the samples within a SIMD lane's last accepted step, up to `until` [s since the start of the drive
    interval].
    """
    group, column = lane // WIDTH, lane % WIDTH
    base, number = group * ROWS.size, seats.trajectory[lane]
    w, piece, t0, begin = seats.lanes, samples.piece[number], seats.clock[lane, 0], seats.clock[lane, 1]
    first, end = samples.first_time[piece], samples.first_time[piece + 1]
    h, done = w[base + ROWS.step + column], seats.done[lane]
    weights, n_columns = seats.weights, len(samples.columns)
    kept = group * 2 * n_columns * WIDTH + column
    while first + done < end and samples.times[first + done] - begin <= until:
        x = min((samples.times[first + done] - begin - t0) / h, 1.0) if h > 0.0 else 0.0
        for s in range(N_STAGES):
            p = ((DENSE[s, 3] * x + DENSE[s, 2]) * x + DENSE[s, 1]) * x + DENSE[s, 0]
            weights[s] = h * (p * x)
        for k in range(n_columns):
            i = samples.columns[k]
            total = weights[0] * seats.before[kept + (n_columns + k) * WIDTH]
            for s in range(1, N_STAGES):
                total += weights[s] * w[base + ROWS.slopes + (s * N + i) * WIDTH + column]
            total += seats.before[kept + k * WIDTH]
            samples.out[number, done, k] = total + TWO_PI * seats.turns[lane, i]
        done += 1
    seats.done[lane] = done


def go_on(samples: Samples, seats: Seats, lane: int, scratch: Any) -> int:
    """Process the last attempted step of a SIMD lane; return the final status of its trajectory, or PENDING."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    w = seats.lanes
    event = w[base + ROWS.event + column]
    w[base + ROWS.event + column] = NOTHING
    piece = samples.piece[seats.trajectory[lane]]
    wanted = samples.first_time[piece + 1] - samples.first_time[piece]
    if w[base + ROWS.after_rejection + column] == 0.0:
        last = seats.interval[lane] + 1 == samples.first_interval[piece + 1]
        ends = event == REACHED and seats.edge[lane] == NE and last
        time = w[base + ROWS.time + column]
        until = time + (COINCIDENT * (seats.clock[lane, 1] + time) if ends else 0.0)
        write_due(samples, seats, lane, until)
        if seats.done[lane] == wanted:
            return BOUNDED if in_bounds(w, base, column) else DIVERGED
    if event == NOTHING:
        return PENDING
    if HAS_EVENTS and event == CROSSED:
        act_on_events(w, base, column)
        if HAS_IMPACTS and w[base + ROWS.event + column] == CHATTERED:
            return ENDS_IN_CHATTER
        return PENDING
    if event == REACHED and seats.edge[lane] < NE:
        table = seats.edge_table[lane]
        seats.edge[lane] = begin_segment(w, base, column, table, seats.edge[lane] + 1)
        return PENDING
    if not in_bounds(w, base, column):
        return DIVERGED
    if event == REACHED:
        if HAS_CONTACTS:
            hold_contacts(w, base, column)
        take_section(w, base, column, scratch, seats.turns[lane])
        seats.clock[lane, 1] += samples.durations[seats.interval[lane]]
        seats.interval[lane] += 1
        begin_interval(samples, seats, lane, scratch)
        return PENDING
    return STEP_LIMIT if event == TOO_MANY_STEPS else STEP_UNDERFLOW


def end_trajectory(samples: Samples, seats: Seats, lane: int, status: int) -> None:
    """Write the status and step count of an ended trajectory; its samples after the end stay NaN."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    samples.status[seats.trajectory[lane]] = status
    samples.n_steps[seats.trajectory[lane]] = int(seats.lanes[base + ROWS.steps + column])


def copy_seat(seats: Seats, source: int, target: int) -> None:
    """Copy all data of one SIMD lane to another."""
    move_lane(seats.lanes, source, target)
    seats.trajectory[target] = seats.trajectory[source]
    seats.interval[target] = seats.interval[source]
    seats.done[target] = seats.done[source]
    seats.edge[target] = seats.edge[source]
    for i in range(2):
        seats.clock[target, i] = seats.clock[source, i]
    for i in range(N):
        seats.turns[target, i] = seats.turns[source, i]
    for k in range(3):
        for i in range(seats.edge_table.shape[2]):
            seats.edge_table[target, k, i] = seats.edge_table[source, k, i]
    rows = len(seats.before) * WIDTH // len(seats.trajectory)
    a = (source // WIDTH) * rows + source % WIDTH
    b = (target // WIDTH) * rows + target % WIDTH
    for row in range(0, rows, WIDTH):
        seats.before[b + row] = seats.before[a + row]


def seats_for(system: System, samples: Samples, n_lanes: int, queue: np.ndarray) -> Seats:
    """Allocate the arrays of the sampling loop for a number of SIMD lanes."""
    n_groups = -(-min(n_lanes, len(samples.piece)) // WIDTH)
    size, n = n_groups * WIDTH, system.n_states
    return Seats(
        lanes=np.zeros(n_groups * rows_of(system).size),
        before=np.zeros(size * 2 * len(samples.columns)),
        clock=np.zeros((size, 2)),
        trajectory=np.zeros(size, np.int64),
        interval=np.zeros(size, np.int64),
        done=np.zeros(size, np.int64),
        edge=np.zeros(size, np.int64),
        turns=np.zeros((size, n), np.int64),
        edge_table=np.zeros((size, 3, max(system.n_edges, 1))),
        p=np.zeros(samples.parameters.shape[1]),
        weights=np.zeros(system.tableau.n_stages),
        scratch=np.zeros(max(system.n_constants + system.n_modes, n)),
        events=np.zeros(n_groups, np.int64),
        n_watching=np.zeros(n_groups, np.int64),
        queue=queue,
    )


def follow_all(samples: Samples, seats: Seats, n_lanes: int, rtol: float, atol: float, max_attempts: float) -> None:
    """Integrate the trajectories of the queue, `n_lanes` at a time, and fill the output arrays of `samples`."""
    n, scratch = len(samples.piece), seats.scratch
    number, active = ZERO, ZERO
    for lane in range(len(seats.trajectory)):
        following = take(seats.queue) if lane < n_lanes else n
        if following < n:
            number, active = following, lane + 1
        elif active == 0:
            return
        # spare lanes of the last group repeat the last trajectory, so that they hold valid numbers; nothing reads them
        begin_trajectory(samples, seats, lane, number, scratch)
    rows, before, clock = seats.lanes, seats.before, seats.clock
    events, n_watching = seats.events, seats.n_watching
    while active > 0:
        in_use = (active + WIDTH - 1) // WIDTH
        for group in range(in_use):
            remember(samples, rows, before, clock, group)
        attempt(rows, events, n_watching, in_use, samples.slack, rtol, atol, max_attempts)
        lane = ZERO
        while lane < active:
            status = go_on(samples, seats, lane, scratch)
            if status == PENDING:
                lane += 1
                continue
            end_trajectory(samples, seats, lane, status)
            number = take(seats.queue)
            if number < n:
                begin_trajectory(samples, seats, lane, number, scratch)
                lane += 1
            else:
                # no trajectory is left for this lane: move the last active lane here and process it next
                active -= 1
                copy_seat(seats, active, lane)


_INLINE = ("remember",)
_CALLED = ("begin_interval", "begin_trajectory", "write_due", "go_on", "end_trajectory", "copy_seat")


@cache
def sampler_of(system: System) -> Callable[..., None]:
    """Compile the sampling loop `follow_all` for a system."""
    if not system.tableau.is_continuous:
        system = replace(system, method="dopri5")
    bindings = engine_bindings(system, RECORD)
    for key in (*_INLINE, *_CALLED):
        bindings[key] = bound_part(globals()[key], bindings, key in _INLINE)
    compiled = entry(follow_all, system.label, bindings, keeping(*system.functions))

    @wraps(compiled)
    def sampler(samples: Samples, n_lanes: int, rtol: float, atol: float, attempts: float) -> None:
        def run(queue: np.ndarray, n_lanes: int) -> None:
            compiled(samples, seats_for(system, samples, n_lanes, queue), n_lanes, rtol, atol, attempts)

        share(run, len(samples.piece), n_lanes)

    return sampler
