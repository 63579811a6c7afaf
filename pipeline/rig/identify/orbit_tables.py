"""Define the tables of measured orbits and bifurcations in the specification of an identification."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from pipeline.specification.section import SectionTable
from pipeline.specification.tables import Table

Quantity = Literal["amplitude", "frequency", "mean", "harmonics"]

Pair = Annotated[tuple[float, float], Field(strict=False)]


class BifurcationTable(Table):
    """Table ``[[orbits.bifurcations]]``: bifurcation that was measured, with its 95 % interval."""

    kind: Literal["fold", "doubling", "torus", "hopf"] = Field(description="Kind of the bifurcation.")
    interval: Pair = Field(description="95 % interval of the parameter, [low, high].")
    period: int = Field(1, ge=1, description="Period of its orbit [drive periods or returns]; no matter for hopf.")
    name: str = Field("", description="Name; by default kind and place in the list.")


class OrbitsTable(Table):
    """Table ``[[orbits]]``: measured orbits along a parameter, and measured bifurcations."""

    file: str = Field(
        "", description="Table of orbits (CSV) or specification with [measured.branch], relative to this file."
    )
    parameter: str = Field("", description="Parameter of the bifurcations; by default that of the file.")
    state: str = Field("", description="State of a CSV file's amplitudes; by default the model's first.")
    section: SectionTable | None = Field(
        None, description="Poincare section of a model without a drive; by default that of the file."
    )
    period: int = Field(1, ge=1, description="Period of the orbits [drive periods or returns].")
    frequency_hz: float | None = Field(None, gt=0, description="Drive frequency [Hz], unless it is the parameter.")
    range: Pair | None = Field(
        None, description="Interval of the parameter in which branches are computed; by default half as wide again."
    )
    parameters: dict[str, float] = Field(
        default_factory=dict, description="Values of parameters in these measurements alone."
    )
    quantities: Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1)] = Field(
        ("amplitude", "frequency"), description="Quantities that are fitted; a drive determines the frequency."
    )
    model_error: dict[Quantity, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Standard deviation that the model is allowed, relative to the measured value; it is added to "
        "that of the measurement.",
    )
    parameter_sd: float = Field(
        0.0,
        ge=0,
        description="Standard deviation of the parameter's measured values. Above 0 the nearest orbit of the branch is "
        "compared, which is also there beside a fold.",
    )
    hold_out: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Names of orbits and bifurcations that are judged but not fitted."
    )
    bifurcations: Annotated[tuple[BifurcationTable, ...], Field(strict=False)] = Field(
        (), description="Measured bifurcations."
    )
