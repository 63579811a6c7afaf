"""Run tasks: in this process, or on the workers of a dask scheduler.

Tasks are submitted in a window, so that a scheduler holds only few of them in a long run. Their results are
small dicts. This module does not depend on what a task computes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pipeline.compute.clients import IN_PROCESS, Where, connected
from pipeline.compute.order import Order, Predecessor, TaskFailedError, why

__all__ = ["TaskFailedError", "default_workers", "run_tasks"]

Task = Callable[[int], dict[str, Any]]
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
) -> Iterator[dict[str, Any]]:
    """Run a task function for every index, and yield the results as they come.

    If a task fails, the others continue; the failed task is tried again alone at the end.

    Parameters
    ----------
    task
        Function of an index, importable on the workers, or a partial of one. Running it twice, even at the
        same time, must do no harm.
    indices
        Tasks to run, each once.
    after
        Function that returns a task's predecessor or None. A predecessor that is not in `indices` counts as
        done.
    seconds
        Estimated time of a task on one core [s]. A worker that takes far longer (see
        `pipeline.compute.limits`) is restarted, and its task runs elsewhere. Not used in this process.
    workers
        Number of processes of the local cluster; 0 runs in this process.
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
    if where.resolved() == IN_PROCESS or workers == 0:
        yield from _in_process(task, order)
        return
    from pipeline.compute.dispatch import Window
    from pipeline.compute.probe import Fitting

    n_workers = min(workers or default_workers(), len(indices))
    with connected(where, n_workers, echo) as client:
        task = Fitting(task)
        yield from Window(client, task, order, seconds=seconds, echo=echo).results()
    order.close()


def _in_process(task: Task, order: Order) -> Iterator[dict[str, Any]]:
    while (index := order.take()) is not None or (index := order.take_failed()) is not None:
        try:
            result = task(index)
        except Exception as error:
            order.failed(index, why(error))
            continue
        order.done(index)
        yield result
    order.close()
