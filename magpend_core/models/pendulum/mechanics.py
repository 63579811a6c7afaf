"""Compute mechanics of the pendulum at given states: accelerations, torques, energy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.models.pendulum.models import STATES
from magpend_core.pointwise import evaluate, rates
from magpend_core.validation import check_states


class Torques(NamedTuple):
    """Bearing loads and torques on the pendulum at given states.

    Attributes
    ----------
    load : ndarray, (..., 2)
        Bearing loads N1, N2 [N] (Eq. 9-11).
    friction : ndarray, (..., 2)
        Friction torques M_R1, M_R2 [N m] (Eq. 7-8).
    drive : ndarray, (...)
        Driving torque M_e [N m] (Eq. 12).
    magnet_moment : ndarray, (...)
        Torque of the magnets about joint 1, M_M [N m] (Eq. 19); with point dipoles, Q1 + Q2.
    magnet_torque : ndarray, (..., 2)
        Generalised torques Q1, Q2 [N m] (Eq. 20).
    """

    load: np.ndarray
    friction: np.ndarray
    drive: np.ndarray
    magnet_moment: np.ndarray
    magnet_torque: np.ndarray


_TORQUES = (
    "load1",
    "load2",
    "friction1",
    "friction2",
    "drive_torque",
    "magnet_moment",
    "magnet_torque1",
    "magnet_torque2",
)


def accelerations(t: float | np.ndarray, state: np.ndarray, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Compute the angular accelerations of both links from the full, implicit model.

    Parameters
    ----------
    t
        Time since a rising edge of the drive [s], a number or one per state.
    state
        ``(psi1, psi2, psi1_dot, psi2_dot)``, shape (..., 4) [rad, rad/s].
    parameters
        See `load_preset`.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    ndarray
        Accelerations of psi1 and psi2, shape (..., 2) [rad/s2].

    Raises
    ------
    ValueError
        If a time or a state is not finite or has the wrong shape, or the frequency is not positive.

    Notes
    -----
    Wojna et al., J. Sound Vib. 430 (2018), Eq. 1-20 as corrected in `magpend_core.models.pendulum.equations`.
    """
    return rates(t, state, parameters, frequency_hz)[..., 2:]


def torques(t: float | np.ndarray, state: np.ndarray, parameters: Parameters, frequency_hz: float) -> Torques:
    """Return bearing loads, friction, drive and magnet torques at given states.

    Parameters
    ----------
    t, state, parameters, frequency_hz
        As for `accelerations`.

    Returns
    -------
    Torques
        Arrays with the leading shape of `state`; without magnets, their torques are 0.

    Raises
    ------
    ValueError
        As for `accelerations`.
    """
    known = {q.name for q in parameters.model.quantities}
    x = evaluate([n for n in _TORQUES if n in known], t, state, parameters, frequency_hz)
    missing = [(0, 0)] * (x.ndim - 1) + [(0, len(_TORQUES) - x.shape[-1])]
    x = np.pad(x, missing)
    return Torques(x[..., 0:2], x[..., 2:4], x[..., 4], x[..., 5], x[..., 6:8])


def energy(state: np.ndarray, parameters: Parameters) -> np.ndarray:
    """Compute the mechanical energy of the links, drive and magnets excluded; 0 hanging at rest.

    Parameters
    ----------
    state
        Shape (..., 4) [rad, rad/s].
    parameters
        See `load_preset`.

    Returns
    -------
    ndarray
        Kinetic plus potential energy [J], the leading shape of `state`: the Hamiltonian of Eq. 1 without
        its torques.

    Raises
    ------
    ValueError
        If a state is not finite or has the wrong shape.
    """
    states = check_states(state, tuple(range(1, np.ndim(state) + 1)), len(STATES))
    psi1, psi2, w1, w2 = np.moveaxis(states, -1, 0)
    p = parameters
    b1 = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"]
    b2 = p["J2"] + p["e2"] ** 2 * p["m2"]
    coupling = p["m2"] * p["e2"] * p["l1"] * np.cos(psi1 - psi2)
    kinetic = 0.5 * b1 * w1**2 + 0.5 * b2 * w2**2 + coupling * w1 * w2
    height1 = (p["m1"] * p["e1"] + p["m2"] * p["l1"]) * (1.0 - np.cos(psi1))
    height2 = p["m2"] * p["e2"] * (1.0 - np.cos(psi2))
    return np.asarray(kinetic + p["g"] * (height1 + height2))
