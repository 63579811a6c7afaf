"""Enlarge the specification of a run: longer axes, more initial conditions, section points or products."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.runs.zoom import put_value
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.spec import Spec
from pipeline.specification.starts import GridStarts, RandomStarts, state_keys, state_of_key
from pipeline.specification.tables import FREQUENCY


@dataclass(frozen=True)
class Widening:
    """Changes that enlarge a specification: longer axes, more initial conditions, section points or products.

    Attributes
    ----------
    axes : dict
        New ranges, as the tables of ``[axes]``, by ``frequency_hz``, parameter, or state of a grid.
    starts : int or None
        Number of random initial states.
    keep : int or None
        Kept sections.
    products : dict
        Options of additional products by name, as in the tables of ``[products]``.
    """

    axes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    starts: int | None = None
    keep: int | None = None
    products: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.axes or self.products) or self.starts is not None or self.keep is not None


def widened(spec: Spec, widening: Widening) -> Spec:
    """Return a specification enlarged by longer axes, more initial conditions, section points or products.

    Raises
    ------
    SpecError
        If a change does not fit, or the result is not a valid specification.
    """
    problems = _problems(spec, widening)
    if problems:
        raise SpecError(problems)
    data = spec.as_dict()
    for name, table in widening.axes.items():
        put_value(spec, data, name, dict(table))
    if widening.starts is not None:
        data["initial_conditions"]["n"] = widening.starts
    if widening.keep is not None:
        data["integration"]["n_keep"] = widening.keep
    data["products"] |= {name: dict(options) for name, options in widening.products.items()}
    return Spec.parse(data, KEPT)


def _problems(spec: Spec, widening: Widening) -> list[str]:
    known = (FREQUENCY, *spec.model.parameter_names, *state_keys(spec.model))
    problems = [f"extend: {unknown_name('axis', name, known)}" for name in widening.axes if name not in known]
    states = [name for name in widening.axes if state_of_key(name, spec.model)]
    kind = spec.initial_conditions.kind
    if states and not isinstance(spec.initial_conditions, GridStarts):
        problems.append(
            f"axis {states[0]}: the initial conditions are a {kind}, and a range widens only a grid; "
            "give a SPEC with the new starts."
        )
    if widening.starts is not None and not isinstance(spec.initial_conditions, RandomStarts):
        problems.append(
            f"starts = {widening.starts}: the initial conditions are a {kind}, not random samples; "
            + ("widen a state's range instead." if kind == "grid" else "give a SPEC with more rows.")
        )
    return problems
