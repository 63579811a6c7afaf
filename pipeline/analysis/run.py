"""Define which parts of a run the analyses use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import xarray as xr

from magpend_core.models.model import Model
from pipeline.specification.spec import Spec


class Run(Protocol):
    """The parts of a run that analyses use: specification, model, result cube and other analyses."""

    @property
    def spec(self) -> Spec:
        """Specification of the run (what it computes)."""

    @property
    def model(self) -> Model:
        """Dynamical model of the run."""

    @property
    def echo(self) -> Callable[[str], None]:
        """Function with which an analysis prints a line of text."""

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the result cube of the run: a Dataset of all cells."""

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of another analysis of this run, computed now or read if it is stored."""
