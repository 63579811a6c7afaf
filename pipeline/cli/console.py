"""What the commands say: results on the standard output, everything else beside it.

Notes, warnings and progress go to the standard error and, with ``--log``, with times to a file; so the
standard output can be read by a program, or by ``head``.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from collections.abc import Iterator
from pathlib import Path

LOG = logging.getLogger("magpend")

FIRST_LINE_S, LINE_EVERY_S = 2.0, 10.0


def note(line: str) -> None:
    """Say what happens; not with ``--quiet``."""
    LOG.info(line)


def result(line: str) -> None:
    """Write a line of a result to the standard output."""
    sys.stdout.write(f"{line}\n")


class _Stderr(logging.Handler):
    """Writes to whatever the standard error is now, above a progress bar if one is drawn."""

    def emit(self, record: logging.LogRecord) -> None:
        bar = Display.current
        if bar is not None:
            bar.clear()
        sys.stderr.write(f"{self.format(record)}\n")


def configure(quiet: bool, verbose: bool, log: Path | None) -> None:
    """Set who hears what.

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
    LOG.addHandler(stderr)
    if log is not None:
        try:
            file = logging.FileHandler(log, encoding="utf-8")
        except OSError as error:
            from pipeline.spec.problems import SpecError

            raise SpecError([f"--log {log}: cannot be written to ({error.strerror})."]) from None
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        LOG.addHandler(file)
        LOG.debug("command: %s", " ".join(sys.argv))


def close() -> None:
    """Close the log file, if there is one."""
    for handler in list(LOG.handlers):
        LOG.removeHandler(handler)
        handler.close()


class Display:
    """Shows what `pipeline.products.reporting` reports: a bar on a terminal, else a line now and then.

    Parameters
    ----------
    terminal
        Draw a bar.
    clock
        Seconds that only ever grow.
    """

    current: Display | None = None

    def __init__(self, *, terminal: bool | None = None, clock: object = time.monotonic) -> None:
        self._terminal = sys.stderr.isatty() if terminal is None else terminal
        self._clock = clock
        self._what, self._started, self._begun, self._last = "", 0.0, 0.0, 0.0
        self._drawn = False

    def __call__(self, what: str, done: float, total: float) -> None:
        """Take a report."""
        now = self._clock()  # type: ignore[operator]
        if what != self._what:
            self.clear()
            self._what, self._started, self._begun = what, now, done
            self._last = now - LINE_EVERY_S + FIRST_LINE_S
        due = 0.1 if self._terminal else LINE_EVERY_S
        if now - self._last < due and not (self._drawn and done >= total):
            return
        self._last = now
        line = self._line(done, total, now - self._started)
        if self._terminal and LOG.handlers and LOG.handlers[0].level <= logging.INFO:
            sys.stderr.write(f"\r\x1b[2K{_bar(done, total)} {line}")
            sys.stderr.flush()
            self._drawn = True
        else:
            note(line)

    def _line(self, done: float, total: float, elapsed: float) -> str:
        from pipeline.runs.progress import duration

        share = f"{self._what}: {done:g} of {total:g} ({100 * done / max(total, 1e-300):.0f} %)"
        rate = (done - self._begun) / elapsed if elapsed > 0 else 0.0
        return f"{share}, {duration((total - done) / rate)} left" if rate > 0 and done < total else share

    def clear(self) -> None:
        """Take the bar away."""
        if self._drawn:
            sys.stderr.write("\r\x1b[2K")
            sys.stderr.flush()
            self._drawn = False


def _bar(done: float, total: float, width: int = 24) -> str:
    filled = min(width, int(width * done / max(total, 1e-300)))
    return f"[{'#' * filled}{'.' * (width - filled)}]"


@contextlib.contextmanager
def progress() -> Iterator[None]:
    """Show the progress of what is done inside."""
    from pipeline.products.reporting import reporting

    display = Display()
    Display.current = display
    try:
        with reporting(display):
            yield
    finally:
        display.clear()
        Display.current = None
