"""Describe a model of which parameters move: the numbers of the ramps become parameters of their own."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models.drift.ramps import Ramp, ramp_parameters
from magpend_core.models.model import Model
from magpend_core.models.presets import Preset
from magpend_core.versions import DRIFT, written

if TYPE_CHECKING:
    from collections.abc import Mapping

    from magpend_core.engine.system import System


@dataclass(frozen=True, eq=False, kw_only=True)
class DriftingModel(Model):
    """A model of which parameters move; made by `drifting`.

    Attributes
    ----------
    still : Model
        The model whose parameters stay where they are.
    ramps : tuple of Ramp
        The motions of its parameters.
    """

    still: Model
    ramps: tuple[Ramp, ...]

    @property
    def reference(self) -> str | Mapping[str, Any]:
        """Return the reference of the model without the motion of its parameters, as runs store it."""
        return self.still.reference

    @cached_property
    def system(self) -> System:
        """Return the system of the model without the motion of its parameters; imports the compiler."""
        return self.still.system

    @cached_property
    def digest(self) -> str:
        """Return a digest of the model and of the code that moves its parameters."""
        whole = f"{self.still.digest} {written('drift', DRIFT)}"
        return hashlib.sha256(whole.encode()).hexdigest()[: len(self.still.digest)]

    def preset(self, name: str | Path | Preset | None = None) -> Preset:
        """Return a preset of the model with the numbers of the ramps; see `Model.preset`."""
        return with_numbers(self.still.preset(name), self.ramps)


def with_numbers(preset: Preset, ramps: tuple[Ramp, ...]) -> Preset:
    """Return a preset with the numbers of ramps among its values."""
    numbers = {n: v for ramp in ramps for n, (_, v) in zip(ramp.names, ramp.numbers, strict=True)}
    return dataclasses.replace(
        preset,
        values={**preset.values, **numbers},
        provenance={**preset.provenance, **dict.fromkeys(numbers, "the drift of the run")},
    )


@cache
def drifting(model: Model, ramps: tuple[Ramp, ...]) -> DriftingModel:
    """Return a model of which parameters move; equal arguments give the same object.

    Parameters
    ----------
    model
        Any model without a section by crossing.
    ramps
        One for each parameter that moves.

    Raises
    ------
    ParameterError
        If a ramp moves no parameter of the model.
    ValueError
        If a number of a ramp has the name of a parameter or state.
    """
    own = {f.name: getattr(model, f.name) for f in dataclasses.fields(Model)}
    more = tuple(p for ramp in ramps for p in ramp_parameters(ramp, model.parameter(ramp.parameter).unit))
    for p in more:
        if p.name in (*model.parameter_names, *model.state_names):
            raise ValueError(
                f"{model.name} has a parameter or state named {p.name}, a name that the drift needs; rename it."
            )
    presets = tuple(with_numbers(p, ramps) for p in model.presets)
    changes: dict[str, Any] = {"parameters": (*model.parameters, *more), "presets": presets}
    return DriftingModel(**{**own, **changes}, still=model, ramps=ramps)
