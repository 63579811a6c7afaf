"""Classify motions by the side of the fixed magnet on which they stay, from their stored section points.

The rule
--------
The moving magnet hangs at the horizontal distance ::

    dx = l1 sin(psi1) + l2 sin(psi2)

from the vertical line through the pivot, on which the fixed magnet stands; the repelling torque
changes its sign there. A motion is one-sided if `dx` never changes its sign. What the cube has of a
motion is one point per drive period, the kept sections; so a cell counts as

* rotating, if a link made full turns, net, over the kept periods;
* left or right, if `dx` is negative or positive at every kept section;
* straddling, if it is neither: kept sections lie on both sides;
* undecided, if all kept sections lie on one side but the drive is slower than the pendulum's slower
  small-angle mode without magnets, whose period is the time of a full swing: between two sections the
  pendulum then has time to cross over and come back;
* unknown, if there is nothing to judge: pending, failed, or not reached.

The sign of `psi1` at the sections is no substitute: it would call 360 of the 5089 one-sided closed
orbits below straddling.

Evidence
--------
Preset ``wojna2018``, whose slower mode has 0.926 Hz; each kept section was integrated over the period that
follows it, and the sign of `dx` along the way compared with the label.

* 2 to 3 Hz, up and down continuation, 16 branches of 401 frequencies, 64 kept sections: all 5089
  closed orbits are one-sided and labelled as they move. Of 1327 cells that are not closed, 1 is called
  one-sided though it steps across between two sections; with 12 kept sections, 65 are that straddle
  within 64 periods.
* 2.2 to 3 Hz, 1500 random initial states with angles up to pi, 64 kept sections: no wrong label.
* 0.1 to 2 Hz, 8 branches of 191 frequencies, 32 kept sections: every motion straddles or rotates. At
  0.72 Hz and below 167 of them show all their kept sections on one side, above that none does.

The torque of the fitted magnet changes its sign at ``psi1 - m psi_rel - n = 0`` instead of ``dx = 0``;
judging the motions by that line moved 1 of these 9444 cells to another class. `dx` is used because it
needs no magnet model and has no jump where an angle passes pi.

Limits
------
One section per period is a sample: a motion that crosses over and back within every period at the same
phase is not seen (hence undecided), a chaotic one that crosses rarely needs many kept sections, and
turns that cancel over the kept periods are not rotation here.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np


class Side(IntEnum):
    """Label of a motion by its side of the fixed magnet: left, right, both, or other outcomes."""

    UNKNOWN = 0
    LEFT = 1
    RIGHT = 2
    STRADDLING = 3
    ROTATING = 4
    UNDECIDED = 5


WORDS = tuple(s.name.lower() for s in Side)
NEUTRAL = (int(Side.UNKNOWN), int(Side.UNDECIDED))


def magnet_offset(states: np.ndarray, parameters: Mapping[str, Any]) -> np.ndarray:
    """Compute the horizontal distance of the moving magnet from the fixed one [m], positive to the right.

    Parameters
    ----------
    states
        psi1, psi2, ... [rad], shape (..., n_states).
    parameters
        ``l1`` and ``l2`` [m], numbers or arrays that broadcast to the leading shape.
    """
    return np.asarray(parameters["l1"] * np.sin(states[..., 0]) + parameters["l2"] * np.sin(states[..., 1]))


def slowest_hz(parameters: Mapping[str, Any]) -> np.ndarray:
    """Compute the frequency [Hz] of the slower small-angle mode of the links without magnets and friction.

    The smaller root w**2 of det(K - w**2 M) = 0 with the linear part of Eq. 1.
    """
    p = parameters
    b1 = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"]
    b2 = p["J2"] + p["e2"] ** 2 * p["m2"]
    n12 = p["m2"] * p["e2"] * p["l1"]
    k1 = (p["m1"] * p["e1"] + p["m2"] * p["l1"]) * p["g"]
    k2 = p["m2"] * p["e2"] * p["g"]
    middle = 0.5 * (b1 * k2 + b2 * k1)
    root = np.sqrt(middle**2 - (b1 * b2 - n12**2) * k1 * k2)
    return np.asarray(np.sqrt((middle - root) / (b1 * b2 - n12**2)) / (2.0 * np.pi))


def classify(
    section: np.ndarray, turns: np.ndarray, frequency_hz: np.ndarray, parameters: Mapping[str, Any]
) -> np.ndarray:
    """Label motions by the side of the fixed magnet on which they stay, from their stored section points and full
    turns.

    Parameters
    ----------
    section
        Kept states, shape (..., n_keep, n_states) [rad, rad/s].
    turns
        Full turns of each link over the kept periods, shape (..., 2).
    frequency_hz
        Drive frequency, broadcasts to the leading shape [Hz].
    parameters
        By name, values that broadcast to the leading shape.

    Returns
    -------
    ndarray of int8
        Codes of `Side`, the leading shape.
    """
    lengths = {name: np.asarray(parameters[name])[..., None] for name in ("l1", "l2")}
    offset = magnet_offset(section, lengths)
    left, right = (offset < 0.0).all(axis=-1), (offset > 0.0).all(axis=-1)
    label = np.select([left, right], [Side.LEFT, Side.RIGHT], Side.STRADDLING).astype(np.int8)
    slow = np.asarray(frequency_hz) < slowest_hz(parameters)
    label = np.where((left | right) & slow, np.int8(Side.UNDECIDED), label)
    return np.where((np.asarray(turns) != 0).any(axis=-1), np.int8(Side.ROTATING), label)
