"""Two runs of a hardening oscillator: along the drive's frequency with the curves of its folds, and over a plane."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.runs.derive import derive
from pipeline.runs.run import run

LINE = """
kind = "continuation"
model = "duffing"
[parameters]
preset = "hardening"
[axes]
frequency_hz = { start = 0.16, stop = 0.30, num = 15 }
[continuation]
direction = "both"
[initial_conditions]
kind = "random"
n = 2
seed = 1
x = [-1.0, 1.0]
v = [-1.0, 1.0]
[integration]
rtol = 1e-8
atol = 1e-8
n_transient = 60
n_keep = 12
"""

PLANE = """
kind = "sweep"
model = "duffing"
[parameters]
preset = "hardening"
[axes]
frequency_hz = { start = 0.20, stop = 0.26, num = 4 }
amplitude = { values = [0.25, 0.3, 0.35] }
[initial_conditions]
kind = "grid"
x = { start = -1.5, stop = 1.5, num = 4 }
v = { start = -2.0, stop = 2.0, num = 4 }
[integration]
rtol = 1e-8
atol = 1e-8
n_transient = 150
n_keep = 12
"""

CURVES: dict[str, Any] = {"max_period": 1, "second": "amplitude", "second_low": 0.25, "second_high": 0.35}


def _made(folder: Path, name: str, text: str) -> Path:
    (folder / f"{name}.toml").write_text(text, "utf-8")
    run(folder / f"{name}.toml", folder / name, workers=0, echo=lambda line: None)
    return folder / name


def made_line(folder: Path) -> Path:
    """Compute the run along the frequency, and its curves."""
    directory = _made(folder, "line", LINE)
    derive(directory, "curves", CURVES)
    return directory


def made_plane(folder: Path) -> Path:
    """Compute the run over the plane, and its attractors."""
    directory = _made(folder, "plane", PLANE)
    derive(directory, "attractors", {})
    return directory
