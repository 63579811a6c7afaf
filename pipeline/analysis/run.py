"""Define what an analysis may ask of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import xarray as xr

from magpend_core.models.model import Model
from pipeline.specification.parsing import Spec


class Run(Protocol):
    """The parts of a run that analyses use; see `pipeline.runs.derive.AnalysedRun`."""

    @property
    def spec(self) -> Spec:
        """Return the run's specification."""

    @property
    def model(self) -> Model:
        """Return the run's model."""

    @property
    def echo(self) -> Callable[[str], None]:
        """Return the function that prints a line."""

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the cells of the run."""

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of another analysis of the same cells."""
