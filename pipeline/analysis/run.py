"""Define the interface of a run that analyses use."""

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
        """Specification of the run."""

    @property
    def model(self) -> Model:
        """Model of the run."""

    @property
    def echo(self) -> Callable[[str], None]:
        """Function that prints a line."""

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the data cube of the run."""

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of another analysis of the same cells."""
