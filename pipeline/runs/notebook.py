"""Show progress in a notebook: a bar below the cell. Widgets are not needed, only IPython's displays."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from html import escape
from typing import Any

from pipeline.products.reporting import is_heard, reporting
from pipeline.runs.progress import Work, duration

EVERY_S = 0.2
"""Least time between two updates of a bar [s]."""


def is_notebook() -> bool:
    """Return whether this code runs in the cell of a notebook (a Jupyter kernel)."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if hasattr(ipython, "get_ipython") else None
    return hasattr(shell, "kernel")


@contextlib.contextmanager
def progress() -> Iterator[None]:
    """Show the progress of the work inside this context as a bar, in a notebook; elsewhere do nothing."""
    if is_heard() or not is_notebook():
        yield
        return
    bar = Bar()
    try:
        with reporting(bar):
            yield
    except BaseException:
        bar.end("stopped")
        raise
    bar.end("done")


class Bar:
    """A bar below a cell, which listens to `pipeline.products.reporting`; it appears with the first report."""

    def __init__(self) -> None:
        self._begun = self._shown = time.monotonic()
        self._work: Work | None = None
        self._handle: Any = None
        self._state = ""

    def __call__(self, what: str, done: float, total: float, expected_s: float = 0.0) -> None:
        """Show a progress report; reports that follow the last update too soon are left out."""
        now = time.monotonic()
        is_new = self._work is None or what != self._work.what
        if self._work is None or is_new:
            self._work = Work(what, now, done, expected_s=expected_s)
        self._work.done, self._work.total, self._work.heard = done, total, now
        if is_new or now - self._shown >= EVERY_S:
            self._show()

    def end(self, state: str) -> None:
        """Show the last report and how the work has ended; do nothing if nothing was shown."""
        self._state = state
        if self._work is not None:
            self._show()

    def _show(self) -> None:
        from IPython.display import display

        self._shown = time.monotonic()
        if self._handle is None:
            self._handle = display(self, display_id=True)  # type: ignore[no-untyped-call]
        else:
            self._handle.update(self)

    def __repr__(self) -> str:
        if self._work is None:
            return ""
        now = time.monotonic()
        if not self._state:
            return self._work.line(now)
        took = f"{self._state} after {duration(now - self._begun)}"
        return f"{self._work.counted()}, {took}" if self._work.total else f"{self._work.what}, {took}"

    def _repr_html_(self) -> str:
        work = self._work
        ended = "1" if self._state == "done" else "0"
        of = f"max='{work.total:g}' value='{work.done:g}'" if work is not None and work.total else ""
        # without a value the browser shows that something is going on
        bar = f"<progress {of or (f'value={ended!r}' if self._state else '')} style='width:24em'></progress>"
        return f"<div>{bar} {escape(repr(self))}</div>"
