"""Decide which task comes next: none before its predecessor, long chains first, failed tasks at the end.

This module only keeps the books; it runs no task.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterator, Sequence

MOST_IN_A_ROW = 16
"""Failures in a row at which the run stops: the cause is then not the tasks, but for example a full disk."""

MOST_FAILED = 64
"""Number of failed tasks at which the run stops; fewer are tried again alone, one by one."""

MOST_NAMED = 10
MOST_LETTERS = 300

Predecessor = Callable[[int], int | None]


class TaskFailedError(Exception):
    """Raised if tasks failed twice, or too many tasks failed; the message names the tasks and the reasons.

    Attributes
    ----------
    failed : dict
        Reason by task.
    waiting : int
        Number of tasks that were not begun because they come after a failed one.
    """

    def __init__(self, failed: dict[int, str], waiting: int = 0, note: str = "") -> None:
        self.failed, self.waiting = dict(failed), waiting
        named = [f"task {i}: {why}" for i, why in list(self.failed.items())[:MOST_NAMED]]
        if len(failed) > MOST_NAMED:
            named.append(f"and {len(failed) - MOST_NAMED} more tasks")
        if waiting:
            named.append(f"{waiting} tasks that come after were not begun")
        super().__init__("; ".join(named) + f". {note or self._note()}")

    def _note(self) -> str:
        it = "it" if len(self.failed) == 1 else "they"
        return (
            f"All others are done; {it} failed again when tried alone. Committed results stay, and the same "
            "command tries the missing tasks again."
        )


def why(error: BaseException) -> str:
    """Format an exception as one line."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= MOST_LETTERS else f"{text[:MOST_LETTERS]}..."


class Order:
    """Queue of tasks. Each task waits for its predecessor, and tasks that begin long chains come first.

    A predecessor that is not among `indices` is done.
    """

    def __init__(self, indices: Sequence[int], after: Predecessor | None = None) -> None:
        self._unseen: Iterator[int] = iter(indices if after is None else ())
        self._ready: list[tuple[int, int]] = []
        self._followers: dict[int, list[int]] = {}
        self._chain: dict[int, int] = {}
        self._left = len(indices)
        self._failed: dict[int, str] = {}
        self._second: deque[int] = deque()
        self._in_a_row = 0
        if after is not None:
            self._arrange(indices, after)

    def _arrange(self, indices: Sequence[int], after: Predecessor) -> None:
        here = set(indices)
        order = []
        for index in indices:
            before = after(index)
            if before is None or before not in here:
                order.append(index)
            else:
                self._followers.setdefault(before, []).append(index)
        n_roots = len(order)
        for index in order:  # grows on the way: every task after its predecessor
            order.extend(self._followers.get(index, ()))
        if len(order) != len(here):
            raise ValueError(f"{len(here) - len(order)} tasks wait for one another in a circle.")
        for index in reversed(order):
            behind = self._followers.get(index)
            if behind:
                self._chain[index] = 1 + max(self._chain.get(i, 0) for i in behind)
        self._ready = [self._key(i) for i in order[:n_roots]]
        heapq.heapify(self._ready)

    def _key(self, index: int) -> tuple[int, int]:
        return -self._chain.get(index, 0), index

    def take(self) -> int | None:
        """Remove a task that may start from the queue, and return it; None if there is none now."""
        return heapq.heappop(self._ready)[1] if self._ready else next(self._unseen, None)

    def take_failed(self) -> int | None:
        """Remove a task that failed once, and return it for its second try; None if there is none."""
        return self._second.popleft() if self._second else None

    def done(self, index: int) -> None:
        """Mark a task as done, so that the tasks that wait for it may start."""
        self._in_a_row = 0
        self._left -= 1
        self._failed.pop(index, None)
        for follower in self._followers.pop(index, ()):
            heapq.heappush(self._ready, self._key(follower))

    def failed(self, index: int, reason: str) -> None:
        """Record that a task failed; it is tried again after all other tasks.

        Raise `TaskFailedError` if so many failed that trying each again makes no sense.
        """
        first = index not in self._failed
        self._failed[index] = reason
        if not first:
            return
        self._second.append(index)
        self._in_a_row += 1
        if self._in_a_row >= MOST_IN_A_ROW or len(self._failed) >= MOST_FAILED:
            note = (
                "Given up: so many tasks fail that the cause is hardly in them. Committed results stay, and the same "
            )
            raise TaskFailedError(self._failed, note=note + "command continues when the cause is removed.")

    def close(self) -> None:
        """Raise `TaskFailedError` if tasks failed twice."""
        if self._failed:
            raise TaskFailedError(self._failed, self._left - len(self._failed))
