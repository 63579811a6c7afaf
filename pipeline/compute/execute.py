"""Run tasks: in threads or processes of this machine, or on the workers of a dask scheduler.

The results of tasks are small dicts. This module does not depend on what a task computes.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Sequence
from typing import Any

from pipeline.compute.clients import IN_PROCESS, PROCESSES, THREADS, Where, connected
from pipeline.compute.order import Order, Predecessor, TaskFailedError, why
from pipeline.compute.processes import Processes
from pipeline.compute.threads import Task, in_threads

__all__ = ["TaskFailedError", "default_workers", "run_tasks"]

Echo = Callable[[str], None]


def default_workers() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(
    task: Task,
    indices: Sequence[int],
    *,
    after: Predecessor | None = None,
    seconds: Callable[[int], float] | None = None,
    workers: int | None = None,
    scheduler: Where | str | None = None,
    echo: Echo = print,
) -> Generator[dict[str, Any], None, None]:
    """Run a task function for every index, and yield the results as they come.

    If a task fails, the others continue; the failed task is tried again alone at the end. After the generator has
    been closed, no task of this machine writes anything any more.

    Parameters
    ----------
    task
        Function of an index, or a partial of one; for processes and dask workers it must be importable there.
        Running it twice, even at the same time, must do no harm.
    indices
        Tasks to run, each once.
    after
        Function that returns a task's predecessor or None. A predecessor that is not in `indices` counts as
        done.
    seconds
        Estimated time of a task on one core [s]. A dask worker that takes far longer (see
        `pipeline.compute.dispatch`) is restarted, and its task runs elsewhere.
    workers
        Number of threads or processes of this machine, by default of its cores; 0 runs in the calling thread.
    scheduler
        Place of the computation; a text stands for ``Where(text)``.
    echo
        Function that takes a line about each problem that was handled.

    Raises
    ------
    SpecError, SchedulerError
        If there are no such workers, before anything is computed; or if the scheduler is lost.
    TaskFailedError
        If tasks failed twice, at the end; or at once if so many fail that the cause is another.
    """
    order = Order(indices, after)
    where = Where.of(scheduler)
    place = where.resolved()
    n_workers = min(workers or default_workers(), len(indices))
    if place == IN_PROCESS or workers == 0:
        yield from _in_calling_thread(task, order)
    elif place == THREADS:
        yield from in_threads(task, indices, after, order, n_workers)
    elif place == PROCESSES:
        with contextlib.closing(Processes(task)) as processes:
            yield from in_threads(processes, indices, after, order, n_workers)
    else:
        from pipeline.compute.clients import Fitting
        from pipeline.compute.dispatch import Window

        with connected(where, echo) as client:
            yield from Window(client, Fitting(task), order, seconds=seconds, echo=echo).results()
    order.close()


def _in_calling_thread(task: Task, order: Order) -> Generator[dict[str, Any], None, None]:
    while (index := order.take()) is not None or (index := order.take_failed()) is not None:
        try:
            result = task(index)
        except Exception as error:
            order.failed(index, why(error))
            continue
        order.done(index)
        yield result
