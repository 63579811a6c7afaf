"""Make ``discs.csv``: a synthetic measurement of the torque between two disc magnets.

    python workflows/magnet/make_discs.py          # needs magpylib

The moving disc is a pair of uniformly charged faces (its magnetisation ends there) in the field of the
fixed one, which magpylib has in closed form: the force on a face is the integral of its charge times the
field, and its moment about the upper joint that of the lever times the force. With 8 rings (Gauss in the
squared radius) of 24 points each the torque is converged to 1e-7 N m at a gap of 30 mm.

The moving disc's axis lies along link 2, the fixed one's is vertical, and faces that meet are alike. A
reading is the torque of the magnets, of the links' weight and of the tie's, and noise.
"""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import magpylib
import numpy as np

from magpend_core import load_model
from magpend_core.models.pendulum.magnet_torque import weight_torque

HERE = Path(__file__).parent
PERMEABILITY = 4e-7 * np.pi
RINGS, SPOKES = 8, 24


def face(radius: float, rings: int, spokes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a disc's face [m], shape (n, 2), and the area of each [m2], shape (n,)."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    r = radius * np.sqrt(0.5 * (nodes + 1.0))
    angle = 2.0 * np.pi * (np.arange(spokes) + 0.5) / spokes
    points = r[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    areas = np.repeat(0.5 * weights * np.pi * radius**2 / spokes, spokes)
    return points.reshape(-1, 2), areas


def loads(
    psi1: np.ndarray,
    psi2: np.ndarray,
    geometry: Mapping[str, float],
    disc: Mapping[str, Any],
    rings: int = RINGS,
    spokes: int = SPOKES,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the force (rightward, upward) on the moving disc [N], shape (n, 2), and its moment about joint 1 [N m],
    shape (n,).

    Parameters
    ----------
    psi1, psi2
        Angles of the links (n,) [rad].
    geometry
        ``l1``, ``l2``, ``h`` [m].
    disc
        ``diameter_m``, ``thickness_m``, ``remanence_T``.
    rings, spokes
        Points of a face.
    """
    diameter, thickness, remanence = disc["diameter_m"], disc["thickness_m"], disc["remanence_T"]
    fixed = magpylib.magnet.Cylinder(
        dimension=(diameter, thickness), polarization=(0.0, 0.0, remanence), position=(0, 0, -geometry["h"])
    )
    none = np.zeros_like(psi1)
    axis = np.stack([np.sin(psi2), none, -np.cos(psi2)], axis=-1)
    across = np.stack([np.cos(psi2), none, np.sin(psi2)], axis=-1)
    upper = np.stack([np.sin(psi1), none, -np.cos(psi1)], axis=-1)
    centre = geometry["l1"] * upper + geometry["l2"] * axis
    points, areas = face(0.5 * diameter, rings, spokes)
    flat = points[:, :1] * across[:, None] + points[:, 1:] * np.array([0.0, 1.0, 0.0])
    force, moment = np.zeros((len(psi1), 2)), none.copy()
    for sign in (1.0, -1.0):  # the outer face is charged as the fixed disc's upper one
        place = (centre + 0.5 * sign * thickness * axis)[:, None] + flat
        field = fixed.getB(place.reshape(-1, 3)).reshape(place.shape)
        pull = sign * remanence / PERMEABILITY * areas[:, None] * field
        force += pull[..., [0, 2]].sum(axis=1)
        moment += (place[..., 0] * pull[..., 2] - place[..., 2] * pull[..., 0]).sum(axis=1)
    return force, moment


def read(header: Mapping[str, Any]) -> list[tuple[float, float, str, float]]:
    """Compute the synthetic readings as rows (psi1 [deg], psi_rel [deg], side, torque [N m])."""
    p = load_model(header["model"]).load(header["preset"], **header["parameters"])
    made, tie = header["synthesis"], header["correction"]["tie"]
    noise = np.random.default_rng(made["seed"])
    beyond = np.array(made["beyond_deg"])
    locked = np.linspace(*(made["psi_rel_deg"][key] for key in ("start", "stop", "num")))
    rows = []
    for psi_rel in locked:
        bent = np.radians(psi_rel)
        in_line = -np.degrees(np.arctan2(p["l2"] * np.sin(bent), p["l1"] + p["l2"] * np.cos(bent)))
        for side, sign in (("right", 1.0), ("left", -1.0)):
            degrees = np.round(in_line + sign * beyond, 1)
            psi1 = np.radians(degrees)
            torque = loads(psi1, psi1 + bent, p, made)[1] + weight_torque(psi1, bent, p)
            torque -= tie["mass_kg"] * p["g"] * tie["lever_m"] * np.sin(psi1)
            torque += noise.normal(0.0, made["noise_Nm"], len(torque))
            rows += [(a, psi_rel, side, t) for a, t in zip(degrees, torque, strict=True)]
    return rows


def main() -> None:
    """Write the readings to the CSV file that the header beside this script names."""
    header = tomllib.loads((HERE / "discs.toml").read_text("utf-8"))
    with (HERE / header["file"]).open("w", newline="", encoding="utf-8") as file:
        file.write("# SYNTHETIC: computed by make_discs.py, see discs.toml; no measurement of a rig\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["psi1_deg", "psi_rel_deg", "side", "torque_Nm"])
        for psi1, psi_rel, side, torque in read(header):
            writer.writerow([f"{psi1:.1f}", f"{psi_rel:.3f}", side, f"{torque:.4f}"])


if __name__ == "__main__":
    main()
