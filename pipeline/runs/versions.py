"""Tell which stored results of analyses hold: the versions of their code, and the attractors that they rest on."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from magpend_core.source_digests import meaning_digest
from pipeline.products.attractors import AttractorOptions
from pipeline.products.product import Analysis, Options
from pipeline.products.registry import ANALYSES
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.run import Run

OF_ATTRACTORS = "attractors.json"

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


def attractor_options(run: Run) -> AttractorOptions:
    """Return the options of the run's attractors: those last given, or the defaults."""
    try:
        return AttractorOptions.model_validate_json(run.info.files.below(DERIVED).read(OF_ATTRACTORS))
    except FileNotFoundError:
        return AttractorOptions()
    except ValueError:
        raise DamagedError(f"{run.name}: {DERIVED}/{OF_ATTRACTORS} is damaged; remove it.") from None


def current(run: Run, name: str) -> dict[str, str]:
    """Return the attributes of those results of an analysis that hold for the present cells and attractors of a run."""
    rests = rests_on_attractors(name)
    options = json.dumps(attractor_options(run).changed(), sort_keys=True) if rests else ""
    found = {"derived_product": name, "cube_digest": run.digest, "analysis_version": code_version(name)}
    return {**found, "attractor_options": options}


def rests_on_attractors(name: str) -> bool:
    """Return whether an analysis takes the run's attractors as they are."""
    return any(one == "attractors" or rests_on_attractors(one) for one in ANALYSES[name].builds_on)


def key_of(current: Mapping[str, str], analysis: Analysis, options: Options) -> dict[str, str]:
    """Return the attributes of a result that hold everything which decides its numbers.

    Parameters
    ----------
    current
        What holds for the present cells and attractors of the run, see `current`.
    analysis, options
        The analysis with its options.
    """
    plain = {name: value for name, value in options.plain().items() if name not in analysis.ignores}
    parts = {**current, "derived_options": json.dumps(plain, sort_keys=True)}
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}
