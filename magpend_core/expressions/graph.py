"""Represent expressions as a graph: equal subexpressions share one node, and simplifications change at most rounding.

A graph belongs to one model and grows in an order that the model's meaning decides alone, so that the code
generated from it is the same in every process. Sums and products are brought into a form in which what needs
no state, and what needs neither state nor time, are parts of their own.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping

CONSTANT, TIMED, STATED = 0, 1, 2
"""What the value of a node changes with: the cell alone, time too, or the state."""

MAX_NODES = 40_000
"""Nodes of a graph; more are not compiled in a time that anyone waits for."""
MAX_POWER = 64
"""Largest whole power that is written as products."""


class GraphError(ValueError):
    """Error: the equations are too large, or have a form that the engine cannot use."""


class Node:
    """Node of an expression graph: a number, a symbol, or an operation on other nodes.

    Attributes
    ----------
    op : str
        ``number``; the leaves of `_LEAVES`; ``add`` (of two or more), ``mul``, ``div``, ``neg``, ``less``
        (``where_less(a, b, yes, no)``), ``choice`` (see `Graph.choice`), ``held`` (its argument alone) and
        functions.
    value : float or int
        Of a number; position of a leaf.
    kind : int
        `CONSTANT`, `TIMED` or `STATED`.
    number : int
        Position in the graph; arguments have lower ones.
    """

    __slots__ = ("args", "kind", "number", "op", "value")

    def __init__(self, op: str, args: tuple[Node, ...], value: float, kind: int, number: int) -> None:
        self.op, self.args, self.value, self.kind, self.number = op, args, value, kind, number

    def is_number(self, value: float) -> bool:
        """Return whether the node is a number with this value."""
        return self.op == "number" and self.value == value


_LEAVES = {
    "number": CONSTANT,
    "parameter": CONSTANT,
    "frequency": CONSTANT,
    "rank": CONSTANT,
    "time": TIMED,
    "segment": TIMED,
    "clock": TIMED,
    "mode_clock": TIMED,
    "state": STATED,
    "rate": STATED,
    "side": STATED,
    "mode_side": STATED,
    "mode_contact": STATED,
}

_FOLDED: dict[str, Callable[..., float]] = {"sqrt": math.sqrt, "absolute": abs, "floor": math.floor}
# exact at 0, whatever the function's last bit elsewhere
_AT_ZERO = {
    "sin": 0.0,
    "cos": 1.0,
    "tan": 0.0,
    "atan": 0.0,
    "tanh": 0.0,
    "sinh": 0.0,
    "cosh": 1.0,
    "exp": 1.0,
    "asin": 0.0,
    "sign": 0.0,
}


def _finite(function: Callable[[float, float], float], a: float, b: float) -> float:
    try:
        value = function(a, b)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise GraphError(f"the equations, or their derivatives, have a number too large to compute with ({a:g}, {b:g})")
    return value


class Graph:
    """Expression graph of one model: makes nodes, and returns the same node for equal expressions."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[tuple[object, ...], Node] = {}
        # base and exponent of products that are powers
        self.whole_powers: dict[int, tuple[Node, int]] = {}
        # positions of parameters that are above 0
        self.positive: frozenset[int] = frozenset()
        self.zero, self.one = self.number(0.0), self.number(1.0)

    def node(self, op: str, *args: Node, value: float = 0.0) -> Node:
        """Return the node of an operation on given nodes, without simplification."""
        key = (op, repr(value), *(a.number for a in args))
        found = self._known.get(key)
        if found is None:
            if len(self.nodes) >= MAX_NODES:
                raise GraphError(f"the equations and their derivatives have more than {MAX_NODES} parts")
            kind = max((a.kind for a in args), default=_LEAVES.get(op, CONSTANT))
            found = Node(op, args, value, kind, len(self.nodes))
            self.nodes.append(found)
            self._known[key] = found
        return found

    def number(self, value: float) -> Node:
        """Return the node of a number; -0.0 becomes 0.0."""
        return self.node("number", value=value + 0.0)

    def leaf(self, op: str, position: int = 0) -> Node:
        """Return the leaf node of a parameter, a state, a state's rate, a mode, the time or the frequency."""
        return self.node(op, value=position)

    # ---- sums ------------------------------------------------------------------------------------

    def add(self, *terms: Node) -> Node:
        """Return the sum of nodes. Terms without the state form one node, and terms without state and time form
        another.
        """
        groups: tuple[list[Node], ...] = ([], [], [])
        for term in self._collected(terms):
            groups[term.kind].append(term)
        for kind in (CONSTANT, TIMED):
            if groups[kind]:
                groups[kind + 1].insert(0, self._sum(groups[kind]))
        return self._sum(groups[STATED]) if groups[STATED] else self.zero

    def _collected(self, terms: Iterable[Node]) -> list[Node]:
        """Simplify the terms of a sum: add numbers, and merge terms that differ only by a numerical factor."""
        total, factors = 0.0, {}  # type: ignore[var-annotated]
        for term in terms:
            factor, core = 1.0, term
            if core.op == "neg":
                factor, core = -1.0, core.args[0]
            if core.op == "number":
                total += factor * core.value
                continue
            if core.op == "mul" and core.args[0].op == "number":
                factor, core = factor * core.args[0].value, core.args[1]
            before = factors.get(core.number, (core, 0.0))[1]
            factors[core.number] = (core, before + factor)
        own = [self.mul(self.number(factor), core) for core, factor in factors.values() if factor != 0.0]
        return own + ([self.number(total)] if total != 0.0 else [])

    def _sum(self, terms: list[Node]) -> Node:
        if len(terms) == 1:
            return terms[0]
        if all(t.op == "neg" for t in terms):
            return self.neg(self.node("add", *(t.args[0] for t in terms)))
        return self.node("add", *terms)

    def neg(self, x: Node) -> Node:
        """Return the graph node of an expression's negative."""
        if x.op == "number":
            return self.number(-x.value)
        return x.args[0] if x.op == "neg" else self.node("neg", x)

    def sub(self, a: Node, b: Node) -> Node:
        """Return the graph node of a difference."""
        return self.add(a, self.neg(b))

    # ---- products --------------------------------------------------------------------------------

    def mul(self, *factors: Node) -> Node:
        """Return the graph node of a product: first the factors without state and time, then those that depend on time
        alone, then the rest.
        """
        total, negative, groups = 1.0, False, ([], [], [])  # type: ignore[var-annotated]
        pending = list(factors)[::-1]
        while pending:
            factor = pending.pop()
            if factor.op == "neg":
                negative = not negative
                pending.append(factor.args[0])
            elif factor.op == "number":
                total = _finite(operator.mul, total, factor.value)
            elif factor.op == "mul" and factor.args[0].kind < factor.kind:
                pending += factor.args[::-1]
            else:
                groups[factor.kind].append(factor)
        if total == 0.0:
            return self.zero
        if total < 0.0:
            total, negative = -total, not negative
        if total != 1.0:
            groups[CONSTANT].insert(0, self.number(total))
        parts = [self._chain(g) for g in groups if g]
        found = self._chain(parts) if parts else self.one
        return self.neg(found) if negative else found

    def _chain(self, factors: list[Node]) -> Node:
        """Return the product of factors, multiplied from left to right; sort factors so that x*y and y*x share one
        node.
        """
        if len({f.kind for f in factors}) == 1:
            factors = sorted(factors, key=lambda f: (f.op != "number", f.number))
        found = factors[0]
        for factor in factors[1:]:
            found = self.node("mul", found, factor)
        return found

    def div(self, a: Node, b: Node) -> Node:
        """Return the graph node of a quotient. A divisor that depends on neither state nor time is replaced by a
        factor, its inverse.
        """
        if a.is_number(0.0) or b.is_number(1.0):
            return a
        if a.op == "number" and b.op == "number" and b.value != 0.0 and math.isfinite(a.value / b.value):
            return self.number(a.value / b.value)
        if a is b:
            return self.one
        if a.op == "neg":
            return self.neg(self.div(a.args[0], b))
        if b.op == "neg":
            return self.neg(self.div(a, b.args[0]))
        if b.kind == CONSTANT and not a.is_number(1.0) and a.kind != CONSTANT:
            return self.mul(self.div(self.one, b), a)
        if a.op == "mul" and a.args[0].kind < b.kind and a.args[0].kind < a.kind:
            return self.mul(a.args[0], self.div(a.args[1], b))
        return self.node("div", a, b)

    def power(self, base: Node, exponent: Node) -> Node:
        """Return a node for a power; whole and half-integer exponents become products and square roots."""
        if exponent.op == "number":
            twice = 2.0 * exponent.value
            if twice == math.floor(twice) and abs(twice) <= 2 * MAX_POWER:
                return self._halves(base, int(twice))
            if base.op == "number" and base.value > 0.0:
                return self.number(_finite(operator.pow, base.value, exponent.value))
        if base.is_number(1.0):
            return self.one
        return self.node("power", base, exponent)

    def _halves(self, base: Node, twice: int) -> Node:
        if twice < 0:
            return self.div(self.one, self._halves(base, -twice))
        whole = self._whole(base, twice // 2)
        return whole if twice % 2 == 0 else self.mul(whole, self.call("sqrt", base))

    def _whole(self, base: Node, n: int) -> Node:
        if n == 0:
            return self.one
        if n == 1:
            return base
        half = self._whole(base, n // 2)
        square = self.mul(half, half)
        found = square if n % 2 == 0 else self.mul(base, square)
        if base.op not in ("mul", "neg", "number"):  # of which factors are taken out
            self.whole_powers.setdefault(found.number, (base, n))
        return found

    # ---- functions -------------------------------------------------------------------------------

    def call(self, function: str, *args: Node) -> Node:
        """Return a node for the call of a function of `engine.simd` or `engine.vecmath`, simplified where possible."""
        first = args[0]
        if len(args) == 1 and first.op == "number":
            if first.value == 0.0 and function in _AT_ZERO:
                return self.number(_AT_ZERO[function])
            if function in _FOLDED and first.value >= 0.0:
                return self.number(_FOLDED[function](first.value))
        if len(args) == 1 and first.op == "neg":
            if function in ("cos", "cosh", "absolute"):
                return self.call(function, first.args[0])
            if function in ("sin", "tan", "atan", "asin", "sinh", "tanh", "sign"):
                return self.neg(self.call(function, first.args[0]))
        if function in ("minimum", "maximum") and args[0] is args[1]:
            return first
        if function == "sign" and first.op == "number":
            return self.number(math.copysign(1.0, first.value))
        return self.node(function, *args)

    def where_less(self, a: Node, b: Node, yes: Node, no: Node) -> Node:
        """Return a node with the value `yes` where ``a < b``, else `no`."""
        if yes is no:
            return yes
        if a is b:
            return no
        if a.op == "number" and b.op == "number":
            return yes if a.value < b.value else no
        return self.node("less", a, b, yes, no)

    def choice(self, side: Node, yes: Node, no: Node) -> Node:
        """Return a node with the value `yes` where `side` is 1, `no` where it is -1, and linearly interpolated in
        between.
        """
        if yes is no or side.is_number(1.0):
            return yes
        if side.is_number(-1.0):
            return no
        if side.op == "number":
            share = self.number(0.5 + 0.5 * side.value)
            return self.add(no, self.mul(share, self.sub(yes, no)))
        if side.op == "neg":
            return self.choice(side.args[0], no, yes)
        return self.node("choice", side, yes, no)


def in_order(roots: Iterable[Node]) -> list[Node]:
    """Return all graph nodes that expressions consist of, each after its arguments."""
    found: dict[int, Node] = {}
    pending = list(roots)
    while pending:
        node = pending.pop()
        if node.number not in found:
            found[node.number] = node
            pending += node.args
    return [found[number] for number in sorted(found)]


def substituted(graph: Graph, roots: list[Node], values: Mapping[Node, Node]) -> list[Node]:
    """Return expressions in which some nodes are replaced by others."""
    known = {node.number: value for node, value in values.items()}
    for node in in_order(roots):
        if node.number not in known:
            args = tuple(known[a.number] for a in node.args)
            same = all(a is b for a, b in zip(args, node.args, strict=True))
            known[node.number] = node if same else made_again(graph, node, args)
    return [known[root.number] for root in roots]


def made_again(graph: Graph, node: Node, args: tuple[Node, ...]) -> Node:
    """Make a node with the operation of a given node and other arguments."""
    if node.op == "add":
        return graph.add(*args)
    if node.op == "mul":
        return graph.mul(*args)
    if node.op == "less":
        return graph.where_less(args[0], args[1], args[2], args[3])
    if node.op in ("neg", "div", "power", "choice"):
        made: Node = getattr(graph, node.op)(*args)
        return made
    return graph.call(node.op, *args)
