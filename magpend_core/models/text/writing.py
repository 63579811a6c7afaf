"""Write expression trees as text in one canonical form, the same for texts that differ only in spaces and brackets."""

from __future__ import annotations

from collections.abc import Callable

from magpend_core.models.text.grammar import Tree


def written(tree: Tree) -> str:
    """Write an expression tree as text in one canonical form, which parses to the same tree."""
    return _WRITE[tree.kind](tree, [written(arg) for arg in tree.args])


def _write_call(tree: Tree, args: list[str]) -> str:
    return f"{tree.value}({','.join(args)})"


def _joined(sign: str) -> Callable[[Tree, list[str]], str]:
    return lambda tree, args: f"({sign.join(args)})"


def _write_product(tree: Tree, args: list[str]) -> str:
    # an inverse writes its sign itself; one that stands first needs something to divide
    text = "".join(a if i == 0 or a.startswith("/") else f"*{a}" for i, a in enumerate(args))
    return f"({text})"


_WRITE: dict[str, Callable[[Tree, list[str]], str]] = {
    "number": lambda tree, args: repr(tree.value),
    "name": lambda tree, args: str(tree.value),
    "call": _write_call,
    "sum": _joined("+"),
    "product": _write_product,
    "negative": lambda tree, args: f"(-{args[0]})",
    "inverse": lambda tree, args: f"/{args[0]}",
    "power": lambda tree, args: f"({args[0]}**{args[1]})",
    "compare": lambda tree, args: f"({args[0]}{tree.value}{args[1]})",
    "and": _joined(" and "),
    "or": _joined(" or "),
    "not": lambda tree, args: f"(not {args[0]})",
}
