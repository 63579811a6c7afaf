"""The pendulum as a system that the engine integrates: fitted magnet and point dipoles."""

from __future__ import annotations

import math
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import exp, sincos, wrapped
from magpend_core.models.pendulum.equations import (
    N_DIPOLE,
    N_FITTED,
    N_LINK,
    VACUUM_PERMEABILITY,
    DipoleConstants,
    FittedConstants,
    LinkConstants,
    dipole_torques,
    drive,
    fitted_torques,
    link_constants,
    solve_accelerations,
)
from magpend_core.models.pendulum.jacobian import (
    acceleration_slopes,
    dipole_torque_slopes,
    fitted_torque_slopes,
)
from magpend_core.models.pendulum.parameters import (
    DipoleMagnet,
    Drive,
    FittedMagnet,
    Friction,
    Parameters,
    Pendulum,
    _names,
)

_LINK_NAMES = _names(Pendulum) + _names(Friction) + _names(Drive)
_N_LINK_PARAMETERS = len(_LINK_NAMES)
_link_constants = inline(link_constants)


@inline
def _fitted_constants(frequency: Any, p: Any, out: Any) -> None:
    """Fill `out` with `LinkConstants`, then `FittedConstants`."""
    values = _link_constants(frequency, p)
    for i in range(N_LINK):
        out[i] = values[i]
    alpha1, alpha2, beta1, beta2 = p[18], p[19], p[20], p[21]
    gamma1, gamma2, p1, p2 = p[22], p[23], p[24], p[25]
    r1, r2, c1, c2, eps_mag, l2, h, delta = p[26], p[27], p[28], p[29], p[30], p[31], p[32], p[33]
    jump = (abs(alpha1) + abs(alpha2)) * values.compliance1
    per_magnet_jump = eps_mag / max(jump, 1e-30)
    magnet = FittedConstants(
        0.5 * alpha1, 0.5 * alpha2, beta1, beta2, 1.0 / gamma1, 1.0 / gamma2, p1, p2, r1, r2,
        1.0 / c1, 1.0 / c2, -0.5 * (p1 + p2), -0.5 * (r1 + r2), eps_mag, 1.0 / eps_mag,
        p[1], l2, h, 1.0 / h, p[1] / h, l2 / h, delta * delta, per_magnet_jump,
    )  # fmt: skip
    for i in range(N_FITTED):
        out[N_LINK + i] = magnet[i]


@inline
def _dipole_constants(frequency: Any, p: Any, out: Any) -> None:
    """Fill `out` with `LinkConstants`, then `DipoleConstants`."""
    values = _link_constants(frequency, p)
    for i in range(N_LINK):
        out[i] = values[i]
    out[N_LINK] = VACUUM_PERMEABILITY * p[18] * p[19] / (4.0 * math.pi)
    out[N_LINK + 1] = p[1]
    out[N_LINK + 2] = p[20]
    out[N_LINK + 3] = p[21]


@inline
def _forcing(t: Any, c: Any) -> Any:
    return drive(t, LinkConstants(*c[:N_LINK]))


@inline
def _fitted_rhs(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    q1, q2 = fitted_torques(psi1, psi2, s1, c1, s2, c2, FittedConstants(*c[N_LINK:]))
    a1, a2 = solve_accelerations(s1, c1, s2, c2, w1, w2, u + q1, q2, LinkConstants(*c[:N_LINK]))
    return w1, w2, a1, a2


@inline
def _dipole_rhs(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    q1, q2 = dipole_torques(psi1, psi2, s1, c1, s2, c2, DipoleConstants(*c[N_LINK:]))
    a1, a2 = solve_accelerations(s1, c1, s2, c2, w1, w2, u + q1, q2, LinkConstants(*c[:N_LINK]))
    return w1, w2, a1, a2


@inline
def _edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """Rising edge at 0, falling edge at d/f; sin(omega t + phase) + a has slope omega cos(phase)."""
    k = _link_constants(frequency, p)
    width = 1.0 / (k.eps_drive * k.omega * sincos(k.phase)[1])
    jump = math.pi * k.drive_amplitude * k.compliance1
    times[0] = 0.0
    times[1] = p[15] / frequency
    for i in range(2):
        half_widths[i] = width
        jumps[i] = abs(jump)


@inline
def _friction_layers(y: Any, dy: Any, k: Any) -> Any:
    """Velocity reversals in the joints: atan(eps v) has its poles at v = +-i/eps."""
    return (
        (y[2], dy[2], k.per_eps, k.per_reversal1),
        (y[3] - y[2], dy[3] - dy[2], k.per_eps, k.per_reversal2),
    )


@inline
def _fitted_layers(y: Any, dy: Any, c: Any) -> Any:
    """The friction's layers and that of the magnets, between the two bumps.

    The zero of dx, the regularised other singularity of Eq. 20, is so near that of x, and as wide,
    that one layer serves for both.
    """
    k = FittedConstants(*c[N_LINK:])
    psi_rel = wrapped(y[1] - y[0])
    u = (psi_rel + k.beta1) * k.per_gamma1
    x = wrapped(y[0]) - (k.m * psi_rel + k.n)
    magnet = (x, y[2] - k.m * (y[3] - y[2]), k.per_eps_mag, k.per_magnet_jump * exp(u * u))
    friction1, friction2 = _friction_layers(y, dy, LinkConstants(*c[:N_LINK]))
    return friction1, friction2, magnet


@inline
def _dipole_layers(y: Any, dy: Any, c: Any) -> Any:
    """The friction's layers; the dipoles' field has none."""
    return _friction_layers(y, dy, LinkConstants(*c[:N_LINK]))


@inline
def _fitted_jacobian(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    _, _, a1, a2 = _fitted_rhs(y, u, c)
    slopes = fitted_torque_slopes(psi1, psi2, s1, c1, s2, c2, FittedConstants(*c[N_LINK:]))
    zero = 0.0 * psi1
    one = zero + 1.0
    kinematic = (zero, zero, one, zero, zero, zero, zero, one)
    k = LinkConstants(*c[:N_LINK])
    return kinematic + acceleration_slopes(s1, c1, s2, c2, w1, w2, a1, a2, slopes, k)


@inline
def _dipole_jacobian(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    _, _, a1, a2 = _dipole_rhs(y, u, c)
    slopes = dipole_torque_slopes(psi1, psi2, s1, c1, s2, c2, DipoleConstants(*c[N_LINK:]))
    zero = 0.0 * psi1
    one = zero + 1.0
    kinematic = (zero, zero, one, zero, zero, zero, zero, one)
    k = LinkConstants(*c[:N_LINK])
    return kinematic + acceleration_slopes(s1, c1, s2, c2, w1, w2, a1, a2, slopes, k)


PENDULUM_FITTED = System(
    name="pendulum_fitted",
    state_names=("psi1", "psi2", "psi1_dot", "psi2_dot"),
    is_angle=(True, True, False, False),
    scales=(1.0, 1.0, 10.0, 10.0),
    parameter_names=_LINK_NAMES + _names(FittedMagnet),
    n_constants=N_LINK + N_FITTED,
    constants=_fitted_constants,
    forcing=_forcing,
    rhs=_fitted_rhs,
    n_edges=2,
    edges=_edges,
    layers=_fitted_layers,
    jacobian=_fitted_jacobian,
    escape=(math.inf, math.inf, 1e4, 1e4),
)
"""The pendulum with the fitted magnet torque (Eq. 1-20)."""

PENDULUM_DIPOLE = System(
    name="pendulum_dipole",
    state_names=("psi1", "psi2", "psi1_dot", "psi2_dot"),
    is_angle=(True, True, False, False),
    scales=(1.0, 1.0, 10.0, 10.0),
    parameter_names=_LINK_NAMES + _names(DipoleMagnet),
    n_constants=N_LINK + N_DIPOLE,
    constants=_dipole_constants,
    forcing=_forcing,
    rhs=_dipole_rhs,
    n_edges=2,
    edges=_edges,
    layers=_dipole_layers,
    jacobian=_dipole_jacobian,
    escape=(math.inf, math.inf, 1e4, 1e4),
)
"""The pendulum with point dipoles (Eq. 1-16)."""


def system_of(parameters: Parameters) -> System:
    """The system whose packed vector `parameters.pack()` is."""
    return PENDULUM_DIPOLE if isinstance(parameters.magnet, DipoleMagnet) else PENDULUM_FITTED
