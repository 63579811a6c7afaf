"""Give the model of an autonomous flow a Poincare section at a level of a state or an expression; the level becomes
its last parameter.
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
from magpend_core.models.parameters import Parameter, ParameterError, near_names
from magpend_core.models.presets import Preset
from magpend_core.sizes import LEVEL

if TYPE_CHECKING:
    from collections.abc import Mapping

    from magpend_core.engine.system import System
    from magpend_core.models.text.model import TextModel


@dataclass(frozen=True, eq=False, kw_only=True)
class SectionedModel(Model):
    """A model with a Poincare section at a level of a state or an expression; made by `sectioned`.

    Attributes
    ----------
    whole : Model
        The model without the section.
    expressed : Model
        The model without the section, with its expression as `surface`; `whole` if it is of a state.
    """

    whole: Model
    expressed: Model

    @property
    def through(self) -> Crossing:
        """Return the Poincare section: what crosses the level, the level, and the direction."""
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

        return with_section(self.expressed.system, self.through.of, self.through.sign)

    @cached_property
    def digest(self) -> str:
        """Return a digest of the model, and of what crosses the level of its Poincare section in which direction."""
        seen = f"{self.expressed.digest} {self.through.of} {self.through.direction}"
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
        If the section is of no state and no expression of the model; each problem begins with ``section.of``.
    ValueError
        If the model is forced, or has a parameter named like the section's level.
    """
    if not model.clock.has_equilibria:
        raise ValueError(f"{model.name} is forced: its sections are at the drive's period; drop the crossing.")
    if LEVEL in model.parameter_names:
        raise ValueError(f"{model.name} has a parameter named {LEVEL}, which is the level's name; rename it.")
    expressed = _expressed(model, crossing.of)
    own = {f.name: getattr(model, f.name) for f in dataclasses.fields(Model)}
    units = {q.name: q.unit for q in model.quantities} | {s.name: s.unit for s in model.states}
    level = Parameter(LEVEL, units.get(crossing.of, "1"), f"level of {crossing.of} at the section")
    changes: dict[str, Any] = {
        "parameters": (*model.parameters, level),
        "presets": tuple(_with_level(p, crossing) for p in model.presets),
        "section": crossing.sentence,
        "clock": returns(crossing),
        "mirror": _mirror(model, expressed, crossing),
    }
    return SectionedModel(**{**own, **changes}, whole=model, expressed=expressed)


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


def _expressed(model: Model, of: str) -> Model:
    """Return the model with what crosses the level as `surface` of its system, unless it is a state."""
    if of in model.state_names:
        return model
    if not hasattr(model, "definition"):
        hint = near_names(of, model.state_names, "states")
        if not of.isidentifier():
            hint = f"expressions need a model as text; known states: {', '.join(model.state_names)}."
        raise ParameterError([f"section.of = {of!r}: is not a state of {model.name}; {hint}"])
    from magpend_core.models.text.surfaces import with_surface

    return with_surface(model, of)  # type: ignore[arg-type]


def _mirror(model: Model, expressed: Model, crossing: Crossing) -> Mirror | None:
    """Return the model's symmetry if it maps the Poincare section onto itself without a shift in time, else None."""
    mirror = model.mirror
    if mirror is None or mirror.half_period:
        return None
    if crossing.of in model.state_names:
        return mirror if mirror.signs[model.state_names.index(crossing.of)] > 0 else None
    from magpend_core.models.text.surfaces import keeps_surface

    text: TextModel = expressed  # type: ignore[assignment]
    return mirror if keeps_surface(text, mirror) else None
