"""Run tasks: in this process, or on the workers of a dask scheduler.

Tasks are submitted as futures in a window, so that a scheduler holds few of them however long the run
is; their results are small dicts. Nothing here knows what a task computes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pipeline.compute.clients import IN_PROCESS, Where, connected

Task = Callable[[int], dict[str, Any]]

WINDOW = 3
"""Tasks in flight per worker thread."""


class TaskFailedError(Exception):
    """A task raised; the message says which and why."""


def default_workers() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(
    task: Task,
    indices: Sequence[int],
    *,
    workers: int | None = None,
    scheduler: Where | str | None = None,
    echo: Callable[[str], None] = print,
) -> Iterator[dict[str, Any]]:
    """Run `task` for every index and yield the results as they come.

    Parameters
    ----------
    task
        Must be importable on the workers, or a partial of such a function.
    indices
        What to run.
    workers
        Processes of the local cluster; 0 runs in this process.
    scheduler
        Where; a text stands for ``Where(text)``.
    echo
        Prints a line.

    Raises
    ------
    SpecError, SchedulerError
        Before anything is computed, if there are no such workers.
    TaskFailedError
        As soon as a task fails; tasks in flight are given up.
    """
    where = Where.of(scheduler)
    if where.resolved() == IN_PROCESS or workers == 0:
        yield from _in_process(task, indices)
        return
    n_workers = min(workers or default_workers(), len(indices))
    with connected(where, n_workers, echo) as client:
        yield from _window(client, task, indices)


def _in_process(task: Task, indices: Sequence[int]) -> Iterator[dict[str, Any]]:
    for index in indices:
        try:
            result = task(index)
        except Exception as error:
            raise TaskFailedError(f"task {index}: {type(error).__name__}: {error}") from error
        yield result


def _window(client: Any, task: Task, indices: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Keep a few tasks per thread in flight, and yield results in the order in which they finish."""
    from distributed import as_completed

    threads = sum(client.nthreads().values()) or 1
    waiting = iter(indices)
    names = {}

    def submit(n: int) -> list[Any]:
        chosen = [i for _, i in zip(range(n), waiting, strict=False)]
        futures = client.map(task, chosen, pure=False)
        names.update({f.key: i for f, i in zip(futures, chosen, strict=True)})
        return list(futures)

    pending = as_completed(submit(WINDOW * threads), loop=client.loop)  # type: ignore[no-untyped-call]
    for batch in pending.batches():  # type: ignore[no-untyped-call]
        for future in batch:
            index = names.pop(future.key)
            if future.status != "finished":
                error = future.exception()
                raise TaskFailedError(f"task {index}: {type(error).__name__}: {error}") from error
            yield future.result()
        for future in submit(len(batch)):
            pending.add(future)  # type: ignore[no-untyped-call]
