"""Write expressions as LaTeX in their original form and order."""

from __future__ import annotations

import re
from collections.abc import Mapping

from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.keys import Key

_OR, _AND, _COMPARE, _SUM, _PRODUCT, _POWER, _ATOM = range(7)
_GREEK = (
    "alpha",
    "beta",
    "gamma",
    "delta",
    "epsilon",
    "zeta",
    "eta",
    "theta",
    "iota",
    "kappa",
    "lambda",
    "mu",
    "nu",
    "xi",
    "pi",
    "rho",
    "sigma",
    "tau",
    "phi",
    "chi",
    "psi",
    "omega",
    "Gamma",
    "Delta",
    "Theta",
    "Lambda",
    "Xi",
    "Pi",
    "Sigma",
    "Phi",
    "Psi",
    "Omega",
)
_NAMED = {
    "asin": r"\arcsin",
    "acos": r"\arccos",
    "atan": r"\arctan",
    "sinh": r"\sinh",
    "cosh": r"\cosh",
    "tanh": r"\tanh",
    "sin": r"\sin",
    "cos": r"\cos",
    "tan": r"\tan",
    "log": r"\ln",
    "log10": r"\log_{10}",
    "min": r"\min",
    "max": r"\max",
    "sign": r"\operatorname{sign}",
    "heaviside": r"\Theta",
    "mod": r"\operatorname{mod}",
    "atan2": r"\operatorname{atan2}",
    "square": r"\operatorname{square}",
}
_SIGNS = {"<": "<", "<=": r"\le", ">": ">", ">=": r"\ge"}


def latex_of(tree: Tree, symbols: Mapping[str, str]) -> str:
    """Return the LaTeX of an expression, without dollar signs.

    Parameters
    ----------
    tree
        What was read.
    symbols
        LaTeX by name; other names are spelled from their letters, see `symbol_of`.
    """
    return _written(tree, symbols)[0]


def equations_of(definition: Definition) -> list[str]:
    """Return lines of LaTeX: the definitions that the equations use, then the time derivative of each state."""
    symbols = {s.name: s.symbol for s in definition.states if s.symbol}
    symbols |= {p.name: p.symbol for p in definition.parameters if p.symbol}
    rates = {line.key.text: line for line in (definition.lines[name] for name in definition.equations)}
    parts = definition.lines_of(definition.dynamics)
    lines = [f"{_left(line.key, symbols)} &= {latex_of(line.tree, symbols)}{_range(line.key)}" for line in parts]
    for line in rates.values():
        symbol = _left(line.key, symbols)
        rate = rf"{{{symbol}}}'" if definition.is_map else rf"\frac{{\mathrm{{d}}{symbol}}}{{\mathrm{{d}}t}}"
        lines.append(f"{rate} &= {latex_of(line.tree, symbols)}{_range(line.key)}")
    return lines


def _left(key: Key, symbols: Mapping[str, str]) -> str:
    """Return the LaTeX of what a key stands for."""
    if key.arguments is not None:
        return rf"{symbol_of(key.name, symbols)}\left({', '.join(symbol_of(a, {}) for a in key.arguments)}\right)"
    if key.indices is None or len(key.indices) == 1:
        return symbol_of(next(name for name, _ in key.elements), symbols)
    return _with_index(key.name, symbol_of(key.variable or "i", {}), symbols)


def _with_index(name: str, index: str, symbols: Mapping[str, str]) -> str:
    """Return the LaTeX of an element with an index: that of the name, or of its rate, with a subscript."""
    symbol = symbols.get(f"{name}1", "")
    if symbol.endswith("_{1}"):
        return f"{symbol.removesuffix('_{1}')}_{{{index}}}"
    head = symbol_of(name, symbols)
    return f"{head.removesuffix('}')},{index}}}" if "_{" in head else f"{head}_{{{index}}}"


def _range(key: Key) -> str:
    """Return the LaTeX of the values of an index, behind an equation of several elements."""
    if key.indices is None or len(key.indices) == 1:
        return ""
    return rf", \quad {symbol_of(key.variable or 'i', {})} = {key.indices[0]}, \dots, {key.indices[-1]}"


def symbol_of(name: str, symbols: Mapping[str, str]) -> str:
    """Return the LaTeX symbol of a name: the user's own symbol, or a Greek letter or word with a subscript."""
    if name in symbols:
        return symbols[name]
    head, _, index = name.partition("_")
    if not index and (found := re.fullmatch(r"([A-Za-z]+?)(\d+)", name)):
        head, index = found[1], found[2]
    head = "\\" + head if head in _GREEK else _upright(head)
    return head if not index else f"{head}_{{{_upright(index.replace('_', ','))}}}"


def _upright(word: str) -> str:
    return word if len(word) == 1 else rf"\mathrm{{{word}}}"


def _written(tree: Tree, symbols: Mapping[str, str]) -> tuple[str, int]:
    """Return the LaTeX of an expression, and how strongly its outermost operator binds."""
    if tree.kind == "number":
        return _number(float(tree.value))
    if tree.kind == "name":
        return symbol_of(str(tree.value), symbols), _ATOM
    if tree.kind == "product":
        return _product(tree, symbols)
    if tree.kind == "call":
        return _call(tree, symbols), _ATOM
    if tree.kind == "power":
        base, exponent = tree.args
        return f"{_in(base, symbols, _ATOM)}^{{{latex_of(exponent, symbols)}}}", _POWER
    if tree.kind == "sum":
        return _sum(tree, symbols), _SUM
    if tree.kind == "negative":
        return f"-{_in(tree.args[0], symbols, _PRODUCT)}", _SUM
    if tree.kind == "index":
        return _with_index(str(tree.value), latex_of(tree.args[0], {}), symbols), _ATOM
    if tree.kind == "total":
        low, high, term = latex_of(tree.args[0], {}), latex_of(tree.args[1], {}), _in(tree.args[2], symbols, _PRODUCT)
        return rf"\sum_{{{symbol_of(str(tree.value), {})}={low}}}^{{{high}}} {term}", _SUM
    if tree.kind == "compare":
        left, right = (_in(arg, symbols, _SUM) for arg in tree.args)
        return f"{left} {_SIGNS[str(tree.value)]} {right}", _COMPARE
    if tree.kind == "not":
        return rf"\neg {_in(tree.args[0], symbols, _ATOM)}", _ATOM
    binds, sign = (_AND, r" \land ") if tree.kind == "and" else (_OR, r" \lor ")
    return sign.join(_in(arg, symbols, binds + 1) for arg in tree.args), binds


def _in(tree: Tree, symbols: Mapping[str, str], least: int) -> str:
    """Return a subexpression's LaTeX, in brackets if its operator binds less tightly than the surrounding one requires
    (`least`).
    """
    text, binds = _written(tree, symbols)
    return text if binds >= least else rf"\left({text}\right)"


def _number(value: float) -> tuple[str, int]:
    digits, _, power = f"{value:.15g}".partition("e")
    if not power:
        return digits, _ATOM if value >= 0 else _SUM
    tens = f"10^{{{int(power)}}}"
    return (tens if digits == "1" else rf"{digits} \cdot {tens}"), _PRODUCT


def _sum(tree: Tree, symbols: Mapping[str, str]) -> str:
    text = _in(tree.args[0], symbols, _SUM)
    for arg in tree.args[1:]:
        is_less = arg.kind == "negative"
        part = _in(arg.args[0] if is_less else arg, symbols, _PRODUCT)
        text += f" {'-' if is_less else '+'} {part}"
    return text


def _product(tree: Tree, symbols: Mapping[str, str]) -> tuple[str, int]:
    above = [arg for arg in tree.args if arg.kind != "inverse"]
    below = [arg.args[0] for arg in tree.args if arg.kind == "inverse"]
    if not below:
        return _times(above, symbols), _SUM if above[0].kind == "negative" else _PRODUCT
    numerator = "1" if not above else _alone(above, symbols)
    return rf"\frac{{{numerator}}}{{{_alone(below, symbols)}}}", _PRODUCT


def _alone(parts: list[Tree], symbols: Mapping[str, str]) -> str:
    return latex_of(parts[0], symbols) if len(parts) == 1 else _times(parts, symbols)


def _times(parts: list[Tree], symbols: Mapping[str, str]) -> str:
    texts = [_in(part, symbols, _PRODUCT) for part in parts]
    if parts[0].kind == "negative":  # a sign that comes first needs no brackets
        texts[0] = latex_of(parts[0], symbols)
    # two numbers side by side would be read as one
    joined = texts[0]
    for text in texts[1:]:
        joined += (r" \cdot " if text[0].isdigit() else r" \, ") + text
    return joined


def _call(tree: Tree, symbols: Mapping[str, str]) -> str:
    args, name = [latex_of(arg, symbols) for arg in tree.args], str(tree.value)
    if tree.value == "sqrt":
        return rf"\sqrt{{{args[0]}}}"
    if tree.value == "abs":
        return rf"\left|{args[0]}\right|"
    if tree.value in ("floor", "ceil"):
        return rf"\left\l{tree.value} {args[0]} \right\r{tree.value}"
    if tree.value == "exp":
        return rf"\mathrm{{e}}^{{{args[0]}}}"
    if tree.value == "where":
        condition, first, second = args
        return rf"\begin{{cases}} {first} & \text{{if }} {condition} \\ {second} & \text{{else}} \end{{cases}}"
    return rf"{_NAMED.get(name, symbol_of(name, symbols))}\left({', '.join(args)}\right)"
