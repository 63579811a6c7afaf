"""Define how a model counts time: by periods of its drive, at even times, by returns to a section, or by iterations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.defaults import DRIVE_HZ

if TYPE_CHECKING:
    from magpend_core.crossing import Crossing


@dataclass(frozen=True)
class Clock:
    """The counting of time in a model; its period is the time from one section point to the next.

    Attributes
    ----------
    period : str
        Word for the period.
    section : str
        Word for the section.
    instant : str
        When section points are taken.
    meaning : str
        What the equations give.
    kind : str
        Kind of system: ``flow`` or ``map``.
    unit : str
        Unit of times and, inverted, of rates.
    hertz : float, optional
        Frequency that the engine takes [Hz]: 1 of a map, of returns one over the longest time between two. None where
        a user gives it.
    frequency : str
        Word for the frequency that a user gives.
    default_hz : float
        This frequency where one trajectory is integrated, and none is given [Hz].
    has_drive : bool
        Whether the equations depend on time.
    is_continuous : bool
        Whether the system moves between section points, as a flow does.
    crossing : Crossing, optional
        Poincare section at which returns are counted.
    """

    period: str
    section: str
    instant: str
    meaning: str
    kind: str = "flow"
    unit: str = "s"
    hertz: float | None = None
    frequency: str = "drive frequency"
    default_hz: float = 1.0
    has_drive: bool = False
    is_continuous: bool = True
    crossing: Crossing | None = None

    @property
    def periods(self) -> str:
        """Plural of the word for the period."""
        return f"{self.period}s"

    @property
    def once(self) -> str:
        """Phrase for the instants of section points, such as "once per drive period"."""
        return f"once per {self.period}" if self.crossing is None else f"crossing of {self.instant}"

    @property
    def has_equilibria(self) -> bool:
        """Whether states can rest, and cycles have a period of their own: those of a flow without a drive."""
        return self.is_continuous and not self.has_drive

    @property
    def n_neutral(self) -> int:
        """Number of multipliers of the section map that are 1 since time may be shifted: 1 of a flow at even times."""
        return int(self.has_equilibria and self.crossing is None)

    def samples(self, n: int) -> int:
        """Return the number of instants at which a period is sampled: `n`, but 1 of a map, which has its iterates
        alone.
        """
        return n if self.is_continuous else 1

    def instants(self, seconds: float, n: int) -> np.ndarray:
        """Return `n` even times from 0 to `seconds`, or the iterations of a map until then."""
        return np.linspace(0.0, seconds, n) if self.is_continuous else np.arange(seconds + 1.0)

    def orbit_seconds(self, n_periods: int, frequency_hz: float) -> float:
        """Return how long an orbit of `n_periods` drive periods takes [s]; NaN without a drive, where orbits differ."""
        return np.nan if self.has_equilibria else n_periods / frequency_hz


DRIVEN = Clock(
    "drive period",
    "stroboscopic section",
    "the start of the drive's period",
    "period 1/f, f the drive's frequency [Hz]",
    default_hz=DRIVE_HZ,
    has_drive=True,
)
"""A drive's periods."""

STROBED = Clock(
    "strobe period",
    "stroboscopic section",
    "one instant of every period",
    "no drive: the equations do not depend on time",
    frequency="strobe frequency",
)
"""Even times of a flow without a drive."""

MAP = Clock(
    "iteration",
    "iterates",
    "every iteration",
    "a map: the equations give the next states",
    kind="map",
    unit="iteration",
    hertz=1.0,
    is_continuous=False,
)
"""Iterations of a map."""


def returns(crossing: Crossing) -> Clock:
    """Return the clock of a flow without a drive whose section points are crossings of a level."""
    return Clock(
        "return",
        "Poincar\u00e9 section",
        crossing.sentence,
        STROBED.meaning,
        hertz=crossing.frequency_hz,
        crossing=crossing,
    )
