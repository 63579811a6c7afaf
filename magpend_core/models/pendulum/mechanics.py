"""The model's quantities at given states, for people: plain arrays in, plain arrays out.

They are evaluated by the very functions that the engine integrates.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.jit import inline, kernel, specialise
from magpend_core.engine.simd import WIDTH, load, load_rows, store_rows
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import sincos
from magpend_core.models.pendulum.equations import (
    N_LINK,
    DipoleConstants,
    FittedConstants,
    LinkConstants,
    dipole_torques,
    fitted_torques,
    loads,
    magnet_moment,
    stribeck,
)
from magpend_core.models.pendulum.parameters import Parameters
from magpend_core.models.pendulum.systems import PENDULUM_FITTED, system_of
from magpend_core.validation import check_frequency, check_states


class Torques(NamedTuple):
    """What acts on the pendulum at a state.

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


def _rates(t: Any, y: Any, c: Any) -> Any:
    return rhs(y, forcing(t, c), c)


def _slopes(t: Any, y: Any, c: Any) -> Any:
    return rhs_jacobian(y, forcing(t, c), c)


@inline
def _fitted_moments(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    k = FittedConstants(*c[N_LINK:])
    q1, q2 = fitted_torques(y[0], y[1], s1, c1, s2, c2, k)
    return magnet_moment(y[0], y[1] - y[0], k), q1, q2


@inline
def _dipole_moments(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    q1, q2 = dipole_torques(y[0], y[1], s1, c1, s2, c2, DipoleConstants(*c[N_LINK:]))
    return q1 + q2, q1, q2


def _torques(t: Any, y: Any, c: Any) -> Any:
    u = forcing(t, c)
    _, _, a1, a2 = rhs(y, u, c)
    s1, c1 = sincos(y[0])
    s2, c2 = sincos(y[1])
    k = LinkConstants(*c[:N_LINK])
    n1, n2 = loads(s1, c1, s1 * c2 - c1 * s2, c1 * c2 + s1 * s2, y[2], y[3], a1, a2, k)
    v2 = y[3] - y[2]
    r1 = (k.T1 + k.mu * n1) * stribeck(y[2], k) + k.viscous1 * y[2]
    r2 = (k.T2 + k.mu * n2) * stribeck(v2, k) + k.viscous2 * v2
    moment, q1, q2 = moments(y, s1, c1, s2, c2, c)
    return n1, n2, r1, r2, u, moment, q1, q2


def _evaluate(t: Any, states: Any, frequency: float, p: Any, out: Any) -> None:
    """Fill `out` (n, n_out) with the bound function at `t` (n,) and `states` (n, N)."""
    c = np.empty(NC)
    constants(frequency, p, c)
    rows = np.empty(NC * WIDTH)
    for i in range(NC):
        for lane in range(WIDTH):
            rows[i * WIDTH + lane] = c[i]
    time = np.zeros(WIDTH)
    y = np.zeros(N * WIDTH)
    values = np.zeros(out.shape[1] * WIDTH)
    n = len(t)
    for first in range(0, n, WIDTH):
        for lane in range(WIDTH):
            source = min(first + lane, n - 1)
            time[lane] = t[source]
            for i in range(N):
                y[i * WIDTH + lane] = states[source, i]
        store_rows(values, 0, quantity(load(time, 0), load_rows(y, 0, N), load_rows(rows, 0, NC)))
        for lane in range(min(WIDTH, n - first)):
            for i in range(out.shape[1]):
                out[first + lane, i] = values[i * WIDTH + lane]


_QUANTITIES = {"rates": (_rates, 4), "slopes": (_slopes, 16), "torques": (_torques, 8)}


@cache
def _evaluator(system: System, name: str) -> Any:
    bindings: dict[str, Any] = {
        "N": system.n_states,
        "NC": system.n_constants,
        "rhs": system.rhs,
        "forcing": system.forcing,
        "rhs_jacobian": system.jacobian,
        "constants": system.constants,
        "moments": _fitted_moments if system is PENDULUM_FITTED else _dipole_moments,
    }
    label = f"{system.label}_{name}"
    bindings["quantity"] = inline(specialise(_QUANTITIES[name][0], label, **bindings))
    return kernel(specialise(_evaluate, label, **bindings))


def _at(name: str, t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Evaluate a quantity; the result has the leading shape of `state` and one last dim."""
    frequency = check_frequency(frequency_hz, ndim=0)
    states = check_states(state, ndim=(1, 2))
    many = np.atleast_2d(states)
    times = np.ascontiguousarray(np.broadcast_to(np.asarray(t, np.float64), len(many)))
    # one period is as good as another, and short times keep the drive's phase exact
    local = np.mod(times, 1.0 / float(frequency))
    out = np.empty((len(many), _QUANTITIES[name][1]))
    evaluate = _evaluator(system_of(parameters), name)
    evaluate(local, many, float(frequency), parameters.pack(), out)
    return out.reshape((*states.shape[:-1], out.shape[1]))


def accelerations(
    t: float | np.ndarray, state: np.ndarray, parameters: Parameters, frequency_hz: float
) -> np.ndarray:
    """Angular accelerations of both links from the full, implicit model.

    Parameters
    ----------
    t
        Time since a rising edge of the drive [s], a number or one per state.
    state
        ``(psi1, psi2, psi1_dot, psi2_dot)``, shape (4,) or (n, 4) [rad, rad/s].
    parameters
        See `load_preset`.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    ndarray
        Accelerations of psi1 and psi2, shape (2,) or (n, 2) [rad/s2].

    Raises
    ------
    ValueError
        If a state is not finite or has the wrong shape, or the frequency is not positive.

    Notes
    -----
    Wojna et al., J. Sound Vib. 430 (2018), Eq. 1-20 as corrected in `magpend_core.models.pendulum.equations`.
    """
    return _at("rates", t, state, parameters, frequency_hz)[..., 2:]


def jacobian(
    t: float | np.ndarray, state: np.ndarray, parameters: Parameters, frequency_hz: float
) -> np.ndarray:
    """Analytic Jacobian of the state's time derivative, implicit loads included.

    Parameters
    ----------
    t, state, parameters, frequency_hz
        As for `accelerations`.

    Returns
    -------
    ndarray
        Shape (4, 4) or (n, 4, 4); entry [i, j] is the derivative of the rate of state i by state j.

    Raises
    ------
    ValueError
        As for `accelerations`.
    """
    flat = _at("slopes", t, state, parameters, frequency_hz)
    return flat.reshape((*flat.shape[:-1], 4, 4))


def torques(t: float | np.ndarray, state: np.ndarray, parameters: Parameters, frequency_hz: float) -> Torques:
    """Bearing loads, friction, drive and magnet torques at given states.

    Parameters
    ----------
    t, state, parameters, frequency_hz
        As for `accelerations`.

    Returns
    -------
    Torques
        Arrays with the leading shape of `state`.

    Raises
    ------
    ValueError
        As for `accelerations`.
    """
    x = _at("torques", t, state, parameters, frequency_hz)
    return Torques(x[..., 0:2], x[..., 2:4], x[..., 4], x[..., 5], x[..., 6:8])


def energy(state: np.ndarray, parameters: Parameters) -> np.ndarray:
    """Mechanical energy of the links, drive and magnets excluded; 0 hanging at rest.

    Parameters
    ----------
    state
        Shape (4,) or (n, 4) [rad, rad/s].
    parameters
        See `load_preset`.

    Returns
    -------
    ndarray
        Kinetic plus potential energy [J], shape () or (n,): the Hamiltonian of Eq. 1 without its
        torques.

    Raises
    ------
    ValueError
        If a state is not finite or has the wrong shape.
    """
    psi1, psi2, w1, w2 = np.moveaxis(check_states(state, ndim=(1, 2)), -1, 0)
    p = parameters.pendulum
    b1 = p.J1 + p.e1**2 * p.m1 + p.l1**2 * p.m2
    b2 = p.J2 + p.e2**2 * p.m2
    coupling = p.m2 * p.e2 * p.l1 * np.cos(psi1 - psi2)
    kinetic = 0.5 * b1 * w1**2 + 0.5 * b2 * w2**2 + coupling * w1 * w2
    height1 = (p.m1 * p.e1 + p.m2 * p.l1) * (1.0 - np.cos(psi1))
    height2 = p.m2 * p.e2 * (1.0 - np.cos(psi2))
    return np.asarray(kinetic + p.g * (height1 + height2))
