"""Describe the forced Duffing oscillator: one well or two, softening or hardening, by its parameters.

    x'' + damping x' + linear x + cubic x**3 = amplitude cos(2 pi f t)

Two wells for linear < 0 < cubic, a hardening spring for both above 0. Quantities are per unit mass.
A model of two functions: begin with it for a system of your own.
"""

from __future__ import annotations

from magpend_core.models.model import Mirror, Model, Preset, Quantity, State
from magpend_core.models.parameters import FINITE, NON_NEGATIVE, Parameter

STATES = (
    State("x", "m", "displacement", "x", rate="v", escape=1e6),
    State("v", "m/s", "velocity", r"\dot{x}", escape=1e6),
)

PARAMETERS = (
    Parameter("damping", "1/s", "viscous damping per mass", NON_NEGATIVE),
    Parameter("linear", "1/s2", "linear stiffness per mass, below 0 for two wells", FINITE),
    Parameter("cubic", "1/(m2 s2)", "cubic stiffness per mass", FINITE),
    Parameter("amplitude", "m/s2", "amplitude of the drive per mass", FINITE),
)

QUANTITIES = (
    Quantity("energy", "J/kg", "kinetic and elastic energy per mass", "E"),
    Quantity("power_in", "W/kg", "power put in by the drive per mass", r"P_\mathrm{in}"),
    Quantity("power_dissipated", "W/kg", "power dissipated per mass", r"P_\mathrm{diss}"),
    Quantity("drive", "m/s2", "driving force per mass", "F"),
)

_DOUBLE_WELL = {"damping": 0.2, "linear": -1.0, "cubic": 1.0, "amplitude": 0.3}
_SOURCES = {
    "twin-well": (_DOUBLE_WELL, "chaotic at 1/(2 pi) Hz: ChaosTools.jl, issue 301"),
    "twin-well-periodic": (
        {**_DOUBLE_WELL, "damping": 0.15, "amplitude": 0.2},
        "two coexisting orbits of period 1 at 1/(2 pi) Hz: DynamicalSystemsBase.jl, issue 139",
    ),
    "hardening": (
        {"damping": 0.1, "linear": 1.0, "cubic": 0.5, "amplitude": 0.3},
        "a resonance that bends to higher frequencies",
    ),
}

DUFFING = Model(
    name="duffing",
    title="forced Duffing oscillator",
    states=STATES,
    parameters=PARAMETERS,
    presets=tuple(Preset(name, values, dict.fromkeys(values, source)) for name, (values, source) in _SOURCES.items()),
    system_path=f"{__package__}.system:DUFFING",
    section="the drive's maximum",
    quantities=QUANTITIES,
    mirror=Mirror((-1, -1), half_period=True),
)

MODELS = (DUFFING,)
