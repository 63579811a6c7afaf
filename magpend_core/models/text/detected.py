"""Describe in sentences the steep places, corners and jumps found in a model's equations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from magpend_core.expressions.graph import Node
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.domains import readable
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import node_values

MAX_DEPTH = 12
"""Expressions that are nested deeper are not written out."""
_NAMES = {"absolute": "abs", "minimum": "min", "maximum": "max"}
_LEAVES = {"time": "t", "frequency": "f"}


def found_in(
    model: TextModel, parameters: Mapping[str, float], frequency_hz: float, state: Sequence[float]
) -> Iterator[str]:
    """Yield a sentence for each boundary layer, switch and impact, and for each steep function that step control
    ignores.

    Parameters
    ----------
    model
        Model given as text.
    parameters
        Parameters for which half-widths and jumps are computed.
    frequency_hz
        Drive frequency [Hz].
    state
        State for which half-widths and jumps are computed, if they depend on the state.
    """
    derived, own = model.derived, model.definition
    for layer in derived.layers:
        width, jump = _numbers((layer.half_width, layer.steep.jump), own, parameters, frequency_hz, state)
        yield (
            f"layer: {layer.steep.form} where {_text(layer.value, own)} passes 0; half-width {width:.3g}, "
            f"jump {jump:.3g}"
        )
    for switch, slides in zip(derived.switches, derived.sliding.slides, strict=True):
        what = "a jump" if switch.jumps else "a corner"
        passed = "a whole number" if switch.whole else "0"
        yield (
            f"switch: {what} where {_text(switch.written, own)} passes {passed}; a step ends there"
            + (", and motion may slide on it" if slides else "")
        )
    for impact in own.impacts:
        way = "rises" if impact.direction > 0 else "falls"
        new = ", ".join(f"{name} becomes {readable(tree)}" for name, tree in impact.set.items())
        rests = "; after infinitely many impacts the state rests there" if impact.stick else ""
        yield f"impact: where {readable(impact.of)} {way} through 0, {new}{rests}"
    for form in derived.missed:
        yield f"not followed: {form}; steps there are chosen by their error alone"


def _numbers(
    nodes: Sequence[Node], own: Definition, parameters: Mapping[str, float], frequency_hz: float, state: Sequence[float]
) -> list[float]:
    """Compute the values of expressions at one state and time 0, with all switches on their positive side."""
    given = {"parameter": [parameters[p.name] for p in own.parameters], "state": list(state)}
    leaves: dict[int, Any] = {}
    pending = list(nodes)
    while pending:
        node = pending.pop()
        if node.number in leaves or node.op == "number":
            continue
        if node.op in given:
            leaves[node.number] = np.float64(given[node.op][int(node.value)])
        elif not node.args:
            leaves[node.number] = np.float64({"frequency": frequency_hz, "time": 0.0}.get(node.op, 1.0))
        pending += node.args
    return [float(value) for value in node_values(nodes, leaves)]


def _text(node: Node, own: Definition, depth: int = 0) -> str:
    """Return an expression of the graph as readable text; parts nested deeper than `MAX_DEPTH` are written as "..."."""
    if node.op == "number":
        return f"{node.value:.6g}"
    if node.op in ("state", "parameter"):
        named: Any = own.states if node.op == "state" else own.parameters
        return str(named[int(node.value)].name)
    if not node.args:
        return _LEAVES.get(node.op, node.op)
    if depth == MAX_DEPTH:
        return "..."
    parts = [_text(arg, own, depth + 1) for arg in node.args]
    if node.op == "add":
        parts.sort(key=lambda part: part.startswith("-"))  # what is subtracted comes last
        text = "".join(p if i == 0 else f" - {p[1:]}" if p.startswith("-") else f" + {p}" for i, p in enumerate(parts))
        return f"({text})" if depth else text
    if node.op in ("mul", "div"):
        return f"{parts[0]}{'*' if node.op == 'mul' else '/'}{parts[1]}"
    if node.op == "neg":
        return f"-{parts[0]}"
    return f"{_NAMES.get(node.op, node.op)}({', '.join(parts)})"
