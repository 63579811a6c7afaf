"""Digests of what sources mean, so that an edited sentence is not another program."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from pathlib import Path

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def meaning(source: str) -> str:
    """Return a text that is the same for two sources that differ in comments, docstrings or layout alone.

    Strings that stand as statements by themselves count as docstrings, wherever they are.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED):
            node.body = [s for s in node.body if not _is_text(s)] or [ast.Pass()]
    return ast.dump(tree)


def _is_text(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def meaning_digest(paths: Iterable[Path]) -> str:
    """Digest of the meaning of Python files and the bytes of others, in the order given; 16 hex digits.

    File names count, folders do not: a package that is moved as a whole is the same.
    """
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0")
        data = meaning(path.read_text("utf-8")).encode() if path.suffix == ".py" else path.read_bytes()
        digest.update(hashlib.sha256(data).digest())
    return digest.hexdigest()[:16]
