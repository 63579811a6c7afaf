"""Define which data the page can request, with the arguments and the answer of each request."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from pipeline.explorer.data.clicked_orbit import orbit
from pipeline.explorer.data.diagram import diagram
from pipeline.explorer.data.disturbances import disturbances
from pipeline.explorer.data.explored import ExploredRun, ExplorerError
from pipeline.explorer.data.overlays import attractors, branches, curves
from pipeline.explorer.data.parameter_plane import curve_orbit, parameter_plane
from pipeline.explorer.data.planes import plane
from pipeline.explorer.data.tables import FORMATS, table
from pipeline.explorer.data.verticals import verticals
from pipeline.explorer.data.view import commands, describe_view
from pipeline.explorer.live.live import LiveRun
from pipeline.explorer.live.messages import Region
from pipeline.explorer.live.regions import zoom_toml

LOG = logging.getLogger(__name__)

JSON = "application/json; charset=utf-8"
BINARY = "application/octet-stream"

_AT = "at."


@dataclass(frozen=True)
class Query:
    """Arguments and body of a request from the page.

    Attributes
    ----------
    words : mapping
        Arguments of the address by name.
    """

    words: Mapping[str, str]
    body: bytes = b""

    def text(self, name: str, default: str | None = None) -> str:
        """Return an argument of the request; raise ExplorerError if it is missing and has no default."""
        found = self.words.get(name, default)
        if found is None:
            raise ExplorerError(f"{name} is missing.")
        return found

    def count(self, name: str, default: int | None = None) -> int:
        """Return an argument of the request as a whole number, 0 or more."""
        text = self.text(name, None if default is None else str(default))
        if not (text.isascii() and text.isdigit() and len(text) < 16):
            raise ExplorerError(f"{name} = {text[:40]!r}: must be a whole number, 0 or more.")
        return int(text)

    @property
    def at(self) -> dict[str, int]:
        """Return the index on each swept axis, from the arguments ``at.NAME`` of the request."""
        names = [name for name in self.words if name.startswith(_AT)]
        return {name.removeprefix(_AT): self.count(name) for name in names}


@dataclass(frozen=True)
class Reply:
    """Reply to a request: its bytes, their media type and, for a download, a file name."""

    content: bytes
    kind: str
    filename: str = ""


Give = Callable[[ExploredRun, Query, LiveRun | None], Reply]


@dataclass(frozen=True)
class Answer:
    """A kind of data that the page can request, with the function that computes it.

    Attributes
    ----------
    give : callable
        ``give(run, query, live)``.
    fresh : bool
        Whether the directory is read again first.
    integrates : bool
        Whether it needs compiled code.
    """

    name: str
    give: Give
    method: str = "GET"
    fresh: bool = False
    integrates: bool = False


def json_reply(value: Any) -> Reply:
    """Make a reply that holds a value as JSON; ValueError for NaN or infinity."""
    return Reply(json.dumps(value, allow_nan=False).encode(), JSON)


def _view(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    def described() -> Reply:
        # commands as whoever started the server can give them; an export names no folder of its maker's
        return json_reply({**describe_view(run, live is not None), "commands": commands(run, run.name)})

    return run.remembered(f"view {live is not None}", described)


def _diagram(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    x, y, at = query.text("x"), query.text("y"), query.at
    key = ("diagram", x, y, *sorted(run.place(at, but=x).items()))
    return run.large(repr(key), lambda: Reply(diagram(run, x, y, at), BINARY))


def _curves(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return json_reply(curves(run, query.text("x"), query.at))


def _branches(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return json_reply(branches(run, query.text("x"), query.text("y"), query.at))


def _attractors(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return json_reply(attractors(run, query.at))


def _disturbances(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return json_reply(disturbances(run, query.at))


def _orbit(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    # compiling the code for multipliers would delay the orbit too long
    linearised = live is None or live.is_warm("maps")
    return Reply(orbit(run, query.count("cell"), query.count("point"), linearised=linearised), BINARY)


def _plane(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return Reply(plane(run, query.at), BINARY)


def _parameter_plane(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return json_reply(parameter_plane(run))


def _curve_orbit(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    return Reply(curve_orbit(run, query.count("curve"), query.count("point")), BINARY)


def _table(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    kind, form = query.text("view"), query.text("format", "csv")
    words = {name: query.count(name) for name in ("cell", "point") if name in query.words}
    asked = {"x": query.text("x", ""), "y": query.text("y", ""), "at": query.at, **words}
    content = table(run, kind, asked, form)
    return Reply(content, FORMATS[form], f"{kind}.{form}")


def _zoom(run: ExploredRun, query: Query, live: LiveRun | None) -> Reply:
    try:
        region = Region.model_validate_json(query.body)
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, p['loc'])) or 'body'}: {p['msg']}" for p in error.errors()[:5]]
        raise ExplorerError("; ".join(problems)) from None
    run.check_axes(region.at)
    return Reply(zoom_toml(run, region).encode(), "text/plain; charset=utf-8")


ANSWERS: dict[str, Answer] = {
    a.name: a
    for a in (
        Answer("view", _view, fresh=True),
        Answer("diagram", _diagram),
        Answer("curves", _curves),
        Answer("branches", _branches),
        Answer("attractors", _attractors),
        Answer("disturbances", _disturbances),
        Answer("orbit", _orbit, integrates=True),
        Answer("plane", _plane),
        Answer("parameter-plane", _parameter_plane),
        Answer("curve-orbit", _curve_orbit, integrates=True),
        Answer("table", _table),
        Answer("zoom", _zoom, method="POST"),
    )
}


def first_answers(run: ExploredRun, live: LiveRun | None) -> None:
    """Compute in advance what the page requests first: the description of the run, and the first diagram."""
    try:
        _view(run, Query({}), live)
        axis = next((a for a in run.axes if a.name == run.path), run.axes[0])
        at = {f"{_AT}{a.name}": "0" for a in run.axes if a.swept and a is not axis}
        _diagram(run, Query({"x": axis.name, "y": verticals(run)[0].name, **at}), live)
    except Exception as error:  # the request itself reports the error, too
        LOG.warning("the first picture could not be prepared: %s", error)
        LOG.debug("where it came from", exc_info=True)
