"""Define the table ``[noise]`` of a specification, white noise on equations of the model, and check it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from magpend_core.disturbance import Disturbance
from magpend_core.models.noisy import noisy
from magpend_core.models.parameters import ParameterError
from magpend_core.sizes import NOISE_PREFIX, REALIZATION
from pipeline.specification.tables import STIFF, Table

if TYPE_CHECKING:
    from magpend_core.models.model import Model

STEPS_PER_PERIOD = 256
"""Steps per period if the specification gives neither their number nor their size."""


def _number_or_text(value: Any) -> str:
    return "(expression)" if isinstance(value, str) else "(number)"


Strength = Annotated[
    Annotated[float, Tag("(number)")] | Annotated[str, Tag("(expression)")], Discriminator(_number_or_text)
]


class NoiseTable(Table):
    """The table ``[noise]``: white noise on equations of the model, and the steps with which it is integrated."""

    strengths: dict[str, Strength] = Field(
        min_length=1,
        description="Strength by state: a number, or an expression of states and parameters in quotes. Its unit is "
        "that of the state over the square root of a second.",
    )
    interpretation: Literal["ito", "stratonovich"] | None = Field(
        default=None, description="Stochastic integral; required where a strength depends on its own state."
    )
    seed: int = Field(default=0, ge=0, le=2**63 - 1, description="Seed of the noise.")
    steps_per_period: Annotated[int, Field(ge=1, le=10_000_000)] | None = Field(
        default=None, description=f"Equal steps per period; {STEPS_PER_PERIOD} by default."
    )
    step: Annotated[float, Field(gt=0)] | None = Field(
        default=None,
        description="Largest step [s], instead of their number: the next shorter one that divides the period.",
    )
    tolerance: float = Field(
        default=0.01,
        gt=0,
        description="Largest change of the states within a period when the steps are halved, in units of their "
        "scales; a run is refused if a sample of its cells exceeds it.",
    )

    @model_validator(mode="after")
    def _one_step(self) -> NoiseTable:
        if self.steps_per_period is not None and self.step is not None:
            raise ValueError("give steps_per_period or step, not both.")
        return self

    @cached_property
    def disturbance(self) -> Disturbance:
        """Return the noise as the numerical core takes it."""
        return Disturbance(tuple(self.strengths.items()), self.interpretation or "")

    def steps_at(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Return the number of steps per period at each drive frequency."""
        if self.step is None:
            return np.full(np.shape(frequency_hz), self.steps_per_period or STEPS_PER_PERIOD, np.int64)
        # a period that is a whole number of steps, up to rounding, is divided into that number
        wanted = 1.0 / (np.asarray(frequency_hz) * self.step)
        return np.maximum(np.ceil(wanted * (1.0 - 1e-12)), 1.0).astype(np.int64)

    @property
    def deciding(self) -> dict[str, Any]:
        """Return what decides a cell's numbers besides its parameters: a strength that is a number is one of them."""
        table = self.model_dump(mode="json", exclude_none=True, exclude={"tolerance"})
        strengths = {k: v if isinstance(v, str) else "" for k, v in self.strengths.items()}
        return {**table, "strengths": strengths}


def disturbed(model: Model, noise: NoiseTable | None) -> Model:
    """Return the model with the noise of a table ``[noise]``; without a table, the model unchanged."""
    return model if noise is None else noisy(model, noise.disturbance)


def noise_of(table: NoiseTable | None, model: Model, data: Mapping[str, Any], problems: list[str]) -> NoiseTable | None:
    """Return the table ``[noise]`` if the model can be given its strengths, else None; add problems to `problems`.

    Parameters
    ----------
    table
        Valid table ``[noise]``, or None.
    model
        Model of the specification.
    data
        Tables of the specification; kind, drive, section, starts, integration and products are checked.
    problems
        List to which problems are added.
    """
    if table is None:
        return None
    problems += _clashes(data)
    try:
        made = noisy(model, table.disturbance)
    except ParameterError as error:
        problems += [p if p.startswith("model.") else f"noise.{p}" for p in error.problems]
        return None
    from magpend_core.engine.noise import obstacles  # brings the compiler

    problems += [f"noise: {p}" for p in obstacles(made.expressed.system, made.noise)]
    return table


def follows(problem: str, data: Mapping[str, Any], noise: NoiseTable | None) -> bool:
    """Return whether a problem of an axis only follows from a faulty table ``[noise]``."""
    return "noise" in data and noise is None and problem.startswith((f"axes.{NOISE_PREFIX}", f"axes.{REALIZATION}"))


def _clashes(data: Mapping[str, Any]) -> list[str]:
    """Return the problems of tables and keys that noise excludes."""
    problems = []
    if data.get("kind") == "continuation":
        problems.append(
            "noise: a continuation follows an attractor, and noise leaves every attractor in the end; set "
            'kind = "sweep", or drop [noise].'
        )
    if "drive" in data:
        problems.append("noise: the intervals of a recorded drive are no equal steps; drop [drive] or [noise].")
    if "drift" in data:
        problems.append("noise: parameters cannot move while noise acts; drop [drift] or [noise].")
    if "section" in data:
        problems.append(
            "noise: a noisy state crosses a level infinitely often; drop [section], and set "
            "parameters.frequency_hz for sections at even times."
        )
    if data.get("initial_conditions", {}).get("refine") is not None:
        problems.append("initial_conditions.refine: noisy cells do not close, so none can be inferred; drop the key.")
    if data.get("integration", {}).get("stop_when_closed"):
        problems.append("integration.stop_when_closed: noisy cells do not close; drop the key.")
    if data.get("integration", {}).get("method") == STIFF:
        problems.append(f'integration.method = "{STIFF}": noise is integrated by a method of its own; drop the key.')
    products = data.get("products", {})
    return problems + [
        f"products.{n}: is defined for runs without noise; drop the product, or [noise]." for n in products
    ]
