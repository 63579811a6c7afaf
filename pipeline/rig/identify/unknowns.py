"""Read and check the identified, tied and fixed parameters of an identification's specification."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import FRACTION, NON_NEGATIVE, POSITIVE, ParameterError, unknown_name_problem
from pipeline.specification.problems import checked, table_at
from pipeline.specification.tables import Table

_LEAST = 1e-9
"""Smallest value of a positive parameter, relative to its start."""

_FRACTION_MARGIN = 1e-6
"""Distance that a fraction keeps from 0 and 1."""

Pair = Annotated[tuple[float, float], Field(strict=False)]


class Prior(Table):
    """Prior of a parameter from an independent measurement: mean and standard deviation."""

    mean: float
    sd: Annotated[float, Field(gt=0)]


class Identified(Table):
    """Table ``[identify.NAME]``: first guess, bounds and prior of a parameter to be identified."""

    start: float | None = Field(None, description="First guess; by default the preset's value")
    bounds: Pair | None = Field(None, description="[low, high]; by default those of the model")
    prior: Prior | None = Field(
        None, description="An independent measurement, { mean = ..., sd = ... }: a weight, a length"
    )


@dataclass(frozen=True)
class Unknown:
    """Parameter to be identified, with first guess, bounds and prior filled in."""

    name: str
    # in the parameter's unit
    start: float
    lower: float
    upper: float
    prior: Prior | None


_TIE = re.compile(r"\s*(?:([+-]?\s*[0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*|(-)\s*)?([A-Za-z_]\w*)\s*")


class ParameterTables:
    """Fixed values, unknowns and ties (parameters proportional to others) of a specification, checked together."""

    def __init__(self, data: Mapping[str, Any], model: Model, preset: str | Path | None, problems: list[str]) -> None:
        self._model, self._problems = model, problems
        identified = table_at(data, "identify", problems)
        tied = table_at(data, "tied", problems)
        self.fixed = dict(table_at(data, "parameters", problems))
        self.values = self._values(preset)
        if not identified:
            problems.append("identify: missing; add a table [identify.NAME] for each parameter to identify.")
        self.unknowns = tuple(
            one for name, table in identified.items() if (one := self._unknown(name, table)) is not None
        )
        self.tied = self._ties(tied, identified)
        for name in self.fixed:
            if name in identified or name in tied:
                where = "identify" if name in identified else "tied"
                problems.append(f"parameters.{name}: is also in {where}; keep one of the two.")
        if self.values is not None and not problems:
            self._check_together()

    def _values(self, preset: str | Path | None) -> Parameters | None:
        try:
            self._model.load(preset)
        except ParameterError as error:
            self._problems += [f"preset: {p}" for p in error.problems]
            return None
        try:
            return self._model.load(preset, **self.fixed)
        except ParameterError as error:
            self._problems += [f"parameters: {p}" for p in error.problems]
            return None

    def _unknown(self, name: str, table: Any) -> Unknown | None:
        if name not in self._model.parameter_names:
            self._problems.append(f"identify.{name}: {unknown_name_problem(name, self._model.parameter_names)}")
            return None
        one = checked(Identified, table, f"identify.{name}", self._problems)
        if one is None or (self.values is None and one.start is None):
            return None
        start = one.start if one.start is not None else self.values[name]  # type: ignore[index]
        wrong = self._model.parameter(name).problem(start)
        if wrong is not None:
            self._problems.append(f"identify.{name}.start: {wrong}")
            return None
        low, high = one.bounds or self._bounds(name, start)
        for bound in one.bounds or ():
            wrong = self._model.parameter(name).problem(bound)
            # an open bound of the model may be named as the end of a range
            if wrong is not None and bound not in (0.0, 1.0):
                self._problems.append(f"identify.{name}.bounds: {wrong}")
        if not low < high:
            self._problems.append(f"identify.{name}.bounds = [{low:g}, {high:g}]: must rise.")
        elif not low <= start <= high:
            self._problems.append(
                f"identify.{name}.bounds = [{low:g}, {high:g}]: exclude the start {start:g}; widen them, or "
                f"give another start."
            )
        least, most = self._bounds(name, start)
        return Unknown(name, start, max(low, least), min(high, most), one.prior)

    def _bounds(self, name: str, start: float) -> tuple[float, float]:
        """Return the model's bounds on a parameter. A bound that is not itself an allowed value is replaced by an
        allowed value close to it.
        """
        return {
            POSITIVE: (_LEAST * start, math.inf),
            NON_NEGATIVE: (0.0, math.inf),
            FRACTION: (_FRACTION_MARGIN, 1.0 - _FRACTION_MARGIN),
        }.get(self._model.parameter(name).bound, (-math.inf, math.inf))

    def _ties(self, table: Mapping[str, Any], identified: Mapping[str, Any]) -> dict[str, tuple[float, str]]:
        found = {}
        for name, text in table.items():
            one = self._tie(name, text, table, identified)
            if one is not None:
                found[name] = one
        return found

    def _tie(
        self, name: str, text: Any, table: Mapping[str, Any], identified: Mapping[str, Any]
    ) -> tuple[float, str] | None:
        known, path = self._model.parameter_names, f"tied.{name}"
        match = _TIE.fullmatch(text) if isinstance(text, str) else None
        factor, other = math.nan, ""
        if match is not None:
            number, minus, other = match.groups()
            factor = -1.0 if minus else _number(number)
        if name not in known:
            problem = unknown_name_problem(name, known)
        elif not math.isfinite(factor):
            problem = 'must be a name, or a number times one, such as "NAME" or "-1.0*NAME".'
        elif name in identified:
            problem = "is also in identify; keep one of the two."
        elif other == name:
            problem = "is tied to itself; name the identified parameter that it follows."
        elif other not in known:
            problem = unknown_name_problem(other, known)
        elif other in table:
            problem = f"follows {other}, which is tied itself; tie both to one identified parameter."
        elif other not in identified:
            problem = f"follows {other}, which is not identified; give its value under [parameters]."
        else:
            return factor, other
        self._problems.append(f"{path} = {text!r}: {problem}")
        return None

    def _check_together(self) -> None:
        assert self.values is not None
        starts = {u.name: u.start for u in self.unknowns}
        tied = {name: factor * starts[other] for name, (factor, other) in self.tied.items()}
        try:
            Parameters(self._model, {**self.values.as_dict(), **starts, **tied})
        except ParameterError as error:
            self._problems += [f"identify: at the start, {p}" for p in error.problems]


def _number(text: str | None) -> float:
    try:
        return 1.0 if text is None else float(text.replace(" ", ""))
    except ValueError:
        return math.nan
