"""Small specifications and quiet runs for tests of any room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.runs.run import run

WELLS = 'kind = "list"\npoints = [[0.1, 0.0], [1.0, 0.2]]'
SQUARE = 'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 3 }\nv = { start = -1.0, stop = 1.0, num = 3 }'


def silent(line: str) -> None:
    """Echo nothing."""


def duffing(
    axes: str = "frequency_hz = { start = 0.15, stop = 0.25, num = 4 }",
    starts: str = WELLS,
    *,
    kind: str = "sweep",
    n_transient: int = 2,
    n_keep: int = 3,
    tolerance: float = 1e-6,
    execution: str = "",
    more: str = "",
) -> str:
    """Return the specification of a small Duffing run, whose engine all tests share."""
    lines = (
        f'kind = "{kind}"\ntitle = "small"\nmodel = "duffing"\n[axes]\n{axes}\n[initial_conditions]\n{starts}',
        f"[integration]\nrtol = {tolerance}\natol = {tolerance}\nn_transient = {n_transient}\nn_keep = {n_keep}",
        f"[execution]\n{execution}\n{more}",
    )
    return "\n".join(lines)


def quietly(spec: Any, out: str | Path, **options: Any) -> Any:
    """Run a specification in this process without a word."""
    return run(spec, out, **{"workers": 0, "echo": silent, **options})


def finished(folder: Path, text: str) -> Path:
    """Write a specification into a folder, run it there, and return the run directory."""
    (folder / "spec.toml").write_text(text, "utf-8")
    quietly(folder / "spec.toml", folder / "run")
    return folder / "run"
