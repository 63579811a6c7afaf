"""Integrate the tangent vectors of large systems, by loops over the stages of a Runge-Kutta step.

These functions are templates for the engine, see `lanes`. For a small system the products of the Jacobian J and the
tangent vectors are written out in the right-hand side (see `variational.with_tangents`). For a large one the
right-hand side computes only the rates of the states. The engine computes all stages of the states first, and stores
the entries of J at each stage. Then it computes all stages of the first vector, of the second, and so on, so that the
rows of a vector stay in the first-level cache. The states do not depend on the vectors, so this order changes no bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from magpend_core.engine.jacobians import rows_of_entries
from magpend_core.engine.jit import inline
from magpend_core.engine.simd import WIDTH, load, multiply_add, store
from magpend_core.engine.system import System

WRITTEN_OUT_MAPS = 3
"""Most states of a map whose determinant is written out."""

DIVERGENCE = "divergence"
"""Name of the state that integrates the trace of the Jacobian."""


def order_of(row: dict[int, int]) -> list[int]:
    """Return the columns of one Jacobian row in the order in which a matrix-vector product adds them.

    The first product is rounded; the others are fused with the sum. If the row has entries in columns 0 and 1, column 1
    comes first, as in a sum written out in source code (see `fusing`). So the sum has the same bits with and without
    the zeros of the row.
    """
    columns = sorted(row)
    return [1, 0, *columns[2:]] if columns[:2] == [0, 1] else columns


def divergence_of(system: System, name: str) -> str:
    """Return source code for the value of the state `DIVERGENCE`, from the tuple `name` of the Jacobian's entries.

    It is the trace, the rate at which a flow changes volumes; of a map with at most `WRITTEN_OUT_MAPS` states the
    logarithm of the factor by which an iteration changes them, and 0 of a map with more.
    """
    rows = rows_of_entries(system)
    if not system.is_map:
        return " + ".join(f"{name}[{row[i]}]" for i, row in enumerate(rows) if i in row) or "0.0 * y[0]"
    if len(rows) > WRITTEN_OUT_MAPS:
        return "0.0 * y[0]"
    return f"log(maximum(absolute({_determinant(rows, name, range(len(rows)))}), 1e-100))"


def _determinant(rows: list[dict[int, int]], name: str, columns: Sequence[int]) -> str:
    """Return source code for the determinant of the last rows of a whole matrix in some of its columns."""
    first = rows[-len(columns)]
    if len(columns) == 1:
        return f"{name}[{first[columns[0]]}]"
    minors = [_determinant(rows, name, [c for c in columns if c != j]) for j in columns]
    terms = [f"{name}[{first[j]}] * ({minor})" for j, minor in zip(columns, minors, strict=True)]
    return " ".join(f"{'-' if k % 2 else '+' if k else ''} {term}" for k, term in enumerate(terms)).strip()


def n_entries(system: System) -> int:
    """Return the number of Jacobian entries stored per Runge-Kutta stage; 0 if `rhs` itself computes the tangent
    vectors.
    """
    if system.known == system.n_states or system.tangents_of is None:
        return 0
    return sum(map(len, rows_of_entries(system.tangents_of))) + _has_trace(system)


def _has_trace(system: System) -> bool:
    return system.state_names[-1] == DIVERGENCE


def tangent_bindings(system: System) -> dict[str, Any]:
    """Return the values of this module's free global names (such as ``N_ENTRIES``) for a system."""
    known, base = system.known, system.tangents_of
    names = {"N_KNOWN": known, "N_ENTRIES": n_entries(system), "CARRIES": n_entries(system) > 0}
    if base is None or not names["CARRIES"]:
        return names
    order: list[int] = []
    columns: list[int] = []
    starts = [0]
    for row in rows_of_entries(base):
        own = order_of(row)
        columns += own
        order += [row[j] for j in own]
        starts.append(len(columns))
    return names | {
        "ENTRY_COLUMNS": np.array(columns),
        "ROW_STARTS": np.array(starts),
        "HAS_TRACE": _has_trace(system),
        "tangent_entries": _tangent_entries(base, order, _has_trace(system)),
    }


def _tangent_entries(base: System, order: list[int], has_trace: bool) -> Callable[..., Any]:
    """Return a function that computes the Jacobian's entries in the order of summation (see `order_of`), then its
    trace.
    """
    parts = [f"entries[{k}]" for k in order]
    if has_trace:
        parts.append(divergence_of(base, "entries"))
    lines = ["def tangent_entries(y, u, c):", "entries = _jacobian(y, u, c)", f"return ({', '.join(parts)},)"]
    scope: dict[str, Any] = {"__name__": base.rhs.__module__, "_jacobian": base.jacobian}
    exec("\n    ".join(lines), scope)
    return inline(scope["tangent_entries"])


def stage_row(w: Any, row: int, s: int, h: Any) -> None:
    """Compute one component of the state at Runge-Kutta stage `s` from the slopes of earlier stages."""
    total = STAGES[s, 0] * load(w, row + ROWS.slopes)
    for j in range(1, s):
        # half of the eighth-order method's coefficients are 0, and add nothing
        if STAGES[s, j] != 0.0:
            total = multiply_add(STAGES[s, j], load(w, row + ROWS.slopes + j * N * WIDTH), total)
    store(w, row + ROWS.trial, load(w, row + ROWS.state) + h * total)


def multiply_vector(w: Any, base: int, k: int, s: int, h: Any) -> None:
    """Compute the state of tangent vector `k` at stage `s`, and its product with the Jacobian there."""
    first = base + N_KNOWN * (1 + k) * WIDTH
    for i in range(N_KNOWN):
        stage_row(w, first + i * WIDTH, s, h)
    entries = base + ROWS.entries + (s - 1) * N_ENTRIES * WIDTH
    vector, slopes = first + ROWS.trial, first + ROWS.slopes + s * N * WIDTH
    for i in range(N_KNOWN):
        at, end = ROW_STARTS[i], ROW_STARTS[i + 1]
        total = 0.0 * h
        if at < end:
            total = load(w, entries + at * WIDTH) * load(w, vector + ENTRY_COLUMNS[at] * WIDTH)
        for p in range(at + 1, end):
            entry = load(w, entries + p * WIDTH)
            total = multiply_add(entry, load(w, vector + ENTRY_COLUMNS[p] * WIDTH), total)
        store(w, slopes + i * WIDTH, total)


def carry_vector(w: Any, base: int, k: int) -> None:
    """Compute the states and slopes of tangent vector `k` at all Runge-Kutta stages but the first."""
    h = load(w, base + ROWS.step)
    for s in range(1, N_STAGES):
        multiply_vector(w, base, k, s, h)


def carry_trace(w: Any, base: int) -> None:
    """Compute the integral of the Jacobian's trace, the last row, at all Runge-Kutta stages but the first."""
    h = load(w, base + ROWS.step)
    row = base + (N - 1) * WIDTH
    for s in range(1, N_STAGES):
        stage_row(w, row, s, h)
        trace = load(w, base + ROWS.entries + (s * N_ENTRIES - 1) * WIDTH)
        store(w, row + ROWS.slopes + s * N * WIDTH, trace)


def run_stages(w: Any, base: int) -> None:
    """Compute all Runge-Kutta stages but the first: of the states, then of each tangent vector, then of the trace
    integral.
    """
    for s in range(1, N_STAGES):
        run_stage(w, base, s)
    for k in range(N_VECTORS):
        carry_vector(w, base, k)
    if HAS_TRACE:
        carry_trace(w, base)


INLINE = ("stage_row", "multiply_vector")
"""Templates of this module that are inlined into their callers; callees come first."""

CALLED = ("carry_vector", "carry_trace")
"""Templates compiled as functions of their own; `run_stages` takes the place of `lanes.run_stages`."""
