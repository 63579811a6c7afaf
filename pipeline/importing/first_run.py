"""Choose a first specification for an imported model: sections, a parameter with a range, and starts.

A short trial integration tells where the motion goes, so that a section lies across it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import LSODA

from magpend_core.models.text.definition import Definition, Impact
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import rates_of, value_of
from magpend_core.models.text.reading import read_definition
from pipeline.importing.assembly import Assembled
from pipeline.importing.drive import constant_setting
from pipeline.importing.expressions import size

TOTAL = 100.0
"""Time of the trial if the file gives none."""
TRIALS = 6
"""Values of the swept parameter at which the motion is tried, besides the own one of the file."""
MOST_EVALUATIONS = 1200
MOST_NODES = 150_000
"""Most evaluations of the equations, and of nodes of their expressions, in a trial."""
VALUES = 51
"""Values of the swept parameter."""
SEVERAL = 5.0
"""Length of a trial in units of the file's time of integration."""
STEPS = 500
"""Least steps of a trial."""
LEAST_SWING = 0.02
"""Least range of a state after the transient, in units of that of all trials, that counts as an oscillation."""
LEAST_WAIT = 10.0
"""Shortest wait for a return to the section."""
LARGE = 1e8


class _EnoughError(Exception):
    """The trial has evaluated the equations often enough."""


def first_tables(model: Assembled) -> dict[str, Any]:
    """Return the tables of a first specification."""
    definition = read_definition(model.model)[0]
    assert definition is not None
    name, low, high = _range(model)
    tables: dict[str, Any] = {"parameters": {}, "axes": {}}
    if name:
        tables["axes"][name] = {"start": low, "stop": high, "num": 201 if definition.is_map else VALUES}
    tables["initial_conditions"] = {"kind": "list", "points": [model.starts]}
    integration = {"n_transient": 200, "n_keep": 32}
    if definition.is_map:
        integration = {"n_transient": 1000, "n_keep": 100}
    elif model.omega is not None:
        tables["parameters"]["omega"] = model.omega
    elif (section := None if model.strengths else _section(model, definition, name, (low, high))) is not None:
        tables["section"] = section
    else:
        tables["parameters"]["frequency_hz"] = _short(200.0 / _total(model))
    if model.strengths:
        tables["noise"] = {
            "strengths": {n: float(t) if _is_number(t) else t for n, t in model.strengths.items()},
            "interpretation": "ito",
        }
        integration = {"n_transient": 0, "n_keep": 200}
    tables["integration"] = integration
    return {key: value for key, value in tables.items() if value}


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _range(model: Assembled) -> tuple[str, float, float]:
    """Return the parameter to sweep and its range: of the file's options, else half its value about it."""
    source, settings = model.source, model.source.settings
    parameters = list(source.parameters)
    chosen = settings.get("rangeover", "")
    if chosen in parameters:
        low, high = (constant_setting(source, key, math.nan) for key in ("rangelow", "rangehigh"))
    else:
        given = [key in settings for key in ("parmin", "parmax")]
        # AUTO begins with the first parameter of the file
        chosen = source.first_parameter if source.first_parameter in parameters else (parameters or [""])[0]
        low, high = (constant_setting(source, key, d) for key, d in (("parmin", 0.0), ("parmax", 2.0)))
        if not any(given) or chosen != source.first_parameter:
            low, high = math.nan, math.nan
    if not chosen:
        return "", 0.0, 0.0
    value = source.parameters[chosen]
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        low, high = sorted((0.5 * value, 1.5 * value)) if value else (0.0, 1.0)
    return model.names[chosen], _short(low), _short(high)


def _section(model: Assembled, definition: Definition, axis: str, span: tuple[float, float]) -> dict[str, Any] | None:
    """Return a section across the motion, from the file's options or a trial; None if all motions come to rest."""
    source, settings = model.source, model.source.settings
    motions = _trials(model, definition, axis, span)
    given = settings.get("poivar", "")
    crossing = [key for key in (given, f"aux {given}") if key in source.states or key in source.quantities]
    if settings.get("poimap", "")[:1] == "s" and crossing:
        sign = constant_setting(source, "poisgn", 1.0)
        level = constant_setting(source, "poipln", 0.0)
        found = {"of": model.names[crossing[0]], "value": level, "direction": "down" if sign < 0 else "up"}
    elif (chosen := _across(model, motions)) is not None:
        found = chosen
    else:
        return None
    return {**found, "longest": _short(max(LEAST_WAIT, _total(model)))}


def _total(model: Assembled) -> float:
    """Return the length of a trial."""
    total = constant_setting(model.source, "total", TOTAL)
    return SEVERAL * (total if 0.0 < total < 1e9 else TOTAL)


def _trials(
    model: Assembled, definition: Definition, axis: str, span: tuple[float, float]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times and states of trials at a few values of the swept parameter."""
    own = {p.name: float(definition.presets[0].values[p.name]) for p in definition.parameters}
    shares = (np.arange(TRIALS) + 0.5) / TRIALS if axis else ()
    values = [own, *({**own, axis: span[0] + (span[1] - span[0]) * share} for share in shares)]
    found = (_Trial(definition, value).motion(model.starts, _total(model)) for value in values)
    return [motion for motion in found if motion is not None]


class _Trial:
    """A short, coarse integration of a model at given parameters, with its impacts."""

    def __init__(self, definition: Definition, values: dict[str, float]) -> None:
        self.definition = definition
        self.values = {**values, "pi": math.pi}
        self.names = [s.name for s in definition.states]
        nodes = sum(map(size, (*definition.equations.values(), *definition.define.values())))
        self.left = min(MOST_EVALUATIONS, MOST_NODES // nodes)

    def known(self, y: np.ndarray) -> dict[str, Any]:
        """Return the values of names."""
        return {**self.values, **dict(zip(self.names, y, strict=True))}

    def rates(self, t: float, y: np.ndarray) -> list[float]:
        """Return the rates; raise if they were asked for too often."""
        self.left -= 1
        if self.left < 0:
            raise _EnoughError
        found = rates_of(self.definition, self.known(y))
        return [float(found[name]) for name in self.names]

    def valued(self, trees: Sequence[Tree], y: np.ndarray) -> list[float]:
        """Return the values of expressions."""
        known = self.known(y)
        for name in self.definition.used(trees):
            if name in self.definition.define:
                known[name] = value_of(self.definition.define[name], known)
        return [float(value_of(tree, known)) for tree in trees]

    def surface(self, impact: Impact) -> Callable[[float, np.ndarray], float]:
        """Return the function whose zero is an impact."""

        def of(t: float, y: np.ndarray) -> float:
            return self.valued((impact.of,), y)[0]

        return of

    def motion(self, start: list[float], total: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return times and states, as far as they were computed; None if they do not stay finite."""
        rows: list[tuple[float, np.ndarray]] = []
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            try:
                self._integrate(np.array(start), total, rows)
            except _EnoughError:
                pass
            except (ValueError, ArithmeticError):
                return None
        t, y = np.array([row[0] for row in rows]), np.array([row[1] for row in rows]).T
        return (t, y) if y.size and t[-1] > 0.0 and np.isfinite(y).all() and np.abs(y).max() < LARGE else None

    def _integrate(self, y: np.ndarray, total: float, rows: list[tuple[float, np.ndarray]]) -> None:
        """Append a row for each step; after an impact go on from the states that it sets."""
        surfaces = [self.surface(impact) for impact in self.definition.impacts]
        before = [surface(0.0, y) for surface in surfaces]
        solver = LSODA(self.rates, 0.0, y, total, rtol=1e-6, atol=1e-9, max_step=total / STEPS)
        while solver.status == "running":
            solver.step()
            rows.append((solver.t, solver.y.copy()))
            after = [surface(solver.t, solver.y) for surface in surfaces]
            for impact, old, new in zip(self.definition.impacts, before, after, strict=True):
                if old * impact.direction < 0.0 <= new * impact.direction:
                    y = solver.y.copy()
                    for name, value in zip(impact.set, self.valued(list(impact.set.values()), y), strict=True):
                        y[self.names.index(name)] = value
                    after = [surface(solver.t, y) for surface in surfaces]
                    solver = LSODA(self.rates, solver.t, y, total, rtol=1e-6, atol=1e-9, max_step=total / STEPS)
                    rows.append((solver.t + 1e-12 * total, y.copy()))
                    break
            before = after


def _across(model: Assembled, motions: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any] | None:
    """Return a section half-way between the extremes of the state that swings most in its own range."""
    best: tuple[float, int, dict[str, Any]] | None = None
    for k, state in enumerate(model.source.states):
        if state in model.source.circles or not motions:
            continue
        extent = max(y[k].max() for _, y in motions) - min(y[k].min() for _, y in motions)
        for times, states in motions:
            values = states[k][times > 0.5 * times[-1]]
            if not values.size:
                continue
            low, high = float(values.min()), float(values.max())
            level = _between(low, high)
            crossings = int(np.count_nonzero((values[1:] > level) & (values[:-1] <= level)))
            swing = (high - low) / (extent or 1.0)
            if swing < LEAST_SWING or crossings < 2:
                continue
            if best is None or (round(swing, 1), crossings) > best[:2]:
                best = round(swing, 1), crossings, {"of": model.names[state], "value": level, "direction": "up"}
    return None if best is None else best[2]


def _between(low: float, high: float) -> float:
    """Return a short number near the middle of an interval."""
    middle, width = 0.5 * (low + high), high - low
    if width <= 0.0:
        return middle
    if low < 0.0 < high and min(-low, high) > 0.25 * width:
        return 0.0
    return round(middle, max(0, 1 - math.floor(math.log10(width))))


def _short(value: float) -> float:
    """Return a number with six digits."""
    return float(f"{value:.6g}")
