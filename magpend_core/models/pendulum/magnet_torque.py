"""Compute the magnets' torque about the upper joint with link 2 locked, as on the test rig, and its parameter
derivatives.

Wojna et al., J. Sound Vib. 430 (2018), section 3, cited by equation number. Link 2 is locked at the angle
``psi_rel = psi2 - psi1`` and the torque about joint 1 is read over ``psi1``: positive torques increase the
angle, right of the fixed magnet they are positive. SI units throughout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

ANGLE = "psi1"
"""The angle over which torques are read."""

LOCKED = "psi_rel"
"""The angle that is locked."""

SYMBOLS = {ANGLE: r"\psi_1", LOCKED: r"\psi_\mathrm{rel}", "torque": r"M_\mathrm{M}"}
"""LaTeX without dollar signs."""

SIDES = ("right", "left")
"""Where the pendulum is, seen from the fixed magnet: that of f_1 and that of f_2 (Eq. 18)."""

HEIGHT, POSITION, WIDTH = "A", "b", "c"
"""What a bump has (Eq. 17)."""

FITTED = ("alpha1", "alpha2", "beta1", "beta2", "gamma1", "gamma2", "p1", "p2", "r1", "r2", "c1", "c2", "eps_mag")
"""Parameters of the fitted torque (Eq. 18-19) that curves determine, in the order of `moment_slopes`."""

MODEL, DIPOLES = "pendulum", "pendulum-dipole"
"""Models with the fitted torque, and with point dipoles."""

_VACUUM_PERMEABILITY = 1.25663706212e-6  # N/A2, CODATA 2018


class Line(NamedTuple):
    """Straight line ``psi1 = slope*psi_rel + offset`` on which the magnets' torque changes sign, midway between its
    peaks.
    """

    slope: float
    offset: float  # rad


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.mod(np.asarray(angle, np.float64) + np.pi, 2.0 * np.pi) - np.pi


def bump(psi1: np.ndarray, height: float, position: float, width: float) -> np.ndarray:
    """Compute one bump of the torque curve, ``height*exp(-((psi1 + position)/width)**2)`` [N m] (Wojna et al. 2018, Eq.
    17).
    """
    return np.asarray(height * np.exp(-(((psi1 + position) / width) ** 2)))


def bump_slopes(psi1: np.ndarray, height: float, position: float, width: float) -> np.ndarray:
    """Compute the derivatives of `bump` by height, position and width; shape (..., 3)."""
    v = (psi1 + position) / width
    e = np.exp(-v * v)
    return np.stack([e, -2.0 * height * e * v / width, 2.0 * height * e * v * v / width], axis=-1)


def transition(p: Mapping[str, float]) -> Line:
    """Return the line in the plane of psi_rel and psi1 that lies midway between the two torque peaks (Wojna et al.
    2018, Eq. 19).
    """
    return Line(-0.5 * (p["p1"] + p["p2"]), -0.5 * (p["r1"] + p["r2"]))


class _Parts(NamedTuple):
    locked: np.ndarray  # rad
    f: tuple[np.ndarray, np.ndarray]  # N m, Eq. 18
    u: tuple[np.ndarray, np.ndarray]
    v: tuple[np.ndarray, np.ndarray]
    share: tuple[np.ndarray, np.ndarray]  # of each bump
    x: np.ndarray  # rad, from the transition


def _parts(psi1: np.ndarray, psi_rel: np.ndarray, p: Mapping[str, float]) -> _Parts:
    psi1, psi_rel = _wrapped(psi1), _wrapped(psi_rel)
    f, u, v = [], [], []
    for i in (1, 2):
        u.append((psi_rel + p[f"beta{i}"]) / p[f"gamma{i}"])
        v.append((psi1 + (p[f"p{i}"] * psi_rel + p[f"r{i}"])) / p[f"c{i}"])
        f.append(p[f"alpha{i}"] * np.exp(-(u[-1] ** 2) - v[-1] ** 2))
    line = transition(p)
    x = psi1 - (line.slope * psi_rel + line.offset)
    step = (2.0 / np.pi) * np.arctan(p["eps_mag"] * x)
    share = 0.5 * (1.0 + step), 0.5 * (1.0 - step)
    return _Parts(psi_rel, (f[0], f[1]), (u[0], u[1]), (v[0], v[1]), share, x)


def magnet_moment(psi1: np.ndarray, psi_rel: np.ndarray, p: Mapping[str, float]) -> np.ndarray:
    """Compute the fitted torque M_M of the magnets about joint 1 [N m] (Wojna et al. 2018, Eq. 18-19).

    Parameters
    ----------
    psi1, psi_rel
        Angles [rad], of shapes that broadcast.
    p
        Values of `FITTED` by name.
    """
    parts = _parts(psi1, psi_rel, p)
    return np.asarray(parts.f[0] * parts.share[0] + parts.f[1] * parts.share[1])


def moment_slopes(psi1: np.ndarray, psi_rel: np.ndarray, p: Mapping[str, float]) -> np.ndarray:
    """Compute the derivatives of `magnet_moment` by the parameters; shape (..., 13) in the order of `FITTED`."""
    parts = _parts(psi1, psi_rel, p)
    stretch = 1.0 + (p["eps_mag"] * parts.x) ** 2
    turning = (parts.f[0] - parts.f[1]) / (np.pi * stretch)
    found = {"eps_mag": turning * parts.x}
    for i in (1, 2):
        f, u, v, share = (part[i - 1] for part in (parts.f, parts.u, parts.v, parts.share))
        gamma, c = p[f"gamma{i}"], p[f"c{i}"]
        found[f"alpha{i}"] = np.exp(-(u**2) - v**2) * share
        found[f"beta{i}"] = -2.0 * f * share * u / gamma
        found[f"gamma{i}"] = 2.0 * f * share * u * u / gamma
        found[f"c{i}"] = 2.0 * f * share * v * v / c
        found[f"r{i}"] = -2.0 * f * share * v / c + 0.5 * turning * p["eps_mag"]
        found[f"p{i}"] = found[f"r{i}"] * parts.locked
    return np.stack([found[name] for name in FITTED], axis=-1)


def weight_torque(psi1: np.ndarray, psi_rel: np.ndarray, p: Mapping[str, float]) -> np.ndarray:
    """Compute the torque of the links' weight about joint 1 with link 2 locked [N m]: the weight terms of Eq. 1 of
    Wojna et al. (2018).

    Parameters
    ----------
    psi1, psi_rel
        Angles [rad], of shapes that broadcast.
    p
        Masses, lengths and g by name.
    """
    upper = p["g"] * (p["m1"] * p["e1"] + p["m2"] * p["l1"])
    lower = p["g"] * p["m2"] * p["e2"]
    return np.asarray(-upper * np.sin(psi1) - lower * np.sin(np.asarray(psi1) + psi_rel))


def dipole_moment(psi1: np.ndarray, psi_rel: np.ndarray, p: Mapping[str, float]) -> np.ndarray:
    """Compute the torque of point dipoles about joint 1 [N m] (Wojna et al. 2018, Eq. 16).

    The force mu_0 pole1 pole2/(4 pi r**2) acts along the line between the magnets, which meets the fixed
    one; its moment about joint 1 is that of its horizontal part there, h below the joint.

    Parameters
    ----------
    psi1, psi_rel
        Angles [rad], of shapes that broadcast.
    p
        ``pole1``, ``pole2`` [A m], ``l1``, ``l2``, ``h`` [m].
    """
    psi2 = np.asarray(psi1) + psi_rel
    dx = p["l1"] * np.sin(psi1) + p["l2"] * np.sin(psi2)
    dy = p["h"] - p["l1"] * np.cos(psi1) - p["l2"] * np.cos(psi2)
    strength = _VACUUM_PERMEABILITY * p["pole1"] * p["pole2"] / (4.0 * np.pi)
    return np.asarray(strength * p["h"] * dx / (dx * dx + dy * dy) ** 1.5)


def reach(p: Mapping[str, float]) -> float:
    """Return the distance of the moving magnet from joint 1 with both links in line [m]."""
    return float(p["l1"] + p["l2"])
