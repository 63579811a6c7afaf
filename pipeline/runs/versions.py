"""Compute the version of an analysis as a digest of the code that it uses, so that other edits keep results valid."""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path

from magpend_core.source_digests import meaning_digest
from pipeline.products.registry import ANALYSES

_ROOT = Path(__file__).parents[2]
_COUNTED = ("pipeline.analysis", "pipeline.layout.vocabulary")


@cache
def code_version(name: str) -> str:
    """Return a digest of the code that an analysis' numbers depend on.

    It covers the numerical core, the modules of `pipeline.analysis` that the analysis imports, directly or
    not, and those of the analyses that it builds on. Comments, docstrings and the wording of errors do not
    count.
    """
    from magpend_core import kernel_version

    digest = hashlib.sha256(kernel_version().encode())
    for module in sorted(modules_of(name)):
        digest.update(f"{module} {meaning_digest([_file(module)])}\n".encode())
    return digest.hexdigest()[:16]


def modules_of(name: str) -> set[str]:
    """Return the modules of `pipeline.analysis` that an analysis imports, directly or not."""
    analysis = ANALYSES[name]
    found: set[str] = set()
    left = [analysis.compute.partition(":")[0]]
    while left:
        module = left.pop()
        if module not in found:
            found.add(module)
            left += _imports(module)
    for other in analysis.builds_on:
        found |= modules_of(other)
    return found


@cache
def _imports(module: str) -> tuple[str, ...]:
    """Return the modules that a module imports, as far as they affect the version of an analysis."""
    names: list[str] = []
    for node in ast.walk(ast.parse(_file(module).read_bytes())):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
    return tuple(n for n in names if n.startswith(_COUNTED) and _is_module(n))


def _is_module(name: str) -> bool:
    try:
        return _file(name).is_file()
    except FileNotFoundError:
        return False


def _file(module: str) -> Path:
    path = _ROOT.joinpath(*module.split("."))
    for file in (path.with_suffix(".py"), path / "__init__.py"):
        if file.is_file():
            return file
    raise FileNotFoundError(path)
