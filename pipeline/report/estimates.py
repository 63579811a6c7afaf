"""Define the estimate that every measure of a study returns, and the results that measures can read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from pipeline.runs.derive import AnalysedRun

if TYPE_CHECKING:
    import xarray as xr

NOWHERE = math.nan


@dataclass(frozen=True)
class Estimate:
    """A measured value with its 95 % confidence interval.

    Attributes
    ----------
    value : float
        The estimate; NaN if nothing could be measured.
    low, high : float
        95 % interval; NaN if nothing could be measured.
    text : str
        A phrase on the counted or located objects.
    step : float or None
        Largest step of the axis there, if it limits the resolution.
    n : int or None
        Number of independent cells, curves or periods behind the estimate.
    missing : str
        Reason why nothing could be measured; otherwise empty.
    """

    value: float
    low: float
    high: float
    text: str = ""
    step: float | None = None
    n: int | None = None
    missing: str = ""


def absent(why: str, step: float | None = None) -> Estimate:
    """Return an estimate without a value, with the reason why it could not be measured."""
    return Estimate(NOWHERE, NOWHERE, NOWHERE, step=step, missing=why)


class Results(Protocol):
    """The results of a study that measures can read by name: runs, recordings and torque fits."""

    def run(self, name: str) -> AnalysedRun:
        """Return a run of the study by name."""

    def recording(self, name: str) -> xr.Dataset:
        """Return a simulated recording of the study by name."""

    def torques(self, name: str) -> Any:
        """Return the fit of the study's torque readings by name."""
