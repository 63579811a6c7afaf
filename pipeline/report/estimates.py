"""Define `Estimate`, the return type of all measures of a study, and the protocol through which measures read the
study's results.
"""

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
    """A measured value with its 95 % interval.

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
    """Return an `Estimate` of NaN for a quantity that could not be measured, with the reason."""
    return Estimate(NOWHERE, NOWHERE, NOWHERE, step=step, missing=why)


class Results(Protocol):
    """Protocol for the results of a study, read by name; see `pipeline.report.results.Results`."""

    def run(self, name: str) -> AnalysedRun:
        """Return a run of the study by name."""

    def recording(self, name: str) -> xr.Dataset:
        """Return a recording of a simulated test rig by name."""

    def torques(self, name: str) -> Any:
        """Return the fit of a study's torque readings by name."""
