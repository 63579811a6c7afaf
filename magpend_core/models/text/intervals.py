"""Enclose the values of expressions over boxes of states by interval arithmetic, rounded outwards.

An interval is a pair of arrays, its least and its greatest values, with one entry for each box. Each result is widened
to the next numbers, that of a library function by some units in the last place. It therefore contains all values that
the expression takes in exact arithmetic (Moore, Kearfott and Cloud, Introduction to Interval Analysis, SIAM, 2009).
NaN stands for an expression that has no real value anywhere in a box, an infinite end for one without a bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import Graph, Node, in_order
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.derive import Builder

Interval = tuple[np.ndarray, np.ndarray]
"""Least and greatest values, arrays of one shape."""

ULPS = 8
"""Units in the last place by which results of library functions, which err by at most 4, are widened."""


class Rates:
    """Rates of an autonomous model given as text, and their Jacobian, over boxes of states.

    Attributes
    ----------
    obstacle : str
        Name of the first function in the rates that jumps, so that no enclosure of slopes exists; else empty.
    """

    def __init__(self, definition: Definition, parameters: Mapping[str, float]) -> None:
        builder = Builder(definition)
        self.graph = builder.graph
        self.roots = tuple(builder.node(tree) for tree in definition.equations.values())
        names = [s.name for s in definition.states]
        states = [builder.names[name] for name in names]
        columns = [derivatives(self.graph, self.roots, {s: self.graph.one}) for s in states]
        self.slopes = [columns[j][i] for i in range(len(names)) for j in range(len(names))]
        self._states = [s.number for s in states]
        self._fixed = {builder.names[name].number: _exact(value) for name, value in parameters.items()}
        jumping = [n.op for n in in_order(self.roots) if n.op not in _OPERATIONS or n.op in _JUMPS]
        self.obstacle = next((op for op in jumping if op not in ("number", "state", "parameter")), "")

    def rates(self, low: np.ndarray, high: np.ndarray) -> Interval:
        """Enclose the rates over boxes with corners `low` and `high`, shape (n, n_states); the result has this shape,
        too.
        """
        return self._of(self.roots, low, high)

    def jacobian(self, low: np.ndarray, high: np.ndarray) -> Interval:
        """Enclose the Jacobian, or the slopes of ``abs``, ``min`` and ``max`` at corners; shape (n, n_states,
        n_states).
        """
        n, found = low.shape[1], self._of(self.slopes, low, high)
        return found[0].reshape(-1, n, n), found[1].reshape(-1, n, n)

    def _of(self, roots: Sequence[Node], low: np.ndarray, high: np.ndarray) -> Interval:
        own = {number: (low[:, i], high[:, i]) for i, number in enumerate(self._states)}
        found = enclosures(self.graph, roots, {**self._fixed, **own})
        shape = low.shape[:1]
        return tuple(np.stack([np.broadcast_to(one[k], shape) for one in found], axis=1) for k in (0, 1))  # type: ignore[return-value]


def enclosures(graph: Graph, roots: Sequence[Node], leaves: Mapping[int, Interval]) -> list[Interval]:
    """Enclose the values of nodes of an expression graph.

    Parameters
    ----------
    graph, roots
        Graph, and the nodes wanted.
    leaves
        Interval of each leaf but numbers, by the node's number.

    Returns
    -------
    list of Interval
        Where a value may leave the domain of a function, the values at the other points of the box.
    """
    known: dict[int, Interval] = dict(leaves)
    with np.errstate(all="ignore"):
        for node in in_order(roots):
            if node.number in known:
                continue
            if node.op == "number":
                known[node.number] = _number(node.value)
            elif node.number in graph.whole_powers:
                base, n = graph.whole_powers[node.number]
                known[node.number] = _whole_power(known[base.number], n)
            elif node.op == "mul" and node.args[0] is node.args[1]:
                known[node.number] = _whole_power(known[node.args[0].number], 2)
            else:
                known[node.number] = _OPERATIONS[node.op](*(known[a.number] for a in node.args))
    return [known[root.number] for root in roots]


def _exact(value: float) -> Interval:
    return np.float64(value), np.float64(value)  # type: ignore[return-value]


def _number(value: float) -> Interval:
    """Enclose a number of the text, which may be the rounded result of numbers that were merged."""
    if value == np.rint(value) and abs(value) < 2.0**31:
        return _exact(value)
    return _widened(*_exact(value))


def _outward(low: Any, high: Any) -> Interval:
    """Widen the result of an operation that is rounded to the nearest number."""
    return np.nextafter(low, -np.inf), np.nextafter(high, np.inf)


def _widened(low: Any, high: Any) -> Interval:
    """Widen the result of a library function; where it is too large for a number, it lies beyond the largest one."""
    most = np.finfo(float).max
    low, high = np.minimum(low, most), np.maximum(high, -most)
    return low - ULPS * _spacing(low), high + ULPS * _spacing(high)


def _spacing(x: Any) -> Any:
    return np.where(np.isfinite(x), np.spacing(np.abs(x)), 0.0)


def add(a: Interval, b: Interval, *more: Interval) -> Interval:
    """Enclose a sum."""
    found = _outward(a[0] + b[0], a[1] + b[1])
    return add(found, *more) if more else found


def negative(a: Interval) -> Interval:
    """Return the negative of an interval."""
    return -a[1], -a[0]


def multiply(a: Interval, b: Interval) -> Interval:
    """Enclose a product; 0 times infinity is 0, as no value is infinite."""
    empty = np.isnan(a[0]) | np.isnan(b[0])
    products = np.array(np.broadcast_arrays(*(x * y for x in a for y in b)))
    products = np.where(np.isnan(products) & ~empty, 0.0, products)
    return _outward(products.min(axis=0), products.max(axis=0))


def inverse(a: Interval) -> Interval:
    """Enclose 1/x: without a bound where the interval has 0 inside, with one bound where 0 is an end of it."""
    low, high = a
    across = (low < 0.0) & (high > 0.0)
    least = np.where(across | (high == 0.0), -np.inf, 1.0 / np.where(high == 0.0, 1.0, high))
    greatest = np.where(across | (low == 0.0), np.inf, 1.0 / np.where(low == 0.0, 1.0, low))
    nothing = (low == 0.0) & (high == 0.0)
    return _outward(np.where(nothing, np.nan, least), np.where(nothing, np.nan, greatest))


def _whole_power(a: Interval, n: int) -> Interval:
    """Enclose a power with a whole exponent above 0, by products of its ends."""
    low, high = a
    if n % 2:
        return _power_of_ends(low, n)[0], _power_of_ends(high, n)[1]
    farthest, nearest = np.maximum(np.abs(low), np.abs(high)), np.minimum(np.abs(low), np.abs(high))
    nearest = np.where((low <= 0.0) & (high >= 0.0), 0.0, nearest)
    return np.maximum(_power_of_ends(nearest, n)[0], 0.0), _power_of_ends(farthest, n)[1]


def _power_of_ends(x: np.ndarray, n: int) -> Interval:
    found = (x, x)
    for _ in range(n - 1):
        found = multiply(found, (x, x))
    return found


def _power(base: Interval, exponent: Interval) -> Interval:
    """Enclose a power of a base above 0, by exponential and logarithm."""
    return _rising(np.exp, 0.0, np.inf)(multiply(exponent, _log(base)))


def _rising(
    function: Callable[[Any], Any], least: float = -np.inf, greatest: float = np.inf
) -> Callable[..., Interval]:
    """Return the enclosure of a rising function with the given least and greatest value."""

    def enclosed(a: Interval) -> Interval:
        low, high = _widened(function(a[0]), function(a[1]))
        return np.maximum(low, least), np.minimum(high, greatest)

    return enclosed


def _within(a: Interval, least: float, greatest: float) -> Interval:
    """Intersect an interval with a function's domain; NaN where they do not meet."""
    outside = (a[1] < least) | (a[0] > greatest) | np.isnan(a[0])
    return tuple(np.where(outside, np.nan, np.clip(end, least, greatest)) for end in a)  # type: ignore[return-value]


def _log(a: Interval) -> Interval:
    low, high = _within(a, 0.0, np.inf)
    nothing = np.isnan(low) | (high == 0.0)
    return tuple(np.where(nothing, np.nan, end) for end in _widened(np.log(low), np.log(high)))  # type: ignore[return-value]


def _sqrt(a: Interval) -> Interval:
    return _rising(np.sqrt, 0.0)(_within(a, 0.0, np.inf))


def _asin(a: Interval) -> Interval:
    return _rising(np.arcsin)(_within(a, -1.0, 1.0))


def _acos(a: Interval) -> Interval:
    low, high = _within(a, -1.0, 1.0)
    return _widened(np.arccos(high), np.arccos(low))


def _cos(a: Interval) -> Interval:
    """Enclose cosines: an end is 1 or -1 if a multiple of pi may lie between the ends."""
    low, high = a
    ends = np.cos(low), np.cos(high)
    least, greatest = _widened(np.minimum(*ends), np.maximum(*ends))
    # more than the error of the quotients up to 1e6
    slack = 1e-9
    first, last = (low - slack) / np.pi, (high + slack) / np.pi
    top = np.floor(last / 2.0) >= np.ceil(first / 2.0)
    bottom = np.floor((last - 1.0) / 2.0) >= np.ceil((first - 1.0) / 2.0)
    far = ~(np.maximum(np.abs(low), np.abs(high)) < 1e6) & ~np.isnan(low)
    return (np.where(bottom | far, -1.0, np.maximum(least, -1.0)), np.where(top | far, 1.0, np.minimum(greatest, 1.0)))


_QUARTER = (np.nextafter(np.pi / 2.0, 0.0), np.nextafter(np.pi / 2.0, 2.0))


def _sin(a: Interval) -> Interval:
    return _cos(add(a, negative(_QUARTER)))


def _tan(a: Interval) -> Interval:
    return multiply(_sin(a), inverse(_cos(a)))


def _cosh(a: Interval) -> Interval:
    low, high = _absolute(a)
    found = _widened(np.cosh(low), np.cosh(high))
    return np.maximum(found[0], 1.0), found[1]


def _absolute(a: Interval) -> Interval:
    low, high = a
    across = (low <= 0.0) & (high >= 0.0)
    return np.where(across, 0.0, np.minimum(np.abs(low), np.abs(high))), np.maximum(np.abs(low), np.abs(high))


def _sign(a: Interval) -> Interval:
    return np.sign(a[0]), np.sign(a[1])


def _less(a: Interval, b: Interval, yes: Interval, no: Interval) -> Interval:
    """Enclose the slope of ``min`` or ``max``: both slopes where the condition holds in a part of the box alone."""
    always, never = a[1] < b[0], a[0] >= b[1]
    return tuple(
        np.where(always, yes[k], np.where(never, no[k], both(yes[k], no[k])))
        for k, both in enumerate((np.minimum, np.maximum))
    )  # type: ignore[return-value]


def _minimum(a: Interval, b: Interval) -> Interval:
    return np.minimum(a[0], b[0]), np.minimum(a[1], b[1])


def _maximum(a: Interval, b: Interval) -> Interval:
    return np.maximum(a[0], b[0]), np.maximum(a[1], b[1])


_OPERATIONS: dict[str, Callable[..., Interval]] = {
    "add": add,
    "neg": negative,
    "mul": multiply,
    "div": lambda a, b: multiply(a, inverse(b)),
    "power": _power,
    "held": lambda a: a,
    "sqrt": _sqrt,
    "exp": _rising(np.exp, 0.0),
    "log": _log,
    "sin": _sin,
    "cos": _cos,
    "tan": _tan,
    "asin": _asin,
    "acos": _acos,
    "atan": _rising(np.arctan),
    "sinh": _rising(np.sinh),
    "cosh": _cosh,
    "tanh": _rising(np.tanh, -1.0, 1.0),
    "absolute": _absolute,
    "minimum": _minimum,
    "maximum": _maximum,
    "sign": _sign,
    "less": _less,
}

_JUMPS = ("sign", "less")
"""Operations that slopes may have but rates may not: there they jump."""
