"""Flows with limit cycles that are known, as text, for tests of sections by crossing."""

from __future__ import annotations

from magpend_core.models import load_model
from magpend_core.models.model import Model

_PLANE = {"x": {}, "y": {}}

HOPF = {
    "name": "hopf", "states": _PLANE, "parameters": {"mu": 0.25, "omega": 2.0},
    "equations": {"x": "mu*x - omega*y - x*(x**2 + y**2)", "y": "omega*x + mu*y - y*(x**2 + y**2)"},
}  # fmt: skip
"""Normal form of Hopf's bifurcation: radius sqrt(mu), period 2 pi/omega, multiplier exp(-4 pi mu/omega)."""

BAUTIN = {
    "name": "bautin", "states": _PLANE, "parameters": {"mu": 0.1, "omega": 2.0},
    "define": {"s": "x**2 + y**2", "g": "mu + s - s**2"},
    "equations": {"x": "g*x - omega*y", "y": "omega*x + g*y"},
}  # fmt: skip
"""Subcritical: with s the squared radius, mu + s - s**2 = 0; a fold of cycles at mu = -1/4, s = 1/2."""

PAIR = {
    "name": "pair", "states": {"x": {}, "y": {}, "u": {}, "w": {}},
    "parameters": {"mu": -0.1, "fast": 2.0, "slow": 0.7},
    "define": {"s": "x**2 + y**2", "r": "u**2 + w**2"},
    "equations": {
        "x": "x*(1 - s) - fast*y", "y": "y*(1 - s) + fast*x",
        "u": "u*(mu - r) - slow*w", "w": "w*(mu - r) + slow*u",
    },
}  # fmt: skip
"""Two oscillators: multipliers exp((mu +- i slow) 2 pi/fast) of the first; a torus from mu = 0."""

VAN_DER_POL = {
    "name": "van_der_pol", "states": {"x": {}, "v": {}}, "parameters": {"mu": 1.0},
    "equations": {"x": "v", "v": "mu*(1 - x**2)*v - x"},
}  # fmt: skip

ROSSLER = {
    "name": "roessler", "states": {"x": {"scale": 10.0}, "y": {"scale": 10.0}, "z": {"scale": 10.0}},
    "parameters": {"a": 0.2, "b": 0.2, "c": 5.7},
    "equations": {"x": "-y - z", "y": "x + a*y", "z": "b + z*(x - c)"},
}  # fmt: skip

LORENZ = {
    "name": "lorenz63", "states": {"x": {"scale": 10.0}, "y": {"scale": 10.0}, "z": {"scale": 10.0}},
    "parameters": {"sigma": 10.0, "rho": 28.0, "beta": 8.0 / 3.0},
    "equations": {"x": "sigma*(y - x)", "y": "x*(rho - z) - y", "z": "x*y - beta*z"},
}  # fmt: skip


def flow(table: dict[str, object]) -> Model:
    """Return a model of one of the texts."""
    return load_model(table)
