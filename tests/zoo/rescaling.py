"""Write a system in other units of length and time, and take numbers back to its own units."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

UNITS = {"small and slow": (1e-9, 1e6), "large and fast": (1e9, 1e-6)}
"""A unit of each state, and of time, by the name of the setting."""

RATES = ("eigenvalue_real", "eigenvalue_imag", "lyapunov_max", "lyapunov_low", "lyapunov_high")


@dataclass(frozen=True)
class Units:
    """Factors of the states and of time [s]."""

    states: Mapping[str, float]
    time: float = 1.0

    def row(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return a row of the table of attractors in the system's own units."""
        rates = {key: row[key] * self.time for key in RATES if row.get(key) is not None}
        seconds = {"period_s": row["period_s"] / self.time} if row.get("period_s") is not None else {}
        return {**row, **rates, **seconds}


def rescaled(data: Mapping[str, Any], length: float, time: float) -> tuple[dict[str, Any], Units]:
    """Return the specification of the same motion in other units, which says nothing of scales; angles stay."""
    from magpend_core.models import load_model

    model = load_model(data["model"])
    table = dict(model.definition.table)
    units = Units({s.name: 1.0 if s.on_circle else length for s in model.states}, time)

    def text(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {**value, "value": text(value["value"])}
        for name, factor in units.states.items():
            value = re.sub(rf"\b{name}\b(?!\s*\()", f"({name}/{factor!r})", str(value))
        return re.sub(r"\bf\b", f"(f*{time!r})", re.sub(r"\bt\b", f"(t/{time!r})", value))

    def all_of(key: str) -> dict[str, Any]:
        return {name: text(value) for name, value in table.get(key, {}).items()}

    plain = {k: v for k, v in table.items() if k not in ("drawing", "classifier", "mirror")}
    plain |= {"name": f"{model.name}-rescaled", "define": all_of("define"), "quantities": all_of("quantities")}
    plain["states"] = {s.name: {"unit": s.unit, "on_circle": s.on_circle} for s in model.states}
    plain["equations"] = {
        name: f"{units.states[name] / time!r}*({text(value)})" for name, value in table["equations"].items()
    }
    plain["impacts"] = [
        {**one, "of": text(one["of"]), "set": {n: f"{units.states[n]!r}*({text(v)})" for n, v in one["set"].items()}}
        for one in table.get("impacts", [])
    ]
    return {**data, "model": plain, **_tables(data, units)}, units


def _tables(data: Mapping[str, Any], units: Units) -> dict[str, Any]:
    """Return the tables that have states, times or frequencies in them."""
    found: dict[str, Any] = {"initial_conditions": _starts(data["initial_conditions"], units)}
    if "section" in data:
        one = data["section"]
        value = one.get("value", 0.0) * units.states[one["of"]]
        found["section"] = {**one, "value": value, "longest": one.get("longest", 100.0) * units.time}
    for name, key in (("parameters", "frequency_hz"), ("axes", "frequency_hz")):
        if key in data.get(name, {}):
            found[name] = {**data[name], key: _times(data[name][key], 1.0 / units.time)}
    return found


def _starts(given: Mapping[str, Any], units: Units) -> dict[str, Any]:
    if "points" in given:
        factors = list(units.states.values())
        return {**given, "points": [[x * c for x, c in zip(row, factors, strict=False)] for row in given["points"]]}
    return {key: _times(value, units.states[key]) if key in units.states else value for key, value in given.items()}


def _times(value: Any, factor: float) -> Any:
    if factor == 1.0:
        return value
    if isinstance(value, Mapping):
        return {key: inner if key == "num" else _times(inner, factor) for key, inner in value.items()}
    return [_times(x, factor) for x in value] if isinstance(value, list) else value * factor
