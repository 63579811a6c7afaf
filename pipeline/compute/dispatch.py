"""Run tasks on the workers of a dask scheduler, with few tasks per thread at a time, and restart workers whose task
hangs. Workers that fall silent are the scheduler's business (its setting ``worker-ttl``).

All waiting happens in the client's event loop. Results and starts of tasks arrive in one queue, so that a
stopped worker cannot hold up the others.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from pipeline.compute.addresses import SchedulerError
from pipeline.compute.order import Order, why
from pipeline.compute.threads import Task

# ---- limits of the run time ------------------------------------------------------------------------

LEAST_S = 60.0
"""Least limit of any task [s]."""

FACTOR = 10.0
"""Limit of a task in units of its estimate times the worst ratio so far of a task's time to its estimate."""

SHORT_S = 1.0
"""Shorter tasks are not compared with their estimates, since starting dominates their time [s]."""

MORE = 2.0
"""Factor of the limit from one try of a task to the next."""


class Limits:
    """Limits of the run time of tasks, from estimated times on one core [s], if there are any, and measured ones."""

    def __init__(self, seconds: Callable[[int], float] | None) -> None:
        self._seconds = seconds
        self._worst = 1.0

    def finished(self, index: int, took_s: float) -> None:
        """Record how long a finished task took, to correct the estimates for the others."""
        if self._seconds is not None and took_s > SHORT_S:
            self._worst = max(self._worst, took_s / max(self._seconds(index), 1e-9))

    def limit_s(self, index: int, tries: int) -> float:
        """Return the time after which a task is given up [s]; it is longer for each further try."""
        if self._seconds is None:
            return float("inf")
        return max(LEAST_S, FACTOR * self._worst * self._seconds(index)) * MORE ** (tries - 1)


# ---- tasks in flight -------------------------------------------------------------------------------

WINDOW = 3
"""Tasks in flight (submitted, not finished) per worker thread."""

TICK_S = 1.0
"""Time between two looks at the scheduler [s]."""

SCHEDULER_S = 30.0
"""Longest wait for an answer of the scheduler [s]; after it the scheduler counts as gone."""

WAITING_S = 30.0
"""Time without workers after which a line is printed [s]."""

MOST_HANGS = 2
"""Number of hangs after which a task is set aside; it is tried again alone, after all others."""

Echo = Callable[[str], None]


@dataclass
class _Flight:
    """A task that was sent to a worker: its index, its future, its start time and the worker."""

    index: int
    future: Any
    started: float | None = None
    worker: str = ""


def announced(task: Task, topic: str, ticket: int, index: int) -> dict[str, Any]:
    """Run a task on a dask worker, after telling the client that it starts."""
    from distributed import get_worker

    worker = get_worker()
    worker.log_event(topic, {"ticket": ticket, "worker": worker.address})
    return task(index)


class Window:
    """Sends the tasks of an `Order` to the workers of a dask client, with a limited number of tasks at a time.

    The task's function must be importable on the workers. `seconds` estimates the time of a task on one core [s];
    `echo` prints a line on a problem that the window has dealt with.
    """

    def __init__(
        self,
        client: Any,
        task: Task,
        order: Order,
        *,
        seconds: Callable[[int], float] | None = None,
        echo: Echo = print,
    ) -> None:
        self._client, self._order, self._echo = client, order, echo
        self._limits = Limits(seconds)
        self._topic = f"magpend-{uuid.uuid4().hex}"
        self._task = partial(announced, task, self._topic)
        self._flights: dict[int, _Flight] = {}
        self._ticket = 0
        self._news: queue.SimpleQueue[tuple[str, int, Any]] = queue.SimpleQueue()
        self._hangs: dict[int, int] = {}
        self._n_threads = 0
        self._now = self._looked = 0.0
        self._clock = time.monotonic()
        self._waiting_since: float | None = None

    def results(self) -> Iterator[dict[str, Any]]:
        """Yield the results of tasks in the order in which the tasks finish.

        Raise `TaskFailedError` as soon as so many tasks have failed that the cause cannot lie in single tasks, and
        `SchedulerError` if the scheduler is gone.
        """
        self._client.subscribe_topic(self._topic, self._on_start)
        self._look()
        self._fill()
        while self._flights:
            for kind, ticket, value in self._wait():
                yield from self._take(kind, ticket, value)
            self._tick()
            if self._now - self._looked >= TICK_S:
                self._look()
                self._give_up_late()
            self._fill()

    def _fill(self) -> None:
        """Send ready tasks until enough are in flight; at the end send failed tasks again, one at a time."""
        wanted = WINDOW * max(self._n_threads, 1) - len(self._flights)
        chosen: list[int] = []
        while len(chosen) < wanted and (index := self._order.take()) is not None:
            chosen.append(index)
        if not chosen and not self._flights and (index := self._order.take_failed()) is not None:
            chosen.append(index)
        if chosen:
            self._submit(chosen)

    def _tick(self) -> None:
        """Advance a clock that stops while this process is suspended, so that no task is blamed for that time."""
        now = time.monotonic()
        self._now += min(now - self._clock, 5 * TICK_S)
        self._clock = now

    def _submit(self, indices: list[int]) -> None:
        tickets = range(self._ticket, self._ticket + len(indices))
        self._ticket = tickets.stop
        futures = self._client.map(self._task, tickets, indices, pure=False)
        for ticket, index, future in zip(tickets, indices, futures, strict=True):
            self._flights[ticket] = _Flight(index, future)
            # Not by the future's own callbacks: all clients of this process share one thread for these, and a
            # callback that waits for a client that is closed meanwhile would hold up every later run.
            ended = asyncio.run_coroutine_threadsafe(_outcome(self._client, future), self._client.loop.asyncio_loop)
            ended.add_done_callback(partial(self._on_end, ticket))

    def _on_start(self, event: tuple[float, dict[str, Any]]) -> None:
        self._news.put(("start", event[1]["ticket"], event[1]["worker"]))

    def _on_end(self, ticket: int, ended: Any) -> None:
        if not ended.cancelled():  # as it is when the client closes
            self._news.put(("end", ticket, ended.result()))

    def _wait(self) -> Iterator[tuple[str, int, Any]]:
        """Wait for tasks to start or end, at most `TICK_S`, and yield these events."""
        with contextlib.suppress(queue.Empty):
            yield self._news.get(timeout=TICK_S)
            while True:
                yield self._news.get_nowait()

    def _take(self, kind: str, ticket: int, value: Any) -> Iterator[dict[str, Any]]:
        flight = self._flights.get(ticket)
        if flight is None:
            return  # the event belongs to a task that was given up
        if kind == "start":
            flight.started, flight.worker = self._now, value
            return
        del self._flights[ticket]
        result, error = value
        if error is None:
            if flight.started is not None:
                self._limits.finished(flight.index, self._now - flight.started)
            self._order.done(flight.index)
            yield result
        elif isinstance(error, asyncio.CancelledError):
            raise SchedulerError(self._lost())
        else:
            self._order.failed(flight.index, _reason(error))

    def _lost(self) -> str:
        return (
            f"The scheduler {self._client.scheduler.address} is gone. Committed results stay; the same "
            "command continues once a scheduler is there."
        )

    def _look(self) -> None:
        """Ask the scheduler how many threads its workers have, and say if there are none for long."""
        try:
            found = self._client.sync(self._client.scheduler.ncores, callback_timeout=SCHEDULER_S)
        except (OSError, TimeoutError) as error:
            raise SchedulerError(self._lost()) from error
        self._looked, self._n_threads = self._now, sum(found.values())
        self._say_if_waiting()

    def _say_if_waiting(self) -> None:
        if self._n_threads:
            self._waiting_since = None
        elif self._waiting_since is None:
            self._waiting_since = self._now
        elif self._now - self._waiting_since > WAITING_S:
            self._waiting_since = float("inf")
            self._echo("the scheduler has no workers; waiting for some")

    def _give_up_late(self) -> None:
        """Give up tasks that exceed their time limit, and restart their workers."""
        for ticket, flight in list(self._flights.items()):
            if flight.started is None:
                continue
            tries = 1 + self._hangs.get(flight.index, 0)
            limit = self._limits.limit_s(flight.index, tries)
            if self._now - flight.started > limit:
                self._give_up(ticket, flight, limit)

    def _give_up(self, ticket: int, flight: _Flight, limit: float) -> None:
        del self._flights[ticket]
        flight.future.cancel(force=True)
        self._restart(flight.worker)
        hangs = self._hangs[flight.index] = 1 + self._hangs.get(flight.index, 0)
        text = f"not done after {limit:.0f} s, far more than estimated"
        self._echo(f"task {flight.index}: {text}; its worker is restarted")
        if hangs < MOST_HANGS:
            self._submit([flight.index])
        else:
            self._order.failed(flight.index, text)

    def _restart(self, address: str) -> None:
        threading.Thread(target=_restarted, args=(self._client, address), daemon=True).start()


async def _outcome(client: Any, future: Any) -> tuple[Any, BaseException | None]:
    """Wait for a task; return its result or its error. If its worker died after the end, dask computes it again."""
    try:
        return await client.gather(future, asynchronous=True), None
    except (Exception, asyncio.CancelledError) as error:
        return None, asyncio.CancelledError() if future.status == "cancelled" else error


def _restarted(client: Any, address: str) -> None:
    """Restart a dask worker in a new thread, and wait there until it is back: a suspended worker answers slowly."""
    with contextlib.suppress(Exception):
        client.restart_workers([address], timeout=SCHEDULER_S, raise_for_error=False)


def _reason(error: BaseException) -> str:
    from distributed.scheduler import KilledWorker

    if isinstance(error, KilledWorker):
        n = error.allowed_failures + 1
        times = "died" if n == 1 else f"died {n} times"
        return f"its worker {times} (out of memory, or killed)"
    return why(error)
