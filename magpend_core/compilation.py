"""Call a listener at the start and end of each compilation, so that a command can show "compiling" while it waits."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

_listener: ContextVar[Callable[[bool], None] | None] = ContextVar("listener", default=None)


@contextlib.contextmanager
def heard_by(listener: Callable[[bool], None]) -> Iterator[None]:
    """Call a listener when a compilation in this context begins (argument True) and when it ends (False)."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextlib.contextmanager
def compiling() -> Iterator[None]:
    """Tell the listener, if there is one, that code is being compiled while this context is open."""
    listener = _listener.get()
    if listener is None:
        yield
        return
    listener(True)
    token = _listener.set(None)  # parts of an engine are compiled inside
    try:
        yield
    finally:
        _listener.reset(token)
        listener(False)
