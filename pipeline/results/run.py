"""Define which parts of a run analyses and figures use."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import xarray as xr

from magpend_core.models.model import Model
from pipeline.specification.spec import Spec


class OpenRun(Protocol):
    """The parts of a run that analyses and figures use: specification, model, record, cube and analyses."""

    @property
    def spec(self) -> Spec:
        """Specification of the run (what it computes)."""

    @property
    def model(self) -> Model:
        """Dynamical model of the run."""

    @property
    def echo(self) -> Callable[[str], None]:
        """Function that prints a line for the user."""

    @property
    def info(self) -> Any:
        """Record of the run (``run.json``)."""

    @property
    def digest(self) -> str:
        """Digest of the run's stored cells."""

    def of(self, source: str) -> OpenRun:
        """Open another run by its source, such as a run directory."""

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the result cube of the run: a Dataset of all cells."""

    def derive(self, name: str, **options: Any) -> xr.Dataset:
        """Return the result of another analysis of this run, computed now or read if it is stored."""

    def branch_options(self, parameter: str) -> Any:
        """Return the options of the run's branches along a parameter: those last given, or the defaults."""

    def with_values(self, values: Sequence[float]) -> OpenRun:
        """Return the run beside this one that has further values of the one swept parameter; compute what it lacks.

        Without any values it is the run beside as it is, or this run if there is none.
        """

    def at_points(self, points: Sequence[Mapping[str, float]], n_starts: int | Sequence[int]) -> Sequence[OpenRun]:
        """Return the run beside this one at each of some single points of the swept parameters, with a number of
        starts; compute what they lack.

        `pipeline.runs.beside.runs_at` says what points and starts are.
        """
