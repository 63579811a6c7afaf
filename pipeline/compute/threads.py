"""Run tasks in threads of this process, by dask's threaded scheduler.

The compiled kernel releases the GIL, and it takes nearly all of a task's time. So threads compute as fast as processes
do, with one start of Python, one compilation and one copy of the modules in memory.

A running kernel cannot be interrupted. So when a run ends early, its threads are left to finish their tasks alone, and
a gate keeps them from writing: the caller may free the run directory at once.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from contextvars import ContextVar
from functools import partial
from multiprocessing.pool import ThreadPool
from queue import SimpleQueue
from typing import Any

from pipeline.compute.addresses import SchedulerError
from pipeline.compute.order import Order, Predecessor, TaskFailedError, why

Task = Callable[[int], dict[str, Any]]


class EndedError(Exception):
    """Raised in a task that has results to write after its run has ended."""


class Gate:
    """Context that tasks enter to write their results, until the run closes it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._n_inside = 0
        self._is_closed = False

    def __enter__(self) -> None:
        with self._changed:
            if self._is_closed:
                raise EndedError("the run has ended")
            self._n_inside += 1

    def __exit__(self, *error: object) -> None:
        with self._changed:
            self._n_inside -= 1
            self._changed.notify_all()

    @property
    def is_closed(self) -> bool:
        """Whether the run has ended."""
        return self._is_closed

    def close(self) -> None:
        """Let no task enter any more, and wait for those that are writing."""
        with self._changed:
            self._is_closed = True
            self._changed.wait_for(lambda: not self._n_inside)


_gate: ContextVar[Gate | None] = ContextVar("gate", default=None)


def writing_results() -> contextlib.AbstractContextManager[None]:
    """Return the context in which a task writes its results; entering it raises `EndedError` after the run's end."""
    return _gate.get() or contextlib.nullcontext()


@contextlib.contextmanager
def starting(n_threads: int) -> Iterator[None]:
    """Turn errors of the system in this context, which starts threads, into `SchedulerError`."""
    try:
        yield
    # multiprocessing stumbles over threads that did not start: its own error is an AttributeError
    except (OSError, RuntimeError, MemoryError, AttributeError) as error:
        raise SchedulerError(
            f"{n_threads} threads could not be started here ({why(error.__context__ or error)}). Raise the limits on "
            "open files, processes and memory (ulimit -n, -u, -v), or give fewer --workers; 0 needs no thread. "
            "Committed results stay, and the same command continues."
        ) from None


def in_threads(
    task: Task, indices: Sequence[int], after: Predecessor | None, order: Order, n_threads: int
) -> Generator[dict[str, Any], None, None]:
    """Run tasks on dask's threaded scheduler, and yield the results as they come; see
    `pipeline.compute.execute.run_tasks`.

    If the generator is closed or raises, no task writes anything after that, see `writing_results`. `order` has the
    books of the same tasks: failed ones are tried again alone, at the end. Raise `TaskFailedError` as soon as so many
    tasks have failed that the cause cannot lie in single tasks.
    """
    ended: SimpleQueue[dict[str, Any] | BaseException | None] = SimpleQueue()
    gate, books = Gate(), threading.Lock()
    tried: set[int] = set()

    def note(index: int, reason: str) -> None:
        """Enter an ended task in the books, in its own thread: no task begins between too many failures and the end."""
        with books:
            tried.add(index)
            if not reason:
                return order.done(index)
            try:
                order.failed(index, reason)
            except TaskFailedError as given_up:
                gate.close()
                ended.put(given_up)

    def attempt(index: int, *is_done: bool) -> bool:
        """Run a task whose predecessor is done, and return whether it is done as well."""
        if gate.is_closed or not all(is_done):
            return False
        _gate.set(gate)
        try:
            result, reason = task(index), ""
        except BaseException as error:
            result, reason = {}, why(error)
        note(index, reason)
        if not reason:
            ended.put(result)
        return not reason

    def compute(chosen: Collection[int]) -> None:
        from dask.threaded import get

        graph = {}
        for index in chosen:
            before = after(index) if after else None
            graph[f"task {index}"] = (partial(attempt, index), *[f"task {before}"] * (before in chosen))
        try:
            with starting(n_threads):
                pool = ThreadPool(n_threads)  # its threads are daemons: the end of Python does not wait for a kernel
            with contextlib.closing(pool):
                get(graph, list(graph), pool=pool)
        except BaseException as error:  # the run must not wait for ever
            ended.put(error)
        else:
            ended.put(None)

    chosen: Collection[int] = set(indices)
    try:
        while chosen:
            with starting(n_threads):
                threading.Thread(target=compute, args=(chosen,), daemon=True).start()
            while (end := ended.get()) is not None:
                if isinstance(end, BaseException):
                    raise end
                yield end
            chosen = _rest(order, tried)
    finally:
        gate.close()


def _rest(order: Order, tried: Collection[int]) -> list[int]:
    """Return the tasks that wait for one that was tried again with success, or the next one to try again."""
    ready = []
    while (index := order.take()) is not None:
        ready.append(index)
    ready = [index for index in ready if index not in tried]
    if not ready and (index := order.take_failed()) is not None:
        ready.append(index)
    return ready
