"""Share the rows of an engine call (branches, cells, trajectories) among threads.

A lane's numbers depend on its own inputs only, so it does not matter which thread integrates which row. Every thread
calls the same compiled function, with work arrays of its own, on the same input and output arrays. Whenever a lane is
free, the function takes the next row from a queue that all threads share (`simd.take`).

The number of threads is that of the innermost `using_threads`, otherwise ``MAGPEND_NUM_THREADS``, otherwise the number
of cores that this process may use.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from functools import cache
from typing import Any

import numba
import numpy as np

from magpend_core.engine.simd import WIDTH

VARIABLE = "MAGPEND_NUM_THREADS"

_SETTINGS: Any = numba.config

_number: ContextVar[int | None] = ContextVar("number", default=None)


@cache
def _default() -> int:
    text = os.environ.get(VARIABLE, "")
    if not text:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{VARIABLE} = {text!r} is no number of threads: give a whole number from 1 on, or unset it.")
    return int(text)


def number_of_threads() -> int:
    """Return the number of threads that a call of the engine may use here.

    Raises
    ------
    ValueError
        If ``MAGPEND_NUM_THREADS`` is not a whole number from 1 on.
    """
    if _SETTINGS.DISABLE_JIT:  # plain Python runs in one thread at a time, and its `take` is not atomic
        return 1
    return _number.get() or _default()


@contextlib.contextmanager
def using_threads(n: int) -> Iterator[None]:
    """Use `n` threads for each call of the engine inside this context."""
    token = _number.set(n)
    try:
        yield
    finally:
        _number.reset(token)


def share(run: Callable[[np.ndarray, int], None], n_rows: int, n_lanes: int) -> None:
    """Call ``run(queue, n_lanes)`` in one or more threads at once, so that together they work on all rows.

    Parameters
    ----------
    run
        Function that takes rows from the queue until it has a number of `n_rows` or above, and releases the GIL.
    n_rows
        Number of rows.
    n_lanes
        Most rows in work at the same time in a thread. With several threads `run` may get a smaller number, so that
        the threads end at about the same time. Groups of SIMD lanes stay full.

    Raises
    ------
    Exception
        The error of `run` in any of the threads.
    """
    queue = np.zeros(1, np.int64)
    n_groups = -(-n_rows // WIDTH)
    n_threads = min(number_of_threads(), n_groups)
    if n_threads < 2:
        run(queue, n_lanes)
        return
    n_lanes = min(n_lanes, WIDTH * max(n_groups // (2 * n_threads), 1))
    helpers = []
    try:
        for _ in range(n_threads - 1):
            context = copy_context()  # with the listeners to progress and compilation
            context.run(_number.set, 1)
            helpers.append(_pool(number_of_threads()).submit(context.run, run, queue, n_lanes))
        run(queue, n_lanes)
        # a helper that has not begun is not needed any more
        for helper in helpers:
            if not helper.cancel():
                helper.result()
    finally:
        queue[0] = n_rows  # after an error or an interruption: nothing is left for the others


@cache
def _pool(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n, "magpend engine")


if hasattr(os, "register_at_fork"):  # a forked process has no threads of its parent
    os.register_at_fork(after_in_child=_pool.cache_clear)
