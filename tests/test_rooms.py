"""The house: no room knows what is another's, and no function or module outgrows its reader."""

from __future__ import annotations

import ast
import graphlib
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest

from magpend_core.models import load_model, model_names
from magpend_core.models.text.views import DEFAULT_PRESET

ROOT = Path(__file__).parents[1]
PIPELINE = sorted((ROOT / "pipeline").rglob("*.py"))
CORE = sorted((ROOT / "magpend_core").rglob("*.py"))
MAX_FUNCTION, MAX_MODULE, MAX_IMPORTS = 60, 640, 25
LEAST_MODULE = 60
"""Lines below which a module that one other alone imports is a fragment of it."""

# every model as text has a preset of the name that is left out, which is a common word
PRESETS = "|".join(sorted({p for name in model_names() for p in load_model(name).preset_names} - {DEFAULT_PRESET}))
PENDULUM = {
    "a state of the pendulum": r"(?<![A-Za-z])psi",
    # files and branches have links, too; these are the pendulum's
    "its links": r"[\"'`]links?[\"'`]|\blinks? [12]\b|\(cell, link\)|two links",
    "its arms": r"\bl1\b|\bl2\b|arm length",
    "its magnets": r"\bmagnets?\b",
    "the number of its states": r"range\(4\)",
    "a preset": rf"\b({PRESETS})\b",
}

KNOWS_A_PART = {
    "pipeline/rig/__init__.py": ("its magnets", "says that the measurement of their torque is here"),
    "pipeline/rig/magnet": ("its magnets", "the paper's measurement of their torque, named for it"),
    "pipeline/rig/commands": ("its magnets", "has the command of that measurement"),
    "pipeline/rig/plugin.py": ("its magnets", "lists the command of that measurement"),
}
"""Files, or folders of them, that may name one part of one model, and why."""

LONG_MODULES = {"magpend_core/engine/lanes.py": "the engine's template: one compiled unit"}

LEAVES = {
    "magpend_core.models.text.runtime": "what generated code calls",
    "magpend_core.models.text.writing": "the inverse of reading",
    "pipeline.cli.report": "a command",
    "pipeline.explorer.notebook": "is imported where the packages of the widget are missing",
}
"""Short modules with one importer that have an idea of their own."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.slow
def test_pipeline__knows_no_model():
    """Nothing outside a model's own room names its states, its parts or its presets."""
    assert {name_of(path): words for path in PIPELINE if (words := words_of_a_model(path))} == {}


def words_of_a_model(path: Path) -> dict[str, list[str]]:
    """Words of one model that a file uses and may not."""
    name, text = name_of(path), path.read_text("utf-8")
    allowed = {what for at, (what, _) in KNOWS_A_PART.items() if name == at or name.startswith(f"{at}/")}
    found = {
        what: sorted({match[0] for match in re.finditer(pattern, text)})
        for what, pattern in PENDULUM.items()
        if what not in allowed
    }
    return {what: words for what, words in found.items() if words}


def test_modules__are_not_too_long():
    lengths = {name_of(path): len(path.read_text("utf-8").splitlines()) for path in (*PIPELINE, *CORE)}
    assert {n: lines for n, lines in lengths.items() if lines > MAX_MODULE and n not in LONG_MODULES} == {}


@pytest.mark.slow
def test_functions__are_not_too_long():
    """Docstrings do not count: they say what a reader needs."""
    assert {name: n for path in PIPELINE for name, n in lengths_in(path) if n > MAX_FUNCTION} == {}


def lengths_in(path: Path) -> Iterator[tuple[str, int]]:
    """Names and lengths of a file's functions."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef):
            first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
            yield f"{name_of(path)}: {node.name}", (node.end_lineno or 0) - first.lineno + 1


def test_tolerances__of_the_analyses_stand_in_one_table():
    table = ROOT / "pipeline" / "results" / "tolerances.py"
    own = re.compile(r"^[A-Z_, ]*RTOL[A-Z_, ]* = ", re.MULTILINE)
    others = [path for path in PIPELINE if table.parent in path.parents and path != table]
    assert own.search(table.read_text("utf-8"))
    assert [name_of(path) for path in others if own.search(path.read_text("utf-8"))] == []


def test_numbers__have_a_name_for_each_meaning():
    """The names of numbers that modules hold; what somebody might choose is a field of a method's settings instead."""
    named = Counter(name for path in PIPELINE for name in numbers_in(path))
    assert {name for name, n in named.items() if n > 1} == set()


def numbers_in(path: Path) -> Iterator[str]:
    """Names of a module's constants that are numbers, or tuples of them."""
    for node in ast.parse(path.read_text("utf-8")).body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        parts = list(ast.walk(node.value)) if targets and node.value is not None else []
        is_number = any(isinstance(part, ast.Constant) and type(part.value) in (int, float) for part in parts)
        if is_number and not any(isinstance(part, (ast.Dict, ast.Call)) for part in parts):
            names = (part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name))
            yield from (name for name in names if name.isupper())


@pytest.fixture(scope="module")
def graph():
    """Which modules each module imports; imports inside functions and for types count too."""
    modules = {module_of(path): path for path in (*PIPELINE, *CORE)}
    return {name: set(imported_by(path, modules)) - {name} for name, path in modules.items()}


@pytest.mark.slow
def test_imports__make_no_circle(graph):
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the circle


@pytest.mark.slow
def test_modules__import_few_others(graph):
    assert {name for name, others in graph.items() if len(others) > MAX_IMPORTS} == set()


@pytest.mark.slow
def test_modules__are_no_fragments_of_their_one_importer(graph):
    named = "".join(path.read_text("utf-8") for path in PIPELINE)
    importers = Counter(name for others in graph.values() for name in others)
    # a declaration names the module of its functions
    alone = {name for name, n in importers.items() if n == 1 and not re.search(rf'"{name}[":]', named)}
    short = {name for name in alone if lines_of(name) < LEAST_MODULE}
    assert short == set(LEAVES)


def lines_of(module: str) -> int:
    path = ROOT / module.replace(".", "/")
    return len((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8").splitlines())


def module_of(path: Path) -> str:
    return name_of(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imported_by(path: Path, modules: Collection[str]) -> Iterator[str]:
    """Names of the modules that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            of_names = {name for alias in node.names if (name := f"{node.module}.{alias.name}") in modules}
            yield from of_names or {node.module} & set(modules)


def test_exceptions__are_still_needed_and_have_files():
    assert [name for name in LONG_MODULES if len((ROOT / name).read_text("utf-8").splitlines()) <= MAX_MODULE] == []
    assert [name for name in KNOWS_A_PART if not (ROOT / name).exists()] == []
