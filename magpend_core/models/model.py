"""Define the class `Model` and its parts, for all code above the engine; imports no compiler.

A model names its states and parameters, its presets with their provenance, and the system that the engine
integrates. It may bring more: quantities of state and time, a classifier of motions with its words, a
mirror symmetry, a drawing. Code outside of a model's own room reads them from here and assumes nothing.
"""

from __future__ import annotations

import importlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from magpend_core.models.clock import DRIVEN, Clock
from magpend_core.models.parameters import Parameter, ParameterError, near_names, unknown_name_problem
from magpend_core.models.presets import Preset as Preset
from magpend_core.models.presets import completed, find_preset
from magpend_core.versions import written

if TYPE_CHECKING:
    from magpend_core.crossing import Crossing
    from magpend_core.disturbance import Disturbance
    from magpend_core.engine.system import System


class ModelError(ParameterError):
    """Error: no model has the name asked for, or a model's definition is not consistent."""


def _no_model(name: str) -> Model:
    raise ModelError([f"model {name!r} does not exist."])


model_named: Callable[[str], Model] = _no_model
"""`magpend_core.models.load_model`. The package sets it, since it knows all models and imports this module."""


@dataclass(frozen=True)
class State:
    """Name, unit and properties of one state of a model.

    Attributes
    ----------
    meaning : str
        A short phrase for tables and axes.
    symbol : str
        LaTeX without dollar signs; empty for the name.
    on_circle : bool
        Whether it is an angle [rad] of which full turns do not matter.
    scale : float
        Size that counts as 1 when states are compared.
    motion : tuple of float or None
        Least and largest value in the motion of a run; half of their difference then counts as 1 in its analyses.
    escape : float
        Beyond this absolute value at a section a trajectory has diverged.
    size : float
        Unit of the absolute tolerance; 1 unless it was found from a run's motions.
    rate : str
        Name of the state that is its time derivative, if one is; phase portraits show the pair.
    """

    name: str
    unit: str
    meaning: str
    symbol: str = ""
    on_circle: bool = False
    scale: float = 1.0
    escape: float = math.inf
    rate: str = ""
    size: float = 1.0
    motion: tuple[float, float] | None = None

    @property
    def measure(self) -> float:
        """Size that counts as 1 in analyses: half of the extent of the motion where it is known, else the scale."""
        return self.scale if self.motion is None else 0.5 * (self.motion[1] - self.motion[0])

    @property
    def farthest(self) -> float:
        """Largest absolute value in the motion, in units of the measure; 1 where the motion is not known."""
        return 1.0 if self.motion is None else max(abs(x) for x in self.motion) / self.measure


@dataclass(frozen=True)
class Quantity:
    """A quantity that a model computes from state and time: an energy, a torque, a position.

    Attributes
    ----------
    name, unit, meaning, symbol : str
        As for `State`.
    """

    name: str
    unit: str
    meaning: str
    symbol: str = ""


@dataclass(frozen=True)
class Classifier:
    """Classification of a model's motions into named classes, computed from stored section points.

    Attributes
    ----------
    words : tuple of str
        Their codes are 0, 1, ...; the first is "unknown": there is nothing to judge.
    neutral : tuple of int
        Codes that say nothing of a motion, drawn grey.
    meaning : str
        What the words are about.
    classify : callable
        ``classify(section, turns, frequency_hz, parameters)`` with `section` (..., n_keep, n_states), `turns`
        (..., n_angles), `frequency_hz` and the values of `parameters` (a mapping by name) of shapes that
        broadcast to the leading one; returns int8 codes of the leading shape. Sections are finite; what is
        not known stays with the caller.
    """

    words: tuple[str, ...]
    neutral: tuple[int, ...]
    meaning: str
    classify: Callable[[np.ndarray, np.ndarray, np.ndarray, Mapping[str, Any]], np.ndarray]


@dataclass(frozen=True)
class Mirror:
    """A symmetry of a model: solutions with states multiplied by `signs`, perhaps shifted by half a drive period, are
    solutions again.

    Attributes
    ----------
    signs : tuple of int
        +1 or -1 for each state.
    half_period : bool
        Whether the image of a section point is that of the state half a drive period later.
    """

    signs: tuple[int, ...]
    half_period: bool


@dataclass(frozen=True)
class Drawing:
    """Geometry of a model for portraits and animations: moving points, anchor points, and the lines between them.

    Attributes
    ----------
    points : callable
        ``points(states, parameters)`` with `states` (..., n_states) and a mapping of parameters; returns the
        place (..., 2) of each moving point by name, x to the right and y upwards.
    fixed : callable
        ``fixed(parameters)``: the place (2,) of each point that does not move, by name.
    lines : tuple of tuple of str
        Names of points that are joined.
    trace : str
        The moving point whose path is worth drawing.
    """

    points: Callable[[np.ndarray, Mapping[str, float]], dict[str, np.ndarray]]
    fixed: Callable[[Mapping[str, float]], dict[str, np.ndarray]]
    lines: tuple[tuple[str, ...], ...]
    trace: str
    unit: str = "m"


def _no_relations(values: Mapping[str, float]) -> list[str]:
    return []


@dataclass(frozen=True, eq=False)
class Model:
    """A forced system with its states, parameters, presets and equations, as the code above the engine uses it.

    Attributes
    ----------
    name : str
        By which specifications and cubes know it.
    title : str
        What it is, in a line.
    parameters : tuple of Parameter
        In the order in which they are packed.
    presets : tuple of Preset
        The first is the default.
    system_path : str
        ``module:attribute`` of the engine's `System`; imported when it is first needed.
    sources : tuple of Path
        Files of a user's own model that decide what is integrated; `digest` covers them.
    version : int
        Number of the results of a model of magpend, see `magpend_core.versions`.
    section : str
        The instant of the drive's period at which sections are taken.
    quantities : tuple of Quantity
        In the order of ``system.quantities``.
    classifier, mirror, drawing
        What the model brings besides.
    angle_dim : str
        Dim of what there is one of per angle, such as full turns.
    relations : callable
        Sentences on values that are in bounds each, but not together.
    clock : Clock
        How it counts time: by periods of a drive, at even times, by returns, or by iterations.
    text : mapping, optional
        The table that the model was read from, if it was text; plain data, see `reference`.
    method : str
        By which its system is integrated, see `System.method`.
    """

    name: str
    title: str
    states: tuple[State, ...]
    parameters: tuple[Parameter, ...]
    presets: tuple[Preset, ...]
    system_path: str
    sources: tuple[Path, ...] = ()
    version: int = 1
    section: str = "the start of the drive's period"
    quantities: tuple[Quantity, ...] = ()
    classifier: Classifier | None = None
    mirror: Mirror | None = None
    drawing: Drawing | None = None
    angle_dim: str = "angle"
    relations: Callable[[Mapping[str, float]], list[str]] = field(default=_no_relations)
    clock: Clock = DRIVEN
    text: Mapping[str, Any] | None = None
    method: str = "dopri5"

    def __repr__(self) -> str:
        states = ", ".join(f"{s.name} [{s.unit}]" for s in self.states)
        values = ", ".join(f"{name} = {value:g}" for name, value in self.presets[0].values.items())
        about = "" if self.title == self.name else f": {self.title}"
        return f"model {self.name}{about}\n  states {states}\n  parameters {values or 'none'}"

    @property
    def reference(self) -> str | Mapping[str, Any]:
        """Return the reference that a run stores and `load_model` reads: the model's name, or its text as a table."""
        return self.name if self.text is None else self.text

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return warnings on likely oversights in the model's text, for example an unused parameter."""
        return ()

    @property
    def angle_remarks(self) -> tuple[str, ...]:
        """Return those of the remarks that name states that are angles but not declared as such."""
        return ()

    @property
    def crossing(self) -> Crossing | None:
        """Return the model's Poincare section by crossing; None if the section is stroboscopic."""
        return self.clock.crossing

    @property
    def disturbance(self) -> Disturbance | None:
        """Return the white noise on the model's equations; None without noise."""
        return None

    @property
    def flow(self) -> Model:
        """Return the model without its Poincare section (if it has one); its trajectories are the same."""
        return self

    @property
    def section_states(self) -> tuple[str, ...]:
        """Return the names of the states that vary on the Poincare section, in order."""
        return self.state_names

    @property
    def state_names(self) -> tuple[str, ...]:
        """Return the names of the states in order."""
        return tuple(s.name for s in self.states)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Return the units of the states in order."""
        return tuple(s.unit for s in self.states)

    @property
    def is_angle(self) -> tuple[bool, ...]:
        """Return for each state whether it is an angle."""
        return tuple(s.on_circle for s in self.states)

    @property
    def angles(self) -> tuple[str, ...]:
        """Return the names of the states that are angles."""
        return tuple(s.name for s in self.states if s.on_circle)

    @property
    def units(self) -> tuple[float, ...]:
        """Return the unit in which sizes of disturbances and coefficients are told, for each state."""
        return tuple(s.scale for s in self.states)

    @property
    def scales(self) -> tuple[float, ...]:
        """Return the measure of each state, by which differences between states are divided."""
        return tuple(s.measure for s in self.states)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of the parameters in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def portraits(self) -> tuple[tuple[str, str], ...]:
        """Return the pairs of states for phase portraits: each state with its time derivative, or else each state with
        the next.
        """
        pairs = tuple((s.name, s.rate) for s in self.states if s.rate)
        names = self.state_names
        return pairs or tuple(itertools.pairwise(names)) or ((names[0], names[0]),)

    @property
    def preset_names(self) -> tuple[str, ...]:
        """Return the names of the presets; the first is the default."""
        return tuple(p.name for p in self.presets)

    @cached_property
    def system(self) -> System:
        """Return the system that the engine integrates; imports the compiler."""
        module, _, attribute = self.system_path.partition(":")
        found: System = getattr(importlib.import_module(module), attribute)
        return found if found.method == self.method else replace(found, method=self.method)

    @cached_property
    def digest(self) -> str:
        """Return the digest of the model: its version, and the source files of a user's own Python model, comments
        and docstrings left out.
        """
        from magpend_core.source_digests import meaning_digest

        return meaning_digest(self.sources) if self.sources else written(self.name, self.version)

    def state(self, name: str) -> State:
        """Return a state by name; raises `ParameterError` with the nearest names if there is none."""
        for s in self.states:
            if s.name == name:
                return s
        hint = near_names(name, self.state_names, "states")
        raise ParameterError([f"{name!r} is not a state of {self.name}; {hint}"])

    def quantity(self, name: str) -> Quantity:
        """Return a quantity by name; raises `ParameterError` with the nearest names if there is none."""
        for q in self.quantities:
            if q.name == name:
                return q
        hint = near_names(name, (q.name for q in self.quantities), "quantities")
        raise ParameterError([f"{name!r} is not a quantity of {self.name}; {hint}"])

    def parameter(self, name: str) -> Parameter:
        """Return a parameter by name; raises `ParameterError` with the nearest names if there is none."""
        for p in self.parameters:
            if p.name == name:
                return p
        hint = near_names(name, self.parameter_names, "parameters")
        raise ParameterError([f"{name!r} is not a parameter of {self.name}; {hint}"])

    def preset(self, name: str | Path | Preset | None = None) -> Preset:
        """Return a preset by name or file, with all its values and those of the preset it is based on.

        Parameters
        ----------
        name
            Of one that ships (by default the first); a file, by a path or a name that ends in ``.toml``; or
            what was read of one.

        Raises
        ------
        ParameterError
            If there is none, or what the file holds is no preset of this model.
        """
        if name is None:
            return self.presets[0]
        found = name if isinstance(name, Preset) else find_preset(name)
        if isinstance(found, Preset):
            return found if found in self.presets else completed(found, self, model_named)
        for p in self.presets:
            if p.name == found:
                return p
        hint = near_names(str(found), self.preset_names, "presets")
        raise ParameterError([f"preset {found!r} does not exist for {self.name}; {hint}"])

    def load(self, preset: str | Path | Preset | None = None, **overrides: float) -> Parameters:
        """Return the parameters of a preset, with the given values replaced.

        Parameters
        ----------
        preset
            One of `preset_names` (by default the first), or a file, see `preset`.
        overrides
            Values by parameter name.

        Raises
        ------
        ParameterError
            If the preset or a name is unknown or a value is out of bounds; all problems at once.
        """
        values = self.preset(preset).values
        own = {name: values[name] for name in self.parameter_names if name in values}
        return Parameters(self, {**own, **overrides})


class Parameters(Mapping[str, float]):
    """The values of all parameters of a model; the drive's frequency is not one of them.

    A mapping from names to values, in the order of `pack`; it cannot be changed. Make one with
    `Model.load`.

    Parameters
    ----------
    model
        Whose parameters they are.
    values
        A value for every parameter.

    Raises
    ------
    ParameterError
        With all problems at once: missing and unknown names, values that are not numbers, NaN or infinite
        values, values out of bounds, and what the model forbids between values.
    """

    __slots__ = ("_values", "model")

    def __init__(self, model: Model, values: Mapping[str, Any]) -> None:
        self.model = model
        known = model.parameter_names
        problems = [unknown_name_problem(n, known) for n in values if n not in known]
        problems += [f"{n} has no value; give one." for n in known if n not in values]
        problems += [
            problem for p in model.parameters if p.name in values and (problem := p.problem(values[p.name])) is not None
        ]
        if not problems:
            self._values = {name: float(values[name]) for name in known}
            problems = list(model.relations(self._values))
        if problems:
            raise ParameterError(problems)

    def __getitem__(self, name: str) -> float:
        if name not in self._values:
            raise KeyError(unknown_name_problem(name, self.names))
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __hash__(self) -> int:
        return hash((self.model.name, *self._values.values()))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Parameters):
            return NotImplemented
        return self.model is other.model and self._values == other._values

    def __repr__(self) -> str:
        return f"Parameters({self.model.name}: {', '.join(f'{n}={v:g}' for n, v in self.items())})"

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all parameters in the order of `pack`."""
        return self.model.parameter_names

    def as_dict(self) -> dict[str, float]:
        """Return all values as a dict by parameter name, in the order of `pack`."""
        return dict(self._values)

    def pack(self) -> np.ndarray:
        """Return all values as a float64 vector of shape ``(len(names),)``, in the model's units."""
        return np.array(list(self._values.values()), dtype=np.float64)

    def replace(self, **overrides: float) -> Self:
        """Return a copy with the given values replaced.

        Parameters
        ----------
        overrides
            New values by parameter name.

        Raises
        ------
        ParameterError
            See the class.
        """
        return type(self)(self.model, {**self._values, **overrides})


@cache
def by_method(model: Model, method: str) -> Model:
    """Return a model whose system is integrated by a method; equal arguments give the same object."""
    if method == model.method:
        return model
    made = replace(model, method=method)
    # what was derived from a text does not depend on it
    made.__dict__.update({key: value for key, value in vars(model).items() if key not in (*vars(made), "system")})
    return made
