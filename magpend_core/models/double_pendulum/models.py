"""Define a planar double pendulum with separate friction in each joint, and with air drag.

The links, angles and signs are those of the pendulum of Wojna et al. (J. Sound Vib. 430, 2018, Eq. 1-6); the
friction is what recordings of free swings ask for. In joint i, at the relative velocity v, it is

    T_i (2/pi) atan(eps v) ((1 - mu0) exp(-c0 |v|) + mu0) + c_i v,

dry with Stribeck effect (mu0 = 1 for none) and viscous. The air's drag is quadratic in the velocity of each
piece of a link across it, k_i per length: link 1 is a strip from joint 1 to joint 2, link 2 one of the length
`l2` from joint 2, whose torques are taken at three Gauss points.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from magpend_core.models.model import Drawing, Mirror, Model, Preset, Quantity, State
from magpend_core.models.parameters import FINITE, NON_NEGATIVE, POSITIVE, Parameter

STATES = (
    State("psi1", "rad", "angle of link 1", r"\psi_1", on_circle=True, rate="psi1_dot"),
    State("psi2", "rad", "angle of link 2", r"\psi_2", on_circle=True, rate="psi2_dot"),
    State("psi1_dot", "rad/s", "rate of link 1", r"\dot{\psi}_1", scale=10.0, escape=1e4),
    State("psi2_dot", "rad/s", "rate of link 2", r"\dot{\psi}_2", scale=10.0, escape=1e4),
)

PARAMETERS = (
    Parameter("g", "m/s2", "gravitational acceleration", NON_NEGATIVE),
    Parameter("l1", "m", "distance between the joints", POSITIVE),
    Parameter("m1", "kg", "mass of link 1", POSITIVE),
    Parameter("m2", "kg", "mass of link 2", POSITIVE),
    Parameter("e1", "m", "joint 1 to the centre of mass of link 1", NON_NEGATIVE),
    Parameter("e2", "m", "joint 2 to the centre of mass of link 2", NON_NEGATIVE),
    Parameter("J1", "kg m2", "moment of inertia of link 1 about its centre of mass", POSITIVE),
    Parameter("J2", "kg m2", "moment of inertia of link 2 about its centre of mass", POSITIVE),
    Parameter("c1", "N m s", "viscous coefficient of joint 1", FINITE),
    Parameter("c2", "N m s", "viscous coefficient of joint 2", FINITE),
    Parameter("T1", "N m", "dry friction torque of joint 1", NON_NEGATIVE),
    Parameter("T2", "N m", "dry friction torque of joint 2", NON_NEGATIVE),
    Parameter("mu0", "1", "kinetic over static friction", NON_NEGATIVE),
    Parameter("c0", "s/rad", "Stribeck constant", NON_NEGATIVE),
    Parameter("eps", "s/rad", "steepness of the friction's sign function", POSITIVE),
    Parameter("k1", "kg/m2", "drag of the air on link 1, per length and squared velocity", NON_NEGATIVE),
    Parameter("k2", "kg/m2", "drag of the air on link 2, per length and squared velocity", NON_NEGATIVE),
    Parameter("l2", "m", "length of link 2 on which the air acts, from joint 2", POSITIVE),
    Parameter("q", "N m", "amplitude of the driving torque on joint 1", FINITE),
)

QUANTITIES = (
    Quantity("energy", "J", "mechanical energy of the links, 0 hanging at rest", "E"),
    Quantity("power_in", "W", "power put in by the drive", r"P_\mathrm{in}"),
    Quantity("power_dissipated", "W", "power dissipated in the joints and the air", r"P_\mathrm{diss}"),
    Quantity("drive_torque", "N m", "driving torque", r"M_e"),
    Quantity("friction1", "N m", "friction torque of joint 1", r"M_{R1}"),
    Quantity("friction2", "N m", "friction torque of joint 2", r"M_{R2}"),
    Quantity("drag1", "N m", "generalised torque of the air on link 1", r"M_{A1}"),
    Quantity("drag2", "N m", "generalised torque of the air on link 2", r"M_{A2}"),
)


def _points(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    places = []
    for i, length in enumerate((parameters["l1"], parameters["l2"])):
        angle = states[..., i]
        places.append(length * np.stack([np.sin(angle), -np.cos(angle)], axis=-1))
    return {"joint": places[0], "end": places[0] + places[1]}


def _pivot(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {"pivot": np.zeros(2)}


_ROOM = Path(__file__).parent

DOUBLE_PENDULUM = Model(
    name="double-pendulum",
    title="planar double pendulum with friction in its joints and in the air",
    states=STATES,
    parameters=PARAMETERS,
    presets=tuple(Preset.read(path) for path in sorted((_ROOM / "presets").glob("*.toml"))),
    system_path=f"{__package__}.system:DOUBLE_PENDULUM",
    section="the drive's rising zero",
    quantities=QUANTITIES,
    mirror=Mirror((-1, -1, -1, -1), half_period=True),
    drawing=Drawing(_points, _pivot, (("pivot", "joint", "end"),), "end"),
    angle_dim="link",
)

MODELS = (DOUBLE_PENDULUM,)
