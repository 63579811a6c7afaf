"""The house: no room knows what is another's, and no function or module outgrows its reader."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from magpend_core.models import load_model, model_names
from magpend_core.models.text.views import DEFAULT_PRESET

ROOT = Path(__file__).parents[1]
PIPELINE = sorted((ROOT / "pipeline").rglob("*.py"))
CORE = sorted((ROOT / "magpend_core").rglob("*.py"))
MAX_FUNCTION, MAX_MODULE = 60, 450

# every model as text has a preset of the name that is left out, which is a common word
PRESETS = "|".join(
    sorted({p for name in model_names() for p in load_model(name).preset_names} - {DEFAULT_PRESET})
)
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
    "pipeline/report/torque_curves.py": ("its magnets", "reports on the fit of that measurement"),
    "pipeline/cli/main.py": ("its magnets", "lists the command of that measurement"),
    "pipeline/cli/magnet.py": ("its magnets", "is the command of that measurement"),
}
"""Files, or folders of them, that may name one part of one model, and why."""

LONG_MODULES = {
    "magpend_core/engine/lanes.py": "the engine's template: one compiled unit",
}


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", PIPELINE, ids=name_of)
def test_pipeline__knows_no_model(path):
    """Nothing outside a model's own room names its states, its parts or its presets."""
    name = name_of(path)
    allowed = {what for at, (what, _) in KNOWS_A_PART.items() if name == at or name.startswith(f"{at}/")}
    found = {
        what: sorted({match[0] for match in re.finditer(pattern, path.read_text("utf-8"))})
        for what, pattern in PENDULUM.items()
        if what not in allowed
    }
    assert not {what: words for what, words in found.items() if words}


@pytest.mark.parametrize("path", [*PIPELINE, *CORE], ids=name_of)
def test_module__is_not_too_long(path):
    if name_of(path) not in LONG_MODULES:
        assert len(path.read_text("utf-8").splitlines()) <= MAX_MODULE


@pytest.mark.parametrize("path", PIPELINE, ids=name_of)
def test_function__is_not_too_long(path):
    """Docstrings do not count: they say what a reader needs."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef):
            first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
            length = (node.end_lineno or 0) - first.lineno + 1
            assert length <= MAX_FUNCTION, f"{node.name}: {length} lines"


def test_exceptions__are_still_needed():
    for name in LONG_MODULES:
        assert len((ROOT / name).read_text("utf-8").splitlines()) > MAX_MODULE, name


def test_exceptions__have_files():
    for name in KNOWS_A_PART:
        assert (ROOT / name).exists(), name
