"""Define the estimate that a measure of a study returns, and the results that it reads."""

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
    """A measured value with its interval.

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
    """Return the estimate for a missing measurement, with the reason."""
    return Estimate(NOWHERE, NOWHERE, NOWHERE, step=step, missing=why)


class Results(Protocol):
    """The results of a study by name; see `pipeline.report.results.Results`."""

    def run(self, name: str) -> AnalysedRun:
        """Return a run."""

    def recording(self, name: str) -> xr.Dataset:
        """Return the recording of a virtual rig."""

    def torques(self, name: str) -> Any:
        """Return the fit of torque readings."""
