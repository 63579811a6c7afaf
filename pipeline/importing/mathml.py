"""Turn the formulas of SBML, as libsbml reads them, into trees of magpend's text language."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import libsbml

from magpend_core.models.text.grammar import Tree
from pipeline.importing.drive import TIME
from pipeline.importing.expressions import MAX_DEPTH, PI, RefusedError, as_condition, compared, number

_CALLS = {
    libsbml.AST_FUNCTION_ABS: "abs",
    libsbml.AST_FUNCTION_ARCCOS: "acos",
    libsbml.AST_FUNCTION_ARCSIN: "asin",
    libsbml.AST_FUNCTION_ARCTAN: "atan",
    libsbml.AST_FUNCTION_CEILING: "ceil",
    libsbml.AST_FUNCTION_COS: "cos",
    libsbml.AST_FUNCTION_COSH: "cosh",
    libsbml.AST_FUNCTION_EXP: "exp",
    libsbml.AST_FUNCTION_FLOOR: "floor",
    libsbml.AST_FUNCTION_LN: "log",
    libsbml.AST_FUNCTION_MAX: "max",
    libsbml.AST_FUNCTION_MIN: "min",
    libsbml.AST_FUNCTION_SIN: "sin",
    libsbml.AST_FUNCTION_SINH: "sinh",
    libsbml.AST_FUNCTION_TAN: "tan",
    libsbml.AST_FUNCTION_TANH: "tanh",
}
_INVERSES = {libsbml.AST_FUNCTION_SEC: "cos", libsbml.AST_FUNCTION_CSC: "sin", libsbml.AST_FUNCTION_COT: "tan"}
_RELATIONS = {
    libsbml.AST_RELATIONAL_EQ: "==",
    libsbml.AST_RELATIONAL_GEQ: ">=",
    libsbml.AST_RELATIONAL_GT: ">",
    libsbml.AST_RELATIONAL_LEQ: "<=",
    libsbml.AST_RELATIONAL_LT: "<",
    libsbml.AST_RELATIONAL_NEQ: "!=",
}
_NUMBERS = (libsbml.AST_INTEGER, libsbml.AST_REAL, libsbml.AST_REAL_E, libsbml.AST_RATIONAL)
_CONSTANTS = {
    libsbml.AST_CONSTANT_E: math.e,
    libsbml.AST_CONSTANT_TRUE: 1.0,
    libsbml.AST_CONSTANT_FALSE: 0.0,
    libsbml.AST_NAME_AVOGADRO: 6.02214179e23,  # the value that SBML Level 3 defines
}
_POWERS = (libsbml.AST_POWER, libsbml.AST_FUNCTION_POWER)


def own_name(name: str) -> str:
    """Return the name in a `Source` of an identifier: one that has a meaning in formulas there gets an underscore."""
    return f"{name}_" if name in (TIME, "pi") else name


def tree_of(node: Any, depth: int = 0) -> Tree:
    """Return the tree of a formula.

    Raises
    ------
    RefusedError
        If a part of it has no meaning in a model as text.
    """
    if depth > MAX_DEPTH:
        raise RefusedError(f"the formula is nested more than {MAX_DEPTH} deep")
    kind = node.getType()
    if kind in _NUMBERS or kind in _CONSTANTS:
        return _number(_CONSTANTS.get(kind, node.getValue()))
    if kind == libsbml.AST_NAME_TIME:
        return Tree("name", 1, TIME)
    if kind == libsbml.AST_CONSTANT_PI:
        return PI
    if kind == libsbml.AST_NAME:
        return Tree("name", 1, own_name(node.getName()))
    args = [tree_of(node.getChild(i), depth + 1) for i in range(node.getNumChildren())]
    if kind == libsbml.AST_FUNCTION_PIECEWISE:
        return _piecewise(args)
    if kind in _RELATIONS:
        pairs = [compared(_RELATIONS[kind], number(a), number(b)) for a, b in pairwise(args)]
        return _joined("and", pairs)
    if kind in (libsbml.AST_LOGICAL_AND, libsbml.AST_LOGICAL_OR):
        return _joined("and" if kind == libsbml.AST_LOGICAL_AND else "or", [as_condition(a) for a in args])
    if kind == libsbml.AST_LOGICAL_NOT:
        return Tree("not", 1, "", (as_condition(args[0]),))
    return _arithmetic(node, kind, [number(a) for a in args])


def _arithmetic(node: Any, kind: int, args: list[Tree]) -> Tree:
    if kind in (libsbml.AST_PLUS, libsbml.AST_TIMES):
        of_sum = kind == libsbml.AST_PLUS
        return _joined("sum" if of_sum else "product", args) if args else _number(0.0 if of_sum else 1.0)
    if kind == libsbml.AST_MINUS:
        last = Tree("negative", 1, "", (args[-1],))
        return last if len(args) == 1 else Tree("sum", 1, "", (args[0], last))
    if kind == libsbml.AST_DIVIDE:
        return Tree("product", 1, "", (args[0], _inverse(args[1])))
    if kind in _POWERS:
        return Tree("power", 1, "", tuple(args))
    if kind == libsbml.AST_FUNCTION_ROOT:
        degree, of = args if len(args) == 2 else (_number(2.0), args[0])
        if degree == _number(2.0):
            return Tree("call", 1, "sqrt", (of,))
        return Tree("power", 1, "", (of, _inverse(degree)))
    if kind == libsbml.AST_FUNCTION_LOG:
        base, of = args if len(args) == 2 else (_number(10.0), args[0])
        if base == _number(10.0):
            return Tree("call", 1, "log10", (of,))
        return Tree("product", 1, "", (Tree("call", 1, "log", (of,)), _inverse(Tree("call", 1, "log", (base,)))))
    if kind in _INVERSES:
        return _inverse(Tree("call", 1, _INVERSES[kind], tuple(args)))
    if kind in _CALLS:
        return Tree("call", 1, _CALLS[kind], tuple(args))
    if kind == libsbml.AST_FUNCTION:
        return Tree("call", 1, node.getName(), tuple(args))
    what = node.getOperatorName() or node.getName() or "a symbol"
    raise RefusedError(f"{what}: the text of a model has no such function")


def _number(value: float) -> Tree:
    if not math.isfinite(value):
        raise RefusedError(f"the number {value} is not finite")
    positive = Tree("number", 1, abs(float(value)))
    return positive if value >= 0.0 else Tree("negative", 1, "", (positive,))


def _inverse(tree: Tree) -> Tree:
    return Tree("inverse", 1, "", (tree,))


def _joined(kind: str, args: list[Tree]) -> Tree:
    if not args:
        raise RefusedError("a comparison or condition has nothing to compare")
    return args[0] if len(args) == 1 else Tree(kind, 1, "", tuple(args))


def _piecewise(args: list[Tree]) -> Tree:
    """Return ``where`` calls for value, condition, value, ..., otherwise."""
    if len(args) % 2 == 0:
        raise RefusedError("piecewise without otherwise has no value where no condition holds")
    tree = number(args[-1])
    for i in range(len(args) - 3, -1, -2):
        condition = as_condition(args[i + 1])
        tree = Tree("call", 1, "where", (condition, number(args[i]), tree))
    return tree
