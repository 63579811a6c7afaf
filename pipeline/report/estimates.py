"""Define the estimate that every measure of a study returns, and judge claims by it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

from pipeline.runs.derive import AnalysedRun

NOWHERE = math.nan


@dataclass(frozen=True)
class Estimate:
    """A measured value with its 95 % confidence interval."""

    value: float  # the estimate; NaN if nothing could be measured
    low: float  # low, high: 95 % interval; NaN if nothing could be measured
    high: float
    text: str = ""  # a phrase on the counted or located objects
    step: float | None = None  # largest step of the axis there, if it limits the resolution
    n: int | None = None  # number of independent cells, curves or periods behind the estimate
    missing: str = ""  # reason why nothing could be measured; otherwise empty


def absent(why: str, step: float | None = None) -> Estimate:
    """Return an estimate without a value, with the reason why it could not be measured."""
    return Estimate(NOWHERE, NOWHERE, NOWHERE, step=step, missing=why)


class Results(Protocol):
    """The results of a study that measures can read by name: runs, and those of other inputs."""

    folder: Path

    def run(self, name: str) -> AnalysedRun:
        """Return a run of the study by name."""

    def read(self, name: str) -> Any:
        """Return what an input of the study is computed from."""

    def computed(self, name: str) -> Any:
        """Return the result of an input of the study by name."""


Options = Mapping[str, Any]
Measure = Callable[[Results, Sequence[str], Options], Estimate]
"""A function of results, the names of those to measure, and options."""


class Verdict(Enum):
    """Verdict on a claim: met, not met, undecided, or used for calibration.

    A claim on which parameters were calibrated tests nothing. It has its own verdict, whatever the result.
    """

    MET = "met"
    NOT_MET = "not met"
    UNDECIDED = "undecided"
    CALIBRATED = "calibrated on this, so no test"

    @property
    def words(self) -> str:
        """Verdict in words, for people."""
        return self.value

    @property
    def css(self) -> str:
        """CSS class of the block that shows this verdict on a page."""
        return self.name.lower().replace("_", "-")

    def __str__(self) -> str:
        return self.value


def judged(low: float, high: float, least: float, most: float) -> Verdict:
    """Judge a claim: met if the confidence interval lies inside the claimed range, not met if outside, else undecided.

    A claimed range is infinite on a side without a bound; the interval is NaN if nothing was measured.
    """
    if not low <= high:  # NaN too
        return Verdict.UNDECIDED
    if low >= least and high <= most:
        return Verdict.MET
    if high < least or low > most:
        return Verdict.NOT_MET
    return Verdict.UNDECIDED
