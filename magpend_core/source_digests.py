"""Compute digests of the source code of users' own models, so that stored results can be compared with it.

Two sources mean the same if they differ in comments, docstrings, layout, or the wording of errors alone. A
run that was begun with one is completed with the other. magpend's own code has numbers, see `magpend_core.versions`.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

_WITHOUT_MEANING = ("type_comment", "kind", "ctx")


def meaning_digest(paths: Iterable[Path]) -> str:
    """Return a digest of what Python sources do, independent of comments, docstrings and location.

    Left out are comments, docstrings and other bare strings, layout and line numbers, and what errors say
    (their types count). Names count, and so does the order of statements.

    Parameters
    ----------
    paths
        Files, and folders for all ``*.py`` below them, in any order. A file counts with its name, one in a
        folder with its path from there; what is not Python, with its bytes.

    Returns
    -------
    str
        16 hexadecimal digits, the same with every version of Python that reads the sources alike.

    Raises
    ------
    OSError
        If a file cannot be read.
    SyntaxError
        If one is not Python.
    """
    digest = hashlib.sha256()
    for name, path in sorted(_files(paths)):
        content = path.read_bytes()
        meaning = _python_meaning(content) if path.suffix == ".py" else hashlib.sha256(content).digest()
        digest.update(name.encode() + b"\0" + meaning)
    return digest.hexdigest()[:16]


@cache  # a command asks for the same modules several times
def _python_meaning(source: bytes) -> bytes:
    tokens: list[str] = []
    _write(ast.parse(source), tokens)
    return hashlib.sha256("".join(tokens).encode()).digest()


def _files(paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    for path in paths:
        if path.is_dir():
            for file in path.rglob("*.py"):
                yield f"{path.name}/{file.relative_to(path).as_posix()}", file
        else:
            yield path.name, path


def _write(node: object, out: list[str]) -> None:
    """Append the text of a syntax tree to `out`, without docstrings and error messages.

    `ast.dump` would do but for its changes from one version of Python to the next: empty fields come and
    go, new ones are added.
    """
    if isinstance(node, ast.AST):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node = ast.Raise(node.exc.func, node.cause)
        out.append(f"{type(node).__name__}(")
        for field in node._fields:
            value = getattr(node, field, None)
            if value is not None and value != [] and field not in _WITHOUT_MEANING:
                out.append(f"{field}=")
                _write(value, out)
        out.append(")")
    elif isinstance(node, list):
        out.append("[")
        for entry in node:
            if not _is_remark(entry):
                _write(entry, out)
        out.append("]")
    else:
        out.append(f"{node!r},")


def _is_remark(node: object) -> bool:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return isinstance(node.value.value, str) or node.value.value is ...
    return isinstance(node, ast.Pass)
