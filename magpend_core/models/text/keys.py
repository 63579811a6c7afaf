"""Read the keys of tables that stand for several names, ``x[i=1..20]``, or for a function, ``g(u, v)``."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from magpend_core.models.text.grammar import Tree

_KEY = re.compile(r"\s*(?P<name>\w+)\s*(?:\[(?P<index>[^\[\]]*)\]|\((?P<arguments>[^()]*)\))?\s*")
_INDEX = re.compile(r"\s*(?:(?P<variable>[A-Za-z]\w*)\s*=\s*)?(?P<low>\d{1,6})\s*(?:\.\.\s*(?P<high>\d{1,6})\s*)?")
MAX_ELEMENTS = 1024
"""Names that one key can stand for."""
_FORM = "must be one number or a range, such as x[1], x[1..20] or x[i=1..20]"


@dataclass(frozen=True)
class Key:
    """What a key of a table stands for.

    Attributes
    ----------
    text : str
        The key as it is written.
    name : str
        Name without index and arguments; the whole key if it has no such form.
    arguments : tuple of str or None
        Names of the arguments of a function; None for no function.
    variable : str
        Name of the index on the right side; empty for none.
    indices : range or None
        Values of the index; None for a single name.
    problem : str
        What is wrong with the index; empty for nothing.
    """

    text: str
    name: str
    arguments: tuple[str, ...] | None = None
    variable: str = ""
    indices: range | None = None
    problem: str = ""

    @property
    def elements(self) -> Iterator[tuple[str, dict[str, int]]]:
        """Names that the key stands for, each with the value of the index."""
        if self.indices is None:
            yield self.name, {}
        for k in self.indices or ():
            yield f"{self.name}{k}", {self.variable: k} if self.variable else {}


@dataclass(frozen=True)
class Line:
    """A definition or an equation as it is written: its key, its text, and its expression with calls and sums."""

    key: Key
    text: str
    tree: Tree


def calls(tree: Tree, functions: Container[str]) -> Iterator[str]:
    """Yield the names of the functions among `functions` that an expression calls."""
    if tree.kind == "call" and tree.value in functions:
        yield str(tree.value)
    for arg in tree.args:
        yield from calls(arg, functions)


def read_key(text: str) -> Key:
    """Read a key; what has no index and no arguments is a name as it is."""
    match = _KEY.fullmatch(text)
    if match is None or (match["index"] is None and match["arguments"] is None):
        return Key(text, text)
    if match["arguments"] is not None:
        return Key(text, match["name"], tuple(arg.strip() for arg in match["arguments"].split(",")))
    index = _INDEX.fullmatch(match["index"])
    if index is None:
        return Key(text, match["name"], problem=f"the index [{match['index'][:40]}] {_FORM}")
    low, high = int(index["low"]), int(index["high"] or index["low"])
    if high - low >= MAX_ELEMENTS:
        return Key(text, match["name"], problem=f"has {high - low + 1} elements; {MAX_ELEMENTS} are the most")
    if not low <= high:
        return Key(text, match["name"], problem=f"the range {low}..{high} is empty; begin with the lower number")
    return Key(text, match["name"], None, index["variable"] or "", range(low, high + 1))


def flat(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with one entry for each name that its keys stand for, such as ``x1`` to ``x20`` for ``x[1..20]``.

    A list of as many values as there are names gives one to each.
    """
    found: dict[str, Any] = {}
    for text, value in table.items():
        key = read_key(text)
        values = value.get("value") if isinstance(value, Mapping) else value
        elements = list(key.elements)
        if key.indices is None or not isinstance(values, list | tuple) or len(values) != len(elements):
            found |= {name: value for name, _ in elements}
        elif isinstance(value, Mapping):
            found |= {name: {**value, "value": v} for (name, _), v in zip(elements, values, strict=True)}
        else:
            found |= dict(zip((name for name, _ in elements), values, strict=True))
    return found
