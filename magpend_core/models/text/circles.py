"""Find states that are angles but not declared as such: the dynamics do not change when 2 pi is added to them."""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import value_of
from magpend_core.sizes import MAX_STATES

N_SAMPLES = 64
"""Random states, times and parameter values at which the dynamics are compared."""

UNCHANGED, ROUNDING = 1e-9, 1e-13
"""Largest change of an expression by a full turn: in units of its change within a turn, and of its own size."""

DEPENDS = 1e-6
"""Least change of an expression within a turn, in units of its own size, that shows that it depends on a state."""


def undeclared_angles(definition: Definition) -> tuple[str, ...]:
    """Return the names of the states that no text declares as angles, and to which 2 pi can be added without effect.

    The rates, the surfaces of the impacts and the states after them are compared at random states, times and
    parameter values. A state on which none of them depends is not returned: it may be a clock or an integral. Systems
    with more than `sizes.MAX_STATES` states are not examined.
    """
    of_states = [s.name for s in definition.states if not s.on_circle]
    if not of_states or len(definition.states) > MAX_STATES:
        return ()
    names = _samples(definition, of_states)
    for name in definition.used(definition.dynamics):
        if name in definition.define:
            names[name] = value_of(definition.define[name], names)
    is_same, depends = np.ones(len(of_states), bool), np.zeros(len(of_states), bool)
    for changed, tree in _dynamics(definition):
        here, within, turned = np.broadcast_to(value_of(tree, names), (3, len(of_states), N_SAMPLES))
        with np.errstate(all="ignore"):
            by_turn, by_part = turned - here, within - here
        if changed in of_states:  # the state after an impact turns with the state before it
            own = of_states.index(changed)
            by_turn[own] = np.remainder(by_turn[own] + np.pi, 2.0 * np.pi) - np.pi
            by_part[own] = 0.0
        rows = np.isfinite(by_turn) & np.isfinite(by_part)
        by_turn, by_part, size = (np.abs(np.where(rows, a, 0.0)).max(axis=1) for a in (by_turn, by_part, here))
        is_same &= by_turn <= UNCHANGED * by_part + ROUNDING * size
        depends |= by_part > DEPENDS * size
    return tuple(name for name, *both in zip(of_states, is_same, depends, strict=True) if all(both))


def angle_remark(name: str) -> str:
    """Return the remark on a state that is an angle but not declared as one."""
    return (
        f"model.states.{name}: the equations stay the same when 2 pi is added, as for an angle; declare it with "
        f"{name} = {{ on_circle = true }}, or full turns lead to ever new states."
    )


def _dynamics(definition: Definition) -> list[tuple[str, Tree]]:
    """Return the expressions that move the state; with each the state that an impact sets to it, else an empty text."""
    if definition.is_map:  # the next state turns with the state
        return list(definition.equations.items())
    found = [("", tree) for tree in (*definition.equations.values(), *(i.of for i in definition.impacts))]
    return found + [(name, tree) for i in definition.impacts for name, tree in i.set.items()]


def _samples(definition: Definition, of_states: list[str]) -> dict[str, Any]:
    """Return values of all names but definitions, shape (3, state, sample): for each state, random samples, then the
    same with another value of this state, and with this state a full turn away.

    One half of the samples has the parameters of the first preset, the other half is near them; none is 0.
    """
    random = np.random.default_rng(0)
    shape = (3, len(of_states), N_SAMPLES)
    near = np.where(np.arange(N_SAMPLES) % 2, random.uniform(0.9, 1.1, N_SAMPLES), 1.0)
    names: dict[str, Any] = {"pi": np.float64(np.pi), "f": random.uniform(0.5, 2.0, N_SAMPLES)}
    names["phase"] = random.uniform(0.0, 1.0, N_SAMPLES)
    names["t"] = names["phase"] / names["f"]
    for name, value in definition.presets[0].values.items():
        names[name] = near * value if value != 0.0 else random.uniform(0.1, 1.0, N_SAMPLES)
    for state in definition.states:
        size = np.pi if state.name in of_states else state.scale
        names[state.name] = np.broadcast_to(random.uniform(-size, size, N_SAMPLES), shape).copy()
    for i, name in enumerate(of_states):
        names[name][1, i] = random.uniform(-np.pi, np.pi, N_SAMPLES)
        names[name][2, i] += np.where(random.uniform(size=N_SAMPLES) < 0.5, -2.0, 2.0) * np.pi
    return names
