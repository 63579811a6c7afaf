"""Flows with limit cycles that are known, as text, for tests of sections by crossing."""

from __future__ import annotations

from magpend_core.models import load_model
from magpend_core.models.model import Model
from magpend_core.models.text import read_model


def table(name: str, equations: dict[str, str], parameters: dict[str, object] | None = None, **more) -> dict:
    """Return the table of a model whose states are those of its equations; `states` says more of some."""
    states = {state: {} for state in equations} | more.pop("states", {})
    return {"name": name, "states": states, "parameters": parameters or {}, "equations": equations, **more}


def model_of(equations: dict[str, str], parameters: dict[str, object] | None = None, **more) -> Model:
    """Return a model of equations without a name of its own."""
    return read_model(table("a", equations, parameters, **more))


# one name and one text: the two differ in values alone, and compile once
_NORMAL_FORM = table(
    "normal_form",
    {"x": "g*x - omega*y", "y": "omega*x + g*y"},
    define={"s": "x**2 + y**2", "g": "mu + cubic*s + quintic*s**2"},
)

HOPF = {**_NORMAL_FORM, "parameters": {"mu": 0.25, "omega": 2.0, "cubic": -1.0, "quintic": 0.0}}
"""Normal form of Hopf's bifurcation: radius sqrt(mu), period 2 pi/omega, multiplier exp(-4 pi mu/omega)."""

BAUTIN = {**_NORMAL_FORM, "parameters": {"mu": 0.1, "omega": 2.0, "cubic": 1.0, "quintic": -1.0}}
"""Subcritical: with s the squared radius, mu + s - s**2 = 0; a fold of cycles at mu = -1/4, s = 1/2."""

PAIR = table(
    "pair",
    {"x": "x*(1 - s) - fast*y", "y": "y*(1 - s) + fast*x", "u": "u*(mu - r) - slow*w", "w": "w*(mu - r) + slow*u"},
    {"mu": -0.1, "fast": 2.0, "slow": 0.7},
    define={"s": "x**2 + y**2", "r": "u**2 + w**2"},
)
"""Two oscillators: multipliers exp((mu +- i slow) 2 pi/fast) of the first; a torus from mu = 0."""

# as in the library, and compiled once with it
VAN_DER_POL = table("van_der_pol", {"x": "v", "v": "mu*(1 - x**2)*v - x"}, {"mu": 1.0})

ROSSLER, LORENZ = "rossler", "lorenz"
"""Those of the library."""


def flow(table: dict[str, object] | str) -> Model:
    """Return a model of one of the texts, or of the library."""
    return load_model(table)


def lorenz96(n: int, forcing: float = 8.0) -> dict[str, object]:
    """Lorenz-96 with `n` states in a ring: every one with the same four neighbours in its equation."""
    rates = {f"x{i}": f"(x{(i + 1) % n} - x{(i - 2) % n})*x{(i - 1) % n} - x{i} + F" for i in range(n)}
    return table("lorenz96", rates, {"F": forcing})
