"""Write the affine twin of a system, in other units and from another zero, and take numbers back to its own units."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Change:
    """A change of units: a state becomes ``factor * x + zero``, and its zero lies `far` extents of its motion away."""

    factors: tuple[float, ...] = (1.0,)  # of the states in turn, those on circles left out
    time: float = 1.0
    far: tuple[float, ...] = (0.0,)
    turn: float = 0.0  # angle [rad] by which the plane of two states that no section is by is turned


UNITS = {
    "small and slow": Change((1e-9,), 1e6),
    "large and fast": Change((1e6,), 1e-6),
    "of two sizes": Change((0.03, 3e-4)),
    "far from zero": Change(far=(1000.0, -10.0)),
    "hundreds, far from zero": Change((300.0, 0.02), 7.0, (-100.0, 1000.0)),
    "degrees": Change((180.0 / math.pi,)),
    "turned": Change(turn=0.7),
}
"""Changes of units by name."""

RATES = ("eigenvalue_real", "eigenvalue_imag", "lyapunov_max", "lyapunov_low", "lyapunov_high")


@dataclass(frozen=True)
class Units:
    """Factors of the states and of time [s], the zeros of the states, and the rotation between them.

    A state in its own units is ``rotation @ ((twin - zeros) / factors)``.
    """

    states: tuple[str, ...]
    factors: np.ndarray
    zeros: np.ndarray
    rotation: np.ndarray
    time: float = 1.0

    def own(self, points: np.ndarray) -> np.ndarray:
        """Return states (..., state) in the system's own units."""
        return np.asarray(((points - self.zeros) / self.factors) @ self.rotation.T)

    def twin(self, points: np.ndarray) -> np.ndarray:
        """Return states (..., state) in the units of the twin."""
        return np.asarray(points @ self.rotation * self.factors + self.zeros)

    def in_twin(self, name: str) -> str:
        """Write a state of the system in the states of the twin."""
        parts = zip(self.states, self.factors, self.zeros, self.rotation[self.states.index(name)], strict=True)
        terms = [f"({float(r / c)!r})*({x} - ({float(zero)!r}))" for x, c, zero, r in parts if r]
        return f"({' + '.join(terms)})"

    def of_twin(self, name: str, values: Mapping[str, str], time: float = 1.0, zero: float = 0.0) -> str:
        """Write a state of the twin, or its rate, as the sum of values of the system's states."""
        i = self.states.index(name)
        parts = zip(self.states, self.rotation[:, i] * self.factors[i] / time, strict=True)
        return " + ".join([*(f"({float(c)!r})*({values[x]})" for x, c in parts if c), f"({float(zero)!r})"])

    def row(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return a row of the table of attractors in the system's own units."""
        rates = {key: row[key] * self.time for key in RATES if row.get(key) is not None}
        seconds = {"period_s": row["period_s"] / self.time} if row.get("period_s") is not None else {}
        return {**row, **rates, **seconds}


def plain_units(names: Iterable[str]) -> Units:
    """Return the units of a system itself."""
    states = tuple(names)
    return Units(states, np.ones(len(states)), np.zeros(len(states)), np.eye(len(states)))


def rescaled(data: Mapping[str, Any], change: Change) -> tuple[dict[str, Any], Units]:
    """Return the specification of the same motion in other units, which says nothing of scales; angles stay."""
    from pipeline.layout.cells import initial_states
    from pipeline.layout.extents import with_sizes
    from pipeline.specification.spec import Spec

    spec = with_sizes(Spec.parse(data))
    model, units = spec.model.flow, units_of(spec, data, change)
    table = dict(model.definition.table)

    def text(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {**value, "value": text(value["value"])}
        names = "|".join(units.states)
        value = re.sub(rf"\b({names})\b(?!\s*\()", lambda found: units.in_twin(found[1]), str(value))
        return re.sub(r"\bf\b", f"(f*{units.time!r})", re.sub(r"\bt\b", f"(t/{units.time!r})", value))

    def states_of(values: Mapping[str, Any], time: float = 1.0, zeros: np.ndarray = units.zeros) -> dict[str, str]:
        own = {name: text(value) for name, value in values.items()}
        return {x: units.of_twin(x, own, time, zero) for x, zero in zip(units.states, zeros, strict=True)}

    def reset(given: Mapping[str, Any]) -> dict[str, str]:
        """Return the states that an impact sets: also those that are turned with one of them."""
        set_ = states_of({name: given.get(name, name) for name in units.states})
        changed = units.rotation[[units.states.index(name) for name in given]].any(axis=0)
        return {name: set_[name] for name, is_set in zip(units.states, changed, strict=True) if is_set}

    def all_of(key: str) -> dict[str, Any]:
        return {name: text(value) for name, value in table.get(key, {}).items()}

    plain = {k: v for k, v in table.items() if k not in ("drawing", "classifier", "mirror")}
    plain |= {"name": f"{model.name}-rescaled", "define": all_of("define"), "quantities": all_of("quantities")}
    plain["states"] = {s.name: {"unit": s.unit, "on_circle": s.on_circle} for s in model.states}
    equations = table["equations"]
    is_map = not model.clock.is_continuous
    plain["equations"] = states_of(equations) if is_map else states_of(equations, units.time, 0.0 * units.zeros)
    plain["impacts"] = [{**one, "of": text(one["of"]), "set": reset(one["set"])} for one in table.get("impacts", [])]
    starts = initial_states(spec.initial_conditions)
    points = units.twin(starts.at(np.arange(len(starts)))).tolist()
    found = {**data, "model": plain, "initial_conditions": {"kind": "list", "points": points}, **_tables(data, units)}
    return found, units


def units_of(spec: Any, data: Mapping[str, Any], change: Change) -> Units:
    """Return the units of a system's twin; states on circles stay as they are."""
    states = spec.model.states
    free = [i for i, s in enumerate(states) if not s.on_circle]
    factors, zeros, rotation = np.ones(len(states)), np.zeros(len(states)), np.eye(len(states))
    factors[free] = np.resize(change.factors, len(free))
    far = np.resize(change.far, len(free)) * [2.0 * states[i].measure for i in free]
    zeros[free] = far * factors[free]
    plane = [i for i in free if states[i].name != data.get("section", {}).get("of")][:2]
    if len(plane) == 2:
        c, s = math.cos(change.turn), math.sin(change.turn)
        rotation[np.ix_(plane, plane)] = [[c, -s], [s, c]]
    return Units(spec.model.state_names, factors, zeros, rotation, change.time)


def _tables(data: Mapping[str, Any], units: Units) -> dict[str, Any]:
    """Return the tables that have states, times or frequencies in them."""
    found: dict[str, Any] = {}
    if "section" in data:
        one, value = data["section"], data["section"].get("value", 0.0)
        if one["of"] in units.states:
            i = units.states.index(one["of"])
            value = float(value * units.factors[i] + units.zeros[i])
        found["section"] = {**one, "value": value, "longest": one.get("longest", 100.0) * units.time}
    for name in ("parameters", "axes"):
        if "frequency_hz" in data.get(name, {}):
            found[name] = {**data[name], "frequency_hz": _times(data[name]["frequency_hz"], 1.0 / units.time)}
    return found


def _times(value: Any, factor: float) -> Any:
    if factor == 1.0:
        return value
    if isinstance(value, Mapping):
        return {key: inner if key == "num" else _times(inner, factor) for key, inner in value.items()}
    return [_times(x, factor) for x in value] if isinstance(value, list) else value * factor
