"""A small run of the Duffing oscillator with two wells, with its critical shocks and an edge state."""

from __future__ import annotations

from pathlib import Path

from pipeline.runs.derive import derive
from pipeline.runs.run import run

HZ = 0.15915494309189535

SMOOTH, FRACTAL = 0, 1
"""Indices on the axis of amplitudes: boundaries of the basins are smooth at the first, fractal at the second."""

WELLS = f"""
kind = "sweep"
title = "Two wells"
model = "duffing"
[parameters]
preset = "twin-well-periodic"
frequency_hz = {HZ}
[axes]
amplitude = {{ values = [0.1, 0.2] }}
[initial_conditions]
kind = "grid"
x = {{ start = -2.0, stop = 2.0, num = 15 }}
v = {{ start = -2.0, stop = 2.0, num = 15 }}
[integration]
rtol = 1e-9
atol = 1e-9
n_transient = 200
n_keep = 8
stop_when_closed = true
closure_tolerance = 1e-6
"""


def shocked_wells(folder: Path) -> Path:
    """Compute the run and its analyses; return its directory."""
    (folder / "wells.toml").write_text(WELLS, "utf-8")
    directory = folder / "wells"
    run(folder / "wells.toml", directory, workers=0, echo=_silent)
    derive(directory, "resilience", {"phases": 2, "directions": 8, "confirmations": 16, "timed": 0})
    derive(directory, "edge", {"between": ("A", "B"), "at": {"amplitude": 0.1}, "pairs": 1})
    return directory


def _silent(text: str) -> None:
    """Print nothing."""
