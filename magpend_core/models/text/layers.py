"""Find steep functions in a model's equations, with their nearest complex singularity and the jump across.

A step that crosses such a place must be in proportion to the distance from the singularity (see
`engine.lanes.choose_step`). Places on the state are *layers*, places in time alone are *edges*.

Found are ``atan(w)`` with its poles at w = +-i, ``tanh(w)`` at +-i pi/2, quotients by ``1 + exp(w)`` at
+-i pi, and ``u/sqrt(u**2 + e**2)`` at u = +-i e, wherever they stand and whatever their argument; unless it
cannot pass zero, as far as its form tells. Not found are other steep forms: ``1/(e**2 + u**2)``,
``exp(-(u/e)**2)``, large whole powers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import CONSTANT, TIMED, Graph, GraphError, Node, in_order, substituted

FADING = ("tanh", "1/(1 + exp)")
"""Forms that fall off exponentially."""
MAX_STEEP = 24
"""Most steep places of a model; each is looked at with every step."""
MOST_EXACT = 8
"""A jump whose expression has at most so many parts that change with the state is followed along the way."""
GENERIC = (0.37, -0.59, 0.83, -0.21, 0.67, -0.43)
"""A state, in units of the scales, at which nothing is special: jumps are estimated there and at 0."""


@dataclass(frozen=True)
class Steep:
    """Steep place of a model's equations, with its half-width and the jump of the rates across it.

    Attributes
    ----------
    node : Node
        The steep function.
    value : Node
        Expression that passes zero at the steep place.
    half_width : Node
        Imaginary part of the nearest singularity, in terms of `value`; depends on parameters and frequency only.
    jump : Node
        Change across the place of the rate that changes most.
    form : str
        Description of the steep function, for messages.
    """

    node: Node
    value: Node
    half_width: Node
    jump: Node
    form: str


@dataclass(frozen=True)
class Place:
    """Steep function such as tanh: its argument, distance to its nearest complex singularity, and total change."""

    argument: Node
    distance: Node
    change: Node
    form: str


def steep_places(graph: Graph, rates: tuple[Node, ...], scales: tuple[float, ...]) -> list[Steep]:
    """Find all steep functions in the rates; return each with its half-width and the jump of the rates.

    Parameters
    ----------
    graph
        Expression graph that contains `rates`.
    rates
        Time derivatives of the states.
    scales
        Scales of the states.
    """
    found: list[Steep] = []
    for node in in_order(rates):
        place = place_of(graph, node)
        if place is None or place.argument.kind == CONSTANT or keeps_sign(graph, place.argument):
            continue
        factor, value = core_of(graph, place.argument)
        half_width = graph.div(place.distance, factor)
        slopes = derivatives(graph, rates, {node: graph.one})
        jump = _jump(graph, [graph.mul(s, place.change) for s in slopes], scales)
        if jump is not None:
            if len(found) == MAX_STEEP:
                raise GraphError(f"the equations have more than {MAX_STEEP} steep places")
            found.append(Steep(node, value, half_width, jump, place.form))
    return found


def place_of(graph: Graph, node: Node) -> Place | None:
    """Return the `Place` (nearest singularity and change) of a steep function, such as atan or tanh; None for another
    node.
    """
    if node.op == "atan":
        return Place(node.args[0], graph.one, graph.number(math.pi), "atan")
    if node.op == "tanh":
        return Place(node.args[0], graph.number(math.pi / 2.0), graph.number(2.0), "tanh")
    if node.op == "div":
        return _logistic(graph, node) or _smoothed_sign(graph, node)
    return None


def _logistic(graph: Graph, node: Node) -> Place | None:
    above, below = node.args
    if below.op != "add" or len(below.args) != 2 or not any(a.is_number(1.0) for a in below.args):
        return None
    other = next((a for a in below.args if a.op == "exp"), None)
    return None if other is None else Place(other.args[0], graph.number(math.pi), above, "1/(1 + exp)")


def _smoothed_sign(graph: Graph, node: Node) -> Place | None:
    above, below = node.args
    if below.op != "sqrt" or below.args[0].op != "add" or len(below.args[0].args) != 2:
        return None
    square = graph.mul(above, above)
    rest = [a for a in below.args[0].args if a is not square]
    if len(rest) != 1 or rest[0].kind != CONSTANT:
        return None
    return Place(above, graph.call("sqrt", rest[0]), graph.number(2.0), "u/sqrt(u**2 + e**2)")


def core_of(graph: Graph, node: Node) -> tuple[Node, Node]:
    """Split a product into the absolute value of its constant factor, and the rest."""
    if node.op == "neg":
        node = node.args[0]
    if node.op == "mul" and node.args[0].kind == CONSTANT:
        return graph.call("absolute", node.args[0]), node.args[1]
    return graph.one, node


def _jump(graph: Graph, changes: list[Node], scales: tuple[float, ...]) -> Node | None:
    """Return an expression for the largest absolute change. A long expression is replaced by its values at two sample
    states.
    """
    changes = [graph.call("absolute", c) for c in changes if not c.is_number(0.0)]
    if not changes:
        return None
    exact = largest(graph, changes)
    stated = sum(n.kind != CONSTANT for n in in_order([exact]))
    if stated <= MOST_EXACT and not any(n.kind == TIMED for n in in_order([exact])):
        return exact
    at_zero = dict.fromkeys(_changing(changes), graph.zero)
    generic = {
        leaf: graph.number(GENERIC[i % len(GENERIC)] * _scale(leaf, scales))
        for i, leaf in enumerate(_changing(changes))
    }
    samples = [largest(graph, substituted(graph, changes, values)) for values in (at_zero, generic)]
    return largest(graph, samples)


def largest(graph: Graph, nodes: list[Node]) -> Node:
    """Return an expression for the maximum of several expressions."""
    found = nodes[0]
    for node in nodes[1:]:
        if not node.is_number(0.0):
            found = node if found.is_number(0.0) else graph.call("maximum", found, node)
    return found


def _changing(nodes: list[Node]) -> Iterator[Node]:
    return (n for n in in_order(nodes) if not n.args and n.kind != CONSTANT)


def _scale(leaf: Node, scales: tuple[float, ...]) -> float:
    return scales[int(leaf.value)] if leaf.op == "state" else 1.0


def keeps_sign(graph: Graph, node: Node) -> bool:
    """Return whether an expression cannot pass zero, judged by its form alone."""
    return _above_zero(graph, node.args[0] if node.op == "neg" else node)


def _above_zero(graph: Graph, node: Node) -> bool:
    if node.op == "number":
        return node.value > 0.0
    if node.op == "parameter":
        return int(node.value) in graph.positive
    if node.op in ("exp", "cosh", "frequency"):
        return True
    if node.op in ("mul", "div", "sqrt"):
        return all(_above_zero(graph, a) for a in node.args)
    if node.op == "add":
        parts = [_above_zero(graph, a) for a in node.args]
        return any(parts) and all(p or _not_below_zero(graph, a) for p, a in zip(parts, node.args, strict=True))
    return False


def _not_below_zero(graph: Graph, node: Node) -> bool:
    if node.op == "mul" and node.args[0] is node.args[1]:
        return True
    if node.op in ("mul", "div"):
        return all(_not_below_zero(graph, a) for a in node.args)
    return node.op in ("absolute", "sqrt") or _above_zero(graph, node)
