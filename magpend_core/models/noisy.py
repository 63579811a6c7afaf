"""Give a model white noise on some of its equations; the strengths become its last parameters."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.disturbance import INTERPRETATIONS, Disturbance
from magpend_core.models.model import Model
from magpend_core.models.parameters import FINITE, NON_NEGATIVE, Parameter, ParameterError, near_names
from magpend_core.models.presets import Preset
from magpend_core.sizes import NOISE_PREFIX, REALIZATION

if TYPE_CHECKING:
    from magpend_core.engine.noise import Noise
    from magpend_core.engine.system import System
    from magpend_core.models.text.model import TextModel

FACTOR = "noise_on_"
"""The factor of the noise on the state x is the quantity noise_on_x of the text."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NoisyModel(Model):
    """A model with white noise on some of its equations; made by `noisy`.

    Attributes
    ----------
    whole : Model
        The model without noise.
    expressed : Model
        The model without noise, with the factors of the strengths as quantities; `whole` if all are numbers.
    disturbed_by : Disturbance
        The noise.
    """

    whole: Model
    expressed: Model
    disturbed_by: Disturbance

    @property
    def disturbance(self) -> Disturbance | None:
        """Return the noise on the model's equations."""
        return self.disturbed_by

    @property
    def reference(self) -> str | Mapping[str, Any]:
        """Return the reference of the model without noise, as runs store it."""
        return self.whole.reference

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return the warnings about the model's text, the strengths included."""
        return self.expressed.remarks

    @property
    def angle_remarks(self) -> tuple[str, ...]:
        """Return the remarks on undeclared angles of the model without noise."""
        return self.whole.angle_remarks

    @cached_property
    def noise(self) -> Noise:
        """Return the noise as the engine takes it; imports the compiler."""
        from magpend_core.engine.jit import inline
        from magpend_core.engine.noise import ITO, Noise

        names = [name for name, _ in self.disturbed_by.strengths]
        states = sorted((self.state_names.index(name), name) for name in names)
        numbers = tuple(number for number, _ in states)
        if not self.disturbed_by.expressions:
            return Noise(numbers)
        system = self.expressed.system
        entries = [
            f"found[{system.quantity_names.index(FACTOR + name)}]" if name in self.disturbed_by.expressions else "one"
            for _, name in states
        ]
        scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_quantities": system.quantities}
        lines = ["one = 0.0 * y[0] + 1.0", "found = _quantities(0.0, y, y, 0.0, c)", f"return ({', '.join(entries)},)"]
        exec("def factors(y, c):\n    " + "\n    ".join(lines) + "\n", scope)
        own = tuple(name in _needed(self.expressed, name) for _, name in states)
        return Noise(numbers, inline(scope["factors"]), own, self.disturbed_by.interpretation or ITO)

    @cached_property
    def system(self) -> System:
        """Return the system that the engine integrates, with its strengths; imports the compiler."""
        from magpend_core.engine.noise import with_strengths

        return with_strengths(self.expressed.system, self.noise)

    @cached_property
    def digest(self) -> str:
        """Return a digest of the model, of the strengths that are expressions, and of their interpretation."""
        noise = [name for name, _ in self.disturbed_by.strengths], self.disturbed_by.interpretation
        seen = f"{self.expressed.digest} {noise!r}"
        return hashlib.sha256(seen.encode()).hexdigest()[: len(self.expressed.digest)]

    def preset(self, name: str | Path | Preset | None = None) -> Preset:
        """Return a preset of the model, with the strengths added; see `Model.preset`."""
        if isinstance(name, Preset) and REALIZATION in name.values:
            return name
        return _with_strengths(self.whole.preset(name), self.disturbed_by)


@cache
def noisy(model: Model, disturbance: Disturbance) -> NoisyModel:
    """Return a model with white noise on some of its equations; equal arguments give the same object.

    Raises
    ------
    ParameterError
        With all problems at once; each begins with ``strengths.<state>`` or ``interpretation``.
    """
    if problems := _problems(model, disturbance):
        raise ParameterError(problems)
    expressed = _expressed(model, disturbance)
    if problems := _dependence_problems(expressed, disturbance):
        raise ParameterError(problems)
    own = {f.name: getattr(model, f.name) for f in dataclasses.fields(Model)}
    changes: dict[str, Any] = {
        "parameters": (*model.parameters, *_parameters(model, disturbance)),
        "presets": tuple(_with_strengths(p, disturbance) for p in model.presets),
        "mirror": None,
    }
    return NoisyModel(**{**own, **changes}, whole=model, expressed=expressed, disturbed_by=disturbance)


def _parameters(model: Model, disturbance: Disturbance) -> list[Parameter]:
    """Return the parameters that noise adds to a model."""
    names = [name for name, _ in disturbance.strengths]
    found = []
    for state in sorted((model.state(name) for name in names), key=model.states.index):
        is_factor = state.name in disturbance.expressions
        unit = "1" if is_factor else f"{state.unit}/sqrt(s)"
        meaning = f"{'factor of the ' if is_factor else ''}strength of the noise on {state.name}"
        found.append(Parameter(NOISE_PREFIX + state.name, unit, meaning, NON_NEGATIVE))
    return [*found, Parameter(REALIZATION, "1", "number of the noise's realization", FINITE)]


def _with_strengths(preset: Preset, disturbance: Disturbance) -> Preset:
    values = {NOISE_PREFIX + name: 1.0 if isinstance(v, str) else float(v) for name, v in disturbance.strengths}
    values[REALIZATION] = 0.0
    return dataclasses.replace(
        preset,
        values={**preset.values, **values},
        provenance={**preset.provenance, **dict.fromkeys(values, "the noise of the run")},
    )


def _problems(model: Model, disturbance: Disturbance) -> list[str]:
    """Return the problems of the strengths themselves: unknown states, names in use, expressions for other models."""
    problems = []
    for name, value in disturbance.strengths:
        place = f"strengths.{name}"
        if name not in model.state_names:
            problems.append(f"{place}: is not a state of {model.name}; {near_names(name, model.state_names, 'states')}")
        elif isinstance(value, str) and not _is_text(model):
            problems.append(f"{place} = {value!r}: {model.name} is not given as text, so its strengths are numbers.")
        elif not isinstance(value, str) and not 0.0 <= value < float("inf"):
            problems.append(f"{place} = {value!r}: must be 0 or greater, or an expression in quotes.")
    taken = [n for n in _new_names(disturbance) if n in model.parameter_names]
    problems += [f"strengths: {model.name} has a parameter named {n}, which noise needs; rename it." for n in taken]
    return problems


def _new_names(disturbance: Disturbance) -> list[str]:
    return [*(NOISE_PREFIX + name for name, _ in disturbance.strengths), REALIZATION]


def _is_text(model: Model) -> bool:
    return hasattr(model, "definition")


def _expressed(model: Model, disturbance: Disturbance) -> Model:
    """Return the model with each expression of a strength as a quantity."""
    if not disturbance.expressions:
        return model
    from magpend_core.models.text import read_model

    text: TextModel = model  # type: ignore[assignment]
    table = dict(text.definition.table)
    added = {FACTOR + name: value for name, value in disturbance.expressions.items()}
    quantities = table.get("quantities", {})
    try:
        return read_model({**table, "quantities": {**quantities, **added}})
    except ParameterError as error:
        problems = []
        for problem in error.problems:
            head = f"model.quantities.{FACTOR}"
            problems.append(problem.replace(head, "strengths.", 1) if problem.startswith(head) else problem)
        raise ParameterError(problems) from None


def _needed(model: Model, state: str) -> tuple[str, ...]:
    """Return the names that the strength of the noise on a state needs; none if it is a number."""
    definition = model.definition  # type: ignore[attr-defined]
    tree = definition.quantities.get(FACTOR + state)
    return () if tree is None else definition.used([tree])


def _dependence_problems(model: Model, disturbance: Disturbance) -> list[str]:
    """Return the problems of strengths that depend on time or on other noisy states, or need an interpretation."""
    problems, noisy_states = [], [name for name, _ in disturbance.strengths]
    needs: list[str] = []
    for name, value in disturbance.expressions.items():
        place, needed = f"strengths.{name} = {value!r}", _needed(model, name)
        if timed := sorted(model.definition.timed & set(needed)):  # type: ignore[attr-defined]
            problems.append(f"{place}: depends on {timed[0]}; strengths are expressions of states and parameters.")
        others = [n for n in noisy_states if n != name and n in needed]
        if others:
            problems.append(
                f"{place}: depends on {others[0]}, which has noise of its own; the step would need double "
                "integrals of two noises. Use states without noise and the state itself."
            )
        needs += [name] if name in needed else []
    given = disturbance.interpretation
    if needs and not given:
        problems.append(
            f"interpretation: missing; the strength of the noise on {needs[0]} depends on {needs[0]}, so say "
            'which equation is meant: interpretation = "ito" or "stratonovich".'
        )
    elif given and given not in INTERPRETATIONS:
        problems.append(f'interpretation = {given!r}: must be "ito" or "stratonovich".')
    return problems
