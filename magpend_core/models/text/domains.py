"""Find the parts of a model's expressions that have no finite value, and the arguments for which that happens.

Looked for before anything is derived or compiled, by numpy on the text as it was written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import Tree, names
from magpend_core.models.text.numeric import value_of

MAX_FAULTS = 20
"""Most faults that are told; there is rarely more than one."""


@dataclass(frozen=True)
class Fault:
    """A part of a model's text that has no finite value, with the reason and the values at which it happens.

    Attributes
    ----------
    place : str
        Key of the text, such as ``equations.v``.
    part : str
        The expression, as it was understood.
    why : str
        What is wrong with it, such as "division by 0".
    row : int
        First of the points at which it happens.
    values : dict
        Values there of the names in the part.
    count : int
        Number of the points at which it happens.
    is_constant : bool
        Whether it needs neither state nor time: then it is no matter of the start.
    """

    place: str
    part: str
    why: str
    row: int
    values: Mapping[str, float]
    count: int
    is_constant: bool = False


def domain_faults(definition: Definition, values: Mapping[str, Any]) -> list[Fault]:
    """Find the innermost parts of a model's equations that have no finite value.

    Parameters
    ----------
    definition
        The text.
    values
        States, parameters, ``t``, ``f`` and ``phase`` by name, arrays (n,).

    Returns
    -------
    list of Fault
        The innermost part of each, in the order of the text. A branch of `where` counts at the points where
        it is taken; in parts without states and time, which impacts and quantities have too, also where the
        state may take it later.
    """
    return (_constant_faults(definition, values) or _start_faults(definition, values))[:MAX_FAULTS]


def _constant_faults(definition: Definition, values: Mapping[str, Any]) -> list[Fault]:
    """Find parts of a model's text that depend on neither state nor time and have no finite value."""
    places = {f"equations.{name}": tree for name, tree in definition.equations.items()}
    for i, impact in enumerate(definition.impacts):
        places[f"impacts[{i}].of"] = impact.of
        places |= {f"impacts[{i}].set.{name}": tree for name, tree in impact.set.items()}
    places |= {f"quantities.{name}": tree for name, tree in definition.quantities.items()}
    changing = {"t", *({"phase"} & definition.timed), *(s.name for s in definition.states)}
    fixed = {name: np.asarray(v, np.float64) for name, v in values.items() if name not in changing}
    known: dict[str, Any] = {"pi": np.pi, **fixed}
    used = [name for name in definition.used(places.values()) if name in definition.define]
    for name in used:
        if _is_constant(definition.define[name], known):
            known[name] = value_of(definition.define[name], known)
    every = np.ones(max((v.size for v in fixed.values()), default=1), bool)
    found: list[Fault] = []
    for place, tree in {**{f"define.{name}": definition.define[name] for name in used}, **places}.items():
        before = len(found)
        _look_at_constants(tree, place, {"pi": np.pi}, every, found, guards=False)
        if len(found) == before:
            _look_at_constants(tree, place, known, every, found, guards=True)
    return [replace(fault, is_constant=True) for fault in found]


def _is_constant(tree: Tree, known: Mapping[str, Any]) -> bool:
    return all(name in known for name, _ in names(tree))


def _look_at_constants(
    tree: Tree, place: str, known: Mapping[str, Any], rows: np.ndarray, found: list[Fault], *, guards: bool
) -> None:
    """Append a fault for each part of an expression that uses only known names and has no finite value.

    With `guards` a branch of `where` counts where a condition of known names takes it.
    """
    if _is_constant(tree, known) and (guards or not _has_guards(tree)):
        _look(tree, place, known, rows, found)
        return
    for arg in tree.args if tree.kind == "product" else ():
        if arg.kind == "inverse" and _is_constant(arg, known):
            zero = rows & (_values(arg.args[0], known, rows) == 0.0)
            if zero.any():
                found.append(_fault(tree, place, "division by 0", zero, known))
    is_guard = guards and tree.kind == "call" and tree.value == "where" and _is_constant(tree.args[0], known)
    taken = _taken(tree, known, rows) if is_guard else [rows] * len(tree.args)
    for arg, own in zip(tree.args, taken, strict=True):
        _look_at_constants(arg, place, known, own, found, guards=guards)


def _has_guards(tree: Tree) -> bool:
    return (tree.kind == "call" and tree.value == "where") or any(map(_has_guards, tree.args))


def _start_faults(definition: Definition, values: Mapping[str, Any]) -> list[Fault]:
    """Find parts of the equations that have no finite value at the initial states."""
    known: dict[str, Any] = {"pi": np.pi, **{name: np.asarray(v, np.float64) for name, v in values.items()}}
    n = max((v.size for v in known.values() if isinstance(v, np.ndarray)), default=1)
    equations = {f"equations.{name}": tree for name, tree in definition.equations.items()}
    defined = [name for name in definition.used(equations.values()) if name in definition.define]
    for name in defined:
        known[name] = value_of(definition.define[name], known)
    every = np.ones(n, bool)
    bad = np.zeros(n, bool)
    for tree in equations.values():
        bad |= ~np.isfinite(_values(tree, known, every))
    if not bad.any():
        return []
    places = {**{f"define.{name}": definition.define[name] for name in defined}, **equations}
    found: list[Fault] = []
    for place, tree in places.items():
        _look(tree, place, known, bad, found)
    return found


def _look(tree: Tree, place: str, known: Mapping[str, Any], rows: np.ndarray, found: list[Fault]) -> np.ndarray:
    """Append a `Fault` for each innermost part of an expression that is not finite; return a mask of the sample points
    concerned.
    """
    if tree.kind == "inverse":  # told with its product
        return _look(tree.args[0], place, known, rows, found)
    bad = np.zeros(rows.shape, bool)
    for arg, own in zip(tree.args, _taken(tree, known, rows), strict=True):
        bad |= _look(arg, place, known, own, found)
    if tree.kind == "product":
        parts = [arg.args[0] for arg in tree.args if arg.kind == "inverse"]
        for part in parts:
            zero = rows & ~bad & (_values(part, known, rows) == 0.0)
            if zero.any():
                found.append(_fault(tree, place, "division by 0", zero, known))
                bad |= zero
    value = _values(tree, known, rows)
    is_number = value.dtype.kind == "f"
    new = rows & ~bad & ~np.isfinite(value) if is_number else np.zeros(rows.shape, bool)
    if new.any() and tree.kind != "name":  # a name without a value has been told where it is defined
        found.append(_fault(tree, place, _why(tree, known, new), new, known))
    return bad | (new if is_number else False)


def _taken(tree: Tree, known: Mapping[str, Any], rows: np.ndarray) -> list[np.ndarray]:
    """Return, for each argument of an expression, a mask of the sample points at which its value is used. `where` uses
    one branch per point.
    """
    if tree.kind == "call" and tree.value == "where":
        chosen = np.broadcast_to(value_of(tree.args[0], known), rows.shape).astype(bool)
        return [rows, rows & chosen, rows & ~chosen]
    return [rows] * len(tree.args)


def _values(tree: Tree, known: Mapping[str, Any], rows: np.ndarray) -> np.ndarray:
    return np.broadcast_to(np.asarray(value_of(tree, known)), rows.shape)


def _why(tree: Tree, known: Mapping[str, Any], new: np.ndarray) -> str:
    row = int(np.argmax(new))
    args = [] if tree.kind == "product" else [float(_values(arg, known, new)[row]) for arg in tree.args]
    if tree.kind == "call" and tree.value == "mod" and args[1] == 0.0:
        return "remainder of a division by 0"
    if tree.kind == "call" and tree.value in ("log", "log10") and args[0] <= 0.0:
        return f"logarithm of {args[0]:.6g}"
    if tree.kind == "call" and tree.value == "sqrt" and args[0] < 0.0:
        return f"square root of {args[0]:.6g}"
    if tree.kind == "call" and tree.value in ("asin", "acos"):
        return f"{tree.value} of {args[0]:.6g}, which is not between -1 and 1"
    if tree.kind == "power" and args[0] == 0.0:
        return f"0 to the power {args[1]:.6g}"
    if tree.kind == "power" and args[0] < 0.0 and not args[1].is_integer():
        return f"{args[0]:.6g} to the power {args[1]:.6g}, which is no whole number"
    return "too large a number"


def _fault(tree: Tree, place: str, why: str, rows: np.ndarray, known: Mapping[str, Any]) -> Fault:
    row = int(np.argmax(rows))
    involved = dict.fromkeys(name for name, _ in names(tree) if name != "pi" and name in known)
    values = {name: float(np.broadcast_to(known[name], rows.shape)[row]) for name in involved}
    return Fault(place, readable(tree), why, row, values, int(rows.sum()))


_BINDING = {"or": 0, "and": 1, "compare": 3, "sum": 4, "negative": 4, "product": 5, "power": 6}


def readable(tree: Tree) -> str:
    """Write an expression as readable text, with brackets only where needed and with short numbers."""
    return _readable(tree, 0)


def _readable(tree: Tree, least: int) -> str:
    if tree.kind == "number":
        text = f"{float(tree.value):.15g}"
        return f"({text})" if text.startswith("-") and least > 4 else text
    if tree.kind == "name":
        return str(tree.value)
    if tree.kind == "call":
        return f"{tree.value}({', '.join(readable(arg) for arg in tree.args)})"
    if tree.kind == "not":
        return f"not {_readable(tree.args[0], 7)}"
    # a sign that comes first binds the whole product like a sum
    own = _BINDING["negative" if tree.kind == "product" and tree.args[0].kind == "negative" else tree.kind]
    text = _joined(tree, own)
    return f"({text})" if own < least else text


def _joined(tree: Tree, own: int) -> str:
    if tree.kind == "negative":
        return f"-{_readable(tree.args[0], 5)}"
    if tree.kind == "power":
        return f"{_readable(tree.args[0], 7)}**{_readable(tree.args[1], 7)}"
    if tree.kind == "compare":
        return f" {tree.value} ".join(_readable(arg, own + 1) for arg in tree.args)
    if tree.kind in ("and", "or"):
        return f" {tree.kind} ".join(_readable(arg, own + 1) for arg in tree.args)
    less = "negative" if tree.kind == "sum" else "inverse"
    plus, minus = (" + ", " - ") if tree.kind == "sum" else ("*", "/")
    inner = _BINDING[tree.kind] + (tree.kind == "product")
    first, *rest = tree.args
    text = "1/" + _readable(first.args[0], 6) if first.kind == "inverse" else _readable(first, own)
    for arg in rest:
        is_less = arg.kind == less
        part = _readable(arg.args[0], _BINDING[tree.kind] + 1) if is_less else _readable(arg, inner)
        text += (minus if is_less else plus) + part
    return text
