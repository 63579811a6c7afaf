"""Compute the version of an analysis from the code that it uses, so that edits elsewhere keep its results valid."""

from __future__ import annotations

import ast
import hashlib
import json
from functools import cache
from pathlib import Path

from magpend_core.source_digests import meaning_digest
from pipeline.products.product import Analysis, Options
from pipeline.products.registry import ANALYSES

_ROOT = Path(__file__).parents[2]
_COUNTED = ("pipeline.analysis", "pipeline.layout.vocabulary")


@cache
def code_version(name: str) -> str:
    """Return a digest of the code that decides the numbers of an analysis.

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
    """Return the modules that an analysis imports, directly or indirectly."""
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
    """Return the modules that a module imports and that count for the version of an analysis."""
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


def key_of(digest: str, analysis: Analysis, options: Options) -> dict[str, str]:
    """Return the attributes of a result that hold everything which decides its numbers, given the cells' digest."""
    plain = {name: value for name, value in options.plain().items() if name not in analysis.ignores}
    parts = {
        "derived_product": analysis.name,
        "derived_options": json.dumps(plain, sort_keys=True),
        "cube_digest": digest,
        "analysis_version": code_version(analysis.name),
    }
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}
