"""Record the further integration of sampled trajectories after the run, until each of them ends."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

ON_SET, FAILED, COURSE_DIVERGED, COURSE_GROWS, AT_REST = -1, -2, -3, -4, -5
"""Ends of extended cells other than orbits; `AT_REST` minus k is the equilibrium number k."""


@dataclass
class Course:
    """A trajectory of the run that is integrated further, with its old and its new section points."""

    cell: int  # its place among the cells of the point
    key: int  # box of its last kept section
    kept: np.ndarray  # (n, state): sections that the run kept
    # state (state,) and step size [s] with which the integration continues
    state: np.ndarray
    step: float = 0.0
    sent: int = 0  # length to which it was last to be integrated, and is not yet where it leapt on the way
    end: int = ON_SET  # number of an orbit, or one of the codes above
    seconds: float = 0.0  # time of the extension [s]; 0 if it is not known
    periods: float = 0.0  # drive periods or returns from its last kept section until it came near its end
    is_leaving: bool = False  # whether it was near its end from the start
    is_neighbour: bool = False  # whether it was drawn beside a cell, and is none itself
    length: int = 0  # number of section points that the further integration has added
    _added: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # these, with room for more

    @property
    def goes_on(self) -> bool:
        """Whether the trajectory is still to be integrated, because no orbit, equilibrium or failure has ended it."""
        return self.end == ON_SET

    @property
    def extension(self) -> np.ndarray:
        """Section points that the further integration has added to those of the run, shape (n, state)."""
        return self._added[: self.length] if self.length else self.kept[:0]

    def add(self, sections: np.ndarray, seconds: np.ndarray, state: np.ndarray, step: float) -> None:
        """Add section points (leg, n, state) to the extension, with the time of each leg, and the state and the step
        size that continue it.
        """
        self.seconds, self.state, self.step = sum(seconds.tolist(), self.seconds), state, step
        sections = sections.reshape(-1, sections.shape[2])
        n = self.length + len(sections)
        if n > len(self._added) or not self.length:
            self._added = np.concatenate([self.extension, np.empty((2 * n - self.length, self.kept.shape[1]))])
        self._added[self.length : n] = sections
        self.length = n

    @property
    def stayed(self) -> np.ndarray:
        """Section points on the set that the trajectory stays on, or that it was on before it left."""
        if self.goes_on:
            return self.extension if self.length else self.kept
        return np.asarray(self.extension[: int(self.periods)])

    @property
    def has_left(self) -> bool:
        """Whether the trajectory has left a set after a least number of section points on it."""
        least = 8  # section points on a set for a cell to count as having left it
        return not self.goes_on and not self.is_leaving and len(self.stayed) >= least


def rest_number(end: int) -> int | None:
    """Return the index of the equilibrium at which a trajectory ended, from its end code; None for any other end."""
    return AT_REST - end if end <= AT_REST else None
