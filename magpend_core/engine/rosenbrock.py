"""Step with a Rosenbrock method, for stiff systems: linear systems with the Jacobian take the place of explicit stages.

These functions are templates for the engine, see `lanes`; `run_stages` takes the place of that of `lanes`. A step
of length h factorises the matrix I - gamma h J once, by elimination with partial pivoting, and solves for the slope of
each stage with it (see `tableau.Implicit`). The rows of a lane group are the same at each step; where a lane needs an
exchange of rows it is made by `where_less`. Elements outside the band of the Jacobian are left out, with the states
in an order that makes the band narrow (reverse Cuthill and McKee).

Tangent vectors are stepped by the derivative of this scheme. For a vector v that is a slope with the same matrix, and
with the change of J along v times the slope of the states on the right-hand side.

The first slope is the rate at the step's begin, the last that at its end, as in the explicit methods: so events, layers
and dense output are the same for both.

Of systems with few states `own_templates` writes loops out, so that sums stay in registers; the bits are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.simd import (
    WIDTH,
    absolute,
    any_nonzero,
    load,
    load_rows,
    maximum,
    multiply_add,
    store,
    store_rows,
    where_less,
)
from magpend_core.engine.symbolic import Linearised, curved, linearised
from magpend_core.engine.system import System
from magpend_core.engine.tangents import n_entries


def order_of_states(entries: Sequence[tuple[int, int]], n: int) -> np.ndarray:
    """Return the position of each state in the linear systems, shape (n,), from the Jacobian's (row, column) pairs."""
    from scipy.sparse import coo_array  # not needed by explicit methods, and slow to import
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    rows, columns = np.array(entries or [(0, 0)]).T
    pattern = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    position = np.empty(n, np.int64)
    position[reverse_cuthill_mckee(pattern + pattern.T, symmetric_mode=True)] = np.arange(n)

    def band(at: np.ndarray) -> int:
        return int(np.abs(at[rows] - at[columns]).max())

    same = np.arange(n)
    return position if band(position) < band(same) else same


def _first_added(stages: np.ndarray) -> int:
    """Return the last stage whose state is not that of the stage before and one more slope."""
    adds = [
        s
        for s in range(1, len(stages))
        if (stages[s, : s - 1] == stages[s - 1, : s - 1]).all() and stages[s, s - 1] == 1.0
    ]
    return max(s for s in range(1, len(stages)) if s not in adds)


class _Layout(NamedTuple):
    """Derivatives of a system, and where their rows begin in the work array: of the states, of tangent vectors, of the
    trace.
    """

    own: Linearised
    of_vector: Linearised
    of_trace: Linearised
    starts: tuple[int, int, int, int]


def _layout(system: System) -> _Layout:
    n, own = (system.tangents_of or system).n_states, linearised(system)
    if n_entries(system):
        of_vector, of_trace = curved(system)
        sizes = [len(of.entries) + len(of.timed) for of in (own, of_vector, of_trace)]
        starts = np.cumsum([0, *sizes])
    else:  # `own` has the rows of the tangent vectors
        own_entries = tuple(place for place in own.entries if place[0] < n)
        of_vector = own._replace(entries=tuple((i - n, j) for i, j in own.entries[len(own_entries) :]))
        of_trace = own
        first, size = len(own_entries), len(own.entries) + len(own.timed)
        own = own._replace(entries=own_entries)
        starts = np.array([0, first, size, size])
    return _Layout(own, of_vector, of_trace, tuple(int(x) for x in starts))  # type: ignore[arg-type]


def implicit_rows(system: System) -> list[int]:
    """Return the numbers of rows of the work array that the method needs; zeros for an explicit method.

    They are those of the derivatives, the matrix, its exchanges, the right-hand side, and the rates' change in time.
    """
    if not system.is_stiff:
        return [0] * 5
    n = (system.tangents_of or system).n_states
    return [_layout(system).starts[-1], n * n, n * n, n, system.n_states]


def implicit_bindings(system: System) -> dict[str, Any]:
    """Return the values of this module's free global names (such as ``GAMMA``) for a system."""
    implicit = system.tableau.implicit
    if implicit is None:
        return {}
    n, (own, of_vector, of_trace, starts) = (system.tangents_of or system).n_states, _layout(system)
    at = order_of_states(own.entries, n)
    offsets = [int(at[i] - at[j]) for i, j in own.entries]
    n_bent = n if n_entries(system) else system.n_states - n
    return {
        "GAMMA": implicit.gamma,
        "FIRST_ADDED": _first_added(system.tableau.stages),
        "COUPLINGS": implicit.couplings,
        "SHIFTS": implicit.shifts,
        "linearise": own.function,
        "bend": of_vector.function,
        "bend_trace": of_trace.function,
        "N_SOLVED": n,
        "N_OWN_ENTRIES": len(own.entries),
        "N_DRIFTING": len(own.timed),
        "N_BENDING": len(of_vector.timed),
        "N_LEAVING": len(of_trace.timed),
        "IS_TIMED": len(own.timed) > 0,
        "AT_BENDS": starts[1] * WIDTH,
        "AT_TRACE": starts[2] * WIDTH,
        "AT_DRIFTS": (starts[2] - len(own.timed) if starts[2] == starts[3] else len(own.entries)) * WIDTH,
        "AT_BENDING": (starts[2] - len(of_vector.timed)) * WIDTH,
        "AT_LEAVING": (starts[3] - len(of_trace.timed)) * WIDTH,
        "POSITIONS": at,
        "PLACES": np.array([at[i] * n + at[j] for i, j in own.entries] or [0]),
        "BELOW": max([0, *offsets]),
        "BEHIND": max([0, *offsets]) - min([0, *offsets]),
        "DRIFTING": np.array(own.timed or (0,)),
        "BENDING": np.array(of_vector.timed or (0,)),
        "CROSS_STARTS": np.searchsorted([i for i, _ in of_vector.entries], np.arange(n_bent + 1)),
        "CROSS_COLUMNS": np.array([j for _, j in of_vector.entries] or [0]),
        "TRACE_COLUMNS": np.array([j for _, j in of_trace.entries] or [0]),
        "N_TRACE_ENTRIES": len(of_trace.entries),
    }


def fill_matrix(w: Any, base: int) -> None:
    """Compute the derivatives of the rates at the begin of a step, and the matrix I - gamma h J."""
    h = load(w, base + ROWS.step)
    y = load_rows(w, base + ROWS.state, N_KNOWN)
    c = load_rows(w, base + ROWS.constants, NC)
    store_rows(w, base + ROWS.derivatives, linearise(y, load(w, base + ROWS.time), c))
    for k in range(N_SOLVED * N_SOLVED):
        store(w, base + ROWS.matrix + k * WIDTH, 0.0 * h)
    for i in range(N_SOLVED):
        store(w, base + ROWS.matrix + i * (N_SOLVED + 1) * WIDTH, 0.0 * h + 1.0)
    for k in range(N_OWN_ENTRIES):
        at = base + ROWS.matrix + PLACES[k] * WIDTH
        entry = load(w, base + ROWS.derivatives + k * WIDTH)
        store(w, at, load(w, at) - (GAMMA * h) * entry)
    if IS_TIMED:
        for i in range(N):
            store(w, base + ROWS.drift + i * WIDTH, 0.0 * h)
        for k in range(N_DRIFTING):
            drift = load(w, base + ROWS.derivatives + AT_DRIFTS + k * WIDTH)
            store(w, base + ROWS.drift + DRIFTING[k] * WIDTH, h * drift)


def exchange(w: Any, base: int, j: int, i: int, end: int) -> None:
    """Exchange rows `i` and `j` of the matrix, from column `j` to `end`, in the lanes in which row `i` has the larger
    pivot.
    """
    row, other = base + ROWS.matrix + j * N_SOLVED * WIDTH, base + ROWS.matrix + i * N_SOLVED * WIDTH
    pivot, candidate = load(w, row + j * WIDTH), load(w, other + j * WIDTH)
    swap = where_less(absolute(pivot), absolute(candidate), 1.0, 0.0)
    store(w, base + ROWS.exchanges + (i * N_SOLVED + j) * WIDTH, swap)
    if any_nonzero(swap):
        store(w, base + ROWS.exchanges, maximum(swap, load(w, base + ROWS.exchanges)))
        for m in range(j, end):
            a, b = load(w, row + m * WIDTH), load(w, other + m * WIDTH)
            store(w, row + m * WIDTH, where_less(0.5, swap, b, a))
            store(w, other + m * WIDTH, where_less(0.5, swap, a, b))


def factorise(w: Any, base: int) -> None:
    """Factorise the matrix into triangles by elimination with partial pivoting; keep inverse pivots on the diagonal."""
    # no row is exchanged with itself: the first element tells whether any is
    store(w, base + ROWS.exchanges, 0.0 * load(w, base + ROWS.step))
    for j in range(N_SOLVED):
        last, end = min(N_SOLVED, j + 1 + BELOW), min(N_SOLVED, j + 1 + BEHIND)
        row = base + ROWS.matrix + j * N_SOLVED * WIDTH
        for i in range(j + 1, last):
            exchange(w, base, j, i, end)
        inverse = 1.0 / load(w, row + j * WIDTH)
        store(w, row + j * WIDTH, inverse)
        for i in range(j + 1, last):
            other = base + ROWS.matrix + i * N_SOLVED * WIDTH
            factor = load(w, other + j * WIDTH) * inverse
            store(w, other + j * WIDTH, factor)
            for m in range(j + 1, end):
                store(w, other + m * WIDTH, load(w, other + m * WIDTH) - factor * load(w, row + m * WIDTH))


def solve(w: Any, base: int) -> None:
    """Replace the right-hand side by the solution of the linear system."""
    right = base + ROWS.right
    for j in range(N_SOLVED):
        last, row = min(N_SOLVED, j + 1 + BELOW), base + ROWS.matrix + j * WIDTH
        x = load(w, right + j * WIDTH)
        for i in range(j + 1, last):
            swap = load(w, base + ROWS.exchanges + (i * N_SOLVED + j) * WIDTH)
            other = load(w, right + i * WIDTH)
            store(w, right + i * WIDTH, where_less(0.5, swap, x, other))
            x = where_less(0.5, swap, other, x)
        store(w, right + j * WIDTH, x)
        for i in range(j + 1, last):
            store(w, right + i * WIDTH, load(w, right + i * WIDTH) - load(w, row + i * N_SOLVED * WIDTH) * x)
    for k in range(N_SOLVED):
        j = N_SOLVED - 1 - k
        row, end = base + ROWS.matrix + j * N_SOLVED * WIDTH, min(N_SOLVED, j + 1 + BEHIND)
        x = load(w, right + j * WIDTH)
        for m in range(j + 1, end):
            x = x - load(w, row + m * WIDTH) * load(w, right + m * WIDTH)
        store(w, right + j * WIDTH, x * load(w, row + j * WIDTH))


def advance_states(w: Any, base: int, s: int) -> None:
    """Compute the state at stage `s`; the last stages add one slope each to the state before."""
    h = load(w, base + ROWS.step)
    for i in range(N_KNOWN):
        row = base + i * WIDTH
        if s > FIRST_ADDED:
            slope = load(w, row + ROWS.slopes + (s - 1) * N * WIDTH)
            store(w, row + ROWS.trial, multiply_add(h, slope, load(w, row + ROWS.trial)))
        else:
            stage_row(w, row, s, h)


def squared_error(w: Any, base: int, rtol: float, atol: float) -> Any:
    """Return the mean square of the scaled error of an attempted step: the last slope that it solved for."""
    h = load(w, base + ROWS.step)
    total = 0.0 * h
    for i in range(N_CONTROLLED):
        row = base + i * WIDTH
        size = maximum(absolute(load(w, row + ROWS.state)), absolute(load(w, row + ROWS.trial)))
        floor = atol * SIZES[i]
        scaled = load(w, row + ROWS.slopes + (N_STAGES - 2) * N * WIDTH) / (rtol * size + floor)
        total = multiply_add(scaled, scaled, total)
    return (h * h) * total * (1.0 / N_CONTROLLED)


def coupled(w: Any, base: int, i: int, s: int) -> Any:
    """Return gamma times the right-hand side of stage `s` for state `i`, without the change of J along a tangent."""
    row = base + ROWS.slopes + i * WIDTH
    total = load(w, row) if s == 1 else load(w, row + s * N * WIDTH)
    for j in range(1, s):
        total = multiply_add(COUPLINGS[s, j], load(w, row + j * N * WIDTH), total)
    if IS_TIMED:
        total = multiply_add(SHIFTS[s], load(w, base + ROWS.drift + i * WIDTH), total)
    return GAMMA * total


def bent(w: Any, base: int, r: int, s: int, total: Any) -> Any:
    """Add to a right-hand side for a tangent vector the change of J along it, times the slope of the states.

    `r` is the row among those of `AT_BENDS`.
    """
    change = 0.0 * total
    for k in range(CROSS_STARTS[r], CROSS_STARTS[r + 1]):
        entry = load(w, base + ROWS.derivatives + AT_BENDS + k * WIDTH)
        slope = load(w, base + ROWS.slopes + (s * N + CROSS_COLUMNS[k]) * WIDTH)
        change = multiply_add(entry, slope, change)
    return multiply_add(GAMMA * load(w, base + ROWS.step), change, total)


def evaluate_stage(w: Any, base: int, s: int) -> None:
    """Compute the state at stage `s`, and its rates in the row of the stage's slopes."""
    h = load(w, base + ROWS.step)
    advance_states(w, base, s)
    if s == 1 or NODES[s] != NODES[s - 1]:
        c = load_rows(w, base + ROWS.constants, NC)
        store(w, base + ROWS.forcing, forcing(load(w, base + ROWS.time) + NODES[s] * h, c))
    c = load_rows(w, base + ROWS.constants, NC)
    y, u = load_rows(w, base + ROWS.trial, N_KNOWN), load(w, base + ROWS.forcing)
    slopes = rhs(y, u, c)
    if CARRIES:
        store_rows(w, base + ROWS.entries + (s - 1) * N_ENTRIES * WIDTH, tangent_entries(y, u, c))
    store_rows(w, base + ROWS.slopes + s * N * WIDTH, slopes)


def store_solution(w: Any, base: int, first: int, s: int) -> None:
    """Solve for the slopes of stage `s` of `N_SOLVED` rows from `first` on, whose right-hand side is set."""
    solve(w, base)
    for i in range(N_SOLVED):
        row = base + ROWS.slopes + (s * N + first + i) * WIDTH
        store(w, row, load(w, base + ROWS.right + POSITIONS[i] * WIDTH))


def solve_states(w: Any, base: int, s: int) -> None:
    """Compute the slopes of stage `s` of the states without tangent vectors."""
    for i in range(N_SOLVED):
        store(w, base + ROWS.right + POSITIONS[i] * WIDTH, coupled(w, base, i, s))
    store_solution(w, base, 0, s)


def solve_vectors(w: Any, base: int, s: int) -> None:
    """Compute the slopes of stage `s` of each tangent vector whose rates `rhs` returns, and of the trace's integral."""
    for first in range(N_SOLVED, N_KNOWN - N_SOLVED + 1, N_SOLVED):
        for i in range(N_SOLVED):
            total = bent(w, base, first + i - N_SOLVED, s, coupled(w, base, first + i, s))
            store(w, base + ROWS.right + POSITIONS[i] * WIDTH, total)
        store_solution(w, base, first, s)
    for i in range(N_KNOWN - N_KNOWN % N_SOLVED, N_KNOWN):
        total = bent(w, base, i - N_SOLVED, s, coupled(w, base, i, s))
        store(w, base + ROWS.slopes + (s * N + i) * WIDTH, total)


def step_vector(w: Any, base: int, k: int) -> None:
    """Compute the slopes of tangent vector `k` at all stages but the first, and its new value; the engine has the
    entries of J at each stage.
    """
    h, first = load(w, base + ROWS.step), N_SOLVED * (1 + k)
    y, v = load_rows(w, base + ROWS.state, N_SOLVED), load_rows(w, base + ROWS.state + first * WIDTH, N_SOLVED)
    c = load_rows(w, base + ROWS.constants, NC)
    store_rows(w, base + ROWS.derivatives + AT_BENDS, bend(y, v, load(w, base + ROWS.time), c))
    for i in range(N_BENDING):
        drift = load(w, base + ROWS.derivatives + AT_BENDING + i * WIDTH)
        store(w, base + ROWS.drift + (first + BENDING[i]) * WIDTH, h * drift)
    for s in range(1, N_STAGES):
        multiply_vector(w, base, k, s, h)
        if s < N_STAGES - 1:
            for i in range(N_SOLVED):
                total = bent(w, base, i, s, coupled(w, base, first + i, s))
                store(w, base + ROWS.right + POSITIONS[i] * WIDTH, total)
            store_solution(w, base, first, s)


def step_trace(w: Any, base: int) -> None:
    """Compute the integral of the Jacobian's trace, the last row, at all stages but the first."""
    h, row = load(w, base + ROWS.step), base + (N - 1) * WIDTH
    y, c = load_rows(w, base + ROWS.state, N_SOLVED), load_rows(w, base + ROWS.constants, NC)
    store_rows(w, base + ROWS.derivatives + AT_TRACE, bend_trace(y, load(w, base + ROWS.time), c))
    if N_LEAVING > 0:
        store(w, row + ROWS.drift, h * load(w, base + ROWS.derivatives + AT_LEAVING))
    for s in range(1, N_STAGES):
        trace = load(w, base + ROWS.entries + (s * N_ENTRIES - 1) * WIDTH)
        store(w, row + ROWS.slopes + s * N * WIDTH, trace)
        if s < N_STAGES - 1:
            change = 0.0 * h
            for m in range(N_TRACE_ENTRIES):
                entry = load(w, base + ROWS.derivatives + AT_TRACE + m * WIDTH)
                slope = load(w, base + ROWS.slopes + (s * N + TRACE_COLUMNS[m]) * WIDTH)
                change = multiply_add(entry, slope, change)
            total = multiply_add(GAMMA * h, change, coupled(w, base, N - 1, s))
            store(w, row + ROWS.slopes + s * N * WIDTH, total)
    stage_row(w, row, N_STAGES - 1, h)


def run_stages(w: Any, base: int) -> None:
    """Compute all slopes of a step but the first, which the last step has computed, and the new state."""
    fill_matrix(w, base)
    factorise(w, base)
    for s in range(1, N_STAGES - 1):
        if s > 1 or CARRIES:
            evaluate_stage(w, base, s)
        solve_states(w, base, s)
        if N_KNOWN > N_SOLVED:
            solve_vectors(w, base, s)
    evaluate_stage(w, base, N_STAGES - 1)
    if CARRIES:
        for k in range(N_VECTORS):
            step_vector(w, base, k)
        if HAS_TRACE:
            step_trace(w, base)


UNROLLED = 10
"""Most states whose stages and linear systems are computed in registers."""


def unrolled_states(n: int) -> Callable[..., None]:
    """Return `advance_states` for a small system, with its loops over states written out."""
    last = "w, base + ROWS.slopes + (s - 1) * N * WIDTH"
    lines = ["def advance_states(w, base, s):", "h = load(w, base + ROWS.step)", "if s > FIRST_ADDED:"]
    for i in range(n):
        at = f"w, base + ROWS.trial + {i * WIDTH}"
        lines.append(f"    store({at}, multiply_add(h, load({last} + {i * WIDTH}), load({at})))")
    lines += ["else:"]
    lines += [f"    x{i} = STAGES[s, 1] * load(w, base + ROWS.slopes + N * WIDTH + {i * WIDTH})" for i in range(n)]
    lines += ["    for j in range(2, s):"]
    for i in range(n):
        slope = f"load(w, base + ROWS.slopes + j * N * WIDTH + {i * WIDTH})"
        lines.append(f"        x{i} = multiply_add(STAGES[s, j], {slope}, x{i})")
    for i in range(n):
        state = f"load(w, base + ROWS.state + {i * WIDTH})"
        lines.append(f"    store(w, base + ROWS.trial + {i * WIDTH}, {state} + h * x{i})")
    return _made("advance_states", lines)


def unrolled_stage(positions: Sequence[int], below: int, behind: int) -> Callable[..., None]:
    """Return `solve_states` for a small system, with its loops over states written out."""
    n, at = len(positions), [int(i) for i in np.argsort(positions)]  # the state of each row
    lines = [
        "def solve_states(w, base, s):",
        "rates = base + ROWS.slopes if s == 1 else base + ROWS.slopes + s * N * WIDTH",
    ]
    lines += [f"x{j} = load(w, rates + {at[j] * WIDTH})" for j in range(n)]
    lines += ["for j in range(1, s):", "    slopes = base + ROWS.slopes + j * N * WIDTH"]
    lines += [f"    x{j} = multiply_add(COUPLINGS[s, j], load(w, slopes + {at[j] * WIDTH}), x{j})" for j in range(n)]
    lines += ["if IS_TIMED:"]
    lines += [
        f"    x{j} = multiply_add(SHIFTS[s], load(w, base + ROWS.drift + {at[j] * WIDTH}), x{j})" for j in range(n)
    ]
    lines += [f"x{j} = GAMMA * x{j}" for j in range(n)]
    if below > 0:
        lines += ["if any_nonzero(load(w, base + ROWS.exchanges)):"]
        lines += [f"    {line}" for line in _eliminated(n, below, True)]
        lines += ["else:", *(f"    {line}" for line in _eliminated(n, below, False))]
    for j in range(n)[::-1]:
        for m in range(j + 1, min(n, j + 1 + behind)):
            lines.append(f"x{j} = x{j} - load(w, base + ROWS.matrix + {(j * n + m) * WIDTH}) * x{m}")
        lines.append(f"x{j} = x{j} * load(w, base + ROWS.matrix + {j * (n + 1) * WIDTH})")
        lines.append(f"store(w, base + ROWS.slopes + s * N * WIDTH + {at[j] * WIDTH}, x{j})")
    return _made("solve_states", lines)


def _eliminated(n: int, below: int, exchanges: bool) -> list[str]:
    lines = []
    for j in range(n):
        rows = range(j + 1, min(n, j + 1 + below))
        for i in rows if exchanges else ():
            at = f"base + ROWS.exchanges + {(i * n + j) * WIDTH}"
            lines += [f"swap = load(w, {at})", f"other = where_less(0.5, swap, x{i}, x{j})"]
            lines += [f"x{i} = where_less(0.5, swap, x{j}, x{i})", f"x{j} = other"]
        lines += [f"x{i} = x{i} - load(w, base + ROWS.matrix + {(i * n + j) * WIDTH}) * x{j}" for i in rows]
    return lines


def _made(name: str, lines: list[str]) -> Callable[..., None]:
    scope: dict[str, Any] = {}
    exec("\n    ".join(lines), globals(), scope)
    function: Callable[..., None] = scope[name]
    return function


def unrolled_factors(n: int, below: int, behind: int) -> Callable[..., None]:
    """Return `factorise` for a small system, with its loops written out."""
    lines = ["def factorise(w, base):", "store(w, base + ROWS.exchanges, 0.0 * load(w, base + ROWS.step))"]
    for j in range(n):
        last, end = min(n, j + 1 + below), min(n, j + 1 + behind)
        lines += [f"exchange(w, base, {j}, {i}, {end})" for i in range(j + 1, last)]
        row = f"w, base + ROWS.matrix + {j * n * WIDTH}"
        lines += [f"inverse = 1.0 / load({row} + {j * WIDTH})", f"store({row} + {j * WIDTH}, inverse)"]
        lines += [f"p{m} = load({row} + {m * WIDTH})" for m in range(j + 1, end)]
        for i in range(j + 1, last):
            other = f"w, base + ROWS.matrix + {i * n * WIDTH}"
            lines += [f"factor = load({other} + {j * WIDTH}) * inverse", f"store({other} + {j * WIDTH}, factor)"]
            for m in range(j + 1, end):
                lines.append(f"store({other} + {m * WIDTH}, load({other} + {m * WIDTH}) - factor * p{m})")
    return _made("factorise", lines)


def own_templates(bindings: dict[str, Any]) -> dict[str, Callable[..., Any]]:
    """Return what takes the place of templates of the same name, for the values of the free names."""
    n, known, band = bindings["N_SOLVED"], bindings["N_KNOWN"], (bindings["BELOW"], bindings["BEHIND"])
    found: dict[str, Callable[..., Any]] = {"squared_error": squared_error}
    if n <= UNROLLED:
        found["factorise"] = unrolled_factors(n, *band)
        found["solve_states"] = unrolled_stage(bindings["POSITIONS"], *band)
    if known <= UNROLLED:
        found["advance_states"] = unrolled_states(known)
    return found


INLINE = ("coupled", "bent")
"""Templates of this module that are inlined into their callers; callees come first."""

CALLED = (
    "fill_matrix",
    "exchange",
    "factorise",
    "solve",
    "store_solution",
    "advance_states",
    "evaluate_stage",
    "solve_states",
    "solve_vectors",
    "step_vector",
    "step_trace",
)
"""Templates compiled as functions of their own; `run_stages` takes the place of `lanes.run_stages`."""
