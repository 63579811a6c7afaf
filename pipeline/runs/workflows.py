"""Find and read specifications, given as TOML files, names of shipped workflows, TOML text or dicts."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.specification.files import STUDY, find_file, shipped_files, toml_tables
from pipeline.specification.inputs import is_toml_text, toml_of
from pipeline.specification.parsing import IDENTIFICATION, Spec, load_spec, spec_of_tables

GALLERY = "gallery"
"""Folder of the shipped specifications that are named with their folder, ``gallery/NAME``: one per published figure."""


def find_spec(name: str | Path) -> Path:
    """Return the path of a specification, given as a path or by the name of a shipped workflow.

    Raises
    ------
    SpecError
        If neither a file nor a workflow has the name.
    """
    return find_file("workflow", name, _shipped())


def read_given(spec: str | Path | Mapping[str, Any], *, smoke: bool = False) -> tuple[Spec, str, Path]:
    """Read a specification, given as a file, the name of a shipped workflow, TOML text or a dict.

    Parameters
    ----------
    spec
        Specification as `pipeline.runs.run.run` takes it.
    smoke
        Whether to apply its ``[smoke]`` table.

    Returns
    -------
    spec : Spec
        The specification.
    text : str
        Its TOML text.
    directory : Path
        Default directory of its run.

    Raises
    ------
    SpecError
        With all problems at once.
    """
    if not isinstance(spec, Mapping) and not is_toml_text(spec):
        path = find_spec(spec)
        return load_spec(path, smoke=smoke), path.read_text("utf-8"), default_directory(path, smoke)
    text = toml_of(spec) if isinstance(spec, Mapping) else str(spec)
    read = spec_of_tables(toml_tables(text.encode(), "the specification"), Path(), smoke=smoke)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return read, text, default_directory(Path(f"{read.model.name}-{digest}"), smoke)


def shipped_workflows() -> dict[str, Path]:
    """Return the paths of the run specifications that ship with magpend, by name."""
    return {name: path for name, path in _shipped().items() if not _identifies(path)}


def shipped_identifications() -> dict[str, Path]:
    """Return the paths of the specifications of identifications that ship with magpend, by name."""
    return {name: path for name, path in _shipped().items() if _identifies(path)}


def _identifies(path: Path) -> bool:
    return tomllib.loads(path.read_text("utf-8")).get("kind") == IDENTIFICATION


def _shipped() -> dict[str, Path]:
    figures = {f"{GALLERY}/{path.stem}": path for path in shipped_files(f"{GALLERY}/*.toml") if path.name != STUDY}
    return {path.stem: path for path in shipped_files("*.toml")} | figures


def default_directory(spec_path: Path, smoke: bool) -> Path:
    """Return the default run directory of a specification file: ``runs/NAME``."""
    return Path("runs") / (spec_path.stem + ("-smoke" if smoke else ""))
