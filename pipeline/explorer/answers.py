"""List which data a page can request, and answer requests in worker threads, whatever carries them."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from pipeline.explorer import RequestError
from pipeline.explorer.data.diagram import diagram
from pipeline.explorer.data.events import event_orbit, events
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import orbit
from pipeline.explorer.data.overlays import attractors, branches, curves, disturbances
from pipeline.explorer.data.parameter_plane import curve_orbit, parameter_plane
from pipeline.explorer.data.planes import plane
from pipeline.explorer.data.tables import FORMATS, table
from pipeline.explorer.data.verticals import verticals
from pipeline.explorer.data.view import commands, describe_view
from pipeline.explorer.live.live import LiveRun, live_problem
from pipeline.explorer.live.messages import read_region
from pipeline.explorer.live.regions import zoom_toml
from pipeline.specification.problems import SpecError
from pipeline.store.errors import StoreError
from pipeline.store.run import RunDirectory

LOG = logging.getLogger(__name__)

_AT, _NUMBERS = "at.", ("cell", "point", "curve", "event")


@dataclass(frozen=True)
class Query:
    """Arguments of a request as texts by name, and its body."""

    words: Mapping[str, str]
    body: bytes = b""

    def read(self, name: str) -> Any:
        """Return an argument: text, a whole number, or for ``at`` the index on each axis from arguments ``at.NAME``."""
        if name == "at":
            return {n.removeprefix(_AT): _whole(n, text) for n, text in self.words.items() if n.startswith(_AT)}
        if name not in self.words:
            raise RequestError(f"{name} is missing.")
        return _whole(name, self.words[name]) if name in _NUMBERS else self.words[name]


def _whole(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise RequestError(f"{name} = {text[:40]!r}: must be a whole number, 0 or more.")
    return int(text)


@dataclass(frozen=True)
class Reply:
    """Reply to a request: its bytes, their media type and, for a download, a file name."""

    content: bytes
    kind: str
    filename: str = ""

    @classmethod
    def of(cls, found: Any) -> Reply:
        """Make a reply that holds packed arrays, or a value as JSON; ValueError for NaN or infinity."""
        if isinstance(found, bytes):
            return cls(found, "application/octet-stream")
        return cls(json.dumps(found, allow_nan=False).encode(), "application/json; charset=utf-8")


@dataclass(frozen=True)
class Answer:
    """A kind of data that a page can request: of the server, of a notebook's kernel, or of a copy that holds it."""

    name: str
    function: Callable[..., Any]  # of the run and of the arguments; without any of them, `(run, query, live)`
    arguments: tuple[str, ...] | None = None
    method: str = "GET"
    fresh: bool = False  # the directory is read again first
    integrates: bool = False  # needs compiled code

    def give(self, run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
        """Answer a request."""
        if self.arguments is None:
            found = self.function(run, query, live)
        else:
            found = self.function(run, *map(query.read, self.arguments))
        return found if isinstance(found, Reply) else Reply.of(found)


def _view(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    def described() -> Reply:
        # commands as whoever started the server can give them; an export names no folder of its maker's
        return Reply.of({**describe_view(run, live is not None), "commands": commands(run, run.name)})

    return run.remembered(f"view {live is not None}", described)


def _diagram(run: ExploredRun, x: str, y: str, at: Mapping[str, int]) -> bytes:
    key = ("diagram", x, y, *sorted(run.place(at, but=x).items()))
    return run.large(repr(key), lambda: diagram(run, x, y, at))


def _orbit(run: ExploredRun, query: Query, live: LiveRun | None) -> bytes:
    # compiling the code for multipliers would delay the orbit too long
    linearised = live is None or live.is_warm("maps")
    return orbit(run, query.read("cell"), query.read("point"), linearised=linearised)


def _table(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    kind, form = query.read("view"), query.words.get("format", "csv")
    asked = {name: query.read(name) for name in ("x", "y", "cell", "point") if name in query.words}
    content = table(run, kind, {**asked, "at": query.read("at")}, form)
    return Reply(content, FORMATS[form], f"{kind}.{form}")


def _zoom(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return Reply(zoom_toml(run, read_region(query.body)).encode(), "text/plain; charset=utf-8")


ANSWERS: dict[str, Answer] = {
    a.name: a
    for a in (
        Answer("view", _view, fresh=True),
        Answer("diagram", _diagram, ("x", "y", "at")),
        Answer("curves", curves, ("x", "at")),
        Answer("branches", branches, ("x", "y", "at")),
        Answer("events", events, ("x", "at")),
        Answer("event-orbit", event_orbit, ("x", "at", "event"), integrates=True),
        Answer("attractors", attractors, ("at",)),
        Answer("disturbances", disturbances, ("at",)),
        Answer("orbit", _orbit, integrates=True),
        Answer("plane", plane, ("at",)),
        Answer("parameter-plane", parameter_plane, ()),
        Answer("curve-orbit", curve_orbit, ("curve", "point"), integrates=True),
        Answer("table", _table),
        Answer("zoom", _zoom, method="POST"),
    )
}


def first_answers(run: ExploredRun, live: LiveRun | None) -> None:
    """Compute in advance what the page requests first: the description of the run, and the first diagram."""
    try:
        _view(run, Query({}), live)
        axis = next((a for a in run.axes if a.name == run.path), run.axes[0])
        at = {a.name: 0 for a in run.axes if a.swept and a is not axis}
        _diagram(run, axis.name, verticals(run)[0].name, at)
    except Exception as error:  # the request itself reports the error, too
        LOG.warning("the first picture could not be prepared: %s", error)
        LOG.debug("where it came from", exc_info=True)


THREADS, MOST_WAITING = 3, 12
"""Requests that are worked on at once, and those that may wait besides."""


class RefusedRequestError(Exception):
    """Raised for a request that is not answered with data.

    `status` is as in HTTP: 400 the request is wrong, 429 too many wait, 500 the run cannot be read.
    """

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class Answering:
    """A run that answers requests for data in a few threads; what waits is bounded."""

    def __init__(self, run: RunDirectory) -> None:
        self.run = ExploredRun.open(run)
        self.live_problem = live_problem(self.run)
        self.live = None if self.live_problem else LiveRun(self.run)
        self.pool = ThreadPoolExecutor(THREADS, "explorer")
        self.waiting = 0
        self.compiled: Future[None] | None = None
        self._lock = threading.Lock()

    def warm(self) -> None:
        """Compute what the page requests first; then compile the code for live computation, in the background."""
        first = self.pool.submit(first_answers, self.run, self.live)
        if self.live is None:
            return
        live, compiled = self.live, Future[None]()
        self.compiled = compiled

        def tell(done: int, total: int) -> None:
            if live.is_warm("series") and not compiled.done():
                compiled.set_result(None)

        # what is compiled would hold up the first picture
        first.add_done_callback(lambda done: None if done.cancelled() else live.warm(tell))

    def ask(self, name: str, query: Query) -> Future[Reply]:
        """Start to answer a request, and return at once. The future gives the reply, or raises RefusedRequestError.

        A request that integrates first waits until the code is compiled, and takes no thread meanwhile.
        """
        found: Future[Reply] = Future()
        found.set_running_or_notify_cancel()
        answer = ANSWERS[name]
        with self._lock:
            accepted = self.waiting < THREADS + MOST_WAITING
            self.waiting += accepted
        if not accepted:
            sentence = "more is asked at once than may wait; try again in a moment"
            found.set_exception(RefusedRequestError(429, sentence))
            return found
        compiled = self.compiled
        if answer.integrates and compiled is not None:
            compiled.add_done_callback(lambda done: self._submit(answer, query, found))
        else:
            self._submit(answer, query, found)
        return found

    def _submit(self, answer: Answer, query: Query, found: Future[Reply]) -> None:
        try:
            self.pool.submit(self._answer, answer, query, found)
        except RuntimeError:  # the pool is closed
            self._end(found, RefusedRequestError(500, "this run is closed"))

    def _answer(self, answer: Answer, query: Query, found: Future[Reply]) -> None:
        try:
            if answer.fresh:
                self.run = self.run.refreshed()
            self.run.check_axes(query.read("at"))
            reply = answer.give(self.run, query, self.live)
        except Exception as error:
            self._end(found, refusal_of(error, answer.name))
        else:
            self._end(found, reply)

    def _end(self, found: Future[Reply], result: Reply | RefusedRequestError) -> None:
        with self._lock:
            self.waiting -= 1
        if isinstance(result, Reply):
            found.set_result(result)
        else:
            found.set_exception(result)

    def close(self) -> None:
        """Cancel the requests that wait, and end live computation."""
        self.pool.shutdown(wait=False, cancel_futures=True)
        if self.live is not None:
            self.live.close()


def refusal_of(error: Exception, name: str) -> RefusedRequestError:
    """Return what is told of an error: a sentence for the user; an unexpected one is told to the log alone."""
    if isinstance(error, StoreError | OSError):
        return RefusedRequestError(500, str(error))
    if isinstance(error, SpecError):
        return RefusedRequestError(400, " ".join(error.problems))
    if isinstance(error, ValueError | ArithmeticError):
        return RefusedRequestError(400, str(error))
    LOG.error("api/%s", name, exc_info=error)
    return RefusedRequestError(500, "something went wrong that magpend did not expect; its terminal says what")
