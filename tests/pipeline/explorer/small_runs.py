"""Small runs that several of the explorer's tests look at, and how they are computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.runs.derive import derive
from tests.pipeline.factories import finished

LITTLE = """
kind = "sweep"
model = "duffing5"
parameters = { frequency_hz = 0.15915494309189535 }
initial_conditions = { kind = "grid", x = { start = -0.9375, stop = 0.9375, num = 4 }, v = 0.1 }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 120, n_keep = 12 }
"""
"""Four cells."""

LINE = """
kind = "continuation"
model = "duffing"
parameters = { preset = "hardening" }
axes = { frequency_hz = { start = 0.16, stop = 0.30, num = 15 } }
continuation = { direction = "both" }
initial_conditions = { kind = "random", n = 2, seed = 1, x = [-1.0, 1.0], v = [-1.0, 1.0] }
integration = { rtol = 1e-8, atol = 1e-8, n_transient = 60, n_keep = 12 }
"""
"""A hardening oscillator along the drive's frequency, to be followed with the curves of its folds."""

PLANE = """
kind = "sweep"
model = "duffing"
parameters = { preset = "hardening" }
axes = { frequency_hz = { start = 0.20, stop = 0.26, num = 4 }, amplitude = { values = [0.25, 0.3, 0.35] } }
initial_conditions.kind = "grid"
initial_conditions.x = { start = -1.5, stop = 1.5, num = 4 }
initial_conditions.v = { start = -2.0, stop = 2.0, num = 4 }
integration = { rtol = 1e-8, atol = 1e-8, n_transient = 150, n_keep = 12 }
"""
"""The same over a plane."""

CURVES: dict[str, Any] = {"second": "amplitude", "second_low": 0.25, "second_high": 0.35}

HZ = 0.15915494309189535

SMOOTH, FRACTAL = 0, 1
"""Indices on the axis of amplitudes: boundaries of the basins are smooth at the first, fractal at the second."""

WELLS = f"""
kind = "sweep"
title = "Two wells"
model = "duffing"
parameters = {{ preset = "twin-well-periodic", frequency_hz = {HZ} }}
axes = {{ amplitude = {{ values = [0.1, 0.2] }} }}
initial_conditions.kind = "grid"
initial_conditions.x = {{ start = -2.0, stop = 2.0, num = 15 }}
initial_conditions.v = {{ start = -2.0, stop = 2.0, num = 15 }}
integration.rtol = 1e-9
integration.atol = 1e-9
integration.n_transient = 200
integration.n_keep = 8
integration.stop_when_closed = true
integration.closure_tolerance = 1e-6
"""


FLOW = """
kind = "sweep"
model.name = "normal_form"
model.states = { x = {}, y = {} }
model.parameters = { mu = -0.1, omega = 2.0, cubic = 1.0, quintic = -1.0 }
model.define = { s = "x**2 + y**2", g = "mu + cubic*s + quintic*s**2" }
model.equations = { x = "g*x - omega*y", y = "omega*x + g*y" }
section = { of = "y", value = 0.3, longest = 20.0 }
axes = { mu = { values = [-0.2, -0.1, 0.1] } }
initial_conditions.kind = "grid"
initial_conditions.x = { start = -0.9, stop = 0.9, num = 3 }
initial_conditions.y = { start = -1.05, stop = 0.95, num = 3 }
integration = { rtol = 1e-9, atol = 1e-9, n_transient = 100, n_keep = 12 }
"""
"""A cycle, and a rest beside it."""


CHARTED = """
kind = "sweep"
title = "Small plane of the Henon map"
model = "henon"
axes.a = { values = [1.0, 1.1, 1.2] }
axes.b = { values = [0.2, 0.3] }
initial_conditions = { kind = "random", n = 6, seed = 1, x = [-0.5, 0.5], y = [-0.2, 0.2] }
integration = { n_transient = 1000, n_keep = 64, stop_when_closed = true, closure_tolerance = 1e-8 }
"""
"""A plane with chaotic sets, whose ends stay unexplained if none is named."""


def charted_plane(folder: Path) -> Path:
    """Compute the run of a plane with its atlas."""
    directory = finished(folder, CHARTED)
    derive(directory, "atlas", {"windows": 0, "curve_period": 2})
    return directory


def bent_resonance(folder: Path) -> tuple[Path, Path]:
    """Compute the run along the frequency with its curves, and the one over the plane with its attractors."""
    line, plane = finished(folder / "line", LINE), finished(folder / "plane", PLANE)
    derive(line, "branches", {"max_period": 1})
    derive(line, "curves", CURVES)
    derive(plane, "attractors", {})
    return line, plane


def shocked_wells(folder: Path) -> Path:
    """Compute a run of two wells, its critical shocks and an edge state."""
    directory = finished(folder, WELLS)
    derive(directory, "resilience", {"phases": 2, "directions": 8, "confirmations": 16, "timed": 0})
    derive(directory, "edge", {"between": ("A", "B"), "at": {"amplitude": 0.1}, "pairs": 1})
    return directory
