"""Give the model of an autonomous flow a Poincare section at a level of one state; the level becomes its last
parameter.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.crossing import Crossing
from magpend_core.models.clock import returns
from magpend_core.models.model import Mirror, Model, Parameters
from magpend_core.models.parameters import Parameter
from magpend_core.models.presets import Preset
from magpend_core.sizes import LEVEL

if TYPE_CHECKING:
    from collections.abc import Mapping

    from magpend_core.engine.system import System


@dataclass(frozen=True, eq=False, kw_only=True)
class SectionedModel(Model):
    """A model with a Poincare section at a level of one state; made by `sectioned`.

    Attributes
    ----------
    whole : Model
        The model without the section.
    """

    whole: Model

    @property
    def through(self) -> Crossing:
        """Return the Poincare section: its state, level and direction."""
        assert self.crossing is not None
        return self.crossing

    @property
    def flow(self) -> Model:
        """Return the model without its Poincare section."""
        return self.whole

    @property
    def section_states(self) -> tuple[str, ...]:
        """Return the names of the states that vary on the Poincare section; for a one-dimensional flow, the name of its
        only state.
        """
        return tuple(name for name in self.state_names if name != self.through.of) or self.state_names

    @property
    def reference(self) -> str | Mapping[str, Any]:
        """Return the reference of the model without its Poincare section, as runs store it."""
        return self.whole.reference

    @cached_property
    def system(self) -> System:
        """Return the system that the engine integrates, with the Poincare section; imports the compiler."""
        from magpend_core.engine.crossing import with_section

        return with_section(self.whole.system, self.through.of, self.through.sign)

    @cached_property
    def digest(self) -> str:
        """Return a digest of the model and of the state and direction of its Poincare section."""
        seen = f"{self.whole.digest} {self.through.of} {self.through.direction}"
        return hashlib.sha256(seen.encode()).hexdigest()[: len(self.whole.digest)]

    def preset(self, name: str | Path | Preset | None = None) -> Preset:
        """Return a preset of the model, with the level of the Poincare section added; see `Model.preset`."""
        if isinstance(name, Preset) and LEVEL in name.values:
            return name
        return _with_level(self.whole.preset(name), self.through)


@cache
def sectioned(model: Model, crossing: Crossing) -> SectionedModel:
    """Return a model with a Poincare section; equal arguments give the same object.

    Parameters
    ----------
    model
        Of a flow without a drive.
    crossing
        Its section.

    Raises
    ------
    ParameterError
        If the section is of no state of the model.
    ValueError
        If the model is forced, or has a parameter named like the section's level.
    """
    if not model.clock.has_equilibria:
        raise ValueError(f"{model.name} is forced: its sections are at the drive's period; drop the crossing.")
    if LEVEL in model.parameter_names:
        raise ValueError(f"{model.name} has a parameter named {LEVEL}, which is the level's name; rename it.")
    state = model.state(crossing.of)
    own = {f.name: getattr(model, f.name) for f in dataclasses.fields(Model)}
    level = Parameter(LEVEL, state.unit, f"level of {state.name} at the section")
    changes: dict[str, Any] = {
        "parameters": (*model.parameters, level),
        "presets": tuple(_with_level(p, crossing) for p in model.presets),
        "section": crossing.sentence,
        "clock": returns(crossing),
        "mirror": _mirror(model, crossing),
    }
    return SectionedModel(**{**own, **changes}, whole=model)


def of_flow(parameters: Parameters) -> Parameters:
    """Return the parameters for the model without its Poincare section; its trajectories are the same."""
    model = parameters.model.flow
    if model is parameters.model:
        return parameters
    return Parameters(model, {name: parameters[name] for name in model.parameter_names})


def _with_level(preset: Preset, crossing: Crossing) -> Preset:
    return dataclasses.replace(
        preset,
        values={**preset.values, LEVEL: crossing.value},
        provenance={**preset.provenance, LEVEL: "the section of the run"},
    )


def _mirror(model: Model, crossing: Crossing) -> Mirror | None:
    """Return the model's symmetry if it maps the Poincare section onto itself without a shift in time, else None."""
    mirror = model.mirror
    if mirror is None or mirror.half_period or mirror.signs[model.state_names.index(crossing.of)] < 0:
        return None
    return mirror
