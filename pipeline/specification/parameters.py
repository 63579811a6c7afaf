"""Check parameters, axes and initial conditions together: names, bounds, relations, and the number of cells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np

from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError, unknown_name_problem
from pipeline.specification.starts import GridStarts, Starts
from pipeline.specification.tables import FREQUENCY, RATES, ParametersTable, Range, word_of

MAX_CELLS = 10**15
MOST_RELATED = 12
"""Most swept parameters that a model may relate to each other: all corners of their box are checked."""


def parameter_problems(
    table: ParametersTable, model: Model, declared: tuple[str, ...], axes: dict[str, Range], complete: bool
) -> list[str]:
    """Return the problems of the parameters: unknown names, values out of bounds, a missing or repeated frequency."""
    problems = _frequency_problems(table, declared, axes, complete)
    swept = {name: axis.array() for name, axis in axes.items() if name != FREQUENCY}
    try:
        base = model.load(table.chosen)
    except ParameterError as error:
        return problems + [f"parameters.preset: {p}" for p in error.problems]
    try:
        base = model.load(table.chosen, **table.overrides)
    except ParameterError as error:
        problems += [f"parameters.overrides: {p}" for p in error.problems]
    known = (*base.names, FREQUENCY)
    problems += [f"axes.{n}: {unknown_name_problem(n, known)}" for n in declared if n not in known]
    for name in table.overrides:
        if name in declared:
            problems.append(f"axes.{name}: is also in parameters.overrides; keep one of the two.")
    for name, values in swept.items():
        problems += [f"axes.{name}: {p}" for p in _axis_problems(base, name, values)]
    return problems or [f"axes: {p}" for p in corner_problems(base, swept)]


def _frequency_problems(
    table: ParametersTable, declared: tuple[str, ...], axes: dict[str, Range], complete: bool
) -> list[str]:
    if FREQUENCY in axes:
        axis = axes[FREQUENCY]
        least = float(axis.given()[0])
        if least <= 0:
            unit = RATES[word_of(axis)].unit
            return [f"axes.frequency_hz: its least value {least!r} must be greater than 0 {unit}."]
    if FREQUENCY not in declared and table.hertz is None and complete:
        return [
            "parameters.frequency_hz: missing; set it there (or omega, or period), or sweep it as axes.frequency_hz."
        ]
    return []


def _axis_problems(base: Parameters, name: str, values: np.ndarray) -> list[str]:
    if name not in base.names:
        return []
    problems: list[str] = []
    for value in dict.fromkeys((float(values.min()), float(values.max()))):
        try:
            base.replace(**{name: value})
        except ParameterError as error:
            problems += [p for p in error.problems if p not in problems]
    return problems


def size_problems(axes: dict[str, Range], starts: Starts | None) -> list[str]:
    """Return a problem if swept values and initial conditions make more than `MAX_CELLS` cells."""
    sizes = {f"axes.{name}": axis.n for name, axis in axes.items()}
    if isinstance(starts, GridStarts):
        sizes |= {f"initial_conditions.{name}": axis.n for name, axis in starts.ranges.items()}
    if math.prod(sizes.values()) <= MAX_CELLS:
        return []
    return [
        f"{' x '.join(sizes)}: {math.prod(sizes.values()):.3g} cells; the limit is {MAX_CELLS:.0e}: use fewer values."
    ]


def corner_problems(base: Parameters, swept: dict[str, np.ndarray]) -> list[str]:
    """Check the model's relations between parameters at all corners of the swept ranges; return the problems.

    Bounds are intervals, so the corners decide. Only the axes of parameters that the model's relations read
    are varied. They are found by asking the model, again whenever its answer has read further parameters.
    """
    ends = {name: (float(v.min()), float(v.max())) for name, v in swept.items()}
    asked = _Asked(base)
    problems, looked_at = base.model.relations(asked), set[str]()
    while not problems and looked_at != asked.names & set(ends):
        looked_at = asked.names & set(ends)
        if len(looked_at) > MOST_RELATED:
            return [f"{base.model.name} relates more than {MOST_RELATED} of the swept parameters; fix some of them."]
        for corner in itertools.product(*(dict.fromkeys(ends[name]) for name in sorted(looked_at))):
            asked.values_now = {**base, **dict(zip(sorted(looked_at), corner, strict=True))}
            problems = base.model.relations(asked)
            if problems:
                return list(problems)
    return list(problems)


class _Asked(Mapping[str, float]):
    """Mapping of parameter values that records which of them were read."""

    def __init__(self, values: Mapping[str, float]) -> None:
        self.values_now, self.names = dict(values), set[str]()

    def __getitem__(self, name: str) -> float:
        self.names.add(name)
        return self.values_now[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_now)

    def __len__(self) -> int:
        return len(self.values_now)
