"""Spell traced numbers as expressions of a model's text, with parts that have names.

Parts are the variables of the function that has been traced, under their own names, and what the equations need more
than once. Brackets stand where the grammar needs them: the text reads back to the operations that were traced.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core.models.text.grammar import name_problem
from magpend_core.models.text.reading import MAX_DEFINED, OF_RUNS
from magpend_core.models.text.tracing import CONDITIONS, Sheet, Traced

SHARED_SIZE = 4
"""Operations of an expression from which on it becomes a part if it is needed more than once."""
LONG, DEEP = 3000, 50
"""Characters and nesting of an expression that is split, well below the grammar's limits."""
_MULTIPLES = (1, 2, 3, 4, 5, 6, 8, 10, 12, 180)
_JOINT, _SUM, _PRODUCT, _SIGN, _POWER, _ATOM = range(6)


@dataclass(frozen=True, slots=True)
class _Text:
    """Text of an expression, how strongly its outermost operator binds, and how deep it is nested."""

    text: str
    binding: int = _ATOM
    depth: int = 1


def spelled(
    roots: Sequence[Traced], variables: Mapping[str, Any], taken: Sequence[str]
) -> tuple[list[str], dict[str, str]]:
    """Return the texts of expressions, and the parts that these use, by name.

    Parameters
    ----------
    roots
        The expressions.
    variables
        Values of the variables of the function; those that are traced lend their names to parts.
    taken
        Names that have a meaning already.
    """
    sheet = Sheet()
    numbers = [sheet.number(root) for root in roots]
    uses = _uses(sheet, numbers)
    names = _names(sheet, numbers, uses, variables, taken)
    texts: dict[int, _Text] = {}
    define: dict[str, str] = {}
    reserved = {*taken, *variables, *names.values()}
    for i in sorted(uses):
        op, value, args = sheet.nodes[i]
        found = _SPELL[op](value, [texts[a] for a in args])
        part = names.get(i)
        if part is None and op not in CONDITIONS and (len(found.text) > LONG or found.depth > DEEP):
            part = _numbered(reserved)
        if part is not None:
            define[part], found = found.text, _Text(part)
        texts[i] = found
    return [texts[i].text for i in numbers], define


def _uses(sheet: Sheet, roots: Sequence[int]) -> dict[int, int]:
    """Return how often each expression stands in others that the roots need, or is a root."""
    uses = dict.fromkeys(roots, 0)
    for root in roots:
        uses[root] += 1
    for i in range(len(sheet.nodes) - 1, -1, -1):
        if i in uses:
            for arg in sheet.nodes[i][2]:
                uses[arg] = uses.get(arg, 0) + 1
    return uses


def _names(
    sheet: Sheet, roots: Sequence[int], uses: Mapping[int, int], variables: Mapping[str, Any], taken: Sequence[str]
) -> dict[int, str]:
    """Return the name of each expression that becomes a part."""
    sizes: list[int] = []
    for _, _, args in sheet.nodes:
        sizes.append(min(sum(1 + sizes[a] for a in args), 10**9))
    names: dict[int, str] = {}
    shared: dict[int, str] = {i: "" for i, n in uses.items() if n > 1 and sizes[i] >= SHARED_SIZE}
    for label, (node, is_own) in _labels(variables).items():
        i = sheet.number(node)
        op, _, args = sheet.nodes[i]
        is_sign = op == "negative" and not sheet.nodes[args[0]][2]
        is_part = i in uses and bool(args) and op not in CONDITIONS and not is_sign and i not in names
        is_rate = i in roots and uses[i] == 1
        if not is_part or is_rate or label in taken or label in OF_RUNS or name_problem(label) is not None:
            continue
        if is_own:
            names[i] = label
        elif shared.get(i) == "":
            shared[i] = label
    reserved = {*taken, *variables, *names.values(), *shared.values()}
    saved = {i: (uses[i] - 1) * sizes[i] for i in shared if i not in names and sheet.nodes[i][0] not in CONDITIONS}
    kept = sorted(saved, key=lambda i: -saved[i])[: max(0, MAX_DEFINED - 10 - len(names))]
    return names | {i: shared[i] or _numbered(reserved) for i in sorted(kept)}


def _labels(variables: Mapping[str, Any]) -> dict[str, tuple[Traced, bool]]:
    """Return the traced numbers among variables by name, and whether each is a variable or an element of one.

    The elements of a vector ``F`` are ``F1``, ``F2``, ..., those of a matrix ``M`` are ``M1_1``, ``M1_2``, ...
    """
    found: dict[str, tuple[Traced, bool]] = {}
    for label, value in variables.items():
        if isinstance(value, np.ndarray) and value.ndim == 0:
            value = value[()]
        if isinstance(value, Traced):
            found[label] = value, True
        elif isinstance(value, np.ndarray | list | tuple):
            for k, element in enumerate(value, 1):
                if isinstance(element, Traced):
                    found[f"{label}{k}"] = element, False
                elif isinstance(element, np.ndarray | list | tuple):
                    rows = {f"{label}{k}_{j}": v for j, v in enumerate(element, 1) if isinstance(v, Traced)}
                    found |= {name: (v, False) for name, v in rows.items()}
    return found


def _numbered(reserved: set[str]) -> str:
    k = 1
    while (name := f"part{k}") in reserved:
        k += 1
    reserved.add(name)
    return name


# ---- texts of operations ---------------------------------------------------------------------------


def _number(value: Any, args: list[_Text]) -> _Text:
    if value < 0.0:
        inner = _number(-value, args)
        return _Text(f"-{inner.text}", min(_SIGN, inner.binding))
    for k in _MULTIPLES:  # the same number to the last bit
        if value == k * math.pi:
            return _Text("pi") if k == 1 else _Text(f"{k}*pi", _PRODUCT, 2)
        if value == math.pi / k:
            return _Text(f"pi/{k}", _PRODUCT, 2)
    return _Text(str(int(value)) if value.is_integer() and value < 1e15 else repr(value))


def _within(inner: _Text, least: int) -> str:
    return inner.text if inner.binding >= least else f"({inner.text})"


def _sum(value: Any, args: list[_Text]) -> _Text:
    left, right = args
    depth = max(left.depth, right.depth + 2)
    text = _within(right, _PRODUCT)
    sign = "-" if text.startswith("-") else "+"
    return _Text(f"{left.text} {sign} {text.removeprefix('-')}", _SUM, depth)


def _negative(value: Any, args: list[_Text]) -> _Text:
    (inner,) = args
    # in a sum the sign is the sum's, and -a*b is read as (-a)*b, which is the same number
    return _Text(f"-{_within(inner, _PRODUCT)}", min(_SIGN, max(inner.binding, _PRODUCT)), inner.depth + 1)


def _product(value: Any, args: list[_Text]) -> _Text:
    return _factors(args, "*")


def _quotient(value: Any, args: list[_Text]) -> _Text:
    return _factors(args, "/")


def _factors(args: list[_Text], sign: str) -> _Text:
    left, right = args
    text = f"{_within(left, _PRODUCT)}{sign}{_within(right, _POWER)}"
    return _Text(text, _PRODUCT, max(left.depth + (left.binding < _PRODUCT), right.depth + 2))


def _power(value: Any, args: list[_Text]) -> _Text:
    base, exponent = args
    text = f"{_within(base, _ATOM)}**{_within(exponent, _ATOM)}"
    return _Text(text, _POWER, max(base.depth, exponent.depth) + 2)


def _call(value: Any, args: list[_Text]) -> _Text:
    return _Text(f"{value}({', '.join(a.text for a in args)})", _ATOM, max(a.depth for a in args) + 2)


def _compare(value: Any, args: list[_Text]) -> _Text:
    left, right = args
    return _Text(f"{left.text} {value} {right.text}", _SUM, max(left.depth, right.depth) + 2)


def _joined(word: str) -> Any:
    def join(value: Any, args: list[_Text]) -> _Text:
        return _Text(f" {word} ".join(_within(a, _SUM) for a in args), _JOINT, max(a.depth for a in args) + 2)

    return join


def _not(value: Any, args: list[_Text]) -> _Text:
    return _Text(f"not ({args[0].text})", _JOINT, args[0].depth + 2)


_SPELL: dict[str, Any] = {
    "number": _number,
    "name": lambda value, args: _Text(str(value)),
    "sum": _sum,
    "negative": _negative,
    "product": _product,
    "quotient": _quotient,
    "power": _power,
    "call": _call,
    "compare": _compare,
    "and": _joined("and"),
    "or": _joined("or"),
    "not": _not,
}
