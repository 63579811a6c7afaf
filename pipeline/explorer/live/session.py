"""Receive the messages of one page, run its jobs, and send the answers.

A session takes messages (see `messages`) and passes its answers to a callback: dictionaries for JSON, and bytes of
`arrays.pack_arrays`. One job of each kind runs at a time, and a newer one replaces it. A session does not know how
messages travel.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from functools import partial

from pipeline.explorer import RequestError
from pipeline.explorer.live.jobs import Desk, Job, Piece, Work
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.messages import CancelRequest, Request, read_request
from pipeline.explorer.live.orbit_following import Follower
from pipeline.explorer.live.regions import RegionRunner
from pipeline.explorer.live.slices import slice_of
from pipeline.explorer.live.starting import start


def works(live: LiveRun) -> Mapping[str, Work]:
    """Return the function that does each kind of live job, by the kind's name."""
    return {
        "start": partial(start, live),
        "slice": partial(slice_of, live),
        "follow": Follower(live).follow,
        "run": RegionRunner(live).run,
    }


LOG = logging.getLogger(__name__)


class LiveSession:
    """Live session of one page: its queues of jobs, and the function that sends answers.

    `emit` is called from threads of jobs, one call at a time for each kind of job.
    """

    def __init__(self, live: LiveRun, emit: Callable[[Piece], None]) -> None:
        self.live = live
        self._emit, self._closed = emit, threading.Event()
        self._desks = {kind: Desk(self._emit_open, work) for kind, work in works(live).items()}
        live.enter(self)
        live.warm(self._tell_warming)

    def _tell_warming(self, done: int, total: int) -> None:
        self._emit_open({"id": None, "kind": "progress", "what": "warming", "done": done, "total": total})

    def _emit_open(self, answer: Piece) -> None:
        if not self._closed.is_set():
            self._emit(answer)

    def receive(self, text: str | bytes) -> None:
        """Handle a message of the page. Errors are sent as answers, and never raised."""
        try:
            request: Request = read_request(text)
        except RequestError as error:
            self._emit_open({"id": error.job, "kind": "error", "error": str(error)})
            return
        except Exception as error:  # a message never ends the server
            LOG.warning("message refused: %s", error)
            self._emit_open({"id": None, "kind": "error", "error": "the message cannot be read."})
            return
        if isinstance(request, CancelRequest):
            for desk in self._desks.values():
                desk.cancel(request.job)
            self._emit_open({"id": request.id, "kind": "done"})
            return
        self._desks[request.do].put(Job(request))

    def close(self) -> None:
        """Cancel all jobs of the session, and send no more answers."""
        self._closed.set()
        for desk in self._desks.values():
            desk.close()
        if self.is_over:  # else it is still waited for when the run is closed
            self.live.leave(self)

    @property
    def is_over(self) -> bool:
        """Whether the session is closed and none of its jobs runs."""
        return self._closed.is_set() and not any(desk.is_busy for desk in self._desks.values())

    def join(self, timeout: float = 30.0) -> None:
        """Wait until no job of the session runs."""
        for desk in self._desks.values():
            desk.join(timeout)
