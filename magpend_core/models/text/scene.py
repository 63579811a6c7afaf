"""Build a text model's drawing and its classifier of motions, as functions of states and parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from magpend_core.models.model import Classifier, Drawing
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.numeric import value_of

UNKNOWN, MIXED = "unknown", "mixed"
"""Words of every classifier: nothing to judge, and none of the text's words for all sections."""
N_STATES = 16
"""States at which a mirror is looked at."""
ROUGHLY = 0.05
"""Share of the largest rate by which a rate may be off its image."""


def values_of(definition: Definition, trees: Iterable[Tree], given: Mapping[str, Any]) -> list[Any]:
    """Compute the values of expressions, and of the definitions that they use.

    Parameters
    ----------
    definition
        Whose expressions they are.
    trees
        Numbers or conditions.
    given
        Values by name, of the states, parameters, and ``t`` and ``f``, that the expressions need.
    """
    trees = list(trees)
    known = {"pi": math.pi, **given}
    if "t" in known and "f" in known:
        known.setdefault("phase", known["t"] * known["f"])
    for name in definition.used(trees):
        if name not in known:
            known[name] = value_of(definition.define[name], known)
    return [value_of(tree, known) for tree in trees]


def by_name(definition: Definition, states: Any, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return a dict with the values of the states, shape (..., n_states), and of the parameters by name."""
    states = np.asarray(states, np.float64)
    own = {s.name: states[..., i] for i, s in enumerate(definition.states)}
    return {**own, **{p.name: parameters[p.name] for p in definition.parameters if p.name in parameters}}


def drawing_of(definition: Definition) -> Drawing | None:
    """Return a text model's drawing as functions of states and parameters; None if the text has no drawing."""
    text = definition.drawing
    if text is None:
        return None

    def points(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
        given = by_name(definition, states, parameters)
        return _places(definition, text.points, given, np.shape(states)[:-1])

    def fixed(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
        given = {p.name: parameters[p.name] for p in definition.parameters}
        return _places(definition, text.fixed, given, ())

    return Drawing(points, fixed, text.lines, text.trace, text.unit)


def _places(
    definition: Definition, places: Mapping[str, tuple[Tree, Tree]], given: Mapping[str, Any], shape: tuple[int, ...]
) -> dict[str, np.ndarray]:
    found = {}
    for name, pair in places.items():
        x, y = values_of(definition, pair, given)
        found[name] = np.stack([np.broadcast_to(np.asarray(v, np.float64), shape) for v in (x, y)], axis=-1)
    return found


def classifier_of(definition: Definition) -> Classifier | None:
    """Return a text model's classifier: a motion gets the first label that holds at all its section points."""
    text = definition.classifier
    if text is None:
        return None
    words = (UNKNOWN, *text.words, MIXED)

    def classify(
        section: np.ndarray, turns: np.ndarray, frequency_hz: np.ndarray, parameters: Mapping[str, Any]
    ) -> np.ndarray:
        own = {name: np.asarray(value)[..., None] for name, value in parameters.items()}
        given = by_name(definition, section, own)
        shape = section.shape[:-1]
        holds = [
            np.broadcast_to(value, shape).all(axis=-1) for value in values_of(definition, text.words.values(), given)
        ]
        codes = [np.int8(code) for code in range(1, len(words) - 1)]
        return np.select(holds, codes, np.int8(len(words) - 1)).astype(np.int8)

    return Classifier(words, (0,), text.meaning, classify)


def mirror_problem(definition: Definition) -> str | None:
    """Return an error sentence if an equation lacks the mirror symmetry declared in the text, at the default
    parameters; else None.

    Rates at a few states are compared with those at their images; a symmetry may hold nearly, as that of a
    square wave with a duty cycle next to one half does.
    """
    mirror = definition.mirror
    if mirror is None:
        return None
    chance = np.random.default_rng(7)
    states = chance.uniform(-1.0, 1.0, (N_STATES, len(definition.states)))
    states *= [s.scale for s in definition.states]
    times = chance.uniform(0.0, 0.5, N_STATES)
    signs = np.array(mirror.signs, np.float64)
    rates = _rates(definition, states, times)
    images = _rates(definition, states * signs, times + 0.5 * mirror.half_period)
    good = np.isfinite(rates).all(axis=1) & np.isfinite(images).all(axis=1)
    apart = np.abs(images - rates * signs)[good]
    size = np.abs(rates[good]).max(axis=0, initial=1e-300)
    for state, wrong in zip(definition.states, (apart > ROUGHLY * size).sum(axis=0), strict=True):
        if wrong > N_STATES // 2:
            later = " half a period later" if mirror.half_period else ""
            return (
                f"the rate of {state.name} at a state and that at its image{later} are not each other's; "
                "correct the signs, or drop the mirror."
            )
    return None


def _rates(definition: Definition, states: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Compute the rates at states (n, n_states) and times (n,), with drive periods of 1 s; returns (n, n_states)."""
    given = {"t": times, "f": 1.0, **by_name(definition, states, definition.presets[0].values)}
    values = values_of(definition, definition.equations.values(), given)
    return np.stack([np.broadcast_to(np.asarray(v, np.float64), times.shape) for v in values], axis=1)
