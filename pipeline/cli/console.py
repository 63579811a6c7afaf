"""Print results to the standard output, and notes, progress and errors to the standard error.

Notes, warnings and progress go to the standard error and, with ``--log``, with times to a file. A program, or
``head``, can therefore read the standard output.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from enum import IntEnum
from pathlib import Path

from pipeline.cli.outputs import check_log
from pipeline.products.reporting import reporting
from pipeline.runs.progress import Work


class Exit(IntEnum):
    """Exit codes of all commands."""

    DONE = 0
    BUG = 1
    REFUSED = 2
    LOCKED = 3
    FAILED = 4
    DAMAGED = 5
    CONTRADICTED = 6
    HUNG_UP = 129
    INTERRUPTED = 130
    TERMINATED = 143

    @property
    def sentence(self) -> str:
        """Meaning of the exit code, for the documentation."""
        return _SENTENCES[self]


_SENTENCES = {
    Exit.DONE: "done",
    Exit.BUG: "an error that magpend did not expect",
    Exit.REFUSED: "bad input, or refused; nothing was created or changed",
    Exit.LOCKED: "another process is writing to the run directory",
    Exit.FAILED: "a computation failed; committed results stay, and the same command continues",
    Exit.DAMAGED: "stored data are damaged",
    Exit.CONTRADICTED: "a study's required claim is contradicted; its report says which",
    Exit.INTERRUPTED: "stopped by Ctrl-C; committed results stay, and the same command continues",
    Exit.TERMINATED: "stopped by SIGTERM; committed results stay, and the same command continues",
    Exit.HUNG_UP: "its terminal was closed; committed results stay, and the same command continues",
}


LOG = logging.getLogger("magpend")

FIRST_LINE_S, NEXT_LINE_S, BAR_EVERY_S = 2.0, 10.0, 0.3


class EnoughError(Exception):
    """Raised when the reader of the standard output, such as ``head``, has closed it."""


def visible(text: str) -> str:
    """Replace the control characters of a text by escapes, so that a text from a file cannot control the terminal."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)


class _Visible(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return visible(super().format(record))


def note(*lines: str) -> None:
    """Print a line for the user to the standard error, unless ``--quiet`` is given."""
    for line in lines:
        LOG.info(line)


def result(*lines: str) -> None:
    """Print lines of a command's result to the standard output.

    Raises
    ------
    EnoughError
        If the reader has closed the standard output.
    """
    for line in lines:
        try:
            sys.stdout.write(f"{visible(line)}\n")
            sys.stdout.flush()
        except BrokenPipeError:
            raise EnoughError from None


def is_shown() -> bool:
    """Return whether notes are printed: they are unless ``--quiet`` is given."""
    return any(isinstance(h, _Stderr) and h.level <= logging.INFO for h in LOG.handlers)


class _Stderr(logging.Handler):
    """Log handler that writes to the standard error, above the progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        bar = Display.current
        if bar is not None:
            bar.clear()
        sys.stderr.write(f"{self.format(record)}\n")


def configure(quiet: bool, verbose: bool, log: Path | None) -> None:
    """Set up the log: which messages are printed to the standard error, and the ``--log`` file.

    Raises
    ------
    SpecError
        If the log file cannot be written.
    """
    close()
    LOG.propagate = False
    LOG.setLevel(logging.DEBUG)
    shown = logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO
    stderr = _Stderr(shown)
    stderr.setFormatter(_Visible())
    LOG.addHandler(stderr)
    if log is not None:
        check_log(log)
        try:
            file = logging.FileHandler(log, encoding="utf-8")
        except OSError as error:
            from pipeline.specification.problems import SpecError

            raise SpecError(f"--log {log}: cannot be written to ({error.strerror}).") from None
        file.setFormatter(_Visible("%(asctime)s %(levelname)s %(message)s"))
        LOG.addHandler(file)
        LOG.debug("command: %s", " ".join(sys.argv))


def close() -> None:
    """Close the log file, if there is one."""
    for handler in list(LOG.handlers):
        LOG.removeHandler(handler)
        handler.close()


class Display:
    """Display of a command's progress: a bar on a terminal, or else a line of text at intervals.

    It listens to `pipeline.products.reporting`. After the first seconds it shows at intervals the present
    work and its duration, even without new reports.

    Parameters
    ----------
    name
        Text that is shown before the first report.
    terminal
        Whether to draw a bar; by default if the standard error is a terminal.
    clock
        Function that returns a monotonic time [s].
    """

    current: Display | None = None

    def __init__(self, name: str, *, terminal: bool | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._terminal = sys.stderr.isatty() if terminal is None else terminal
        self._clock, self._started = clock, clock()
        self._work = Work(name, self._started)
        self._drawn = False
        self._lock, self._over = threading.RLock(), threading.Event()

    def __call__(self, what: str, done: float, total: float, expected_s: float = 0.0) -> None:
        """Record a progress report: the name of the work, and the amounts done and in total."""
        with self._lock:
            if what != self._work.what:
                self._work = Work(what, self._clock(), done, expected_s=expected_s)
            self._work.done, self._work.total, self._work.heard = done, total, self._clock()

    def show(self) -> None:
        """Print the current progress: as a bar on a terminal, or else as a line of the log."""
        with self._lock:
            line = self._work.line(self._clock())
            if not self._terminal:
                note(line)
            elif is_shown():
                sys.stderr.write(f"\r\x1b[2K{line}")
                sys.stderr.flush()
                self._drawn = True

    def clear(self) -> None:
        """Remove the progress bar from the terminal."""
        with self._lock:
            if self._drawn:
                sys.stderr.write("\r\x1b[2K")
                sys.stderr.flush()
                self._drawn = False

    def watch(self) -> None:
        """Redraw the progress at intervals, until `stop` is called."""
        pause = FIRST_LINE_S
        while not self._over.wait(pause):
            self.show()
            pause = BAR_EVERY_S if self._terminal else NEXT_LINE_S

    def stop(self) -> None:
        """Stop redrawing the progress, and remove the progress bar."""
        self._over.set()
        self.clear()


def at_rest() -> None:
    """Stop showing progress. A command that lasts until the user ends it calls this."""
    if Display.current is not None:
        Display.current.stop()


@contextlib.contextmanager
def progress(name: str) -> Iterator[None]:
    """Show the progress of the work that is done inside this context."""
    display = Display(name)
    Display.current = display
    watcher = threading.Thread(target=display.watch, daemon=True)
    watcher.start()
    try:
        with reporting(display):
            yield
    finally:
        display.stop()
        watcher.join()
        Display.current = None
