"""Run tasks in threads of this process.

The compiled kernel releases the GIL, and it takes nearly all of a task's time. So threads compute as fast as processes
do, with one start of Python, one compilation and one copy of the modules in memory.

A running kernel cannot be interrupted. So when a run ends early, its threads are left to finish their tasks alone, and
a gate keeps them from writing: the caller may free the run directory at once.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator
from contextvars import ContextVar
from queue import SimpleQueue
from typing import Any

from pipeline.compute.order import Order, why

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

    def close(self) -> None:
        """Let no task enter any more, and wait for those that are writing."""
        with self._changed:
            self._is_closed = True
            self._changed.wait_for(lambda: not self._n_inside)


_gate: ContextVar[Gate | None] = ContextVar("gate", default=None)


def writing_results() -> contextlib.AbstractContextManager[None]:
    """Return the context in which a task writes its results; entering it raises `EndedError` after the run's end."""
    return _gate.get() or contextlib.nullcontext()


def in_threads(task: Task, order: Order, n_threads: int) -> Generator[dict[str, Any], None, None]:
    """Run the tasks of an order in threads, and yield the results as they come.

    If the generator is closed or raises, no task writes anything after that, see `writing_results`.

    Raises
    ------
    TaskFailedError
        As soon as so many tasks have failed that the cause cannot lie in single tasks.
    """
    waiting: SimpleQueue[int | None] = SimpleQueue()
    ended: SimpleQueue[tuple[int, dict[str, Any], str]] = SimpleQueue()
    gate = Gate()

    def work() -> None:
        _gate.set(gate)
        while (index := waiting.get()) is not None:
            try:
                result, reason = task(index), ""
            except BaseException as error:
                result, reason = {}, why(error)
            ended.put((index, result, reason))

    n_running = 0
    try:
        for _ in range(n_threads):
            # daemons: the end of Python does not wait for a kernel
            threading.Thread(target=work, name="magpend task", daemon=True).start()
        while True:
            while n_running < n_threads and (index := order.take()) is not None:
                waiting.put(index)
                n_running += 1
            if not n_running:
                if (index := order.take_failed()) is None:
                    return
                waiting.put(index)
                n_running = 1
            index, result, reason = ended.get()
            n_running -= 1
            if reason:
                order.failed(index, reason)
            else:
                order.done(index)
                yield result
    finally:
        for _ in range(n_threads):
            waiting.put(None)
        gate.close()
