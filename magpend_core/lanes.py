"""The engine: many trajectories in step, each with its own time, step size and parameters.

Dormand-Prince 5(4) with error control. Every trajectory owns a lane; `simd.WIDTH` lanes form a
group, whose numbers lie row by row in one flat array (see `Rows`). One attempted step advances all
groups; accept or reject is a choice per lane, never a branch. Afterwards a short scalar pass serves
the lanes at which something happened: the end of a segment between two edges of the forcing, the end
of a period (then the observer is called), the end of a cell (then the lane is refilled).

What a lane computes depends on its own inputs alone. Nothing crosses lanes, and no operation's result
depends on the vector width, so results are the same bits alone or among others, in any order and on
any CPU.

The functions here are templates: names in capitals and the system's functions are bound by
`engine_of`, then compiled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from magpend_core.jit import inline, kernel, specialise
from magpend_core.simd import (
    WIDTH,
    absolute,
    load,
    load_rows,
    maximum,
    minimum,
    sqrt,
    store,
    store_rows,
    where_less,
)
from magpend_core.status import Status
from magpend_core.system import System
from magpend_core.vecmath import TWO_PI, exp, log2_rough

# Dormand and Prince, J. Comput. Appl. Math. 6 (1980) 19-26, RK5(4)7M
NODES = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
STAGES = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
N_STAGES = 7
A = tuple(tuple(float(x) for x in row) for row in STAGES)

SAFETY = 0.9
SHRINK = 0.2
GROW = 5.0
_LN2_TENTH = math.log(2.0) / 10.0

# events that the vector part leaves for the scalar pass
NOTHING, REACHED, TOO_MANY_STEPS, UNDERFLOW = 0.0, 1.0, 2.0, 3.0
PENDING, DIVERGED = int(Status.PENDING), int(Status.DIVERGED)
STEP_LIMIT, STEP_UNDERFLOW, UNREACHED = int(Status.STEP_LIMIT), int(Status.STEP_UNDERFLOW), int(Status.UNREACHED)


class Rows(NamedTuple):
    """Where a group's rows start, in float64 numbers from the group's base."""

    state: int
    slopes: int  # N_STAGES * n_states rows
    trial: int  # the stage's state, at the end the new state
    constants: int
    time: int  # s, since the last section
    wish: int  # s, step size that the error control wants
    step: int  # s, step size of this attempt
    fresh: int  # 1 while the first slope is missing: the next attempt has step 0 and fills it
    after_rejection: int  # 1 if the last attempt was rejected
    start: int  # s, start of the segment
    target: int  # s, end of the segment
    start_width: int  # s, half-width of the edge at the start
    target_width: int  # s
    period: int  # s
    steps: int  # accepted in this cell
    rejected: int  # rejected attempts in this cell
    attempts: int  # in this period
    event: int
    size: int


def rows_of(system: System) -> Rows:
    """Lay out a group for a system."""
    counts = [
        system.n_states, N_STAGES * system.n_states, system.n_states, system.n_constants, *[1] * 14,
    ]  # fmt: skip
    offsets = np.concatenate([[0], np.cumsum(counts)]) * WIDTH
    return Rows(*(int(x) for x in offsets))


def choose_step(w: Any, base: int, limit: float) -> None:
    """Set the step of the next attempt.

    The step is the least of what error control wants and, for each layer and edge, what keeps it in
    proportion to the distance from the nearest complex singularity: with D the distance in time to
    the crossing and d the half-width in time, at most max(limit D/(1 + limit), limit d) towards
    the crossing and limit sqrt(D^2 + d^2) away from it. It ends on the segment's end exactly, and
    the last two steps before that share the rest.
    """
    y = load_rows(w, base + ROWS.state, N)
    dy = load_rows(w, base + ROWS.slopes, N)
    c = load_rows(w, base + ROWS.constants, NC)
    t = load(w, base + ROWS.time)
    remaining = load(w, base + ROWS.target) - t
    h = load(w, base + ROWS.wish)
    approach = limit / (1.0 + limit)
    for value, rate, half_width in layers(y, dy, c):
        distance = absolute(value)
        towards = maximum(approach * distance, limit * half_width)
        away = limit * sqrt(value * value + half_width * half_width)
        h = minimum(where_less(value * rate, 0.0, towards, away) / absolute(rate), h)
    if NE > 0:
        passed = t - load(w, base + ROWS.start)
        width = load(w, base + ROWS.start_width)
        h = minimum(limit * sqrt(passed * passed + width * width), h)
        width = load(w, base + ROWS.target_width)
        h = minimum(maximum(approach * remaining, limit * width), h)
    shared = where_less(remaining, 2.0 * h, 0.5 * remaining, h)
    h = where_less(h, remaining, shared, remaining)
    h = where_less(0.5, load(w, base + ROWS.fresh), 0.0, h)
    store(w, base + ROWS.step, h)


def run_stage(w: Any, base: int, s: int) -> None:
    """Compute the state and the slope of stage `s` (1 to 6)."""
    h = load(w, base + ROWS.step)
    for i in range(N):
        row = base + i * WIDTH
        total = STAGES[s, 0] * load(w, row + ROWS.slopes)
        for j in range(1, s):
            total = total + STAGES[s, j] * load(w, row + ROWS.slopes + j * N * WIDTH)
        store(w, row + ROWS.trial, load(w, row + ROWS.state) + h * total)
    c = load_rows(w, base + ROWS.constants, NC)
    u = forcing(load(w, base + ROWS.time) + NODES[s] * h, c)
    slopes = rhs(load_rows(w, base + ROWS.trial, N), u, c)
    store_rows(w, base + ROWS.slopes + s * N * WIDTH, slopes)


def squared_error(w: Any, base: int, rtol: float, atol: float) -> Any:
    """Mean square of the scaled error estimate of the attempt."""
    total = 0.0 * load(w, base + ROWS.step)
    for i in range(N):
        row = base + i * WIDTH
        error = ERROR[0] * load(w, row + ROWS.slopes)
        for j in range(2, N_STAGES):
            error = error + ERROR[j] * load(w, row + ROWS.slopes + j * N * WIDTH)
        size = maximum(absolute(load(w, row + ROWS.state)), absolute(load(w, row + ROWS.trial)))
        scaled = error / (atol + rtol * size)
        total = total + scaled * scaled
    h = load(w, base + ROWS.step)
    return (h * h) * total * (1.0 / N)


def finish_step(w: Any, base: int, rtol: float, atol: float, max_attempts: float) -> None:
    """Accept or reject the attempt, lane by lane, and set the next wish and the event."""
    e2 = minimum(squared_error(w, base, rtol, atol), 1e20)
    factor = SAFETY * exp(log2_rough(maximum(e2, 1e-20)) * -_LN2_TENTH)
    factor = minimum(maximum(factor, SHRINK), GROW)
    factor = where_less(0.5, load(w, base + ROWS.after_rejection), minimum(factor, 1.0), factor)
    h = load(w, base + ROWS.step)
    wish = load(w, base + ROWS.wish)
    t = load(w, base + ROWS.time)
    target = load(w, base + ROWS.target)
    rejected = where_less(1.0, e2, 1.0, 0.0)
    # an attempt cut short by a layer or a target says little about the step that error control
    # allows afterwards: the old wish stands unless the error asks for more
    next_wish = where_less(h, wish, maximum(wish, h * factor), h * factor)
    next_wish = where_less(0.5, rejected, h * factor, next_wish)
    stepped = where_less(0.0, h, 1.0, 0.0)
    store(w, base + ROWS.wish, where_less(0.5, stepped, next_wish, wish))
    for i in range(N):
        row = base + i * WIDTH
        old = load(w, row + ROWS.state)
        store(w, row + ROWS.state, where_less(0.5, rejected, old, load(w, row + ROWS.trial)))
        old = load(w, row + ROWS.slopes)
        last = load(w, row + ROWS.slopes + (N_STAGES - 1) * N * WIDTH)
        store(w, row + ROWS.slopes, where_less(0.5, rejected, old, last))
    arrived = where_less(h, target - t, 0.0, 1.0 - rejected)
    t_new = where_less(0.5, arrived, target, t + h)
    store(w, base + ROWS.time, where_less(0.5, rejected, t, t_new))
    attempts = load(w, base + ROWS.attempts) + stepped
    store(w, base + ROWS.attempts, attempts)
    store(w, base + ROWS.steps, load(w, base + ROWS.steps) + stepped * (1.0 - rejected))
    store(w, base + ROWS.rejected, load(w, base + ROWS.rejected) + rejected)
    store(w, base + ROWS.after_rejection, rejected)
    store(w, base + ROWS.fresh, 0.0 * h)
    event = where_less(0.5, arrived, REACHED, where_less(max_attempts, attempts, TOO_MANY_STEPS, NOTHING))
    tiny = 1e-15 * load(w, base + ROWS.period)
    event = where_less(next_wish, tiny, UNDERFLOW, event)
    store(w, base + ROWS.event, event)


def attempt(w: Any, n_groups: int, limit: float, rtol: float, atol: float, max_attempts: float) -> None:
    """Advance all groups by one attempted step."""
    for group in range(n_groups):
        choose_step(w, group * ROWS.size, limit)
    for s in range(1, N_STAGES):
        for group in range(n_groups):
            run_stage(w, group * ROWS.size, s)
    for group in range(n_groups):
        finish_step(w, group * ROWS.size, rtol, atol, max_attempts)
