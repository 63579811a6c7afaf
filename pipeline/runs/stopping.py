"""Handle the signals that end a command: Ctrl-C, SIGTERM, and SIGHUP of a closing terminal.

The first signal ends a command in order: current tasks are given up, the run directory is freed, temporary files are
removed. A running kernel cannot be interrupted; the process ends without waiting for it. The second signal ends a
command at once. Before a command has begun, the first signal ends it at once.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

NUMBERS = tuple(getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n))


class Stopped(KeyboardInterrupt):
    """Raised by a signal that ends a command; a subclass of `KeyboardInterrupt`.

    Attributes
    ----------
    number : int
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(number)


class InterruptedRunError(Exception):
    """Raised if a signal stopped a run; the results of finished tasks stay.

    Attributes
    ----------
    signal_number : int
    """

    def __init__(self, signal_number: int, message: str) -> None:
        self.signal_number = signal_number
        super().__init__(message)


class _Listener:
    """Signal handler of the command line: it raises `Stopped` at a first signal, or ends the process."""

    first: int | None = None
    is_in_order = False

    def __call__(self, number: int, frame: Any) -> None:
        if self.first is None and self.is_in_order:
            self.first = number
            raise Stopped(number)
        leave(number)


_listener = _Listener()


def listen() -> None:
    """Install the command line's handler for Ctrl-C, SIGTERM and SIGHUP, except for signals that are ignored."""
    for number in NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _listener)


@contextlib.contextmanager
def in_order() -> Iterator[None]:
    """Let a first signal raise `Stopped` inside this context, so that code can clean up; a second one ends the
    process.
    """
    _listener.is_in_order = True
    try:
        yield
    finally:
        _listener.is_in_order = False
        if _listener.first is not None:  # ignore further signals while the message is printed
            for number in NUMBERS:
                signal.signal(number, signal.SIG_IGN)


def first_signal() -> int | None:
    """Return the number of the first signal that this process has received; None if there was none."""
    return _listener.first


def end_if_stopped(code: int) -> None:
    """End this process if it has received a signal, after flushing its output."""
    if _listener.first is not None:
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)


def leave(number: int) -> NoReturn:
    """End this process at once."""
    shown = "\x1b[?25h" if sys.stderr.isatty() else ""
    how = "stopped" if _listener.first is None else "stopped at once; committed results stay"
    with contextlib.suppress(OSError):
        os.write(2, f"{shown}\nmagpend: {how}.\n".encode())
    os._exit(128 + number)


def interrupt(message: str) -> KeyboardInterrupt:
    """Return the exception for Ctrl-C in Python code; a notebook shows it as one line, its message.

    It is no subclass: a script that ends by a plain `KeyboardInterrupt` ends by the signal, as shells expect.
    """
    error = KeyboardInterrupt(message)
    vars(error)["_render_traceback_"] = lambda: [message]  # IPython looks for it
    return error


@contextlib.contextmanager
def stoppable(directory: str | Path) -> Iterator[None]:
    """Turn a signal inside this context into an `InterruptedRunError`, after the code has cleaned up.

    Parameters
    ----------
    directory
        Directory that keeps the results, for the message.
    """
    try:
        with _raising():
            yield
    except KeyboardInterrupt as error:
        number = error.number if isinstance(error, Stopped) else signal.SIGINT
        message = f"Stopped. Committed results in {directory} stay; the same command continues from there."
        raise InterruptedRunError(number, message) from None


@contextlib.contextmanager
def _raising() -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP raise `Stopped` inside the context, unless they have another handler."""

    def stop(number: int, frame: Any) -> None:
        raise Stopped(number)

    taken = []
    with contextlib.suppress(ValueError):  # outside the main thread handlers cannot be installed
        for number in NUMBERS:
            if signal.getsignal(number) is signal.SIG_DFL:
                signal.signal(number, stop)
                taken.append(number)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)
