"""Integrate many trajectories with white noise in SIMD lanes, by steps of fixed length.

Each drive period is divided into equal steps. Additive noise is integrated by the method SRA3, of strong order
1.5 (and of order 3 without noise): A. Roessler, Runge-Kutta methods for the strong approximation of solutions of
stochastic differential equations, SIAM J. Numer. Anal. 48 (2010) 922-952, section 5. With the increment W of the
Wiener process over a step h and its area A = (1/h) int_0^h W(s) ds,

    k1 = f(t, x),  k2 = f(t + h, x + h k1),  k3 = f(t + h/2, x + h (k1 + k2)/4 + 3/2 b A)
    x' = x + h (k1 + k2 + 4 k3)/6 + b W.

Strengths that depend on states that have no noise add (b(x + h k1) - b(x)) (W - A), the same paper's rule for
strengths that change in time: the order stays 1.5. Strengths that depend on their own state add the term of
Milstein without derivatives, (b(x + b sqrt(h)) - b(x)) (W**2 - h)/(2 sqrt(h)) in the interpretation of Ito, with
W**2 instead of W**2 - h in that of Stratonovich: the order is 1. P. E. Kloeden and E. Platen, Numerical Solution of
Stochastic Differential Equations, Springer 1992, eqs. (11.1.3) and (11.1.7).

W and A are normal numbers: W = sqrt(h) n1, A = W/2 + H with H = sqrt(h/12) n2 independent of W. For halved steps on
the same path they are split by J. Foster, T. Lyons and H. Oberhauser, An optimal polynomial approximation of
Brownian motion, SIAM J. Numer. Anal. 58 (2020) 1393-1421: W1 = W/2 + 3 H/2 + Z, H1 = H/4 - Z/2 + N/2,
W2 = W - W1, H2 = H/4 - Z/2 - N/2 with Z = sqrt(h/16) n3 and N = sqrt(h/12) n4.

The functions here are templates, bound to a system by `noisy_engine_of` (see `lanes`). Reading order, from the
bottom of the file: `advance` is the main loop, `make_steps` moves a group of lanes, `step` makes one step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine import lanes, passage
from magpend_core.engine.jit import bound_part, entry, inline, keeping
from magpend_core.engine.lanes import ZERO
from magpend_core.engine.noise import ITO, Noise
from magpend_core.engine.observers import Observer
from magpend_core.engine.passage import FIRST_HALF, PASSAGE, SECOND_HALF, WHOLE, watched_step
from magpend_core.engine.random_numbers import normal_pair, tag_word
from magpend_core.engine.simd import WIDTH, load, load_rows, store, store_rows, take
from magpend_core.engine.system import System
from magpend_core.engine.threads import share
from magpend_core.status import Status

PENDING, DIVERGED = int(Status.PENDING), int(Status.DIVERGED)
PATH, BRIDGE = 0, 1
"""Purposes of the random numbers of a step: the path, and its refinement. `passage.LEAVING` is another."""
ROOT_TWELFTH = math.sqrt(1.0 / 12.0)
ROOT_HALF = math.sqrt(0.5)


class NoisyRows(NamedTuple):
    """Offsets of the rows in the work array of a group of SIMD lanes, in float64 numbers from the group's first."""

    state: int
    first_slope: int  # n_states rows, so below
    second_slope: int
    third_slope: int
    trial: int
    strength: int  # a row for each noise, so below
    strength_ahead: int  # at the end of the step, without noise in it
    strength_beside: int  # at the state moved by noise alone
    wiener: int  # W of the step
    rest: int  # H of the step
    wiener_next: int  # of the second half of a halved step
    rest_next: int
    step: int  # s
    root: int  # square root of the step
    done: int  # steps since the begin of the period
    total: int  # steps since the begin of the cell
    low: int  # words that identify the cell
    high: int
    fresh: int  # written by `lanes.take_section`, read by nobody
    constants: int
    centre: int  # of the region, see `passage`; these rows exist with the observer `PASSAGE` alone
    low_face: int
    high_face: int
    weight: int
    begin: int  # state at the begin of the step
    place: int  # state at the end of the step in which the path left
    held_strength: int
    radius: int
    passed: int  # steps since the begin of the cell until the path left
    size: int


def noisy_rows_of(system: System, noise: Noise, observer: Observer) -> NoisyRows:
    """Return the row layout of the work array for a group of SIMD lanes."""
    n, k = system.n_states, len(noise.states)
    watched = [*[n] * 6, k, 1, 1] if observer is PASSAGE else [0] * 9
    counts = [*[n] * 5, *[k] * 7, *[1] * 7, system.n_constants, *watched]
    offsets = np.concatenate([[0], np.cumsum(counts)]) * WIDTH
    return NoisyRows(*(int(x) for x in offsets))


class NoisyCells(NamedTuple):
    """Input and output arrays of `advance`; the first dim is the cell."""

    frequency: Any  # Hz
    parameters: Any  # (cell, n_parameters)
    initial: Any  # (cell, n_states)
    words: Any  # (cell, 2): words that identify the cell
    first_period: Any  # int64: periods that the cell has behind it
    n_steps: Any  # int64: steps per period
    section: Any  # (cell, n_keep, n_states)
    measures: Any  # (cell, n_measures)
    turns: Any  # int64 (cell, n_states): full turns since the begin
    before: Any  # (cell, n_states): state at the begin of the last period
    status: Any  # int64
    n_periods: Any  # int64, integrated here
    region: Any  # a `passage.Region`; without entries but for the observer `PASSAGE`


class NoisyWork(NamedTuple):
    """Working arrays and bookkeeping of `advance`, mostly one entry or row per SIMD lane."""

    lanes: Any  # float64, the groups' rows
    cell: Any  # int64
    left: Any  # int64, steps to the end of the period
    i_period: Any  # int64, completed periods
    turns: Any  # int64 (lanes, n_states)
    memory: Any  # float64 (lanes, n_memory), the observer's own
    scratch: Any  # float64, for constants and for states
    section: Any  # float64 (n_states,)
    queue: Any  # int64 (1,), the next cell: shared by all threads


def slope(w: Any, base: int, state: int, time: Any, out: int) -> None:
    """Compute the right-hand side at the state in the rows that begin at `state`, and write it to those at `out`."""
    c = load_rows(w, base + ROWS.constants, NC)
    y = load_rows(w, state, N)
    store_rows(w, out, rhs(y, forcing(time, c), c))


def strengths(w: Any, base: int, state: int, out: int) -> None:
    """Compute the strengths of the noises at the state in the rows that begin at `state`, and write them to those at
    `out`.
    """
    c = load_rows(w, base + ROWS.constants, NC)
    y = load_rows(w, state, N)
    store_rows(w, out, strengths_of(y, c))


def draw(w: Any, base: int, keys: Any) -> None:
    """Draw the increments W and H of all noises over a step."""
    count, root = load(w, base + ROWS.total), load(w, base + ROWS.root)
    low, high = load(w, base + ROWS.low), load(w, base + ROWS.high)
    for j in range(N_SOURCES):
        first, second = normal_pair(count, low, high, PATH_TAGS[j], keys)
        store(w, base + ROWS.wiener + j * WIDTH, root * first)
        store(w, base + ROWS.rest + j * WIDTH, (ROOT_TWELFTH * root) * second)


def split(w: Any, base: int, keys: Any) -> None:
    """Split the increments over a step into those over its two halves, on the same path."""
    count, root = load(w, base + ROWS.total), load(w, base + ROWS.root)
    low, high = load(w, base + ROWS.low), load(w, base + ROWS.high)
    for j in range(N_SOURCES):
        first, second = normal_pair(count, low, high, BRIDGE_TAGS[j], keys)
        shift, turn = (0.25 * root) * first, (0.5 * ROOT_TWELFTH * root) * second
        at = base + j * WIDTH
        whole, rest = load(w, at + ROWS.wiener), load(w, at + ROWS.rest)
        half = 0.5 * whole + (1.5 * rest + shift)
        mean = 0.25 * rest - 0.5 * shift
        store(w, at + ROWS.wiener, half)
        store(w, at + ROWS.rest, mean + turn)
        store(w, at + ROWS.wiener_next, whole - half)
        store(w, at + ROWS.rest_next, mean - turn)


def second_half(w: Any, base: int) -> None:
    """Put the increments over the second half of a halved step where `step` reads them."""
    for j in range(N_SOURCES):
        at = base + j * WIDTH
        store(w, at + ROWS.wiener, load(w, at + ROWS.wiener_next))
        store(w, at + ROWS.rest, load(w, at + ROWS.rest_next))


def strengths_beside(w: Any, base: int, root: Any) -> None:
    """Compute the strengths at the state moved by one square root of the step along the noise."""
    for i in range(N):
        store(w, base + ROWS.trial + i * WIDTH, load(w, base + ROWS.state + i * WIDTH))
    for j in range(N_SOURCES):
        at = base + ROWS.trial + NOISY[j] * WIDTH
        store(w, at, load(w, at) + root * load(w, base + ROWS.strength + j * WIDTH))
    strengths(w, base, base + ROWS.trial, base + ROWS.strength_beside)


def step(w: Any, base: int, time: Any, h: Any, root: Any) -> None:
    """Make one step from the time `time` in all lanes of a group, with the increments that were drawn."""
    if MILSTEIN:
        strengths_beside(w, base, root)
    slope(w, base, base + ROWS.state, time, base + ROWS.first_slope)
    for i in range(N):
        row = base + i * WIDTH
        store(w, row + ROWS.trial, load(w, row + ROWS.state) + h * load(w, row + ROWS.first_slope))
    slope(w, base, base + ROWS.trial, time + h, base + ROWS.second_slope)
    if MULTIPLICATIVE:
        strengths(w, base, base + ROWS.trial, base + ROWS.strength_ahead)
    for i in range(N):
        row = base + i * WIDTH
        total = load(w, row + ROWS.first_slope) + load(w, row + ROWS.second_slope)
        store(w, row + ROWS.trial, load(w, row + ROWS.state) + (0.25 * h) * total)
    for j in range(N_SOURCES):
        row, at = base + j * WIDTH, base + ROWS.trial + NOISY[j] * WIDTH
        area = 0.5 * load(w, row + ROWS.wiener) + load(w, row + ROWS.rest)
        store(w, at, load(w, at) + (1.5 * load(w, row + ROWS.strength)) * area)
    slope(w, base, base + ROWS.trial, time + 0.5 * h, base + ROWS.third_slope)
    for i in range(N):
        row = base + i * WIDTH
        total = load(w, row + ROWS.first_slope) + load(w, row + ROWS.second_slope)
        total = total + 4.0 * load(w, row + ROWS.third_slope)
        store(w, row + ROWS.state, load(w, row + ROWS.state) + (h * (1.0 / 6.0)) * total)
    for j in range(N_SOURCES):
        add_noise(w, base, j, h, root)
    if MULTIPLICATIVE:
        strengths(w, base, base + ROWS.state, base + ROWS.strength)


def add_noise(w: Any, base: int, j: int, h: Any, root: Any) -> None:
    """Add the effect of noise `j` over a step to its state."""
    row, at = base + j * WIDTH, base + ROWS.state + NOISY[j] * WIDTH
    strength, wiener = load(w, row + ROWS.strength), load(w, row + ROWS.wiener)
    kick = strength * wiener
    if MULTIPLICATIVE:
        change = load(w, row + ROWS.strength_ahead) - strength
        kick = kick + change * (0.5 * wiener - load(w, row + ROWS.rest))
    if MILSTEIN:
        slant = (load(w, row + ROWS.strength_beside) - strength) * OWN[j]
        square = wiener * wiener - ITO_TERM * h
        kick = kick + (slant / (2.0 * root)) * square
    store(w, at, load(w, at) + kick)


def make_steps(w: Any, base: int, n: int, keys: Any, halves: bool) -> None:
    """Make `n` steps in all lanes of a group; with `halves`, each as two steps of half the length on the same path."""
    h, root = load(w, base + ROWS.step), load(w, base + ROWS.root)
    strengths(w, base, base + ROWS.state, base + ROWS.strength)
    for _ in range(n):
        done = load(w, base + ROWS.done)
        draw(w, base, keys)
        time = done * h
        if halves:
            split(w, base, keys)
            watched_step(w, base, time, 0.5 * h, ROOT_HALF * root, keys, FIRST_HALF)
            second_half(w, base)
            watched_step(w, base, time + 0.5 * h, 0.5 * h, ROOT_HALF * root, keys, SECOND_HALF)
        else:
            watched_step(w, base, time, h, root, keys, WHOLE)
        store(w, base + ROWS.done, done + 1.0)
        store(w, base + ROWS.total, load(w, base + ROWS.total) + 1.0)


def begin_cell(cells: NoisyCells, work: NoisyWork, lane: int, cell: int, scratch: Any) -> None:
    """Load a cell's initial state and constants into a SIMD lane."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    w, frequency, n = work.lanes, cells.frequency[cell], cells.n_steps[cell]
    constants(frequency, cells.parameters[cell], scratch)
    for i in range(NC):
        w[base + ROWS.constants + i * WIDTH + column] = scratch[i]
    h = 1.0 / frequency / n
    w[base + ROWS.step + column] = h
    w[base + ROWS.root + column] = math.sqrt(h)
    w[base + ROWS.done + column] = 0.0
    w[base + ROWS.total + column] = float(cells.first_period[cell] * n)
    w[base + ROWS.low + column] = cells.words[cell, 0]
    w[base + ROWS.high + column] = cells.words[cell, 1]
    for i in range(N):
        w[base + ROWS.state + i * WIDTH + column] = cells.initial[cell, i]
        work.turns[lane, i] = 0
    for i in range(work.memory.shape[1]):
        work.memory[lane, i] = 0.0
    work.cell[lane] = cell
    work.left[lane] = n
    work.i_period[lane] = 0
    if PASSES:
        begin_watch(cells, cell, w, base, column)
    # angles come in as given; from here on they are in (-pi, pi] at every section
    take_section(w, base, column, scratch, work.turns[lane])
    note_state(cells, work, lane)


def note_state(cells: NoisyCells, work: NoisyWork, lane: int) -> None:
    """Write the state at the begin of a period, from which the step size is checked."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    for i in range(N):
        cells.before[work.cell[lane], i] = work.lanes[base + ROWS.state + i * WIDTH + column]


def end_period(cells: NoisyCells, work: NoisyWork, lane: int, settings: Any, section: Any) -> bool:
    """Record the section of a lane whose period has ended; return whether its cell has ended."""
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    w, cell = work.lanes, work.cell[lane]
    work.i_period[lane] += 1
    work.left[lane] = cells.n_steps[cell]
    w[base + ROWS.done + column] = 0.0
    status = PENDING
    if PASSES:
        status = note_passage(cells, cell, w, base, column)
    if status == PENDING:
        status = DIVERGED
        if take_section(w, base, column, section, work.turns[lane]):
            status = observe(
                section,
                work.turns[lane],
                work.i_period[lane],
                work.memory[lane],
                cells.section[cell],
                cells.measures[cell],
                settings,
            )
    if status == PENDING:
        note_state(cells, work, lane)
        return False
    cells.status[cell] = status
    cells.n_periods[cell] = work.i_period[lane]
    for i in range(N):
        cells.turns[cell, i] = work.turns[lane, i]
        if status == DIVERGED:
            for k in range(cells.section.shape[1]):
                cells.section[cell, k, i] = np.nan
    return True


def move_cell(work: NoisyWork, source: int, target: int) -> None:
    """Copy all data of one SIMD lane to another lane."""
    move_lane(work.lanes, source, target)
    work.cell[target] = work.cell[source]
    work.left[target] = work.left[source]
    work.i_period[target] = work.i_period[source]
    for i in range(N):
        work.turns[target, i] = work.turns[source, i]
    for i in range(work.memory.shape[1]):
        work.memory[target, i] = work.memory[source, i]


def advance(cells: NoisyCells, work: NoisyWork, n_lanes: int, keys: Any, settings: Any, halves: bool) -> None:
    """Integrate the cells of the queue, at most `n_lanes` at the same time, and fill the output arrays of `cells`."""
    n_cells = len(cells.frequency)
    cell, active = ZERO, ZERO
    rows, scratch, section = work.lanes, work.scratch, work.section
    for lane in range(len(work.cell)):
        following = take(work.queue) if lane < n_lanes else n_cells
        if following < n_cells:
            cell, active = following, lane + 1
        elif active == 0:
            return
        # lanes beyond the last cell repeat it, so that they hold ordinary numbers; no one looks
        begin_cell(cells, work, lane, cell, scratch)
    while active > 0:
        in_use = (active + WIDTH - 1) // WIDTH
        for group in range(in_use):
            lane, last = group * WIDTH, min(group * WIDTH + WIDTH, active)
            if lane >= last:
                continue
            n = work.left[lane]
            for other in range(lane + 1, last):
                n = min(n, work.left[other])
            make_steps(rows, group * ROWS.size, n, keys, halves)
            for other in range(lane, last):
                work.left[other] -= n
            while lane < last:
                if work.left[lane] > 0 or not end_period(cells, work, lane, settings, section):
                    lane += 1
                    continue
                cell = take(work.queue)
                if cell < n_cells:
                    begin_cell(cells, work, lane, cell, scratch)
                    lane += 1
                else:
                    # the last lane moves here, at whatever step it is
                    active -= 1
                    move_cell(work, active, lane)
                    last = min(last, active)


_INLINE = ("add_noise", "note_state")
_CALLED = (  # callees first
    "slope",
    "strengths",
    "draw",
    "split",
    "second_half",
    "strengths_beside",
    "step",
    "watched_step",
    "make_steps",
    "begin_cell",
    "end_period",
    "move_cell",
)
_OF_LANES = ("in_bounds", "take_section", "move_lane")


def _strengths_of(system: System, noise: Noise) -> Callable[..., Any]:
    """Return ``strengths_of(y, c)``: the strength of each noise, from the states and the constants."""
    n = system.n_constants - len(noise.states)
    scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_factors": noise.factors}
    values = [f"c[{n + i}]" for i in range(len(noise.states))]
    lines = ["zero = 0.0 * y[0]"]
    if noise.factors is None:
        values = [f"zero + {value}" for value in values]
    else:
        lines.append(f"factors = _factors(y, c[:{n}])")
        values = [f"{value} * factors[{i}]" for i, value in enumerate(values)]
    body = "\n    ".join([*lines, f"return ({', '.join(values)},)"])
    exec(f"def strengths_of(y, c):\n    {body}\n", scope)
    return inline(scope["strengths_of"])


def _bindings(system: System, noise: Noise, observer: Observer) -> dict[str, Any]:
    """Return the values of the names that the templates leave open, templates included."""
    multiplicative = noise.factors is not None
    numbers = range(len(noise.states))
    bindings: dict[str, Any] = {
        **lanes.engine_bindings(system, observer),
        "ROWS": noisy_rows_of(system, noise, observer),
        "PASSES": observer is PASSAGE,
        "N_SOURCES": len(noise.states),
        "NOISY": np.array(noise.states, np.int64),
        "OWN": np.array(noise.own, np.float64),
        "MULTIPLICATIVE": multiplicative,
        "MILSTEIN": multiplicative and any(noise.own),
        "ITO_TERM": 1.0 if noise.interpretation == ITO else 0.0,
        "PATH_TAGS": np.array([tag_word(j, PATH) for j in numbers]),
        "BRIDGE_TAGS": np.array([tag_word(j, BRIDGE) for j in numbers]),
        "strengths_of": _strengths_of(system, noise),
    }
    for key in _OF_LANES:
        bindings[key] = bound_part(getattr(lanes, key), bindings, key != "move_lane")
    bindings |= passage.passage_bindings(system, noise, bindings)
    for key in (*_INLINE, *_CALLED):
        bindings[key] = bound_part(globals()[key], bindings, key in _INLINE)
    return bindings


@cache
def noisy_engine_of(system: System, noise: Noise, observer: Observer) -> Callable[..., None]:
    """Compile `advance` for a system with its strengths (`noise.with_strengths`), its noise and an observer.

    Returns
    -------
    callable
        ``engine(cells, n_lanes, keys, settings, halves)``.
    """
    bindings = _bindings(system, noise, observer)
    functions = (*system.functions, observer.observe, observer.memory_size)
    kept = keeping(*functions, *(() if noise.factors is None else (noise.factors,)))
    compiled = entry(advance, f"{system.label}_{noise.label}_{observer.name}", bindings, kept)
    memory_size = getattr(observer.memory_size, "py_func", observer.memory_size)
    rows = noisy_rows_of(system, noise, observer)

    @wraps(compiled)
    def engine(cells: NoisyCells, n_lanes: int, keys: Any, settings: Any, halves: bool) -> None:
        def run(queue: np.ndarray, n_lanes: int) -> None:
            n_groups = -(-min(n_lanes, len(cells.frequency)) // WIDTH)
            size = n_groups * WIDTH
            work = NoisyWork(
                lanes=np.zeros(n_groups * rows.size),
                cell=np.zeros(size, np.int64),
                left=np.zeros(size, np.int64),
                i_period=np.zeros(size, np.int64),
                turns=np.zeros((size, system.n_states), np.int64),
                memory=np.zeros((size, memory_size(settings, system.n_states))),
                scratch=np.zeros(max(system.n_constants, system.n_states)),
                section=np.zeros(system.n_states),
                queue=queue,
            )
            compiled(cells, work, n_lanes, keys, settings, halves)

        share(run, len(cells.frequency), n_lanes)

    return engine
