"""Write out what stands for several terms in an expression: calls of the text's functions, indices and sums."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, replace

from magpend_core.models.text.grammar import GrammarError, Tree
from magpend_core.models.text.numeric import value_of

MAX_PARTS = 400_000
"""Numbers, names and operations of all expressions that are written out."""
MAX_WRITTEN = 300
"""Nesting of an expression that is written out."""


@dataclass(frozen=True)
class Function:
    """A function that a model's text defines: the names of its arguments, and its body."""

    arguments: tuple[str, ...]
    body: Tree


def _is_short(tree: Tree, functions: Container[str]) -> bool:
    own = tree.kind in ("index", "total") or (tree.kind == "call" and tree.value in functions)
    return own or any(_is_short(arg, functions) for arg in tree.args)


class Writing:
    """Writer of the expressions of a text, without calls of its functions, indices and sums.

    Attributes
    ----------
    functions : dict of str to Function
        Functions by name; none may need itself.
    """

    def __init__(self) -> None:
        self.functions: dict[str, Function] = {}
        self._known: Container[str] = ()
        self._parts = 0

    def out(self, tree: Tree, known: Container[str], indices: Mapping[str, int] | None = None) -> Tree:
        """Return an expression that is written out.

        Parameters
        ----------
        tree
            Expression whose calls have the right numbers of arguments.
        known
            Names that elements with an index may have.
        indices
            Value of the key's index by its name.

        Raises
        ------
        GrammarError
            If there is no such element, an index is no whole number, or the expressions become too large.
        """
        if not indices and not _is_short(tree, self.functions):
            return tree
        self._known = known
        return self.tree(tree, {name: _number(k, 1) for name, k in (indices or {}).items()}, 1)

    def tree(self, tree: Tree, values: Mapping[str, Tree], depth: int) -> Tree:
        """Return an expression, a part of another one, with values in place of names."""
        self._parts += 1
        if self._parts > MAX_PARTS or depth > MAX_WRITTEN:
            few = f"the text has more than {MAX_PARTS} parts"
            what = few if self._parts > MAX_PARTS else f"is nested more than {MAX_WRITTEN} deep"
            raise GrammarError(f"{what} when calls and sums are written out; use define for parts")
        if tree.kind == "name":
            return values.get(str(tree.value), tree)
        if tree.kind == "index":
            return self.element(tree, values, depth)
        if tree.kind == "total":
            return self.total(tree, values, depth)
        if not tree.args:
            return tree
        args = tuple(self.tree(arg, values, depth + 1) for arg in tree.args)
        if tree.kind == "call" and tree.value in self.functions:
            called = self.functions[str(tree.value)]
            return self.tree(called.body, dict(zip(called.arguments, args, strict=True)), depth + 1)
        return replace(tree, args=args)

    def element(self, tree: Tree, values: Mapping[str, Tree], depth: int) -> Tree:
        """Return the name of an element, such as ``x3`` for ``x[i + 1]`` where i is 2."""
        place = f"{tree.value}[...] at character {tree.at}"
        k = self.whole(tree.args[0], values, depth, f"the index of {place}")
        name = f"{tree.value}{k}"
        if k < 0 or name not in self._known:
            at = ", ".join(f"{v} = {t.value:g}" for v, t in values.items() if t.kind == "number")
            raise GrammarError(
                f"{place} is {tree.value}[{k}]{' at ' if at else ''}{at}, which does not exist; give the ends "
                "equations of their own, or close a ring of n: x[mod(i, n) + 1] is after x[i], x[mod(i - 2, n) + 1] "
                "before it"
            )
        return Tree("name", tree.at, name)

    def total(self, tree: Tree, values: Mapping[str, Tree], depth: int) -> Tree:
        """Return the terms of a sum, joined."""
        place = f"the sum at character {tree.at}"
        low, high = (self.whole(arg, values, depth, f"the range of {place}") for arg in tree.args[:2])
        terms = []
        for k in range(low, high + 1):
            inner = {**values, str(tree.value): _number(k, tree.at)}
            terms.append(self.tree(tree.args[2], inner, depth + 1))
        return terms[0] if len(terms) == 1 else Tree("sum", tree.at, "", tuple(terms)) if terms else _number(0, tree.at)

    def whole(self, tree: Tree, values: Mapping[str, Tree], depth: int, what: str) -> int:
        """Return the value of an index."""
        try:
            value = float(value_of(self.tree(tree, values, depth + 1), {}))
        except KeyError as error:
            raise GrammarError(f"{what} needs {error}; it can have whole numbers and indices alone") from None
        if not value.is_integer():
            raise GrammarError(f"{what} is {value:g}; it must be a whole number")
        return int(value)


def _number(value: int, at: int) -> Tree:
    number = Tree("number", at, float(abs(value)))
    return number if value >= 0 else Tree("negative", at, "", (number,))
