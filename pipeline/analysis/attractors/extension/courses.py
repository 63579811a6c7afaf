"""Record how sampled trajectories go on after the last section point of the run, until they end."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

LEAST_SEEN = 8
"""Fewest section points on a set for a cell to count as having left it."""

ON_SET, FAILED, DIVERGED, AT_REST = -1, -2, -3, -4
"""Ends of extended cells other than orbits; `AT_REST` minus k is the equilibrium number k."""


@dataclass
class Course:
    """Sampled trajectory of the run and its extension by further integration.

    Attributes
    ----------
    cell : int
        Its place among the cells of the point.
    key : int
        Box of its last kept section.
    kept : ndarray, (n, state)
        Sections that the run kept.
    state, step
        State (state,) and step size [s] with which the integration continues.
    legs : list of ndarray
        Sections of the extension, leg by leg.
    end : int
        Number of an orbit, or one of the codes above.
    periods : float
        Drive periods or returns from its last kept section until it came near its end.
    is_leaving : bool
        Whether it was near its end from the start.
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
        """Whether the trajectory has not ended yet (on an orbit, at an equilibrium, diverged or failed)."""
        return self.end == ON_SET

    @property
    def extension(self) -> np.ndarray:
        """All section points of the extension, shape (n, state)."""
        return np.concatenate([self.kept[:0], *self.legs])

    @property
    def stayed(self) -> np.ndarray:
        """Section points on the set: the whole extension, or the part before the trajectory left."""
        if self.goes_on:
            return self.extension if self.legs else self.kept
        return np.asarray(self.extension[: int(self.periods)])

    @property
    def has_left(self) -> bool:
        """Whether the trajectory stayed on a set for at least `LEAST_SEEN` section points before it ended elsewhere."""
        return not self.goes_on and not self.is_leaving and len(self.stayed) >= LEAST_SEEN

    @property
    def length(self) -> int:
        """Number of section points in the extension."""
        return sum(len(leg) for leg in self.legs)


def rest_number(end: int) -> int | None:
    """Return the number of the equilibrium at which a trajectory ended, from its end code; None for another kind of
    end.
    """
    return AT_REST - end if end <= AT_REST else None
