"""Limit the run time of tasks: by estimated times, and by how far earlier estimates were wrong."""

from __future__ import annotations

from collections.abc import Callable

LEAST_S = 60.0
"""Least limit of any task [s]."""

FACTOR = 10.0
"""Limit of a task in units of its estimate times the worst ratio so far of a task's time to its estimate."""

SHORT_S = 1.0
"""Shorter tasks are not compared with their estimates, since starting dominates their time [s]."""

MORE = 2.0
"""Factor of the limit from one try of a task to the next."""


class Limits:
    """Limits of the run time of tasks, from estimated and measured times.

    Parameters
    ----------
    seconds
        Estimated time of a task on one core [s]; None sets no limit.
    """

    def __init__(self, seconds: Callable[[int], float] | None) -> None:
        self._seconds = seconds
        self._worst = 1.0

    def finished(self, index: int, took_s: float) -> None:
        """Record how long a finished task took, to correct the estimates for the others."""
        if self._seconds is not None and took_s > SHORT_S:
            self._worst = max(self._worst, took_s / max(self._seconds(index), 1e-9))

    def limit_s(self, index: int, tries: int) -> float:
        """Return the time after which a task is given up [s]; it is longer for each further try."""
        if self._seconds is None:
            return float("inf")
        return max(LEAST_S, FACTOR * self._worst * self._seconds(index)) * MORE ** (tries - 1)
