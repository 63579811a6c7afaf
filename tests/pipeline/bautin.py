"""An oscillator with closed forms, its run and its orbits as data, for tests of branches, bands and identifications.

    r' = (m - h) r + r^3 - g r^5,  angle' = w

Its cycles have g r^4 - r^2 - (m - h) = 0 and frequency w/2 pi: the larger r is stable, the smaller one is not. The fold
of cycles lies at m = h - 1/(4 g), the Hopf point at m = h. On the section y = 0 they have x = r.
"""

from __future__ import annotations

import json
import math

import numpy as np

TRUTH = {"g": 1.2, "h": 0.05, "w": 6.0}
FREQUENCY_HZ = TRUTH["w"] / (2.0 * math.pi)
MODEL = {
    "name": "bautin-cycle",
    "states": {"x": {"scale": 1.0}, "y": {"scale": 1.0}},
    "parameters": {name: {"value": value} for name, value in {"m": 0.0, **TRUTH}.items()},
    "define": {"r2": "x**2 + y**2", "growth": "m - h + r2 - g*r2**2"},
    "equations": {"x": "growth*x - w*y", "y": "growth*y + w*x"},
}
SECTION = {"of": "y", "value": 0.0, "direction": "up", "longest": 20.0}
SWEEP = {
    "kind": "sweep",
    "model": MODEL,
    "section": SECTION,
    "axes": {"m": {"start": -0.3, "stop": 0.2, "num": 6}},
    "initial_conditions": {"kind": "list", "points": [[1.0, 0.0], [0.01, 0.0]]},
    "integration": {"n_transient": 200, "n_keep": 2, "stop_when_closed": True},
}


def radius(m, sign=1, g=TRUTH["g"], h=TRUTH["h"]):
    """Radius of the stable (1) or the unstable (-1) cycle; NaN where it does not exist."""
    inside = np.asarray(1.0 + 4.0 * g * (m - h))
    root = np.sqrt(np.where((inside > 0) & (np.asarray(g) > 0), inside, np.nan))
    return np.sqrt((1.0 + sign * root) / (2.0 * np.abs(g)))


def write_orbits(path, values, sign=1, *, sd=0.002, frequency_sd=0.001, factor=1.0):
    """Write a table of measured orbits, whose amplitudes are off by a factor."""
    lines = ["m,name,stable,amplitude,amplitude_sd,frequency,frequency_sd"]
    for m in values:
        word, size = "yes" if sign > 0 else "no", factor * float(radius(m, sign))
        lines.append(f"{m},{word} {m},{word},{size!r},{sd},{FREQUENCY_HZ!r},{frequency_sd}")
    path.write_text("\n".join(lines) + "\n")
    return path


def _toml(v):
    if isinstance(v, dict):
        return "{ " + ", ".join(f"{k} = {_toml(x)}" for k, x in v.items()) + " }"
    return json.dumps(v)


def write_toml(path, data):
    """Write a specification, with a table for each of its `orbits`."""
    lines = [f"{k} = {_toml(v)}" for k, v in data.items() if k != "orbits"]
    for table in data.get("orbits", ()):
        lines += ["[[orbits]]", *(f"{k} = {_toml(v)}" for k, v in table.items())]
    path.write_text("\n".join(lines) + "\n")
    return path
