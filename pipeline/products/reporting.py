"""Report the progress of a computation to a listener.

    for orbit in track(orbits, "polishing orbits"):
        ...

    with reporting(display):
        derive(...)

Without a listener nothing is shown, and reporting takes almost no time. Results do not depend on it.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from typing import Protocol, TypeVar

from magpend_core.compilation import heard_by


class Listener(Protocol):
    """Protocol of a function that shows progress reports."""

    def __call__(self, what: str, done: float, total: float, expected_s: float = 0.0) -> None:
        """Show that `done` of `total` parts of a piece of work are finished; see `report`."""


_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)

UNTOLD = math.inf
"""Expected time of work whose parts differ so much that their number does not tell the time left."""

COMPILING = "compiling"
"""Name of the work while the compiler runs."""


def report(what: str, done: float, total: float, expected_s: float = 0.0) -> None:
    """Report to the listener that `done` of `total` parts of a piece of work are finished.

    Parameters
    ----------
    what
        The work in a word or two, such as ``following branches``.
    done, total
        Amounts in any unit; `total` may grow during the work, and is 0 if it is unknown.
    expected_s
        Expected time of the rest, used until the speed is known [s]. `UNTOLD`: no time left is shown.
    """
    listener = _listener.get()
    if listener is not None:
        listener(what, done, total, expected_s)


def is_heard() -> bool:
    """Return whether there is a listener for progress reports."""
    return _listener.get() is not None


T = TypeVar("T")


def track(items: Sequence[T], what: str) -> Iterator[T]:
    """Yield items, and report the number of finished items as progress.

    Parameters
    ----------
    items
        The parts of the work.
    what
        Name of the work, see `report`.
    """
    n = len(items)
    report(what, 0, n)
    for i, item in enumerate(items):
        yield item
        report(what, i + 1, n)


@contextlib.contextmanager
def reporting(listener: Listener) -> Iterator[None]:
    """Send all progress reports from inside this context to a listener, and report when the compiler runs."""
    last: tuple[str, float, float, float] = ("", 0.0, 0.0, 0.0)

    def heard(what: str, done: float, total: float, expected_s: float = 0.0) -> None:
        nonlocal last
        last = what, done, total, expected_s
        listener(what, done, total, expected_s)

    def compiler(begins: bool) -> None:
        if begins:
            listener(COMPILING, 0, 0)
        elif last[0]:
            listener(*last)

    token = _listener.set(heard)
    try:
        with heard_by(compiler):
            yield
    finally:
        _listener.reset(token)


@contextlib.contextmanager
def unheard() -> Iterator[None]:
    """Drop the progress reports from inside this context: whoever opens it reports the work as a whole."""
    token = _listener.set(None)
    try:
        yield
    finally:
        _listener.reset(token)


def silent(_: str) -> None:
    """Print nothing: the function ``echo`` of a silent run."""
