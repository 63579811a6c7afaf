"""Small specifications and quiet runs for tests of any room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.runs.run import run

WELLS = 'kind = "list"\npoints = [[0.1, 0.0], [1.0, 0.2]]'
SQUARE = 'kind = "grid"\nx = { start = -1.0, stop = 1.0, num = 3 }\nv = { start = -1.0, stop = 1.0, num = 3 }'


# a double well with noise
WELL = """
kind = "sweep"
title = "double well with noise"

[model]
name = "well"
states = { x = { meaning = "position" } }
parameters = { a = 1.0 }
equations = { x = "a*x - x**3" }

[noise]
strengths = { x = 0.5 }
seed = 1
steps_per_period = 8

[parameters]
frequency_hz = 5.0

[axes]
noise_x = { values = [0.45, 0.55, 0.7] }
realization = { start = 0, stop = 199, step = 1 }

[initial_conditions]
kind = "list"
points = [[-1.0]]

[integration]
n_transient = 0
n_keep = 1000
"""

# a fold that moves: x + l = -1 is stable, 1 unstable
FOLD_LENGTH = 20.0
MODEL = {
    "name": "moving-fold",
    "states": {"x": {"escape": 1e6}},
    "parameters": {"l": 0.0},
    "equations": {"x": "(x + l)**2 - 1"},
}
FOLD = {
    "kind": "sweep",
    "title": "a fold that moves",
    "model": MODEL,
    "parameters": {"frequency_hz": 1.0},
    "drift": {"l": {"to": FOLD_LENGTH}},
    "axes": {"l_rate_per_s": {"values": [0.9, 1.0, 1.1, 1.3]}},
    "initial_conditions": {"kind": "list", "points": [[-1.0], [0.25]]},
    "integration": {"rtol": 1e-10, "atol": 1e-10, "n_transient": 0, "n_keep": 40},
}


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
    folder.mkdir(exist_ok=True)
    (folder / "spec.toml").write_text(text, "utf-8")
    quietly(folder / "spec.toml", folder / "run")
    return folder / "run"
