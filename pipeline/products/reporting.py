"""How far a computation is: whoever computes says it here, whoever shows it listens.

    for orbit in track(orbits, "polishing orbits"):
        ...

    with reporting(display):
        derive(...)

Nothing is shown, and next to nothing costs, where nobody listens. Results do not depend on it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from typing import Protocol, TypeVar

T = TypeVar("T")


class Listener(Protocol):
    """What shows progress."""

    def __call__(self, what: str, done: float, total: float, expected_s: float = 0.0) -> None:
        """Take that `done` of `total` parts of a piece of work are finished; see `report`."""


_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


def report(what: str, done: float, total: float, expected_s: float = 0.0) -> None:
    """Say that `done` of `total` parts of a piece of work are finished.

    Parameters
    ----------
    what
        The work in a word or two, such as ``following branches``.
    done, total
        In any unit; `total` may grow while the work shows how much there is, and is 0 if nobody knows.
    expected_s
        About how long the rest will take, for as long as nothing better is known [s].
    """
    listener = _listener.get()
    if listener is not None:
        listener(what, done, total, expected_s)


def is_heard() -> bool:
    """Whether anybody listens."""
    return _listener.get() is not None


def track(items: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """Yield items, and report how many are done.

    Parameters
    ----------
    items
        The parts of the work.
    what
        As in `report`.
    total
        Number of items; by default their length.
    """
    n = len(items) if total is None else total  # type: ignore[arg-type]
    report(what, 0, n)
    for i, item in enumerate(items):
        yield item
        report(what, i + 1, n)


@contextlib.contextmanager
def reporting(listener: Listener) -> Iterator[None]:
    """Let a listener hear all reports from within."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
