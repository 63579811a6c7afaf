"""Define the Poincare section of a system without a drive, where a state or an expression crosses a level."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.validation import check_array

if TYPE_CHECKING:
    from magpend_core.engine.system import System


DIRECTIONS = {"up": 1, "down": -1}
"""Sign of the rate with which the level is crossed."""


@dataclass(frozen=True)
class Crossing:
    """A Poincare section of a system without forcing: the points where a state or an expression crosses a level.

    A period is then the time from one crossing to the next, a *return*. Crossings are steps of the
    integration that end on the level (see `engine.events`, which says what can be missed). An angle crosses
    its level modulo 2 pi. The crossing that a trajectory starts on does not count.

    Attributes
    ----------
    of : str
        Name of a state; of a model as text, also an expression of its states, parameters, parts and quantities.
    value : float
        The level, in the unit of `of`.
    direction : str
        "up" for crossings at which this rises, "down" where it falls.
    longest : float
        Longest wait for a return [s]; a cell that has none within it ends as ``NO_RETURN``.

    Raises
    ------
    ValueError
        If the direction is neither, `value` is not finite, or `longest` not above 0 and finite.
    """

    of: str
    value: float = 0.0
    direction: str = "up"
    longest: float = 100.0

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"direction = {self.direction!r} of a section must be 'up' or 'down'.")
        check_array("value of a section", self.value, 0)
        if not check_array("longest of a section", self.longest, 0) > 0.0:
            raise ValueError(f"longest = {self.longest} of a section is out of bounds: it must be greater than 0.")

    @property
    def sign(self) -> int:
        """Direction of the crossing: +1 upwards, -1 downwards."""
        return DIRECTIONS[self.direction]

    @property
    def frequency_hz(self) -> float:
        """Value passed to the engine as the drive frequency [Hz]: 1 over the longest time to wait for a crossing."""
        return 1.0 / float(self.longest)

    @property
    def sentence(self) -> str:
        """Description of the section in words: what crosses, level and direction."""
        return f"{self.of} = {self.value:g} going {self.direction}"

    def applied(self, parameters: np.ndarray, system: System) -> tuple[System, np.ndarray, np.ndarray]:
        """Add this Poincare section to a system. Return the new system, its parameters with the level appended, and the
        frequency [Hz] to give to the engine.

        Parameters
        ----------
        parameters
            Packed parameters of `system`, shape (..., n_parameters).
        system
            One without forcing.

        Raises
        ------
        ValueError
            If the system has no such state or depends on time.
        """
        from magpend_core.engine.crossing import with_section  # brings the compiler

        packed = np.asarray(parameters, np.float64)
        level = np.full((*packed.shape[:-1], 1), float(self.value))
        frequency = np.full(packed.shape[:-1], self.frequency_hz)
        crossed = with_section(system, self.of, self.sign)
        return crossed, np.concatenate([packed, level], axis=-1), frequency
