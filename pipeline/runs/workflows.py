"""Find what is to be run: a file, or a workflow that ships."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path

from pipeline.spec.parsing import IDENTIFICATION
from pipeline.spec.problems import SpecError, unknown_name


def find_spec(name: str | Path) -> Path:
    """Return the path of a specification: a file, or the bare name of one that ships.

    Raises
    ------
    SpecError
        If there is neither.
    """
    path = Path(name)
    if path.exists() or path.suffix or len(path.parts) > 1:
        return path
    shipped = {**shipped_workflows(), **shipped_identifications()}
    if str(name) in shipped:
        return shipped[str(name)]
    raise SpecError([f"{name}: no such file; {unknown_name('workflow', str(name), shipped)}"])


def shipped_workflows() -> dict[str, Path]:
    """Paths of the workflows that ship with magpend, by name: what ``magpend run`` takes."""
    return {name: path for name, path in _shipped().items() if not _identifies(path)}


def shipped_identifications() -> dict[str, Path]:
    """Paths of the identifications that ship with magpend, by name: what ``magpend identify`` takes."""
    return {name: path for name, path in _shipped().items() if _identifies(path)}


def _identifies(path: Path) -> bool:
    return tomllib.loads(path.read_text("utf-8")).get("kind") == IDENTIFICATION


def _shipped() -> dict[str, Path]:
    try:
        folder = Path(str(resources.files("workflows")))
    except ModuleNotFoundError:
        return {}
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def default_directory(spec_path: Path, smoke: bool) -> Path:
    """Where a run goes unless told otherwise."""
    return Path("runs") / (spec_path.stem + ("-smoke" if smoke else ""))
