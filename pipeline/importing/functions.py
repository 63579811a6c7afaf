"""Write out the functions of a file where they are called."""

from __future__ import annotations

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import MAX_DEPTH, MAX_NODES, RefusedError, replaced, rewritten, size
from pipeline.importing.source import Source

MOST_REPEATED = 6
"""Nodes of a function's right side up to which it is written out everywhere."""


class Functions:
    """Writes out the functions of a source; a call with names alone becomes a named part if `parts` are given."""

    def __init__(self, source: Source, parts: dict[str, Tree] | None = None) -> None:
        self.source, self.parts = source, parts
        self.named: dict[tuple[str, tuple[str, ...]], str] = {}
        self.under_way: list[str] = []
        self.nodes = 0

    def written_out(self, tree: Tree) -> Tree:
        """Return a tree without calls of the source's functions.

        Raises
        ------
        RefusedError
            If a function needs itself, has other arguments, or makes the tree too long.
        """
        return rewritten(tree, self._written)

    def _written(self, node: Tree) -> Tree:
        if node.kind != "call" or node.value not in self.source.functions:
            return node
        name = str(node.value)
        args, body = self.source.functions[name]
        if name in self.under_way:
            raise RefusedError(f"the function {name} needs itself")
        if len(self.under_way) >= MAX_DEPTH:
            raise RefusedError(f"functions are nested more than {MAX_DEPTH} deep")
        if len(node.args) != len(args):
            raise RefusedError(f"{name} has {len(node.args)} arguments; it takes {len(args)}")
        plain = tuple(str(arg.value) for arg in node.args if arg.kind == "name")
        if (name, plain) in self.named and len(plain) == len(args):
            return Tree("name", node.at, self.named[name, plain])
        self.under_way.append(name)
        body = self.written_out(replaced(body, dict(zip(args, node.args, strict=True))))
        self.under_way.pop()
        self.nodes += size(body)
        if self.nodes > MAX_NODES:
            raise RefusedError("functions make the equations too long")
        if self.parts is None or len(plain) < len(args) or size(body) <= MOST_REPEATED:
            return body
        return Tree("name", node.at, self._part(name, plain, body))

    def _part(self, name: str, plain: tuple[str, ...], body: Tree) -> str:
        """Make a call of a function, whose arguments are names, a part with a name, and return this name."""
        assert self.parts is not None
        first = all(known != name for known, _ in self.named)
        new = name if first else "_".join((name, *plain))
        while new in self.parts or (new in self.source.lines and new != name):
            new += "_"
        self.named[name, plain] = new
        self.parts[new] = body
        if new != name:
            self.source.lines.setdefault(new, self.source.line_of(name))
            self.source.spelling.setdefault(new, "_".join(map(self.source.spelled, (name, *plain))))
        return new
