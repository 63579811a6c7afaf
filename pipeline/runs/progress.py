"""Show the progress of a run: a bar on a terminal or below the cell of a notebook, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape
from types import TracebackType
from typing import Any, Self

from pipeline.products.reporting import UNTOLD, is_heard, report, reporting

LINE_EVERY_S = 10.0
WORK = "computing cells"


def duration(seconds: float) -> str:
    """Format a time, such as ``3 min 20 s``."""
    if seconds < 90:
        return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 90:
        return f"{minutes} min {rest} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min"


def whole(seconds: float) -> str:
    """Format a time without a second part that is zero, such as ``30 min``."""
    return duration(seconds).removesuffix(" 0 s").removesuffix(" 0 min")


def size(n_bytes: float) -> str:
    """Format a number of bytes, such as ``6.3 MB``."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if n_bytes < 1000:
            return f"{n_bytes:.0f} {unit}" if unit == "bytes" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.1f} TB"


@dataclass
class Work:
    """A named piece of work, with the amounts done and in total."""

    what: str  # name of the work
    started: float  # time of its first report [s]
    begun: float = 0.0  # amount that was done at its first report
    # amounts of the last report; a total of 0 is unknown
    done: float = 0.0
    total: float = 0.0
    heard: float = 0.0  # time of the last report [s]
    # expected time of the whole work [s]; 0 if unknown, `UNTOLD` if no time left is to be shown
    expected_s: float = 0.0

    def counted(self) -> str:
        """Return the name of the work with the amounts done and in total."""
        return f"{self.what}: {self.done:g} of {self.total:g} ({100 * min(self.done / self.total, 1.0):.0f} %)"

    def line(self, now: float) -> str:
        """Return a line of text with the progress and the remaining time."""
        elapsed = max(now - self.started, 0.0)
        if not self.total:
            return f"{self.what}: {duration(elapsed)} so far"
        text = self.counted()
        if self.done >= self.total:
            return text
        took, more = self.heard - self.started, self.done - self.begun
        if self.expected_s == UNTOLD:
            left, about = 0.0, ""
        elif more > 0:
            left, about = took * (self.total - self.done) / more - (now - self.heard), ""
        else:
            left, about = self.expected_s - elapsed, "about "
        return f"{text}, {about}{duration(left)} left" if left > 0 else f"{text}, {duration(elapsed)} so far"


class Progress:
    """Context that counts finished cells, and shows their number as a bar or as text lines.

    Parameters
    ----------
    total
        Number of cells of the run.
    done
        Number of cells that were committed before.
    terminal
        Whether to draw a bar instead of printing lines.
    echo
        Function that prints a line.
    clock
        Function that returns a monotonic time [s].
    expected_s
        Expected time of the missing cells, by the rule of thumb [s].
    """

    def __init__(
        self,
        total: int,
        done: int,
        *,
        terminal: bool,
        echo: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        expected_s: float = 0.0,
    ) -> None:
        self._expected_s = expected_s
        self._total, self._before, self._done = total, done, done
        self._echo, self._clock = echo, clock
        self._started = self._last_line = clock()
        self._bar: Any = _bar(total, done) if terminal and not is_heard() else None

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        report(WORK, self._done, self._total, self._expected_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def add(self, cells: int) -> None:
        """Count newly finished cells, and show the progress."""
        self._done += cells
        if is_heard():
            report(WORK, self._done, self._total)
        elif self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self._done, rate=f"{self.rate():.0f} cells/s")
        elif self._clock() - self._last_line >= LINE_EVERY_S or self._done == self._total:
            self._last_line = self._clock()
            self._echo(self.line())

    def rate(self) -> float:
        """Return how many cells per second were computed so far."""
        elapsed = self._clock() - self._started
        return (self._done - self._before) / elapsed if elapsed > 0 else 0.0

    def line(self) -> str:
        """Return the progress as a text line: finished cells, percentage, rate and remaining time."""
        rate = self.rate()
        left = f", {duration((self._total - self._done) / rate)} left" if rate > 0 and self._done < self._total else ""
        share = 100 * self._done / self._total
        return f"{self._done}/{self._total} cells ({share:.0f} %), {rate:.0f} cells/s{left}"


def _bar(total: int, done: int) -> Any:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    bar = RichProgress(
        TextColumn("computing"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("cells"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    bar.add_task("cells", total=total, completed=done, rate="")
    return bar


EVERY_S = 0.2
"""Least time between two updates of a bar [s]."""


def is_notebook() -> bool:
    """Return whether this code runs in the cell of a notebook (a Jupyter kernel)."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if hasattr(ipython, "get_ipython") else None
    return hasattr(shell, "kernel")


@contextlib.contextmanager
def bar_in_notebook() -> Iterator[None]:
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
