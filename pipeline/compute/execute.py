"""Run tasks: in this process, or on the workers of a dask scheduler.

Tasks are submitted in a window, so that a scheduler holds few of them however long the run is; their
results are small dicts. Nothing here knows what a task computes.
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
    """CPU cores that this process may use."""
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
    """Run `task` for every index and yield the results as they come.

    Where one fails, the others go on; it is tried again alone when they are done.

    Parameters
    ----------
    task
        Must be importable on the workers, or a partial of such a function. Running it twice, even at
        once, must do no harm.
    indices
        What to run, each once.
    after
        The task whose result must be there before one starts, or None; one that is not in `indices` is
        there already.
    seconds
        What a task takes on one core, as estimated [s]. A worker that is busy with it for far longer (see
        `pipeline.compute.limits`) is restarted, and the task goes elsewhere. Not looked at in this process.
    workers
        Processes of the local cluster; 0 runs in this process.
    scheduler
        Where; a text stands for ``Where(text)``.
    echo
        Takes a line when something goes wrong and is dealt with.

    Raises
    ------
    SpecError, SchedulerError
        Before anything is computed, if there are no such workers; and when the scheduler is lost.
    TaskFailedError
        At the end, if tasks failed twice; at once, if so many fail that it is not the tasks.
    """
    order = Order(indices, after)
    where = Where.of(scheduler)
    if where.resolved() == IN_PROCESS or workers == 0:
        yield from _in_process(task, order)
        return
    from pipeline.compute.probe import Fitting
    from pipeline.compute.window import Window

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
