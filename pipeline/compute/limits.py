"""When a task has taken too long: the limit follows from its estimate, and from how estimates turned out."""

from __future__ import annotations

from collections.abc import Callable

LEAST_S = 60.0
"""No task is given up earlier than this after its start [s]."""

FACTOR = 10.0
"""A task may take this many times its estimate, or times what the worst task so far took of its own."""

SHORT_S = 1.0
"""Tasks that took less say nothing about estimates: starting takes its time [s]."""

MORE = 2.0
"""Every further try of a task may take this many times longer than the one before."""

SILENT_S = 20.0
"""A worker that has not been heard of for so long is taken for stopped [s]; they report every half second."""


class Limits:
    """Says how long tasks may take.

    Parameters
    ----------
    seconds
        Estimated time of a task on one core [s]; None knows no limit.
    """

    def __init__(self, seconds: Callable[[int], float] | None) -> None:
        self._seconds = seconds
        self._worst = 1.0

    def finished(self, index: int, took_s: float) -> None:
        """Learn from a task that finished: estimates may be several times too low."""
        if self._seconds is not None and took_s > SHORT_S:
            self._worst = max(self._worst, took_s / max(self._seconds(index), 1e-9))

    def limit_s(self, index: int, tries: int) -> float:
        """Longest time for a task of which it is the n-th try [s]."""
        if self._seconds is None:
            return float("inf")
        return max(LEAST_S, FACTOR * self._worst * self._seconds(index)) * MORE ** (tries - 1)
