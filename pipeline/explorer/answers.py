"""The answers that the page can ask for, by name: what each takes from an address, and what it gives."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.explorer.diagram import diagram
from pipeline.explorer.explored import ExploredRun, ExplorerError
from pipeline.explorer.view import describe_view

JSON = "application/json; charset=utf-8"
BINARY = "application/octet-stream"

_AT = "at."


@dataclass(frozen=True)
class Query:
    """What a request says.

    Attributes
    ----------
    words : mapping
        Arguments of the address by name.
    body : bytes
    """

    words: Mapping[str, str]
    body: bytes = b""

    def text(self, name: str, default: str | None = None) -> str:
        """An argument; raises `ExplorerError` if it is missing and has no default."""
        found = self.words.get(name, default)
        if found is None:
            raise ExplorerError(f"{name} is missing.")
        return found

    def count(self, name: str, default: int | None = None) -> int:
        """A whole number, 0 or more."""
        text = self.text(name, None if default is None else str(default))
        if not (text.isascii() and text.isdigit() and len(text) < 16):
            raise ExplorerError(f"{name} = {text[:40]!r}: must be a whole number, 0 or more.")
        return int(text)

    @property
    def at(self) -> dict[str, int]:
        """Index by axis: the arguments ``at.NAME``."""
        names = [name for name in self.words if name.startswith(_AT)]
        return {name.removeprefix(_AT): self.count(name) for name in names}


@dataclass(frozen=True)
class Reply:
    """An answer: bytes, their type, and the name of a file if it is a download."""

    content: bytes
    kind: str
    filename: str = ""


Give = Callable[[ExploredRun, Query, bool], Reply]


@dataclass(frozen=True)
class Answer:
    """One kind of answer.

    Attributes
    ----------
    name : str
    give : callable
        ``give(run, query, live)``.
    method : str
    fresh : bool
        Whether the directory is looked at again before.
    """

    name: str
    give: Give
    method: str = "GET"
    fresh: bool = False


def json_reply(value: Any) -> Reply:
    """JSON without NaN: a gap is null."""
    return Reply(json.dumps(value, allow_nan=False).encode(), JSON)


def _view(run: ExploredRun, query: Query, live: bool) -> Reply:
    return json_reply(describe_view(run, live))


def _diagram(run: ExploredRun, query: Query, live: bool) -> Reply:
    return Reply(diagram(run, query.text("x"), query.text("y"), query.at), BINARY)


ANSWERS: dict[str, Answer] = {
    a.name: a
    for a in (
        Answer("view", _view, fresh=True),
        Answer("diagram", _diagram),
    )
}
