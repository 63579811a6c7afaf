"""Answer the pages of a widget: read their messages, and send what the server would send.

A page is one output that shows the widget; a notebook can show it several times. Messages of pages are objects with
``page``, a name that the page has chosen, and one of

    {"page", "id", "ask": NAME, "words": {...}, "body": TEXT}   a request for data, see `answers`
    {"page", "live": TEXT}                                      a message of `live.messages`
    {"page", "open": true}, {"page", "close": true}             the page begins or ends to compute live

Answers name the page as well, and have their content in a buffer, byte for byte what the server sends:

    {"page", "id", "status", "kind", "filename"}, [content]     or {"page", "id", "status", "error"}
    {"page", "live": TEXT} or {"page", "live": true}, [content]
"""

from __future__ import annotations

import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from pipeline.explorer.answers import ANSWERS, Answering, Query, RefusedRequestError, Reply
from pipeline.explorer.live.jobs import Piece
from pipeline.explorer.live.session import LiveSession

LOG = logging.getLogger(__name__)

LEAST_HEIGHT = 320
"""Lowest widget in which the diagram has its axes [CSS px]."""


MOST_PAGES = 8
"""Pages of a widget that may compute live at once; a further one ends the session of the oldest."""

Send = Callable[[dict[str, Any], list[bytes]], None]


class GoneError(Exception):
    """Raised by a function that sends, if no page can take messages any more."""


class Connection:
    """Messages between the pages of a widget and the run that answers them.

    ``send(content, buffers)`` sends a message to all pages; it is called from several threads, one call at a time. If
    it raises GoneError, all jobs are cancelled.
    """

    def __init__(self, answering: Answering, send: Send) -> None:
        self._answering, self._deliver = answering, send
        self._sessions: OrderedDict[str, LiveSession] = OrderedDict()
        self._pages: set[str] = set()
        self._lock, self._sending = threading.Lock(), threading.Lock()
        self._begun = self._closed = False

    def receive(self, message: Any) -> None:
        """Handle a message of a page, and return at once; what is no message of a page is ignored."""
        page = message.get("page") if isinstance(message, Mapping) else None
        if not isinstance(page, str) or self._closed:
            return
        self._pages.add(page)
        if not self._begun:  # a widget that nobody looks at computes nothing
            self._begun = True
            self._answering.warm()
        if "ask" in message:
            self._ask(page, message)
        elif message.get("open"):
            self._open(page)
        elif message.get("close"):
            self.leave(page)
        elif isinstance(message.get("live"), str):
            session = self._sessions.get(page) or self._open(page)
            if session is not None:
                session.receive(message["live"])

    # ---- data --------------------------------------------------------------------------------

    def _ask(self, page: str, message: Mapping[str, Any]) -> None:
        head = {"page": page, "id": message.get("id")}
        name, words, body = message["ask"], message.get("words") or {}, message.get("body") or ""
        if name not in ANSWERS:
            self._send({**head, "status": 404, "error": "there is no such page"}, [])
            return
        query = Query({str(k): str(v) for k, v in words.items()}, str(body).encode())
        self._answering.ask(name, query).add_done_callback(lambda found: self._reply(head, found))

    def _reply(self, head: dict[str, Any], found: Future[Reply]) -> None:
        error = found.exception()
        if error is None:
            reply = found.result()
            told = {"status": 200, "kind": reply.kind, "filename": reply.filename}
            self._send({**head, **told}, [reply.content])
        else:
            status = error.status if isinstance(error, RefusedRequestError) else 500
            self._send({**head, "status": status, "error": str(error)}, [])

    # ---- live computation --------------------------------------------------------------------

    def _open(self, page: str) -> LiveSession | None:
        """Begin a session for a page, which may have had one before."""
        live = self._answering.live
        if live is None:
            return None

        def emit(answer: Piece) -> None:
            if isinstance(answer, bytes):
                self._send({"page": page, "live": True}, [answer])
            else:
                self._send({"page": page, "live": json.dumps(answer, allow_nan=False)}, [])

        self._end_session(page)
        session = LiveSession(live, emit)
        with self._lock:
            self._sessions[page] = session
            left = [self._sessions.popitem(last=False)[1] for _ in range(len(self._sessions) - MOST_PAGES)]
        for one in left:
            one.close()
        return session

    def leave(self, page: str) -> None:
        """Cancel all jobs of a page that is gone."""
        self._end_session(page)
        self._pages.discard(page)
        if not self._pages:  # notebooks keep the widget of a cell that runs again
            self._answering.run.drop_large()

    def _end_session(self, page: str) -> None:
        with self._lock:
            session = self._sessions.pop(page, None)
        if session is not None:
            session.close()

    def close(self) -> None:
        """Cancel all jobs of all pages, and send nothing more."""
        self._closed = True
        for page in list(self._sessions):
            self._end_session(page)

    # ---- sending -----------------------------------------------------------------------------

    def _send(self, content: dict[str, Any], buffers: list[bytes]) -> None:
        if self._closed:
            return
        try:
            with self._sending:
                self._deliver(content, buffers)
        except GoneError:
            self.close()
        except Exception as error:  # such as a connection that was just lost: nobody is left to be told
            LOG.info("a page of a notebook takes nothing: %s", error)
