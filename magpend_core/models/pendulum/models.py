"""Define the pendulum's models: fitted magnets, point dipoles or none, driven by a square wave or a sine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models.model import Classifier, Drawing, Mirror, Model, Preset, Quantity, State
from magpend_core.models.pendulum import parameters as groups
from magpend_core.models.pendulum import sides


def _place(length: float, angle: np.ndarray) -> np.ndarray:
    return length * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


def _with_magnet(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    joint = _place(parameters["l1"], states[..., 0])
    return {"joint": joint, "magnet": joint + _place(parameters["l2"], states[..., 1])}


def _magnet_and_joint(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {"pivot": np.zeros(2), "fixed magnet": np.array([0.0, -parameters["h"]])}


def _without_magnet(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    joint = _place(parameters["l1"], states[..., 0])
    return {"joint": joint, "centre of mass": joint + _place(parameters["e2"], states[..., 1])}


def _joint(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {"pivot": np.zeros(2)}


DRAWN_MAGNETS = Drawing(_with_magnet, _magnet_and_joint, (("pivot", "joint", "magnet"),), "magnet")
DRAWN_LINKS = Drawing(_without_magnet, _joint, (("pivot", "joint", "centre of mass"),), "centre of mass")


STATES = (
    State("psi1", "rad", "angle of link 1", r"\psi_1", on_circle=True, rate="psi1_dot"),
    State("psi2", "rad", "angle of link 2", r"\psi_2", on_circle=True, rate="psi2_dot"),
    State("psi1_dot", "rad/s", "rate of link 1", r"\dot{\psi}_1", scale=10.0, escape=1e4),
    State("psi2_dot", "rad/s", "rate of link 2", r"\dot{\psi}_2", scale=10.0, escape=1e4),
)

LINK_QUANTITIES = (
    Quantity("energy", "J", "mechanical energy of the links, 0 hanging at rest", "E"),
    Quantity("power_in", "W", "power put in by the drive", r"P_\mathrm{in}"),
    Quantity("power_dissipated", "W", "power dissipated in the joints", r"P_\mathrm{diss}"),
    Quantity("drive_torque", "N m", "driving torque", r"M_e"),
    Quantity("friction1", "N m", "friction torque of joint 1", r"M_{R1}"),
    Quantity("friction2", "N m", "friction torque of joint 2", r"M_{R2}"),
    Quantity("load1", "N", "bearing load of joint 1", r"N_1"),
    Quantity("load2", "N", "bearing load of joint 2", r"N_2"),
)
MAGNET_QUANTITIES = (
    Quantity("magnet_moment", "N m", "torque of the magnets about joint 1", r"M_M"),
    Quantity("magnet_torque1", "N m", "generalised torque of the magnets on link 1", r"Q_1"),
    Quantity("magnet_torque2", "N m", "generalised torque of the magnets on link 2", r"Q_2"),
    Quantity("magnet_x", "m", "moving magnet, right of the upper joint", r"x_\mathrm{m}"),
    Quantity("magnet_y", "m", "moving magnet, above the upper joint", r"y_\mathrm{m}"),
)
"""After those of the links, where there are magnets."""

SIDES = Classifier(sides.WORDS, sides.NEUTRAL, "side of the fixed magnet on which the motion stays", sides.classify)

_ROOM = Path(__file__).parent
_PRESETS = tuple(Preset.read(path) for path in sorted((_ROOM / "presets").glob("*.toml")))
_DRIVES: dict[str, tuple[Any, str]] = {
    "": (groups.SQUARE_WAVE, "the drive's rising edge"),
    "-sine": (groups.SINE, "the drive's rising zero"),
}


def _model(name: str, title: str, drive: str, magnets: tuple[Any, ...], **more: Any) -> Model:
    driven, section = _DRIVES[drive]
    kind = {"pendulum": "FITTED", "pendulum-dipole": "DIPOLE", "pendulum-free": "FREE"}[name]
    attribute = f"PENDULUM_{kind}" + ("_SINE" if drive else "")
    with_magnets = bool(magnets)
    return Model(
        name=name + drive,
        title=title + (", driven by a sine" if drive else ""),
        states=STATES,
        parameters=(*groups.LINKS, *groups.FRICTION, *driven, *magnets),
        presets=_PRESETS,
        system_path=f"{__package__}.systems:{attribute}",
        section=section,
        quantities=LINK_QUANTITIES + (MAGNET_QUANTITIES if with_magnets else ()),
        classifier=SIDES if with_magnets else None,
        # with a duty cycle of one half; near it, the symmetry is approximate
        mirror=Mirror((-1, -1, -1, -1), half_period=True),
        drawing=DRAWN_MAGNETS if with_magnets else DRAWN_LINKS,
        angle_dim="link",
        **more,
    )


_FITTED = "forced double pendulum with two repelling magnets"
_DIPOLE = "forced double pendulum with point dipoles"
_FREE = "forced double pendulum without magnets"
_APART: dict[str, Any] = {"relations": groups.keep_dipoles_apart}

FITTED = _model("pendulum", _FITTED, "", groups.FITTED_MAGNETS)
FITTED_SINE = _model("pendulum", _FITTED, "-sine", groups.FITTED_MAGNETS)
DIPOLE = _model("pendulum-dipole", _DIPOLE, "", groups.POINT_DIPOLES, **_APART)
DIPOLE_SINE = _model("pendulum-dipole", _DIPOLE, "-sine", groups.POINT_DIPOLES, **_APART)
FREE = _model("pendulum-free", _FREE, "", groups.NO_MAGNETS)
FREE_SINE = _model("pendulum-free", _FREE, "-sine", groups.NO_MAGNETS)

MODELS = (FITTED, FITTED_SINE, DIPOLE, DIPOLE_SINE, FREE, FREE_SINE)
