"""Read equations that a program assigns one after the other, as MATLAB, Fortran and C do."""

from __future__ import annotations

import re
from collections.abc import Mapping

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import ZERO, Dialect, Parser, RefusedError, names_in, number, replaced, rewritten
from pipeline.importing.numbers import constant
from pipeline.importing.source import Source

MOST_INDEX = 1000
"""Highest index of a variable or parameter."""
_WHOLE_DIVISION = re.compile(r"(?<![\w.])\d+\s*/\s*\d+(?![\w.])")


class Procedure:
    """The assignments of a function, in their order.

    Parameters
    ----------
    arrays
        Kind of each array by its name: ``state``, ``parameter`` or ``rate``.
    base
        Index of the first element.
    spelled
        Names of functions here by their names in the file.
    """

    def __init__(
        self, source: Source, dialect: Dialect, arrays: Mapping[str, str], base: int, spelled: Mapping[str, str]
    ) -> None:
        self.source, self.dialect, self.arrays, self.base, self.spelled = source, dialect, arrays, base, spelled
        self.values: dict[str, Tree] = {}
        self.rates: dict[int, Tree] = {}
        self.states: dict[int, str] = {}
        self.parameters: dict[int, str] = {}

    def element(self, kind: str, index: int) -> str:
        """Return the name of an element of an array of states or parameters, which exists from then on."""
        if not self.base <= index < MOST_INDEX + self.base:
            raise RefusedError(f"the index {index} is out of bounds")
        table = self.states if kind == "state" else self.parameters
        return table.setdefault(index, f"{'u' if kind == 'state' else 'par'}{index - self.base + 1}")

    def tree(self, text: str, *, whole_numbers: bool = False) -> Tree:
        """Parse an expression, with the elements of arrays as names and the values of earlier assignments."""
        if whole_numbers and (match := _WHOLE_DIVISION.search(text)):
            raise RefusedError(f"{match[0]} divides whole numbers, which drops the rest; write {match[0]}.0")
        tree = number(Parser(text, self.dialect, {}).whole())
        return replaced(rewritten(tree, self._named), self.values)

    def _named(self, node: Tree) -> Tree:
        if node.kind != "call":
            return node
        name = str(node.value)
        kind = self.arrays.get(name)
        if kind in ("state", "parameter"):
            (index,) = node.args if len(node.args) == 1 else (ZERO,)
            if index.kind != "number" or len(node.args) != 1:
                raise RefusedError(f"{name} must have a number as its index")
            return Tree("name", node.at, self.element(kind, int(float(index.value))))
        if name in ("pow", "power") and len(node.args) == 2:
            return Tree("power", node.at, "", node.args)
        return Tree("call", node.at, self.spelled.get(name, name), node.args)

    def assign(self, line: int, target: str, index: int | None, tree: Tree) -> None:
        """Take an assignment to an element of the rates, or to a variable of the function."""
        if self.arrays.get(target) == "rate" and index is not None:
            if index in self.rates:
                raise RefusedError(f"{target}({index}) is assigned twice")
            self.element("state", index)
            self.rates[index] = tree
            self.source.lines[f"rate {index}"] = line
            return
        if index is not None or target in self.arrays:
            raise RefusedError(f"{target} is no variable that can be assigned here")
        elements = {**{n: "state" for n in self.states.values()}, **{n: "parameter" for n in self.parameters.values()}}
        if tree.kind == "name" and str(tree.value) in elements and str(tree.value) not in self.source.spelling:
            self.source.spelling[str(tree.value)] = target  # a name for an element
            self.values[target] = tree
            return
        name = target
        while name in self.source.parts or name in elements:
            name += "_"
        self.source.parts[name] = tree
        self.source.lines[name] = line
        self.source.spelling[name] = target
        self.values[target] = Tree("name", 1, name)

    def finish(self, starts: Mapping[int, Tree], values: Mapping[int, Tree]) -> None:
        """Put states, parameters and their values into the source."""
        source = self.source
        if not self.rates:
            source.refuse(1, "no equations were found")
        for index, name in sorted(self.states.items()):
            if index not in self.rates:
                source.refuse(1, f"there is no equation of variable {index - self.base + 1}")
            source.lines[name] = source.lines.get(f"rate {index}", 1)
            source.states[name] = self.rates.get(index, ZERO)
        unknown = []
        for index, name in sorted(self.parameters.items()):
            source.parameters[name] = 1.0
            if index in values:
                source.parameters[name] = self._constant(values[index])
            else:
                unknown.append(source.spelled(name))
        if unknown:
            source.notes.append(f"the file has no values of {', '.join(unknown)}: 1 stands for each; give your own.")
        for index, tree in starts.items():
            if index in self.states:
                source.starts[self.states[index]] = self._constant(tree)

    def _constant(self, tree: Tree) -> float:
        try:
            return constant(self.source, tree, {})
        except RefusedError:
            names = ", ".join(sorted(names_in(tree))) or "it"
            self.source.notes.append(f"a value of the starting point depends on {names}, and is left at 0.")
            return 0.0
