"""Derive the motion of a state that rests on the surface of an impact after infinitely many bounces in a finite time.

The surface pushes along the direction n in which an impact changes the states. While a state rests on it,
the impact's value g and its rate stay 0: the rates f become f - n a/b, where a is the second derivative that
g would have without the contact, and b the change of the rate of g along n. The contact ends where a changes
its sign, because a surface does not pull (Brogliato, Nonsmooth Mechanics, 3rd ed., Springer 2016, chapter 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import Graph, GraphError, Node, in_order, substituted


@dataclass(frozen=True)
class Jump:
    """Impact as expressions: event function and its rate, the states after the impact, and, if it sticks, the states at
    rest.
    """

    value: Node
    rate: Node
    direction: int
    states: tuple[Node, ...]
    at_rest: tuple[Node, ...] = ()


@dataclass(frozen=True)
class _Contact:
    """Contact of a resting state with the surface of an impact, as expressions: push, reaction and direction."""

    push: Node  # second derivative of the impact's value without the contact
    reaction: tuple[Node, ...]  # term that the contact adds to each rate
    direction: tuple[Node, ...]  # direction in state space in which the surface pushes
    slopes: list[Node]  # derivatives of the value's rate by the states


def with_contacts(
    graph: Graph, free: tuple[Node, ...], jumps: Sequence[Jump], sticks: Sequence[bool]
) -> tuple[tuple[Node, ...], list[Jump], tuple[int, ...]]:
    """Extend rates and impacts by the motion in contact, while a state rests on the surface of an impact.

    Parameters
    ----------
    graph
        To which all belong.
    free
        Rates of the states without contact.
    jumps
        The impacts.
    sticks
        Which of them let the state rest.

    Returns
    -------
    rates, jumps, sticks
        The last as `System.sticks`.

    Raises
    ------
    GraphError
        If an impact that sticks does not change how fast its own value changes.
    """
    found = {k: _contact(graph, free, jumps[k], f"impacts[{k}].stick") for k, stick in enumerate(sticks) if stick}
    rates, changed = list(free), list(jumps)
    for k, contact in found.items():
        mode = graph.leaf("mode_contact", k)
        for i, own in enumerate(contact.reaction):
            if not own.is_number(0.0):
                rates[i] = graph.add(rates[i], _at_rest(graph, mode, own, graph.zero))
        release = graph.neg(contact.push)
        (rate,) = along(graph, (release,))
        jump = jumps[k]
        changed[k] = replace(
            jump,
            value=_at_rest(graph, mode, release, jump.value),
            rate=_at_rest(graph, mode, rate, jump.rate),
            at_rest=_resting(graph, free, jump, contact),
        )
    alone = any(
        not _change(graph, found[j].slopes, found[k].direction).is_number(0.0) for j in found for k in found if j != k
    )
    return tuple(rates), changed, tuple((2 if alone else 1) if stick else 0 for stick in sticks)


def along(graph: Graph, nodes: tuple[Node, ...]) -> list[Node]:
    """Return the time derivatives of expressions along a motion. The states' own derivatives enter as symbols."""
    states = {n: graph.leaf("rate", int(n.value)) for n in in_order(nodes) if n.op == "state"}
    return derivatives(graph, nodes, {**states, graph.leaf("time"): graph.one})


def _contact(graph: Graph, free: tuple[Node, ...], jump: Jump, place: str) -> _Contact:
    speed = _of_motion(graph, jump.rate, free)
    slopes = _slopes(graph, speed, len(free))
    direction = _pushed(graph, jump.states, slopes)
    if direction is None or not _change(graph, _slopes(graph, jump.value, len(free)), direction).is_number(0.0):
        raise GraphError(
            f"{place}: a state can rest on a surface whose speed the impact changes, and not its place: `of` "
            "must need a coordinate, and `set` the velocity of that coordinate"
        )
    (rate,) = along(graph, (speed,))
    push = _of_motion(graph, rate, free)
    strength = graph.neg(graph.div(push, _change(graph, slopes, direction)))
    return _Contact(push, tuple(graph.mul(strength, n) for n in direction), direction, slopes)


def _pushed(graph: Graph, states: Sequence[Node], slopes: Sequence[Node]) -> tuple[Node, ...] | None:
    """Return the direction in state space in which an impact changes the states; None if there is none."""
    own = [graph.leaf("state", i) for i in range(len(states))]
    changes = tuple(graph.sub(new, old) for new, old in zip(states, own, strict=True))
    for i, slope in enumerate(slopes):
        if not slope.is_number(0.0) and not changes[i].is_number(0.0):
            found = tuple(derivatives(graph, changes, {own[i]: graph.one}))
            if not _change(graph, slopes, found).is_number(0.0):
                return found
    return None


def _resting(graph: Graph, free: tuple[Node, ...], jump: Jump, contact: _Contact) -> tuple[Node, ...]:
    """Return expressions for the state projected onto the surface of an impact, with no speed relative to it."""
    own = [graph.leaf("state", i) for i in range(len(free))]
    moved = derivatives(graph, free, dict(zip(own, contact.direction, strict=True)))
    away = graph.div(jump.value, _change(graph, _slopes(graph, jump.value, len(free)), moved))
    placed = [graph.sub(y, graph.mul(away, m)) for y, m in zip(own, moved, strict=True)]
    speed = graph.div(_of_motion(graph, jump.rate, free), _change(graph, contact.slopes, contact.direction))
    states = [graph.sub(y, graph.mul(speed, n)) for y, n in zip(own, contact.direction, strict=True)]
    return tuple(substituted(graph, states, dict(zip(own, placed, strict=True))))


def _of_motion(graph: Graph, node: Node, free: tuple[Node, ...]) -> Node:
    """Return an expression with the symbols for rates replaced by the equations of motion without contact."""
    (found,) = substituted(graph, [node], {graph.leaf("rate", i): rate for i, rate in enumerate(free)})
    return found


def _slopes(graph: Graph, node: Node, n: int) -> list[Node]:
    return [derivatives(graph, (node,), {graph.leaf("state", i): graph.one})[0] for i in range(n)]


def _change(graph: Graph, slopes: Sequence[Node], direction: Sequence[Node]) -> Node:
    """Return a directional derivative: the scalar product of a gradient (`slopes`) and a direction in state space."""
    return graph.add(graph.zero, *(graph.mul(a, b) for a, b in zip(slopes, direction, strict=True)))


def _at_rest(graph: Graph, mode: Node, yes: Node, no: Node) -> Node:
    return graph.where_less(mode, graph.number(0.5), yes, no)
