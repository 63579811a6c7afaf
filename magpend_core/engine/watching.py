"""Track minimum, maximum and mean of named quantities over each drive period that ends with a recorded section point.

These functions are templates for the engine, see `lanes`; "watched" means tracked. After an accepted step each quantity
is known at the start, in the middle (from the method's continuous extension) and at the end of the step. The parabola
through the three values gives the extremes within the step, Simpson's rule gives the integral. With a step h the error
of an extreme is of order h^3, or h^4 where the quantity is even about it; the error of the mean is of order h^4. On
the pendulum at a tolerance of 1e-9, the errors are 2e-5 (extremes) and 1e-7 (means) of a quantity's range, but 2e-4
for the peaks of friction torques, which are hardly wider than a step. At a tolerance of 1e-5 they are 100 times larger.

States, steps and sections have the same bits whether quantities are tracked or not. Nothing is evaluated in a group of
lanes without a lane in such a period.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import (
    WIDTH,
    load,
    load_rows,
    maximum,
    minimum,
    multiply_add,
    store,
    store_rows,
    where_less,
)
from magpend_core.engine.system import System

LOWEST, HIGHEST, MEAN = 0, 1, 2
"""Entries of the last dim of `Cells.watched`."""


def watched_function(system: System, watched: tuple[int, ...]) -> Callable[..., Any]:
    """Compile a function like ``system.quantities`` that returns only the quantities to be tracked.

    `watched` holds indices into ``system.state_names + system.quantity_names``. numba cannot select tuple entries by
    indices that it learns at run time, so the source of the function is generated. The cache treats it as part of the
    system's module (see `jit.keeping`).
    """
    n = system.n_states
    picked = ", ".join(f"y[{i}]" if i < n else f"values[{i - n}]" for i in watched)
    lines = ["def watched_values(t, y, dy, u, c):", f"return ({picked},)" if watched else "return ()"]
    if any(i >= n for i in watched):
        lines.insert(1, "values = _quantities(t, y, dy, u, c)")
    scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_quantities": system.quantities}
    exec("\n    ".join(lines), scope)
    return inline(scope["watched_values"])


def evaluate_watched(w: Any, base: int) -> None:
    """Evaluate the tracked quantities in the middle and at the end of an attempted step, before it is accepted or
    rejected.
    """
    h = load(w, base + ROWS.step)
    t = load(w, base + ROWS.time)
    for i in range(N):
        row = base + i * WIDTH
        total = MIDDLE[0] * load(w, row + ROWS.slopes)
        for s in range(FIRST_WEIGHED, N_STAGES):
            total = multiply_add(MIDDLE[s], load(w, row + ROWS.slopes + s * N * WIDTH), total)
        store(w, row + ROWS.halfway, load(w, row + ROWS.state) + h * total)
    c = load_rows(w, base + ROWS.constants, NC)
    y = load_rows(w, base + ROWS.halfway, N)
    u = forcing(t + 0.5 * h, c)
    store_rows(w, base + ROWS.middle, watched_values(t + 0.5 * h, y, rhs(y, u, c), u, c))
    c = load_rows(w, base + ROWS.constants, NC)
    y = load_rows(w, base + ROWS.trial, N)
    dy = load_rows(w, base + ROWS.slopes + (N_STAGES - 1) * N * WIDTH, N)
    store_rows(w, base + ROWS.end, watched_values(t + h, y, dy, forcing(t + h, c), c))


def update_extremes(w: Any, base: int) -> None:
    """Update the extremes and integrals of the current period with an accepted step.

    The first step of every period has size 0; it stores the values at the start of the period.
    """
    h = load(w, base + ROWS.step)
    rejected = load(w, base + ROWS.after_rejection)
    for i in range(N_WATCHED):
        row = base + i * WIDTH
        middle, end = load(w, row + ROWS.middle), load(w, row + ROWS.end)
        begin = load(w, row + ROWS.begin)
        begin = where_less(0.0, h, begin, end)
        # the parabola begin + slope x + bend x^2 for x in [0, 1]
        slope = multiply_add(-3.0, begin, 4.0 * middle) - end
        bend = 2.0 * (begin + end) - 4.0 * middle
        turns = where_less(0.0, h, slope * (slope + 2.0 * bend), 0.0)
        vertex = where_less(turns, 0.0, begin - slope * slope / (4.0 * bend), end)
        low, high = load(w, row + ROWS.lowest), load(w, row + ROWS.highest)
        integral = load(w, row + ROWS.integral)
        lower = minimum(minimum(vertex, end), low)
        higher = maximum(maximum(vertex, end), high)
        more = integral + h * (begin + 4.0 * middle + end) * (1.0 / 6.0)
        store(w, row + ROWS.lowest, where_less(0.5, rejected, low, lower))
        store(w, row + ROWS.highest, where_less(0.5, rejected, high, higher))
        store(w, row + ROWS.integral, where_less(0.5, rejected, integral, more))
        store(w, row + ROWS.begin, where_less(0.5, rejected, begin, end))


def keep_extremes(w: Any, base: int, lane: int, out: Any) -> None:
    """Write minimum, maximum and mean of each tracked quantity over the period just ended to `out` (n_watched, 3)."""
    for i in range(N_WATCHED):
        row = base + i * WIDTH + lane
        out[i, LOWEST] = w[row + ROWS.lowest]
        out[i, HIGHEST] = w[row + ROWS.highest]
        length = ROWS.time if HAS_SECTION else ROWS.period
        out[i, MEAN] = w[row + ROWS.integral] / w[base + length + lane]


def set_watching(work: Any, lane: int, watching: int) -> None:
    """Note whether the quantities in a SIMD lane are tracked, and update the count of such lanes in its group."""
    work.n_watching[lane // WIDTH] += watching - work.watching[lane]
    work.watching[lane] = watching


def begin_watch(work: Any, lane: int, wanted: bool) -> None:
    """Reset minimum, maximum and integral of the tracked quantities at the start of a period; note whether to track
    them.
    """
    set_watching(work, lane, 1 if wanted else 0)
    base, column = (lane // WIDTH) * ROWS.size, lane % WIDTH
    for i in range(N_WATCHED):
        row = base + i * WIDTH + column
        work.lanes[row + ROWS.lowest] = np.inf
        work.lanes[row + ROWS.highest] = -np.inf
        work.lanes[row + ROWS.integral] = 0.0
