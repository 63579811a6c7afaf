"""Differentiate expressions by the chain rule on their graph.

Each part's derivative is made once, so that the Jacobian of equations that share parts is about as large as
the equations times the number of states, however deep definitions stand in one another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from magpend_core.expressions.graph import Graph, Node, in_order


def derivatives(graph: Graph, roots: tuple[Node, ...], seeds: Mapping[Node, Node]) -> list[Node]:
    """Return the derivative of each expression along a direction, given by `seeds`.

    Parameters
    ----------
    graph
        To which all belong.
    roots
        What is differentiated.
    seeds
        Rates of change of leaves; the others do not change.

    Returns
    -------
    list of Node
        ``sum(d root / d leaf * seed)`` for each root.
    """
    known: dict[int, Node] = {leaf.number: seed for leaf, seed in seeds.items()}
    for node in in_order(roots):
        if node.number in known:
            continue
        inner = [known[a.number] for a in node.args]
        if all(d.is_number(0.0) for d in inner):
            known[node.number] = graph.zero
        elif node.number in graph.whole_powers:
            base, n = graph.whole_powers[node.number]
            slope = graph.mul(graph.number(n), graph.power(base, graph.number(n - 1)))
            known[node.number] = graph.mul(slope, known[base.number])
        else:
            known[node.number] = _RULES[node.op](graph, node, inner)
    return [known[root.number] for root in roots]


Rule = Callable[[Graph, Node, list[Node]], Node]


def _mul(g: Graph, node: Node, d: list[Node]) -> Node:
    a, b = node.args
    return g.mul(g.number(2.0), a, d[0]) if a is b else g.add(g.mul(d[0], b), g.mul(a, d[1]))


def _div(g: Graph, node: Node, d: list[Node]) -> Node:
    inverse = g.div(g.one, node.args[1])
    return g.mul(g.sub(d[0], g.mul(node.args[0], inverse, d[1])), inverse)


def _power(g: Graph, node: Node, d: list[Node]) -> Node:
    base, exponent = node.args
    by_base = g.mul(exponent, g.power(base, g.sub(exponent, g.one)), d[0])
    if d[1].is_number(0.0):
        return by_base
    return g.add(by_base, g.mul(node, g.call("log", base), d[1]))


def _atan2(g: Graph, node: Node, d: list[Node]) -> Node:
    y, x = node.args
    top = g.sub(g.mul(x, d[0]), g.mul(y, d[1]))
    return g.mul(top, g.div(g.one, g.add(g.mul(x, x), g.mul(y, y))))


def _less(g: Graph, node: Node, d: list[Node]) -> Node:
    return g.where_less(node.args[0], node.args[1], d[2], d[3])


def _choice(g: Graph, node: Node, d: list[Node]) -> Node:
    side, yes, no = node.args
    by_side = g.mul(g.number(0.5), d[0], g.sub(yes, no))
    return g.add(by_side, g.choice(side, d[1], d[2]))


def _maximum(g: Graph, node: Node, d: list[Node]) -> Node:
    a, b = node.args
    return g.where_less(b, a, d[0], d[1])


def _minimum(g: Graph, node: Node, d: list[Node]) -> Node:
    a, b = node.args
    return g.where_less(a, b, d[0], d[1])


def _slope(slope: Callable[[Graph, Node, Node], Node]) -> Rule:
    """Return the chain rule for a function f(x), where `slope` gives f' from x and f(x)."""
    return lambda g, node, d: g.mul(slope(g, node.args[0], node), d[0])


def _one_over_root(g: Graph, x: Node) -> Node:
    return g.div(g.one, g.call("sqrt", g.sub(g.one, g.mul(x, x))))


_RULES: dict[str, Rule] = {
    "add": lambda g, node, d: g.add(*d),
    "neg": lambda g, node, d: g.neg(d[0]),
    "held": lambda g, node, d: d[0],
    "mul": _mul,
    "div": _div,
    "power": _power,
    "atan2": _atan2,
    "less": _less,
    "maximum": _maximum,
    "minimum": _minimum,
    "choice": _choice,
    "sign": lambda g, node, d: g.zero,
    "floor": lambda g, node, d: g.zero,
    "square": lambda g, node, d: g.zero,
    "absolute": _slope(lambda g, x, y: g.call("sign", x)),
    "sqrt": _slope(lambda g, x, y: g.div(g.number(0.5), y)),
    "exp": _slope(lambda g, x, y: y),
    "log": _slope(lambda g, x, y: g.div(g.one, x)),
    "sin": _slope(lambda g, x, y: g.call("cos", x)),
    "cos": _slope(lambda g, x, y: g.neg(g.call("sin", x))),
    "tan": _slope(lambda g, x, y: g.add(g.one, g.mul(y, y))),
    "sinh": _slope(lambda g, x, y: g.call("cosh", x)),
    "cosh": _slope(lambda g, x, y: g.call("sinh", x)),
    "tanh": _slope(lambda g, x, y: g.sub(g.one, g.mul(y, y))),
    "asin": _slope(lambda g, x, y: _one_over_root(g, x)),
    "acos": _slope(lambda g, x, y: g.neg(_one_over_root(g, x))),
    "atan": _slope(lambda g, x, y: g.div(g.one, g.add(g.one, g.mul(x, x)))),
    **dict.fromkeys(
        (
            "number",
            "parameter",
            "frequency",
            "rank",
            "time",
            "segment",
            "clock",
            "mode_clock",
            "mode_contact",
            "state",
            "rate",
            "side",
            "mode_side",
        ),
        lambda g, node, d: g.zero,
    ),
}
