"""Run tasks: in this process, or on the workers of a dask scheduler.

Tasks are submitted as futures in a window, so that a scheduler holds few of them however long the run
is; their results are small dicts. Nothing here knows what a task computes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pipeline.compute.clients import connected

Task = Callable[[int], dict[str, Any]]

WINDOW = 3
"""Tasks in flight per worker thread."""

IN_PROCESS = "none"


class TaskFailedError(Exception):
    """A task raised; the message says which and why."""


def default_workers() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def scheduler_address(scheduler: str | None) -> str | None:
    """Return the scheduler to connect to: the given one, or that of the environment."""
    return scheduler or os.environ.get("DASK_SCHEDULER_ADDRESS") or None


def run_tasks(
    task: Task, indices: Sequence[int], *, workers: int | None = None, scheduler: str | None = None
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
        ``"none"`` runs in this process; an address such as ``tcp://host:8786`` uses that scheduler;
        None looks at ``DASK_SCHEDULER_ADDRESS``, then starts a local cluster.

    Raises
    ------
    TaskFailedError
        As soon as a task fails; tasks in flight are given up.
    """
    address = scheduler_address(scheduler)
    if address == IN_PROCESS or workers == 0:
        yield from _in_process(task, indices)
        return
    n_workers = min(workers or default_workers(), len(indices))
    with connected(address, n_workers) as client:
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
