"""Parameters of a model: named, bounded, validated, packed into one flat vector for the kernels.

All quantities are in the model's own units (SI for those that ship). Names are unique within a model, so
that an override or a sweep axis needs the bare name only.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

if TYPE_CHECKING:
    from magpend_core.crossing import Crossing
    from magpend_core.models.model import Model

POSITIVE = "greater than 0"
NON_NEGATIVE = "0 or greater"
FRACTION = "between 0 and 1, both excluded"
FINITE = "a finite number"

BOUNDS: dict[str, Callable[[float], bool]] = {
    POSITIVE: lambda x: x > 0.0,
    NON_NEGATIVE: lambda x: x >= 0.0,
    FRACTION: lambda x: 0.0 < x < 1.0,
    FINITE: lambda x: True,
}


class ParameterError(ValueError):
    """One or more parameters are unknown, missing or out of bounds.

    Attributes
    ----------
    problems : list of str
        A sentence for each problem: the name, the value, the bound and what to do.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = list(problems)
        super().__init__("\n".join(self.problems))


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model.

    Attributes
    ----------
    name : str
    unit : str
    meaning : str
        A short phrase for tables and axes.
    bound : str
        One of `BOUNDS`.
    symbol : str
        LaTeX without dollar signs; empty for the name.
    """

    name: str
    unit: str
    meaning: str
    bound: str = FINITE
    symbol: str = ""

    def problem(self, value: Any) -> str | None:
        """Return the sentence for a bad value, or None."""
        wanted = self.bound if self.bound == FINITE else f"a number {self.bound}"
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            return f"{self.name} = {value!r} is not a number; give {wanted}."
        if not math.isfinite(value):
            return f"{self.name} = {value!r} is not finite; give {wanted}."
        if not BOUNDS[self.bound](float(value)):
            return f"{self.name} = {value!r} is out of bounds: it must be {self.bound}."
        return None


def near_names(name: str, known: Iterable[str], what: str) -> str:
    """Return the hint of a sentence on an unknown name: the nearest known ones, or all."""
    names = list(known)
    near = difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
    return f"did you mean {' or '.join(near)}?" if near else f"known {what}: {', '.join(names)}."


def unknown_name_problem(name: str, known: Iterable[str]) -> str:
    """Return the sentence for an unknown parameter name, with the nearest known names."""
    return f"{name!r} is not a parameter; {near_names(name, known, 'names')}"


class Parameters(Mapping[str, float]):
    """Everything that a model needs besides the drive's frequency: a value for each of its parameters.

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

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self.model.reference, self._values, self.model.crossing)

    def __repr__(self) -> str:
        return f"Parameters({self.model.name}: {', '.join(f'{n}={v:g}' for n, v in self.items())})"

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all parameters in the order of `pack`."""
        return self.model.parameter_names

    def as_dict(self) -> dict[str, float]:
        """Return all values by name, in the order of `pack`."""
        return dict(self._values)

    def pack(self) -> np.ndarray:
        """Return all values as a float64 vector of shape ``(len(names),)``, in the model's units."""
        return np.array(list(self._values.values()), dtype=np.float64)

    def replace(self, **overrides: float) -> Self:
        """Return a copy with some values replaced.

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


def _again(model: str | Mapping[str, Any], values: dict[str, float], crossing: Crossing | None = None) -> Parameters:
    """Unpickle: models are known by name, or by their text, and by the section that they are seen through."""
    from magpend_core.models import load_model
    from magpend_core.models.sectioned import sectioned

    found = load_model(model)
    return Parameters(found if crossing is None else sectioned(found, crossing), values)
