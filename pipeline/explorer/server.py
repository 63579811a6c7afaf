"""Serve the interactive page of a run on this machine only: page, data and a websocket for live computation.

What takes long to import is imported once the address is known, while a browser starts. `security` says who is
answered.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import logging
import os
import shutil
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tornado import httpserver, web
from tornado.ioloop import IOLoop
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from pipeline.explorer import html
from pipeline.explorer.live.messages import MOST_BYTES, number_in
from pipeline.explorer.security import Guard, Rate, headers_of, new_token
from pipeline.runs.stopping import Stopped, first_signal
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    from pipeline.explorer.answers import Answer
    from pipeline.explorer.live.jobs import Piece
    from pipeline.explorer.live.live import LiveRun
    from pipeline.explorer.live.session import LiveSession


LOG = logging.getLogger(__name__)

_REDIRECT = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="refresh" content="0; url={address}">
<meta name="referrer" content="no-referrer">
<title>magpend</title>
</head>
<body><a href="{address}">magpend explore</a></body>
</html>
"""


def redirect_file(folder: Path, address: str) -> Path:
    """Write a file that redirects a browser to an address, and that only this user can read."""
    path = folder / "open.html"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(_REDIRECT.format(address=escape(address)))
    return path


@contextlib.contextmanager
def browser() -> Iterator[Callable[[str], None]]:
    """Yield a function that opens an address in the user's browser without waiting for it.

    The redirect file exists as long as the block runs.
    """
    folder = Path(tempfile.mkdtemp(prefix="magpend-explore-"))

    def open_address(address: str) -> None:
        path = redirect_file(folder, address)
        threading.Thread(target=webbrowser.open, args=(path.as_uri(),), daemon=True, name="browser").start()

    try:
        yield open_address
    finally:
        shutil.rmtree(folder, ignore_errors=True)


MOST_CONNECTIONS = 8
"""Pages that may watch at once."""

MOST_PER_SECOND, MOST_AT_ONCE = 40.0, 80
"""Messages that a page may send, lastingly and in a burst."""

MOST_UNSENT = 64 * 2**20
"""Bytes that may wait to be sent to a page that does not take them; then it is left."""


class LiveSocket(WebSocketHandler):
    """Websocket connection of one page that computes live."""

    def initialize(self, service: Service, live: LiveRun, others: set[LiveSocket]) -> None:
        """Store the service, its run, and the set of open connections."""
        self._service, self._live, self._others = service, live, others
        self._session: LiveSession | None = None
        self._rate = Rate(MOST_PER_SECOND, MOST_AT_ONCE)
        self._waiting = 0

    async def prepare(self) -> None:
        """Refuse a connection without a valid token, or if too many are open."""
        guard, headers = self._service.guard, self.request.headers
        if guard.foreign(headers) or not guard.authorised(headers, self.get_query_argument("token", "")):
            self.set_status(403)
            await self.finish({"error": "this address has no valid token, or another page asks."})
        elif len(self._others) >= MOST_CONNECTIONS:
            self.set_status(503)
            await self.finish({"error": f"{MOST_CONNECTIONS} pages watch already; close one."})

    def open(self, *args: str, **kwargs: str) -> None:
        """Start a live session for the new connection."""
        from pipeline.explorer.live.session import LiveSession

        self._others.add(self)
        self.set_nodelay(True)
        loop = IOLoop.current()

        def emit(answer: Piece) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.add_callback(self._send, answer)

        self._session = LiveSession(self._live, emit)

    def on_message(self, message: str | bytes) -> None:
        """Handle a message of the page, or answer that messages come too fast."""
        if not self._rate.allows():
            told = "too many messages; send fewer."
            self._send({"id": number_in(message), "kind": "error", "error": told})
        elif self._session is not None:
            self._session.receive(message)

    def _send(self, answer: Piece) -> None:
        if self.ws_connection is None:
            return
        is_binary = isinstance(answer, bytes)
        data = answer if isinstance(answer, bytes) else json.dumps(answer, allow_nan=False)
        self._waiting += len(data)
        if self._waiting > MOST_UNSENT:
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


HOST = "127.0.0.1"

MOST_BODY, MOST_HEADERS = 64 * 1024, 16 * 1024
"""Bytes of a request."""

MOST_SILENCE_S = 60.0
"""Longest time that a connection may send no request, take nothing of an answer, or answer no ping [s]."""

LIMITS: dict[str, Any] = {
    "max_body_size": MOST_BODY,
    "max_header_size": MOST_HEADERS,
    "max_buffer_size": MOST_BODY + MOST_HEADERS,
    "idle_connection_timeout": MOST_SILENCE_S,
    "body_timeout": 20.0,
}
"""What a connection may take."""

MOST_ADDRESS = 4096
"""Characters of an address: more is none that the page makes."""

PER_SECOND, BURST = 40.0, 120
"""Requests that are answered."""

STRANGERS_PER_SECOND, STRANGERS_BURST = 4.0, 20
"""Requests without the token, which are all refused."""

STATIC = {
    "explorer.js": "text/javascript; charset=utf-8",
    "explorer.css": "text/css; charset=utf-8",
    "LICENSES.txt": "text/plain; charset=utf-8",
}
"""Files of the page, by name: no other is served, and none is looked up by what a request says."""


def static_files() -> dict[str, tuple[bytes, str]]:
    """Read the static files of the page; return their contents and media types by name."""
    folder = resources.files("pipeline.explorer") / "static"
    return {name: ((folder / name).read_bytes(), kind) for name, kind in STATIC.items() if (folder / name).is_file()}


class Service:
    """State that all request handlers share: the run that answers, the check of requests, and rate limits."""

    def __init__(self, run: RunDirectory, guard: Guard) -> None:
        from pipeline.explorer.answers import Answering

        self.answering = Answering(run)
        self.guard, self.rate = guard, Rate(PER_SECOND, BURST)
        self.strangers = Rate(STRANGERS_PER_SECOND, STRANGERS_BURST)
        self.files = Rate(PER_SECOND, BURST)
        self.static = static_files()


class Handler(web.RequestHandler):
    """Base of all request handlers: it checks the token and the rate of requests, and sets headers."""

    needs_token = True
    service: Service

    def initialize(self, service: Service) -> None:
        """Store the service, which all handlers share."""
        self.service = service

    def set_default_headers(self) -> None:
        """Set the headers of every answer, also of errors."""
        service: Service | None = getattr(self, "service", None) or self.application.settings.get("service")
        if service is not None:
            for name, value in headers_of(service.guard.port).items():
                self.set_header(name, value)

    def compute_etag(self) -> str | None:
        """Switch entity tags off: browsers must not store answers, and hashing a large diagram takes time."""
        return None

    def prepare(self) -> None:
        """Reject a request with a wrong origin or token, too long an address, or above the rate limit."""
        guard, headers = self.service.guard, self.request.headers
        if len(self.request.uri or "") > MOST_ADDRESS:
            self.refuse(414, "the address is too long")
            return
        foreign = guard.foreign(headers)
        known = not foreign and guard.authorised(headers, self.get_query_argument("token", ""))
        # requests without a token must not use up the rate of valid ones
        free = known or not self.needs_token
        budget = self.service.rate if known else self.service.files if free else self.service.strangers
        if foreign is None and not budget.allows():
            self.refuse(429, "too many requests; wait a moment")
        elif foreign is not None:
            self.refuse(403, foreign)
        elif not free:
            self.refuse(403, "the token is missing or wrong; use the address that magpend explore printed")

    def refuse(self, status: int, sentence: str) -> None:
        """Answer a request with an error status and a sentence, as JSON."""
        self.set_status(status)
        self.set_header("Content-Type", "application/json; charset=utf-8")
        self.finish(json.dumps({"error": sentence}))

    def finish(self, chunk: str | bytes | dict[str, Any] | None = None) -> asyncio.Future[None]:
        """Send the answer, and close the connection if its client does not take it in time."""
        loop, sent = IOLoop.current(), super().finish(chunk)
        late = loop.call_later(MOST_SILENCE_S, self._leave)
        sent.add_done_callback(lambda _: loop.remove_timeout(late))
        return sent

    def _leave(self) -> None:
        LOG.warning("a client does not take its answer; its connection is closed")
        self.request.connection.stream.close()  # type: ignore[union-attr]

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Answer a request that failed, without internal details."""
        self.refuse(status_code, self._reason)


class PageHandler(Handler):
    """Handler of requests for the page itself."""

    def refuse(self, status: int, sentence: str) -> None:
        """Answer a request with an error status and a sentence, as an HTML page."""
        self.set_status(status)
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(html.note_html(sentence))

    async def get(self) -> None:
        """Send the HTML page of the run."""
        if "explorer.js" not in self.service.static:
            self.refuse(500, "the page's script is not installed: install magpend again")
            return
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(html.served_html(self.service.answering.run.info.title, self.service.guard.token))


class StaticHandler(Handler):
    """Handler of requests for the script and the style of the page, which need no token."""

    needs_token = False

    async def get(self, name: str) -> None:
        """Send a script or style file by name."""
        if name not in self.service.static:
            self.refuse(404, "there is no such file")
            return
        content, kind = self.service.static[name]
        self.set_header("Content-Type", kind)
        self.finish(content)


class ApiHandler(Handler):
    """Handler of requests for one kind of data."""

    answer: Answer

    def initialize(self, service: Service, answer: Answer) -> None:  # type: ignore[override]
        """Store the service, and the kind of data that this handler answers with."""
        self.service, self.answer = service, answer

    async def get(self) -> None:
        """Answer a GET request, whose arguments are in its address."""
        await self._reply("GET")

    async def post(self) -> None:
        """Answer a POST request, whose arguments are in its body."""
        await self._reply("POST", self.request.body)

    async def _reply(self, method: str, body: bytes = b"") -> None:
        from pipeline.explorer.answers import Query, RefusedRequestError

        if self.answer.method != method:
            self.refuse(405, f"api/{self.answer.name} takes {self.answer.method}")
            return
        query = Query({k: v[-1].decode("utf-8", "replace") for k, v in self.request.query_arguments.items()}, body)
        try:
            reply = await asyncio.wrap_future(self.service.answering.ask(self.answer.name, query))
        except RefusedRequestError as error:
            self.refuse(error.status, str(error))
        else:
            self.set_header("Content-Type", reply.kind)
            if reply.filename:
                self.set_header("Content-Disposition", f'attachment; filename="{reply.filename}"')
            with contextlib.suppress(Exception):  # the client has disconnected
                await self.finish(reply.content)


class NothingHandler(Handler):
    """Handler of requests for addresses that do not exist."""

    def prepare(self) -> None:
        """Check the request as usual, then answer it with status 404."""
        super().prepare()
        if not self._finished:
            self.refuse(404, "there is no such page")


def application(service: Service) -> web.Application:
    """Make the web application that answers the requests for a run."""
    from pipeline.explorer.answers import ANSWERS

    shared, live = {"service": service}, service.answering.live
    routes: list[Any] = [
        (r"/", PageHandler, shared),
        (r"/static/([A-Za-z.]+)", StaticHandler, shared),
        *((rf"/api/{name}", ApiHandler, {**shared, "answer": a}) for name, a in ANSWERS.items()),
        *([] if live is None else [("/ws", LiveSocket, {**shared, "live": live, "others": set()})]),
    ]
    return web.Application(
        routes,
        default_handler_class=NothingHandler,
        default_handler_args=shared,
        service=service,
        websocket_ping_interval=MOST_SILENCE_S,
        compress_response=False,
        log_function=lambda handler: None,
    )


def listening(port: int) -> socket.socket:
    """Open a socket that listens on this machine only, at the given or a free port; raise SpecError if it is taken."""
    if not 0 <= port <= 65535:
        raise SpecError(f"--port {port}: must be 0 to 65535; 0 takes a free one.")
    found = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((HOST, port))
        found.listen(64)
        found.setblocking(False)
    except OSError as error:
        found.close()
        reason = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise SpecError(f"--port {port}: {reason}; give another one, or none for a free one.") from None
    return found


def serve(
    source: str | Path | RunDirectory,
    port: int = 0,
    *,
    echo: Callable[[str], None],
    opened: Callable[[str], None] | None = None,
    curves: str | Path | RunDirectory | None = None,
) -> None:
    """Serve the interactive page of a run until the process is stopped.

    Parameters
    ----------
    source
        Run directory, ``s3://BUCKET/PREFIX``, or an opened run.
    port
        On loopback; 0 takes a free one.
    echo
        Prints a line.
    opened
        Called with the address once it can be asked, such as to open a browser.
    curves
        Run whose bifurcation curves are shown over the map of two parameters; by default those of the run.

    Raises
    ------
    SpecError
        If the port cannot be had.
    RefusedError, DamagedError, UnreadableError
        As `RunDirectory.open`.
    """
    from pipeline.explorer.data.explored import ExploredRun

    run: RunDirectory = RunDirectory.open(source)
    if curves is not None:
        run = replace(ExploredRun.open(run), curves=RunDirectory.open(curves))
    taken = listening(port)
    guard = Guard(new_token(), taken.getsockname()[1])
    address = f"http://{HOST}:{guard.port}/?token={guard.token}"
    echo(address)
    if opened is not None:
        opened(address)
    # a browser takes a moment to start, and so does what answers it: who asks meanwhile waits in the queue
    try:
        service = Service(run, guard)
        try:
            asyncio.run(_answer(service, taken))
        finally:
            service.answering.close()
    finally:
        taken.close()


async def _answer(service: Service, taken: socket.socket) -> None:
    server = httpserver.HTTPServer(application(service), **LIMITS)
    server.add_socket(taken)
    service.answering.warm()
    # a package that is imported meanwhile may catch the exception of a signal
    while (number := first_signal()) is None:
        await asyncio.sleep(1.0)
    raise Stopped(number)
