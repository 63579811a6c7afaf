"""Serve the websocket through which a page computes live."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable
from typing import Any

from tornado.ioloop import IOLoop
from tornado.web import RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from pipeline.explorer.live.jobs import Answer
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.messages import MOST_BYTES, number_in
from pipeline.explorer.live.session import LiveSession

LOG = logging.getLogger(__name__)

MOST_CONNECTIONS = 8
"""Pages that may watch at once."""

MOST_PER_SECOND, MOST_AT_ONCE = 40.0, 80.0
"""Messages that a page may send, lastingly and in a burst."""

MOST_WAITING = 64 * 2**20
"""Bytes that may wait to be sent to a page that does not take them; then it is left."""

Authorised = Callable[[RequestHandler], bool]
Route = tuple[str, type[WebSocketHandler], dict[str, Any]]


def socket_routes(live: LiveRun, authorised: Authorised) -> list[Route]:
    """Return the tornado routes of the websocket for live computation.

    Parameters
    ----------
    live
        The run; one object for all connections.
    authorised
        Says whether a request may connect, by its token and its host; that its origin is this server is
        looked at besides.
    path
        Pattern of the address.
    """
    return [("/ws", LiveSocket, {"live": live, "authorised": authorised, "others": set()})]


class LiveSocket(WebSocketHandler):
    """Websocket connection of one page that computes live."""

    def initialize(self, live: LiveRun, authorised: Authorised, others: set[LiveSocket]) -> None:
        """Store the run, the function that checks requests, and the set of open connections."""
        self._live, self._authorised, self._others = live, authorised, others
        self._session: LiveSession | None = None
        self._allowance, self._heard = MOST_AT_ONCE, time.monotonic()
        self._waiting = 0

    async def prepare(self) -> None:
        """Refuse a connection without a valid token, or if too many are open."""
        if not self._authorised(self):
            self.set_status(403)
            await self.finish({"error": "this address has no valid token, or another page asks."})
        elif len(self._others) >= MOST_CONNECTIONS:
            self.set_status(503)
            await self.finish({"error": f"{MOST_CONNECTIONS} pages watch already; close one."})

    def open(self, *args: str, **kwargs: str) -> None:
        """Start a live session for the new connection."""
        self._others.add(self)
        self.set_nodelay(True)
        loop = IOLoop.current()

        def emit(answer: Answer) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.add_callback(self._send, answer)

        self._session = LiveSession(self._live, emit)

    def on_message(self, message: str | bytes) -> None:
        """Handle a message of the page, or answer that messages come too fast."""
        now = time.monotonic()
        self._allowance = min(MOST_AT_ONCE, self._allowance + MOST_PER_SECOND * (now - self._heard)) - 1.0
        self._heard = now
        if self._allowance < 0.0:
            self._allowance = 0.0
            told = "too many messages; send fewer."
            self._send({"id": number_in(message), "kind": "error", "error": told})
        elif self._session is not None:
            self._session.receive(message)

    def _send(self, answer: Answer) -> None:
        if self.ws_connection is None:
            return
        is_binary = isinstance(answer, bytes)
        data = answer if isinstance(answer, bytes) else json.dumps(answer, allow_nan=False)
        self._waiting += len(data)
        if self._waiting > MOST_WAITING:
            LOG.warning("a page takes nothing any more; it is left")
            self.close(1008, "too slow")
            return
        with contextlib.suppress(WebSocketClosedError):
            sent = asyncio.ensure_future(self.write_message(data, binary=is_binary))
            sent.add_done_callback(lambda done: self._sent(done, len(data)))

    def _sent(self, done: asyncio.Future[None], n_bytes: int) -> None:
        self._waiting -= n_bytes
        if not done.cancelled():
            done.exception()  # a page that has gone is nobody's mistake

    def on_close(self) -> None:
        """Cancel all jobs of the connection."""
        self._others.discard(self)
        if self._session is not None:
            self._session.close()

    @property
    def max_message_size(self) -> int:
        """Length of the longest message that is accepted [bytes]."""
        return MOST_BYTES


__all__ = ["LiveSocket", "socket_routes"]
