"""Read the expression whose level is a Poincare section, and check it before anything is compiled."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from magpend_core.models.model import Mirror
from magpend_core.models.parameters import ParameterError, near_names
from magpend_core.models.text.calls import Function
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import TIMED, Tree
from magpend_core.models.text.model import TextModel, model_of
from magpend_core.models.text.numeric import rates_of
from magpend_core.models.text.scene import by_name, values_of
from magpend_core.models.text.tables import FUNCTION, Reader

PLACE = "section.of"
N_STATES = 64
"""States at which an expression is looked at."""
STEP = 1e-4
"""Change of the states in differences, in units of their scales."""
ALONG = 1e-6
"""Largest change along the motion, in units of the sum of the changes by each state, of what the motion keeps."""
SAME = 1e-9
"""Largest relative difference of two values that are equal."""


def with_surface(model: TextModel, of: str) -> TextModel:
    """Return a model whose system has a `surface`, see `System`: an expression of its states.

    Parameters
    ----------
    model
        Without a drive.
    of
        Expression, with the states, parameters, parts and quantities of the model.

    Raises
    ------
    ParameterError
        If it is no such expression, or the motion crosses none of its levels.
    """
    own = model.definition
    define = {**{name: tree for name, tree in own.quantities.items() if name not in own.define}, **own.define}
    own = replace(own, define=define)
    tree = _parsed(own, of)
    if (problem := _names_problem(own, tree)) is not None:
        raise ParameterError([f"{PLACE} = {of!r}: {problem}"])
    looked = _Looked(own, tree, _drawn(own))
    if (problem := looked.problem) is not None:
        raise ParameterError([f"{PLACE} = {of!r}: {problem}"])
    expressed = model_of(replace(own, surface=tree, surface_unit=looked.unit), model.shipped)
    return replace(expressed, method=model.method)


def keeps_surface(model: TextModel, mirror: Mirror) -> bool:
    """Return whether a mirror symmetry of the states leaves the `surface` of a model as it is."""
    assert model.definition.surface is not None
    looked = _Looked(model.definition, model.definition.surface, _drawn(model.definition))
    images = looked.at(looked.states * np.array(mirror.signs, np.float64))
    return bool((np.abs(images - looked.here) <= SAME * looked.size)[np.isfinite(looked.here)].all())


def tangent_problem(model: TextModel, parameters: Mapping[str, float]) -> str | None:
    """Return why no trajectory crosses a level of a model's `surface` at some parameters; None if some may."""
    assert model.definition.surface is not None
    return _Looked(model.definition, model.definition.surface, parameters).tangent_problem()


def _drawn(own: Definition) -> dict[str, Any]:
    chance, default = np.random.default_rng(8), own.presets[0].values
    return {name: (value or 1.0) * chance.uniform(0.5, 1.5, N_STATES) for name, value in default.items()}


def _parsed(own: Definition, of: str) -> Tree:
    states, quantities = [s.name for s in own.states], list(own.quantities)
    timed = set(TIMED) & set(re.findall(r"[A-Za-z_]\w*", of))  # known, so that it is refused for what it is
    known = dict.fromkeys((*states, *(p.name for p in own.parameters), *own.define, "pi", *timed), "name")
    reader = Reader()
    for name, line in own.lines.items():
        if line.key.arguments is not None:
            reader.writing.functions[name] = Function(line.key.arguments, line.tree)
            known[name] = FUNCTION
    if of.isidentifier() and of not in known:
        hint = near_names(of, (*states, *quantities), "states")
        raise ParameterError([f"{PLACE} = {of!r}: is not a state of {own.name}; {hint}"])
    tree = reader.expression(of, PLACE, known)
    if tree is None:
        raise ParameterError(reader.problems)
    return tree


def _names_problem(own: Definition, tree: Tree) -> str | None:
    used = own.used([tree])
    if timed := sorted(own.timed & set(used)):
        return f"depends on {timed[0]}; a section is a level of an expression of states and parameters."
    states = [s.name for s in own.states]
    if set(used).isdisjoint(states):
        return f"names no state of {own.name}, so nothing crosses its levels; known states: {', '.join(states)}."
    return None


@dataclass(frozen=True)
class _Looked:
    """An expression at some states and parameters."""

    own: Definition
    tree: Tree
    parameters: Mapping[str, Any]

    @cached_property
    def states(self) -> np.ndarray:
        ranges = [s.motion or (-s.scale, s.scale) for s in self.own.states]
        low, high = np.array(ranges).T
        return np.random.default_rng(7).uniform(low, high, (N_STATES, len(ranges)))

    @cached_property
    def here(self) -> np.ndarray:
        return self.at(self.states)

    @property
    def size(self) -> float:
        return float(np.abs(self.here[np.isfinite(self.here)]).max(initial=1e-300))

    @cached_property
    def indices(self) -> list[int]:
        """Numbers of the states that the expression needs."""
        used = set(self.own.used([self.tree]))
        return [i for i, s in enumerate(self.own.states) if s.name in used]

    def at(self, states: np.ndarray) -> np.ndarray:
        (found,) = values_of(self.own, [self.tree], by_name(self.own, states, self.parameters))
        return np.broadcast_to(np.asarray(found, np.float64), len(states))

    def change(self, way: np.ndarray) -> np.ndarray:
        """Return the differences of the values at the ends of steps to both sides."""
        return np.asarray(self.at(self.states + way) - self.at(self.states - way))

    def changes(self, way: np.ndarray) -> np.ndarray:
        """Return the sums of the sizes of the changes by each state alone."""
        columns = np.arange(way.shape[1])
        return np.asarray(sum(np.abs(self.change(np.where(columns == i, way, 0.0))) for i in self.indices))

    @cached_property
    def by_states(self) -> np.ndarray:
        scales = np.array([s.scale for s in self.own.states])
        return self.changes(STEP * np.tile(scales, (N_STATES, 1)))

    @property
    def unit(self) -> float:
        """Typical change as the states change by their scales, to two digits; 1 if that is not known."""
        known = self.by_states[np.isfinite(self.by_states) & (self.by_states > 0.0)]
        return float(f"{np.median(known) / (2.0 * STEP):.1e}") if len(known) else 1.0

    @property
    def problem(self) -> str | None:
        """What makes the expression no section, if it is known at the states that are looked at."""
        for i in self.indices:
            state = self.own.states[i]
            if state.on_circle and self._differs(2.0 * math.pi, i):
                return (
                    f"changes by a full turn of the angle {state.name}; write sin({state.name}), or take "
                    f'of = "{state.name}" with a value.'
                )
        known = np.isfinite(self.by_states)
        if not known.any():
            return None
        if (self.by_states[known] <= 1e-12 * self.size).all():
            return "is the same at all states, so nothing crosses its levels."
        return self.tangent_problem()

    def _differs(self, turn: float, i: int) -> bool:
        turned = self.states.copy()
        turned[:, i] += turn
        return bool((np.abs(self.at(turned) - self.here) > SAME * self.size).any())

    def tangent_problem(self) -> str | None:
        """Return what makes the expression no section if the motion does not change it."""
        given = {"t": 0.0, "f": 1.0, **by_name(self.own, self.states, self.parameters)}
        rates = rates_of(self.own, {"pi": math.pi, **given})
        flow = np.stack([np.broadcast_to(rates[s.name], N_STATES) for s in self.own.states], axis=1)
        scales = np.array([s.scale for s in self.own.states])
        speed = np.abs(flow / scales).max(axis=1, keepdims=True)
        way = STEP * flow / np.where(speed > 0.0, speed, 1.0)
        along, parts = np.abs(self.change(way)), self.changes(way)
        known = np.isfinite(along) & np.isfinite(parts)
        if not known.any() or (along > ALONG * parts + 1e-13 * self.size)[known].any():
            return None
        return (
            "does not change along the motion, so that no trajectory crosses its levels; take an expression whose "
            "rate is not 0, such as a state."
        )
