"""Sampled cells on their way from the last section that a run kept, and where they end."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

LEAST_SEEN = 8
"""Fewest section points of a cell on a set that it left."""

ON_SET, FAILED, DIVERGED, AT_REST = -1, -2, -3, -4
"""Ends of extended cells that are no orbits; `AT_REST` minus a number is an equilibrium."""


@dataclass
class Course:
    """A sampled cell on its way.

    Attributes
    ----------
    cell : int
        Its place among the cells of the point.
    key : int
        Box of its last kept section.
    kept : ndarray, (n, state)
        Sections of the run.
    state, step
        With which it goes on.
    legs : list of ndarray
        Sections since.
    end : int
        Number of an orbit, or one of the codes above.
    periods : float
        Drive periods or returns from its last kept section until it came near where it ended.
    is_leaving : bool
        Whether it was near there from the start.
    """

    cell: int
    key: int
    kept: np.ndarray
    state: np.ndarray
    step: float = 0.0
    legs: list[np.ndarray] = field(default_factory=list)
    end: int = ON_SET
    periods: float = 0.0
    is_leaving: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether it has not ended."""
        return self.end == ON_SET

    @property
    def extension(self) -> np.ndarray:
        """All sections since, shape (n, state)."""
        return np.concatenate([self.kept[:0], *self.legs])

    @property
    def stayed(self) -> np.ndarray:
        """Section points on the set: the whole extension, or of a cell that left what was before."""
        if self.goes_on:
            return self.extension if self.legs else self.kept
        return np.asarray(self.extension[: int(self.periods)])

    @property
    def has_left(self) -> bool:
        """Whether it ended, and stayed elsewhere for some time before."""
        return not self.goes_on and not self.is_leaving and len(self.stayed) >= LEAST_SEEN

    @property
    def length(self) -> int:
        """Sections since."""
        return sum(len(leg) for leg in self.legs)


def rest_number(end: int) -> int | None:
    """Number of the equilibrium that an end stands for, None if it is another end."""
    return AT_REST - end if end <= AT_REST else None
