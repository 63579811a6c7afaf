"""Run live jobs in threads: one of each kind at a time, and a newer job cancels the older one."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from magpend_core.models.parameters import ParameterError
from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.live.messages import Request
from pipeline.explorer.live.settling import CancelledError
from pipeline.specification.problems import SpecError
from pipeline.store.errors import StoreError

LOG = logging.getLogger(__name__)

PATIENCE_S = 8.0
"""Time that the run of a region has to end in order, until it is killed [s]."""

Piece = dict[str, Any] | bytes
"""JSON, or what `pack_arrays` gives."""

Emit = Callable[[Piece], None]


class Job:
    """A live job: a request of the page, with the functions that send its answers."""

    def __init__(self, request: Request) -> None:
        self.request, self.id = request, request.id
        self._cancelled = threading.Event()
        self._emit: Emit = _nowhere

    def answers_to(self, emit: Emit) -> None:
        """Set the function that sends the answers of this job to the page."""
        self._emit = emit

    def cancel(self) -> None:
        """Ask this job to end when it next checks."""
        self._cancelled.set()

    def check(self) -> None:
        """Raise CancelledError if this job has been cancelled."""
        if self._cancelled.is_set():
            raise CancelledError

    def wait(self, seconds: float) -> None:
        """Wait for some seconds; raise CancelledError at once if the job is cancelled."""
        self._cancelled.wait(seconds)
        self.check()

    def tell(self, kind: str, **fields: Any) -> None:
        """Send an answer to the page as a JSON object."""
        if kind != "done" or not fields.get("cancelled"):
            self.check()
        self._emit({"id": self.id, "kind": kind, **fields})

    def show(self, kind: str, arrays: Mapping[str, np.ndarray], **attrs: Any) -> None:
        """Send an answer to the page as packed arrays."""
        self.check()
        self._emit(pack_arrays(arrays, {"id": self.id, "kind": kind, **attrs}))


def _nowhere(answer: Piece) -> None:
    """Ignore an answer; used until a job has a receiver."""


Work = Callable[[Job], None]


class Desk:
    """Queue of live jobs of one kind. One job runs at a time, in a thread that exists only while there are jobs."""

    def __init__(self, emit: Emit, work: Work) -> None:
        self._emit, self._work = emit, work
        self._lock = threading.Lock()
        self._waiting: Job | None = None
        self._current: Job | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def put(self, job: Job) -> None:
        """Add a job. It cancels the job that runs, and replaces the job that waits."""
        job.answers_to(self._emit)
        with self._lock:
            if self._closed:
                return
            left, self._waiting = self._waiting, job
            if self._current is not None:
                self._current.cancel()
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="magpend-desk", daemon=True)
                self._thread.start()
        if left is not None:
            left.tell("done", cancelled=True)

    def cancel(self, number: int) -> None:
        """Cancel the job with a given number, if it runs or waits."""
        left = None
        with self._lock:
            if self._waiting is not None and self._waiting.id == number:
                left, self._waiting = self._waiting, None
            if self._current is not None and self._current.id == number:
                self._current.cancel()
        if left is not None:
            left.tell("done", cancelled=True)

    def close(self) -> None:
        """Cancel all jobs of this queue, and accept no more."""
        with self._lock:
            self._closed, self._waiting = True, None
            if self._current is not None:
                self._current.cancel()

    @property
    def is_busy(self) -> bool:
        """Whether a job of this queue runs or waits."""
        return self._thread is not None

    def join(self, timeout: float) -> None:
        """Wait until no job of this queue runs, at most `timeout` seconds."""
        thread = self._thread
        if thread is not None:
            thread.join(timeout)

    def _serve(self) -> None:
        while True:
            with self._lock:
                self._current, self._waiting = self._waiting, None
                if self._current is None:
                    self._thread = None
                    return
                job = self._current
            self._do(job)

    def _do(self, job: Job) -> None:
        try:
            self._work(job)
        except CancelledError:
            self._emit({"id": job.id, "kind": "done", "cancelled": True})
        except Exception as error:
            self._emit({"id": job.id, "kind": "error", "error": sentence_of_error(error)})


def sentence_of_error(error: Exception) -> str:
    """Return a sentence about an error for the user; write unexpected errors to the log."""
    problems = getattr(error, "problems", None)
    if isinstance(error, SpecError | ParameterError) and problems:
        return str(problems[0])
    if isinstance(error, RequestError | StoreError | ArithmeticError):
        return str(error)
    LOG.error("a live job failed", exc_info=error)
    return f"this could not be computed ({type(error).__name__}); the server's log has more."
