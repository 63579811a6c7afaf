"""Evaluate expressions with numpy, as they were written, without compiling or deriving anything.

What opening and drawing a run need of a model; and what derived and compiled functions are checked against.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from magpend_core.expressions.graph import Node, in_order
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import Tree


def _square(phase: Any, duty: Any) -> Any:
    return np.where(phase - np.floor(phase) < duty, 1.0, -1.0)


def _power(base: Any, exponent: Any) -> Any:
    return np.power(np.asarray(base, np.float64), exponent)


def _fold(function: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def over_all(first: Any, *rest: Any) -> Any:
        for other in rest:
            first = function(first, other)
        return first

    return over_all


CALLS: dict[str, Callable[..., Any]] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "log10": np.log10,
    "sign": np.sign,
    "heaviside": lambda x: np.heaviside(x, 1.0),
    "floor": np.floor,
    "ceil": np.ceil,
    "mod": np.mod,
    "min": _fold(np.minimum),
    "max": _fold(np.maximum),
    "where": np.where,
    "square": _square,
}
"""numpy's function for each of `grammar.FUNCTIONS`."""

_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}

_JOIN: dict[str, Callable[..., Any]] = {
    "sum": _fold(np.add),
    "product": _fold(np.multiply),
    "and": _fold(np.logical_and),
    "or": _fold(np.logical_or),
    "negative": np.negative,
    "not": np.logical_not,
    "power": _power,
}


def value_of(tree: Tree, names: Mapping[str, Any]) -> Any:
    """Compute the value of a parsed expression for given values of its names.

    Parameters
    ----------
    tree
        A number or a condition.
    names
        Values of all names in it: numbers or arrays that broadcast.

    Returns
    -------
    ndarray or number
        Not finite where the expression is not, without a warning.
    """
    with np.errstate(all="ignore"):
        return _value(tree, names)


def rates_of(definition: Definition, names: Mapping[str, Any]) -> dict[str, Any]:
    """Compute the rates of all states, by name, for given values of the states, the parameters and the time."""
    known = dict(names)
    for name in definition.used(definition.equations.values()):
        if name in definition.define:
            known[name] = value_of(definition.define[name], known)
    return {name: value_of(tree, known) for name, tree in definition.equations.items()}


def _value(tree: Tree, names: Mapping[str, Any]) -> Any:
    if tree.kind == "number":
        return np.float64(tree.value)
    if tree.kind == "name":
        return names[str(tree.value)]
    if tree.kind == "product":
        return _product(tree, names)
    args = [_value(arg, names) for arg in tree.args]
    if tree.kind == "call":
        return CALLS[str(tree.value)](*args)
    if tree.kind == "compare":
        return _COMPARE[str(tree.value)](*args)
    return _JOIN[tree.kind](*args)


def _product(tree: Tree, names: Mapping[str, Any]) -> Any:
    """Compute a product, with multiplications and divisions in the order of the text."""
    value = _value(tree.args[0], names)
    for part in tree.args[1:]:
        if part.kind == "inverse":
            value = np.divide(value, _value(part.args[0], names))
        else:
            value = np.multiply(value, _value(part, names))
    return value


_NODES: dict[str, Callable[..., Any]] = {
    **CALLS,
    "add": _fold(np.add),
    "mul": np.multiply,
    "div": np.divide,
    "neg": np.negative,
    "power": _power,
    "absolute": np.abs,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "held": lambda x: x,
    "less": lambda a, b, yes, no: np.where(a < b, yes, no),
    "choice": lambda side, yes, no: np.where(side > 0.0, yes, no),
}


def node_values(roots: Sequence[Node], leaves: Mapping[int, Any]) -> list[Any]:
    """Compute the values of nodes of an expression graph.

    Parameters
    ----------
    roots
        What is wanted.
    leaves
        Value of each leaf but numbers, by the node's number.
    """
    known: dict[int, Any] = dict(leaves)
    with np.errstate(all="ignore"):
        for node in in_order(roots):
            if node.number in known:
                continue
            if node.op == "number":
                known[node.number] = np.float64(node.value)
            else:
                known[node.number] = _NODES[node.op](*(known[a.number] for a in node.args))
    return [known[root.number] for root in roots]
