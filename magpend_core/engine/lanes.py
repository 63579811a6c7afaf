"""Integrate many trajectories at once in SIMD lanes, each with its own time, step size and parameters.

The methods are those of Dormand and Prince, of order 5 or 8, and Steinebach's Rosenbrock method of order 5, with error
control. Every trajectory has a lane;
`simd.WIDTH` lanes form a group, whose numbers lie row by row in one flat array (see `Rows`). Each pass attempts
one step in all groups; a step is accepted or rejected lane by lane, by `where_less` and not by a branch. Then a
short scalar pass serves the lanes in which something happened: the end of a time segment between two forcing
edges, the end of a period (the observer is called), or the end of a trajectory (the lane gets the next one).

The results of a lane depend only on its own inputs. Nothing is exchanged between lanes, and no operation
depends on the vector width. So a trajectory has the same bits alone or among others, in any order, on any CPU.

The functions here are templates: their free names (names in capitals, functions of the system) get values in
`engine_bindings`, then `engine_of` compiles them.

Words: a *branch* is a sequence of parameter points, computed one after the other from the last state; a *cell* is
one parameter point of a branch; an *edge* is an instant at which the forcing switches; a *layer* is a narrow
region of states in which the right-hand side changes quickly.

Reading order, from the bottom of the file: `advance` is the main loop. `attempt` makes one step of all groups
(`run_stages`, `choose_step`, `finish_step`). `serve` is the scalar pass over lanes with an event. `start_branch`,
`start_point`, `end_cell` and `end_branch` fill and empty lanes. `engine_bindings` binds the names.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine import events as event_templates
from magpend_core.engine import modes as mode_templates
from magpend_core.engine import observers, rosenbrock
from magpend_core.engine import tangents as tangent_templates
from magpend_core.engine.digests import code_length
from magpend_core.engine.events import LANDED, TAKE_BACK, event_bindings
from magpend_core.engine.jit import bound_part, entry, inline, keeping
from magpend_core.engine.modes import CHATTERED, mode_bindings
from magpend_core.engine.observers import Observer
from magpend_core.engine.rosenbrock import implicit_bindings, implicit_rows
from magpend_core.engine.simd import (
    WIDTH,
    absolute,
    any_nonzero,
    load,
    load_rows,
    maximum,
    minimum,
    multiply_add,
    store,
    store_rows,
    take,
    where_less,
)
from magpend_core.engine.system import System
from magpend_core.engine.tangents import n_entries, tangent_bindings
from magpend_core.engine.threads import share
from magpend_core.engine.vecmath import TWO_PI, exp2_rough, hypot_rough, log2_rough
from magpend_core.engine.watching import (
    begin_watch,
    evaluate_watched,
    keep_extremes,
    set_watching,
    update_extremes,
    watched_function,
)
from magpend_core.status import Status

ZERO: Any = np.int64(0)  # numba types a plain 0 as a literal and would compile every callee once more

UNROLLED_STATES = 3
"""Systems with at most this many states have their stages unrolled (see `unrolled_stages`)."""
UNROLLED_LENGTH = 3000
"""So have systems with one state more, if their right-hand side has at most this many bytes of bytecode."""

FADED = 5.1
"""Distance [half-widths] beyond which a layer with exponential tails needs no short steps, at a `step_ratio` of 1.

At m half-widths d from the layer, J exp(-pi m) remains of the jump J. A step of length 1000 d that ends there has
an error of about 1000 J d exp(-pi m). This equals slack/1e4, the tolerance, at m = 5.1 - log(slack/(J d))/pi.
"""
FIRST_STEP = 1e-3
"""First step of a branch [drive periods]; error control finds the right size within a few steps."""
FARTHEST = 1e15
"""Largest angle [rad]; beyond it, float64 numbers are too far apart to be angles."""
SAFETY = 0.85
SHRINK = 0.2
GROW = 5.0

# codes of the events that the vector part reports to the scalar pass
NOTHING, REACHED, TOO_MANY_STEPS, UNDERFLOW, DUE, CROSSED = 0.0, 1.0, 2.0, 3.0, 4.0, 5.0
PENDING, DIVERGED = int(Status.PENDING), int(Status.DIVERGED)
STEP_LIMIT, STEP_UNDERFLOW = int(Status.STEP_LIMIT), int(Status.STEP_UNDERFLOW)
UNREACHED, NO_RETURN = int(Status.UNREACHED), int(Status.NO_RETURN)
ENDS_IN_CHATTER = int(Status.CHATTER)


class Rows(NamedTuple):
    """Offsets of the rows in the work array of one group of SIMD lanes, in float64 numbers from the group's start."""

    state: int
    slopes: int  # N_STAGES * n_states rows
    trial: int  # state at the present stage; after the last stage the new state
    forcing: int  # at the last stage's time
    time: int  # s, since the last section
    wish: int  # s, step size that the error control wants
    step: int  # s, step size of this attempt
    fresh: int  # 1 while the first slope is missing: the next attempt has step 0 and fills it
    after_rejection: int  # 1 if the last attempt was rejected
    start: int  # s, start of the segment
    target: int  # s, end of the segment
    start_width: int  # s, half-width of the edge at the start
    target_width: int  # s
    start_ratio: int  # step_ratio of the edge at the start
    target_ratio: int
    target_share: int  # target_ratio/(1 + target_ratio)
    period: int  # s
    steps: int  # accepted in this cell
    rejected: int  # rejected attempts in this cell
    attempts: int  # in this period
    event: int
    halfway: int  # state in the middle of a step, if quantities are tracked (watched)
    begin: int  # tracked quantities at the begin of the step, one row each; likewise the next five
    middle: int
    end: int
    lowest: int  # in this period
    highest: int
    integral: int
    known: int  # values and rates of events at the begin of the step, see `events`
    found: int  # at the end of the attempt
    passed: int  # where the last attempt that was taken back ended
    halfway_events: int  # in the middle of the attempt, if there are surfaces
    side: int  # of each event
    fired: int  # 1 if it happened at the end of the last step
    dip: int  # position (0 to 1) in the attempt at which the event function may be below zero, or 2
    aimed: int  # s, length of the next attempt, if an event determines it
    ahead: int  # s, from the begin of the step to the end of the attempt in `passed`
    resolution: int  # s, of the event's instant; 0 if no event is being located
    level: int  # of the section
    entries: int  # Jacobian entries at each stage but the first, if the engine integrates the tangent vectors
    derivatives: int  # of the rates, by states and by time; this and the next four of an implicit method only
    matrix: int
    exchanges: int  # 1 where two of its rows were exchanged
    right: int  # right-hand side of the linear system
    drift: int  # change of the rates in time during the step
    constants: int  # last, and padded to a multiple of four: more systems then agree in all other offsets
    size: int


def rows_of(system: System, n_watched: int = 0) -> Rows:
    """Return the row layout of the work array for a group of SIMD lanes, with `n_watched` recorded quantities."""
    n = system.n_events
    counts = [
        system.n_states,
        system.tableau.n_stages * system.n_states,
        system.n_states,
        *[1] * 18,
        system.n_states if n_watched else 0,
        *[n_watched] * 6,
        *[2 * n] * 3,
        2 * n if system.n_surfaces else 0,
        *[n] * 3,
        *[1 if n else 0] * 4,
        (system.tableau.n_stages - 1) * n_entries(system),
        *implicit_rows(system),
        -(-(system.n_constants + system.n_modes) // 4) * 4,
    ]
    offsets = np.concatenate([[0], np.cumsum(counts)]) * WIDTH
    return Rows(*(int(x) for x in offsets))


def step_ratio(room: Any) -> Any:
    """Return the largest safe step near a boundary layer or forcing edge, as a multiple of the distance to the complex
    singularity.

    The right-hand side near a layer behaves like (J/pi) atan(t/d), whose derivatives at a distance R
    from the poles at +-i d grow like J d n!/R^(n+1): a step h = c R leaves an error in proportion to
    J d c^6 for a method of order 5. So c = (slack/(J d))^(1/6), with `room` = slack/(J d).
    """
    return exp2_rough(log2_rough(minimum(maximum(room, 1e-30), 1e30)) * (1.0 / (ORDER + 1.0)))


def choose_step(w: Any, base: int, slack: float) -> None:
    """Set the size of the next attempted step from error control, boundary layers, forcing edges and events.

    The step is the smallest of several bounds. One is the size that error control allows. Each layer and each edge
    gives another, in proportion to the distance from its complex singularity. Let D be the time until the state
    crosses the layer, d its half-width in time, and c its `step_ratio`. Towards the crossing the bound is
    max(c D/(1 + c), c d), away from it c sqrt(D^2 + d^2), to 2 %. A layer with exponential tails (LAYERS_FADE)
    matters only within `FADED`: a step may lead up to there, or to a tenth of D. A step ends exactly at the end of
    its time segment; the last two steps before that are equal.
    """
    t = load(w, base + ROWS.time)
    remaining = load(w, base + ROWS.target) - t
    h = load(w, base + ROWS.wish)
    if HAS_LAYERS:
        h = limited_by_layers(w, base, slack, t, h)
    if NE > 0:
        passed = t - load(w, base + ROWS.start)
        away = hypot_rough(passed, load(w, base + ROWS.start_width))
        h = minimum(load(w, base + ROWS.start_ratio) * away, h)
        least = load(w, base + ROWS.target_ratio) * load(w, base + ROWS.target_width)
        h = minimum(maximum(load(w, base + ROWS.target_share) * remaining, least), h)
    shared = where_less(remaining, 2.0 * h, 0.5 * remaining, h)
    h = where_less(h, remaining, shared, remaining)
    if HAS_EVENTS:
        aimed = load(w, base + ROWS.aimed)
        h = where_less(0.0, aimed, aimed, h)
    h = where_less(0.5, load(w, base + ROWS.fresh), 0.0, h)
    store(w, base + ROWS.step, h)


def limited_by_layers(w: Any, base: int, slack: float, t: Any, h: Any) -> Any:
    """Return the step size `h`, reduced near a boundary layer (a narrow region where the right-hand side changes
    quickly).
    """
    y = load_rows(w, base + ROWS.state, N_KNOWN)
    dy = load_rows(w, base + ROWS.slopes, N_KNOWN)
    c = load_rows(w, base + ROWS.constants, NC)
    # the smallest bound is kept as a fraction h/speed_h until the end: one division for all layers
    speed_h = 1.0 + 0.0 * h
    for value, rate, half_width, per_strength in layers_at(t, y, dy, c):
        speed = absolute(rate)
        ratio = step_ratio(slack * speed * per_strength)
        distance = absolute(value)
        nearing = value * rate
        # the two bounds in the docstring of `choose_step`, as states (not times): `speed` divides at the end
        towards = ratio * maximum(distance, (1.0 + ratio) * half_width)
        away = ratio * hypot_rough(distance, half_width)
        if LAYERS_FADE:
            reach = half_width * maximum(FADED - 1.32 * log2_rough(ratio), 1.0)
            nearer = (1.0 + ratio) * minimum(distance - reach, 0.9 * distance)
            towards = maximum(towards, nearer)
            away = where_less(reach, distance, 1e100, away)
        length = where_less(nearing, 0.0, towards, away)
        speed = speed * where_less(nearing, 0.0, 1.0 + ratio, 1.0)
        mine, other = length * speed_h, h * speed
        h = where_less(mine, other, length, h)
        speed_h = where_less(mine, other, speed, speed_h)
    return h / speed_h


def run_stage(w: Any, base: int, s: int) -> None:
    """Compute the state and the slope of Runge-Kutta stage `s` (1, 2, ...)."""
    h = load(w, base + ROWS.step)
    for i in range(N_KNOWN):
        row = base + i * WIDTH
        # the first product has a variable of its own: `fusing` then fuses the same products as in the unrolled form
        total = STAGES[s, 0] * load(w, row + ROWS.slopes)
        for j in range(1, s):
            total = multiply_add(STAGES[s, j], load(w, row + ROWS.slopes + j * N * WIDTH), total)
        store(w, row + ROWS.trial, load(w, row + ROWS.state) + h * total)
    if NODES[s] != NODES[s - 1]:
        c = load_rows(w, base + ROWS.constants, NC)
        store(w, base + ROWS.forcing, forcing(load(w, base + ROWS.time) + NODES[s] * h, c))
    # load the constants after the last store: LLVM can then use them from memory instead of spilling registers
    c = load_rows(w, base + ROWS.constants, NC)
    y, u = load_rows(w, base + ROWS.trial, N_KNOWN), load(w, base + ROWS.forcing)
    slopes = rhs(y, u, c)
    if CARRIES:
        # before the store of the slopes, so that LLVM can share subexpressions of `rhs` and the Jacobian
        entries = tangent_entries(y, u, c)
        store_rows(w, base + ROWS.entries + (s - 1) * N_ENTRIES * WIDTH, entries)
    store_rows(w, base + ROWS.slopes + s * N * WIDTH, slopes)


def run_stages(w: Any, base: int) -> None:
    """Compute the states and slopes of all Runge-Kutta stages but the first, which the last step has computed."""
    for s in range(1, N_STAGES):
        run_stage(w, base, s)


def unrolled_stages(system: System) -> Callable[..., None]:
    """Return `run_stages` for a small system, with its loops written out.

    The slopes stay in registers, and zeros of the tableau cost nothing. For larger systems, many copies of a long
    right-hand side would take long to compile and gain little.
    """
    n, tableau = system.n_states, system.tableau
    nodes, stages = tableau.nodes, tableau.stages
    lines = [
        "def run_stages(w, base):",
        "h, t = load(w, base + ROWS.step), load(w, base + ROWS.time)",
        "c = load_rows(w, base + ROWS.constants, NC)",
        "y = load_rows(w, base + ROWS.state, N)",
        "k0 = load_rows(w, base + ROWS.slopes, N)",
    ]
    for s in range(1, tableau.n_stages):
        terms = [(j, stages[s, j]) for j in range(s) if stages[s, j] != 0.0]
        states = []
        for i in range(n):
            first, *rest = terms
            total = f"{float(first[1])!r} * k{first[0]}[{i}]"
            for j, a in rest:
                total = f"multiply_add({float(a)!r}, k{j}[{i}], {total})"
            states.append(f"multiply_add(h, {total}, y[{i}])")
        lines.append(f"trial = ({', '.join(states)},)")
        if nodes[s] != nodes[s - 1]:
            lines.append(f"u = forcing(t + {float(nodes[s])!r} * h, c)")
        lines.append(f"k{s} = rhs(trial, u, c)")
        lines.append(f"store_rows(w, base + ROWS.slopes + {s * n * WIDTH}, k{s})")
    lines.append("store_rows(w, base + ROWS.trial, trial)")
    scope: dict[str, Any] = {}
    exec("\n    ".join(lines), globals(), scope)
    function: Callable[..., None] = scope["run_stages"]
    return function


def squared_error(w: Any, base: int, rtol: float, atol: float) -> Any:
    """Return the mean square of the scaled error estimate of an attempted step."""
    total = 0.0 * load(w, base + ROWS.step)
    for i in range(N_CONTROLLED):
        row = base + i * WIDTH
        error = ERROR[0] * load(w, row + ROWS.slopes)
        for j in range(2, N_STAGES):
            error = multiply_add(ERROR[j], load(w, row + ROWS.slopes + j * N * WIDTH), error)
        size = maximum(absolute(load(w, row + ROWS.state)), absolute(load(w, row + ROWS.trial)))
        floor = atol * SIZES[i]
        scaled = error / (rtol * size + floor)
        total = multiply_add(scaled, scaled, total)
    h = load(w, base + ROWS.step)
    return (h * h) * total * (1.0 / N_CONTROLLED)


def squared_error_of_two(w: Any, base: int, rtol: float, atol: float) -> Any:
    """Return the mean square of the scaled error of an attempted step, from estimates of two orders.

    With the mean squares E (higher order) and F (lower order), the result is E**2/(E + F/100): Hairer, Norsett and
    Wanner, Solving Ordinary Differential Equations I, section II.10.
    """
    total, other_total = 0.0 * load(w, base + ROWS.step), 0.0 * load(w, base + ROWS.step)
    for i in range(N_CONTROLLED):
        row = base + i * WIDTH
        slope = load(w, row + ROWS.slopes)
        error, other = ERROR[0] * slope, OTHER_ERROR[0] * slope
        for j in range(5, N_STAGES):
            slope = load(w, row + ROWS.slopes + j * N * WIDTH)
            error = multiply_add(ERROR[j], slope, error)
            other = multiply_add(OTHER_ERROR[j], slope, other)
        size = maximum(absolute(load(w, row + ROWS.state)), absolute(load(w, row + ROWS.trial)))
        floor = atol * SIZES[i]
        per = 1.0 / (rtol * size + floor)
        error, other = error * per, other * per
        total = multiply_add(error, error, total)
        other_total = multiply_add(other, other, other_total)
    h = load(w, base + ROWS.step)
    both = maximum(multiply_add(0.01, other_total, total), 1e-300)
    return (h * h) * total * (total / both) * (1.0 / N_CONTROLLED)


def finish_step(w: Any, base: int, rtol: float, atol: float, max_attempts: float) -> bool:
    """Accept or reject the attempted step in each SIMD lane. Set the next step size and the code of the event, if any,
    at the step's end.

    Return whether a lane of the group has an event.
    """
    e2 = minimum(squared_error(w, base, rtol, atol), 1e20)
    factor = SAFETY * exp2_rough(log2_rough(maximum(e2, 1e-20)) * (-0.5 / ORDER))
    bounded = minimum(maximum(factor, SHRINK), GROW)
    bounded = where_less(0.5, load(w, base + ROWS.after_rejection), minimum(bounded, 1.0), bounded)
    h = load(w, base + ROWS.step)
    wish = load(w, base + ROWS.wish)
    t = load(w, base + ROWS.time)
    target = load(w, base + ROWS.target)
    rejected = where_less(1.0, e2, 1.0, 0.0)
    # a step shorter than error control allowed (`wish`), because of a layer or a segment's end: keep the wish,
    # unless the error shows that it is too long or could be longer
    next_wish = where_less(h, wish, minimum(h * factor, maximum(wish, h * bounded)), h * bounded)
    next_wish = where_less(0.5, rejected, h * bounded, next_wish)
    stepped = where_less(0.0, h, 1.0, 0.0)
    next_wish = where_less(0.5, stepped, next_wish, wish)
    if HAS_EVENTS:
        aimed = load(w, base + ROWS.aimed)
        if HAS_SURFACES:
            hides = hides_events(w, base)
            next_wish = where_less(0.5, hides, minimum(next_wish, 0.5 * h), next_wish)
            rejected = maximum(rejected, hides)
        if SECTION_TURNS:
            far = turns_too_far(w, base)
            next_wish = where_less(0.5, far, minimum(next_wish, 0.5 * h), next_wish)
            rejected = maximum(rejected, far)
        verdict = judge_events(w, base, rejected)
        taken_back = where_less(absolute(verdict - TAKE_BACK), 0.5, 1.0, 0.0)
        # the length of an attempt that ends at an event does not tell which length error control allows
        as_before = maximum(taken_back, where_less(0.0, aimed, 1.0 - rejected, 0.0))
        next_wish = where_less(0.5, as_before, wish, next_wish)
        rejected = maximum(rejected, taken_back)
    store(w, base + ROWS.wish, next_wish)
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
    # count attempts of length 0, too; otherwise a lane whose time does not advance would never end
    attempts = load(w, base + ROWS.attempts) + (1.0 - load(w, base + ROWS.fresh))
    store(w, base + ROWS.attempts, attempts)
    store(w, base + ROWS.steps, load(w, base + ROWS.steps) + stepped * (1.0 - rejected))
    store(w, base + ROWS.rejected, load(w, base + ROWS.rejected) + rejected)
    store(w, base + ROWS.after_rejection, rejected)
    store(w, base + ROWS.fresh, 0.0 * h)
    event = where_less(0.5, arrived, REACHED, where_less(max_attempts, attempts, TOO_MANY_STEPS, NOTHING))
    if HAS_EVENTS:
        lands = where_less(absolute(verdict - LANDED), 0.5, 1.0, 0.0)
        in_time = where_less(max_attempts, attempts, event, CROSSED)
        event = where_less(0.5, lands, in_time, event)
    # of a stiff method the first steps are by far the shortest, where time has all its digits
    period = load(w, base + ROWS.period)
    tiny = 1e-15 * (maximum(t_new, 1e-15 * period) if IS_STIFF else period)
    event = where_less(next_wish, tiny, UNDERFLOW, event)
    if REWRITES:
        last = load(w, base + ROWS.state + (N - 1) * WIDTH)
        event = where_less(event, 0.5, where_less(last, RENEW_BELOW, DUE, event), event)
    store(w, base + ROWS.event, event)
    return any_nonzero(event)


def attempt(
    w: Any, events: Any, n_watching: Any, n_groups: int, slack: float, rtol: float, atol: float, max_attempts: float
) -> None:
    """Attempt one step in all groups of SIMD lanes.

    Write to `events`, per group, whether one of its lanes has an event. `n_watching` holds, per group, the number of
    lanes whose quantities are tracked in the present period.
    """
    for group in range(n_groups):
        base = group * ROWS.size
        choose_step(w, base, slack)
        run_stages(w, base)
        if WATCHES and n_watching[group] > 0:
            evaluate_watched(w, base)
        events[group] = finish_step(w, base, rtol, atol, max_attempts)
        if WATCHES and n_watching[group] > 0:
            update_extremes(w, base)


def iterate(
    w: Any, events: Any, n_watching: Any, n_groups: int, slack: float, rtol: float, atol: float, max_attempts: float
) -> None:
    """Iterate a map once in all groups of SIMD lanes: `attempt` of a system that is a map."""
    for group in range(n_groups):
        base = group * ROWS.size
        run_stages(w, base)
        for i in range(N):
            row = base + i * WIDTH
            store(w, row + ROWS.state, load(w, row + ROWS.slopes + N * WIDTH))
        store(w, base + ROWS.steps, load(w, base + ROWS.steps) + 1.0)
        store(w, base + ROWS.event, REACHED + 0.0 * load(w, base + ROWS.step))
        events[group] = 1


def load_cell(
    w: Any, base: int, lane: int, frequency: float, p: Any, slack: float, scratch: Any, edge_table: Any
) -> None:
    """Load the constants and forcing edges of a parameter point into a SIMD lane; leave the lane's state unchanged."""
    constants(frequency, p, scratch)
    for i in range(N_OWN):
        w[base + ROWS.constants + i * WIDTH + lane] = scratch[i]
    period = 1.0 / frequency
    edges(frequency, p, edge_table[0], edge_table[1], edge_table[2])
    if NE > 0:
        for i in range(NE):
            edge_table[2, i] = step_ratio(slack / (edge_table[2, i] * edge_table[1, i]))
    w[base + ROWS.period + lane] = period
    w[base + ROWS.steps + lane] = 0.0
    w[base + ROWS.rejected + lane] = 0.0
    if HAS_SECTION:
        w[base + ROWS.level + lane] = p[len(p) - 1]


def begin_period(w: Any, base: int, lane: int, edge_table: Any) -> int:
    """Set the time of a SIMD lane to 0, the start of a drive period; return the index of the forcing edge to integrate
    to.
    """
    w[base + ROWS.time + lane] = 0.0
    w[base + ROWS.attempts + lane] = 0.0
    # The last slope was computed at time `period`, where the forcing differs by rounding from time 0. Compute it
    # again, so that a later call that continues this branch has the same bits. After a level crossing the slope
    # does not change; then it is computed again only if quantities are tracked, which need values here.
    if WATCHES or not HAS_SECTION:
        w[base + ROWS.fresh + lane] = 1.0
    if NE > 0 and edge_table[0, 0] == 0.0:
        set_target(w, base, lane, 0.0, edge_table, ZERO)
        return begin_segment(w, base, lane, edge_table, ZERO + 1)
    set_target(w, base, lane, 0.0, edge_table, ZERO + NE)
    return begin_segment(w, base, lane, edge_table, ZERO)


def set_target(w: Any, base: int, lane: int, time: float, edge_table: Any, edge: int) -> None:
    """Set the end of a SIMD lane's present time segment: forcing edge `edge` at `time`, or no edge if ``edge =
    n_edges``.
    """
    w[base + ROWS.target + lane] = time
    w[base + ROWS.target_width + lane] = edge_table[1, edge] if edge < NE else np.inf
    ratio = edge_table[2, edge] if edge < NE else 1.0
    w[base + ROWS.target_ratio + lane] = ratio
    w[base + ROWS.target_share + lane] = ratio / (1.0 + ratio)


def begin_segment(w: Any, base: int, lane: int, edge_table: Any, edge: int) -> int:
    """Begin the next time segment of a SIMD lane, up to forcing edge `edge` or, with ``edge = n_edges``, the period's
    end.
    """
    w[base + ROWS.start + lane] = w[base + ROWS.target + lane]
    w[base + ROWS.start_width + lane] = w[base + ROWS.target_width + lane]
    w[base + ROWS.start_ratio + lane] = w[base + ROWS.target_ratio + lane]
    if HAS_SEGMENTS:
        w[base + ROWS.constants + (NC - 1) * WIDTH + lane] = edge
        w[base + ROWS.fresh + lane] = 1.0
        if HAS_SWITCHES:
            keep_switches(w, base, lane)
        if HAS_CONTACTS:
            seat_contacts(w, base, lane, False)
    if edge < NE:
        set_target(w, base, lane, edge_table[0, edge], edge_table, edge)
        return edge
    # the segment ends with the period; at this instant edge 0 follows, if that is at time 0
    first = ZERO if NE > 0 and edge_table[0, 0] == 0.0 else ZERO + NE
    set_target(w, base, lane, w[base + ROWS.period + lane], edge_table, first)
    return NE


def in_bounds(w: Any, base: int, lane: int) -> bool:
    """Return whether all states in a SIMD lane are finite and within their bounds."""
    for i in range(N):
        if not abs(w[base + ROWS.state + i * WIDTH + lane]) <= ESCAPE[i]:
            return False
    return True


def take_section(w: Any, base: int, lane: int, section: Any, turns: Any) -> bool:
    """Copy the state of a SIMD lane to `section`, with angles wrapped to (-pi, pi] in both; return whether it is in
    bounds.
    """
    good = in_bounds(w, base, lane)
    for i in range(N):
        at = base + ROWS.state + i * WIDTH + lane
        x = w[at]
        if good and IS_ANGLE[i] == 1 and not (-math.pi < x <= math.pi):
            n = math.ceil((x - math.pi) / TWO_PI)
            x -= n * TWO_PI
            # rounding can leave x at or below -pi
            if x <= -math.pi:
                x = math.pi
            turns[i] += n
            w[at] = x
            w[base + ROWS.fresh + lane] = 1.0
        section[i] = x
    return good


def move_lane(w: Any, source: int, target: int) -> None:
    """Copy all rows of the work array that belong to one SIMD lane to another lane."""
    a = (source // WIDTH) * ROWS.size + source % WIDTH
    b = (target // WIDTH) * ROWS.size + target % WIDTH
    for row in range(0, ROWS.size, WIDTH):
        w[b + row] = w[a + row]


def renew_state(w: Any, base: int, lane: int, state: Any, memory: Any, settings: Any) -> None:
    """Let the observer's function `renew` change the state of the trajectory in a SIMD lane."""
    for i in range(N):
        state[i] = w[base + ROWS.state + i * WIDTH + lane]
    renew(state, memory, settings)
    for i in range(N):
        w[base + ROWS.state + i * WIDTH + lane] = state[i]
    w[base + ROWS.fresh + lane] = 1.0


class Work(NamedTuple):
    """Working arrays and bookkeeping of `advance`, mostly one entry or row per SIMD lane."""

    lanes: Any  # float64, the groups' rows
    branch: Any  # int64
    point: Any  # int64, within the branch
    edge: Any  # int64, the edge at the end of the segment
    i_period: Any  # int64, completed periods of this cell
    turns: Any  # int64 (lanes, n_states), since the branch's start
    edge_table: Any  # float64 (lanes, 3, n_edges): time [s], half-width [s], step_ratio
    memory: Any  # float64 (lanes, n_memory), the observer's own
    watching: Any  # int64, 1 in a period whose extremes are wanted
    n_watching: Any  # int64 per group: sum of the above
    events: Any  # int64 per group: whether one of its lanes has an event
    scratch: Any  # float64, for constants and for states
    section: Any  # float64 (n_states,)
    queue: Any  # int64 (1,), the next branch: shared by all threads


class Cells(NamedTuple):
    """Input and output arrays of `advance`; the first two dims are branch and parameter point."""

    frequency: Any  # Hz
    parameters: Any  # (..., n_parameters)
    slack: float  # see step_ratio
    state: Any  # (branch, n_states): initial, at the end final
    step_size: Any  # (branch,): initial [s] or 0, at the end the next
    turns: Any  # int64 (branch, n_states): at the end the turns since the start
    final_state: Any  # (..., n_states), last state of each cell; NaN for a cell that was not reached
    next_step: Any  # s, step size to continue with from there; NaN after a failure
    section: Any  # (..., n_keep, n_states)
    measures: Any  # (..., n_measures)
    status: Any  # int64
    n_periods: Any  # int64
    n_steps: Any  # int64, accepted
    n_rejected: Any  # int64
    watched: Any  # (..., n_keep, n_watched, 3), see `watching`; size 0 if nothing is tracked
    return_times: Any  # (..., n_keep), s, time since the previous section; size 0 for a stroboscopic section


def start_branch(cells: Cells, work: Work, lane: int, branch: int, settings: Any, scratch: Any) -> None:
    """Load the initial state and the first parameter point of a branch into a SIMD lane."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    for i in range(N):
        w_at = base + ROWS.state + i * WIDTH + column
        work.lanes[w_at] = cells.state[branch, i]
        work.turns[lane, i] = 0
    work.branch[lane] = branch
    start_point(cells, work, lane, ZERO, settings, scratch)
    # the given angles are not wrapped; from here on they lie in (-pi, pi] at every section
    take_section(work.lanes, base, column, scratch, work.turns[lane])
    given = cells.step_size[branch]
    cautious = FIRST_STEP * work.lanes[base + ROWS.period + column]
    work.lanes[base + ROWS.wish + column] = given if given > 0.0 else cautious


def start_point(cells: Cells, work: Work, lane: int, point: int, settings: Any, scratch: Any) -> None:
    """Start the parameter point `point` of a lane's branch from the state in which the previous point ended."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    branch = work.branch[lane]
    frequency = cells.frequency[branch, point]
    p = cells.parameters[branch, point]
    load_cell(work.lanes, base, column, frequency, p, cells.slack, scratch, work.edge_table[lane])
    work.edge[lane] = begin_period(work.lanes, base, column, work.edge_table[lane])
    work.point[lane] = point
    work.i_period[lane] = 0
    for i in range(work.memory.shape[1]):
        work.memory[lane, i] = 0.0
    work.lanes[base + ROWS.fresh + column] = 1.0
    work.lanes[base + ROWS.after_rejection + column] = 0.0
    work.lanes[base + ROWS.event + column] = NOTHING
    if HAS_EVENTS:
        begin_events(work.lanes, base, column)
    if WATCHES:
        begin_watch(work, lane, keeps_next(0, work.memory[lane], settings))


def has_failed(status: int) -> bool:
    """Return whether a status means that the trajectory failed and its section points must not be used."""
    return status == DIVERGED or status == STEP_LIMIT or status == STEP_UNDERFLOW or status == ENDS_IN_CHATTER


def forget(cells: Cells, branch: int, point: int) -> None:
    """Set the recorded section points of a failed trajectory to NaN."""
    for i in range(cells.section.shape[2]):
        for k in range(N):
            cells.section[branch, point, i, k] = np.nan
        if WATCHES:
            cells.watched[branch, point, i] = np.nan
        if HAS_SECTION:
            cells.return_times[branch, point, i] = np.nan


def end_cell(cells: Cells, work: Work, lane: int, status: int) -> None:
    """Write status, counts and final state of a trajectory that has ended at one parameter point."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    at = (work.branch[lane], work.point[lane])
    cells.status[at] = status
    cells.n_periods[at] = work.i_period[lane]
    cells.n_steps[at] = int(work.lanes[base + ROWS.steps + column])
    cells.n_rejected[at] = int(work.lanes[base + ROWS.rejected + column])
    for i in range(N):
        cells.final_state[at][i] = work.lanes[base + ROWS.state + i * WIDTH + column]
    if not has_failed(status):
        cells.next_step[at] = work.lanes[base + ROWS.wish + column]
    if has_failed(status) or status == NO_RETURN:
        forget(cells, work.branch[lane], work.point[lane])


def end_branch(cells: Cells, work: Work, lane: int, status: int) -> None:
    """Write the last state of a branch, and mark the parameter points that it did not reach."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    branch = work.branch[lane]
    for point in range(work.point[lane] + 1, cells.frequency.shape[1]):
        cells.status[branch, point] = UNREACHED
        forget(cells, branch, point)
    for i in range(N):
        cells.state[branch, i] = work.lanes[base + ROWS.state + i * WIDTH + column]
        cells.turns[branch, i] = work.turns[lane, i]
    cells.step_size[branch] = work.lanes[base + ROWS.wish + column]


def serve(cells: Cells, work: Work, lane: int, settings: Any, section: Any, scratch: Any) -> bool:
    """Handle the end of a SIMD lane's segment or period, or its failure. Return whether the lane's branch has ended."""
    w, base, column = work.lanes, (lane // WIDTH) * ROWS.size, lane % WIDTH
    event = w[base + ROWS.event + column]
    w[base + ROWS.event + column] = NOTHING
    status = PENDING
    if HAS_EVENTS and event == CROSSED:
        on_section = act_on_events(w, base, column)
        if HAS_IMPACTS and w[base + ROWS.event + column] == CHATTERED:
            event = CHATTERED
        elif not on_section:
            return False
    if REWRITES and (event == REACHED or event == DUE or event == CROSSED):
        renew_state(w, base, column, section, work.memory[lane], settings)
        if event == DUE:
            return False
    if event == REACHED and work.edge[lane] < NE:
        work.edge[lane] = begin_segment(w, base, column, work.edge_table[lane], work.edge[lane] + 1)
        return False
    if event == (CROSSED if HAS_SECTION else REACHED):
        work.i_period[lane] += 1
        if HAS_CONTACTS:
            hold_contacts(w, base, column)
        if take_section(w, base, column, section, work.turns[lane]):
            at = (work.branch[lane], work.point[lane])
            if HAS_SECTION:
                keep_time(w, base, column, work.memory[lane], cells.return_times[at])
            if WATCHES and work.watching[lane] == 1:
                keep_extremes(w, base, column, cells.watched[at][n_kept(work.memory[lane])])
            status = observe(
                section,
                work.turns[lane],
                work.i_period[lane],
                work.memory[lane],
                cells.section[at],
                cells.measures[at],
                settings,
            )
        else:
            status = DIVERGED
        if status == PENDING:
            work.edge[lane] = begin_period(w, base, column, work.edge_table[lane])
            if WATCHES:
                begin_watch(work, lane, keeps_next(work.i_period[lane], work.memory[lane], settings))
            return False
    elif not in_bounds(w, base, column):
        # a divergent trajectory ends with too short steps, before a section could show the divergence
        status = DIVERGED
    elif event == REACHED:
        status = NO_RETURN
    elif event == TOO_MANY_STEPS:
        status = STEP_LIMIT
    elif HAS_IMPACTS and event == CHATTERED:
        status = ENDS_IN_CHATTER
    else:
        status = STEP_UNDERFLOW
    end_cell(cells, work, lane, status)
    if has_failed(status) or work.point[lane] + 1 == cells.frequency.shape[1]:
        end_branch(cells, work, lane, status)
        return True
    start_point(cells, work, lane, work.point[lane] + 1, settings, scratch)
    return False


def keep_time(w: Any, base: int, lane: int, memory: Any, out: Any) -> None:
    """Store the time since the previous section point in the observer's memory and, while room is left, in the output
    array.
    """
    time = w[base + ROWS.time + lane]
    memory[len(memory) - 1] = time
    if n_kept(memory) < len(out):
        out[n_kept(memory)] = time


def work_for(system: System, observer: Observer, cells: Cells, n_lanes: int, settings: Any, queue: np.ndarray) -> Work:
    """Allocate the working arrays for `n_lanes` SIMD lanes."""
    n_groups = -(-min(n_lanes, len(cells.frequency)) // WIDTH)
    size = n_groups * WIDTH
    memory_size = getattr(observer.memory_size, "py_func", observer.memory_size)
    n_memory = memory_size(settings, system.n_states) + (system.section is not None)
    rows = rows_of(system, cells.watched.shape[-2])
    return Work(
        lanes=np.zeros(n_groups * rows.size),
        branch=np.zeros(size, np.int64),
        point=np.zeros(size, np.int64),
        edge=np.zeros(size, np.int64),
        i_period=np.zeros(size, np.int64),
        turns=np.zeros((size, system.n_states), np.int64),
        edge_table=np.zeros((size, 3, max(system.n_edges, 1))),
        memory=np.zeros((size, n_memory)),
        watching=np.zeros(size, np.int64),
        n_watching=np.zeros(n_groups, np.int64),
        events=np.zeros(n_groups, np.int64),
        scratch=np.zeros(max(system.n_constants + system.n_modes, system.n_states)),
        section=np.zeros(system.n_states),
        queue=queue,
    )


def advance(
    cells: Cells, work: Work, n_lanes: int, rtol: float, atol: float, max_attempts: float, settings: Any
) -> None:
    """Integrate the branches of the queue in SIMD lanes, at most `n_lanes` branches at the same time, and fill the
    output arrays of `cells`.
    """
    n_branches = cells.frequency.shape[0]
    branch, active = ZERO, ZERO
    # local names: numba counts references of a tuple's field atomically at every use, too slow per lane
    rows, events, scratch, section = work.lanes, work.events, work.scratch, work.section
    for lane in range(len(work.branch)):
        following = take(work.queue) if lane < n_lanes else n_branches
        if following < n_branches:
            branch, active = following, lane + 1
        elif active == 0:
            return
        # spare lanes of the last group repeat the last branch, so that they hold valid numbers; nothing reads them
        start_branch(cells, work, lane, branch, settings, scratch)
    while active > 0:
        in_use = (active + WIDTH - 1) // WIDTH
        attempt(rows, events, work.n_watching, in_use, cells.slack, rtol, atol, max_attempts)
        for group in range(in_use):
            if events[group] == 0:
                continue
            lane, last = group * WIDTH, group * WIDTH + WIDTH
            last = last if last < active else active
            while lane < last:
                event = rows[group * ROWS.size + ROWS.event + lane % WIDTH]
                if event == NOTHING or not serve(cells, work, lane, settings, section, scratch):
                    lane += 1
                    continue
                branch = take(work.queue)
                if branch < n_branches:
                    start_branch(cells, work, lane, branch, settings, scratch)
                    lane += 1
                else:
                    # no branch is left for this lane: move the last active lane here and serve it next
                    active -= 1
                    copy_lane(work, active, lane)
                    last = last if last < active else active


def copy_lane(work: Work, source: int, target: int) -> None:
    """Copy all data of one SIMD lane to another lane, bookkeeping included."""
    move_lane(work.lanes, source, target)
    work.branch[target] = work.branch[source]
    work.point[target] = work.point[source]
    work.edge[target] = work.edge[source]
    work.i_period[target] = work.i_period[source]
    for i in range(N):
        work.turns[target, i] = work.turns[source, i]
    for i in range(NE):
        for k in range(3):
            work.edge_table[target, k, i] = work.edge_table[source, k, i]
    for i in range(work.memory.shape[1]):
        work.memory[target, i] = work.memory[source, i]
    if WATCHES:
        set_watching(work, target, work.watching[source])
        set_watching(work, source, 0)


_INLINE = (
    "step_ratio",
    "squared_error",
    "load_cell",
    "set_target",
    "begin_segment",
    "begin_period",
    "in_bounds",
    "take_section",
    "renew_state",
    "move_lane",
    "has_failed",
    "evaluate_watched",
    "update_extremes",
    "keep_extremes",
    "set_watching",
    "begin_watch",
    "keep_time",
)
_CALLED = (
    "limited_by_layers",
    "choose_step",
    "run_stage",
    "run_stages",
    "finish_step",
    "attempt",
    "forget",
    "end_cell",
    "end_branch",
    "start_point",
    "start_branch",
    "serve",
    "copy_lane",
)


def _name(system: System, observer: Observer, watched: tuple[int, ...]) -> str:
    return "_".join([system.label, observer.name, *(["watch"] if watched else []), *map(str, watched)])


def _layers_at(system: System) -> Callable[..., Any]:
    """Return ``system.layers`` with the time as an additional first argument."""
    rates = "dy + (t,)" if system.timed_layers else "dy"
    scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_layers": system.layers}
    exec(f"def layers_at(t, y, dy, c):\n    return _layers(y, {rates}, c)\n", scope)
    return inline(scope["layers_at"])


def engine_bindings(system: System, observer: Observer, watched: tuple[int, ...] = ()) -> dict[str, Any]:
    """Return the values of this module's free global names (such as ``N``, ``rhs``) for a system and an observer."""
    bindings: dict[str, Any] = {
        "ROWS": rows_of(system, len(watched)),
        "WATCHES": len(watched) > 0,
        "N_WATCHED": len(watched),
        "watched_values": watched_function(system, watched),
        "n_kept": observer.n_kept,
        "keeps_next": observer.keeps_next,
        "N": system.n_states,
        "N_CONTROLLED": system.controlled,
        "NC": system.n_constants + system.n_modes,
        "N_OWN": system.n_constants,
        "N_STAGES": system.tableau.n_stages,
        "NODES": system.tableau.nodes,
        "STAGES": system.tableau.stages,
        "ERROR": system.tableau.error,
        "OTHER_ERROR": system.tableau.other_error,
        "ORDER": float(system.tableau.order),
        "DENSE": system.tableau.dense,
        "MIDDLE": system.tableau.middle,
        "FIRST_WEIGHED": 2 - system.is_stiff,
        "IS_STIFF": system.is_stiff,
        **event_bindings(system),
        **mode_bindings(system),
        "NE": system.n_edges,
        "HAS_LAYERS": system.has_layers,
        "LAYERS_FADE": system.layers_fade,
        "REWRITES": observer.rewrites,
        "RENEW_BELOW": observer.renew_below,
        "IS_ANGLE": np.array(system.is_angle, np.int64),
        "SCALES": np.array(system.units),
        "SIZES": np.array(system.sizes),
        "ESCAPE": np.where(system.is_angle, np.minimum(system.escape, FARTHEST), system.escape),
        "constants": system.constants,
        "edges": system.edges,
        "forcing": system.forcing,
        "rhs": system.rhs,
        "layers_at": _layers_at(system),
        "memory_size": observer.memory_size,
        **observer.bindings,
        **tangent_bindings(system),
        **implicit_bindings(system),
    }
    lengths = code_length(system.rhs) + code_length(system.forcing)
    short = lengths <= UNROLLED_LENGTH and not bindings["CARRIES"]
    for key in observers.HELPERS:
        bindings[key] = bound_part(getattr(observers, key), bindings, True)
    bindings["observe"] = bound_part(observer.observe, bindings, True)
    bindings["renew"] = bound_part(observer.renew, bindings, True)
    templates: dict[str, Any] = {}
    for module in (event_templates, mode_templates):
        templates |= {key: getattr(module, key) for key in (*module.INLINE, *module.CALLED)}
    templates |= {key: globals()[key] for key in (*_INLINE, *_CALLED)}
    if system.is_stiff or bindings["CARRIES"]:
        rooms = (tangent_templates, rosenbrock) if system.is_stiff else (tangent_templates,)
        for room in reversed(rooms):  # callees come first
            templates = {key: getattr(room, key) for key in (*room.INLINE, *room.CALLED)} | templates
        templates["run_stages"] = rooms[-1].run_stages
        if system.is_stiff:
            templates |= rosenbrock.own_templates(bindings)
    elif system.n_states <= UNROLLED_STATES + short and not system.is_map:
        templates["run_stages"] = unrolled_stages(system)
    if system.is_map:
        templates["attempt"] = iterate
    if system.tableau.has_two_errors:
        templates["squared_error"] = squared_error_of_two
    dissolving = {*event_templates.INLINE, *mode_templates.INLINE, *tangent_templates.INLINE}
    dissolving |= {*rosenbrock.INLINE, *_INLINE}
    for key, template in templates.items():
        bindings[key] = bound_part(template, bindings, key in dissolving)
    return bindings


def engine_of(system: System, observer: Observer, watched: tuple[int, ...] = ()) -> Callable[..., None]:
    """Compile `advance` for a system, an observer, and the quantities whose minimum, maximum and mean are recorded.

    `watched` holds their indices in ``system.state_names + system.quantity_names``.
    """
    return _engine_of(system.plain, observer, watched)


@cache
def _engine_of(system: System, observer: Observer, watched: tuple[int, ...]) -> Callable[..., None]:
    bindings = engine_bindings(system, observer, watched)
    rest = observer.n_kept, observer.keeps_next
    kept = keeping(*system.functions, observer.observe, observer.memory_size, observer.renew, *rest)
    compiled = entry(advance, _name(system, observer, watched), bindings, kept)

    @wraps(compiled)
    def engine(cells: Cells, n_lanes: int, rtol: float, atol: float, attempts: float, settings: Any) -> None:
        def run(queue: np.ndarray, n_lanes: int) -> None:
            work = work_for(system, observer, cells, n_lanes, settings, queue)
            compiled(cells, work, n_lanes, rtol, atol, attempts, settings)

        share(run, len(cells.frequency), n_lanes)

    return engine
