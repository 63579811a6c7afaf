"""Check the table ``[parameters]`` and the axes against the parameters of a model."""

from __future__ import annotations

import numpy as np

from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError, unknown_name_problem
from pipeline.specification.ranges import corner_problems
from pipeline.specification.tables import FREQUENCY, ParametersTable, Range


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
    problems = []
    if FREQUENCY in declared and table.frequency_hz is not None:
        problems.append("axes.frequency_hz: is also in parameters; keep one of the two.")
    if FREQUENCY in axes:
        least = float(axes[FREQUENCY].array()[0])
        if least <= 0:
            problems.append(f"axes.frequency_hz: its least value {least!r} must be greater than 0 Hz.")
    if FREQUENCY not in declared and table.frequency_hz is None and complete:
        return ["parameters.frequency_hz: missing; set it there, or sweep it as axes.frequency_hz."]
    return problems


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
