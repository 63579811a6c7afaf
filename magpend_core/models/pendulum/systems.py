"""Define the pendulum's systems for the engine: one for each kind of magnets and drive."""

from __future__ import annotations

import math
from typing import Any

from magpend_core.engine.jit import inline, specialise
from magpend_core.engine.system import System, positions
from magpend_core.engine.vecmath import LN2, LOG2_E, exp, sincos, wrapped
from magpend_core.models.model import Model
from magpend_core.models.pendulum import jacobian
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
    loads,
    magnet_moment,
    sine_constants,
    sine_drive,
    solve_accelerations,
    square_wave_constants,
    stribeck,
)
from magpend_core.models.pendulum.models import DIPOLE, DIPOLE_SINE, FITTED, FITTED_SINE, FREE, FREE_SINE


@inline
def _common_quantities(y: Any, dy: Any, u: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any) -> Any:
    """Compute energy, powers, loads and friction torques, which do not depend on the magnets."""
    _, _, w1, w2 = y
    s12, c12 = s1 * c2 - c1 * s2, c1 * c2 + s1 * s2
    kinetic = 0.5 * k.B1 * (w1 * w1) + 0.5 * k.B2 * (w2 * w2) + k.N12 * c12 * (w1 * w2)
    energy = kinetic + (k.M1 * (1.0 - c1) + k.M2 * (1.0 - c2))
    n1, n2 = loads(s1, c1, s12, c12, w1, w2, dy[2], dy[3], k)
    v2 = w2 - w1
    r1 = (k.T1 + k.mu * n1) * stribeck(w1, k) + k.viscous1 * w1
    r2 = (k.T2 + k.mu * n2) * stribeck(v2, k) + k.viscous2 * v2
    return energy, u * w1, r1 * w1 + r2 * v2, u, r1, r2, n1, n2


def free_quantities(t: Any, y: Any, dy: Any, u: Any, c: Any) -> Any:
    """Compute the named quantities of the pendulum without magnets."""
    s1, c1 = sincos(y[0])
    s2, c2 = sincos(y[1])
    return _common_quantities(y, dy, u, s1, c1, s2, c2, LinkConstants(*c[:N_LINK]))


def fitted_quantities(t: Any, y: Any, dy: Any, u: Any, c: Any) -> Any:
    """Compute the named quantities of the pendulum with the fitted magnet torque."""
    s1, c1 = sincos(y[0])
    s2, c2 = sincos(y[1])
    common = _common_quantities(y, dy, u, s1, c1, s2, c2, LinkConstants(*c[:N_LINK]))
    k = FittedConstants(*c[N_LINK:])
    q1, q2 = magnet_torques(y, s1, c1, s2, c2, c)
    moment = magnet_moment(y[0], y[1] - y[0], k)
    return common + (moment, q1, q2, k.l1 * s1 + k.l2 * s2, -(k.l1 * c1 + k.l2 * c2))


def dipole_quantities(t: Any, y: Any, dy: Any, u: Any, c: Any) -> Any:
    """Compute the named quantities of the pendulum with point dipoles."""
    s1, c1 = sincos(y[0])
    s2, c2 = sincos(y[1])
    common = _common_quantities(y, dy, u, s1, c1, s2, c2, LinkConstants(*c[:N_LINK]))
    k = DipoleConstants(*c[N_LINK:])
    q1, q2 = magnet_torques(y, s1, c1, s2, c2, c)
    return common + (q1 + q2, q1, q2, k.l1 * s1 + k.l2 * s2, -(k.l1 * c1 + k.l2 * c2))


QUANTITIES = {"fitted": fitted_quantities, "dipole": dipole_quantities, "none": free_quantities}
"""Template by kind of magnets."""


# ---- magnets: constants, torques, layers, slopes -------------------------------------------------


def _fitted_magnet(p: Any, values: Any, out: Any) -> None:
    """Fill `out` with the constants of the fitted magnet torque, `FittedConstants`."""
    alpha1, alpha2, eps_mag = p[AT.alpha1], p[AT.alpha2], p[AT.eps_mag]
    p1, p2, r1, r2, l1, l2, h = p[AT.p1], p[AT.p2], p[AT.r1], p[AT.r2], p[AT.l1], p[AT.l2], p[AT.h]
    jump = (abs(alpha1) + abs(alpha2)) * values.compliance1
    per_magnet_jump = eps_mag / max(jump, 1e-30)
    root = math.sqrt(LOG2_E)
    magnet = FittedConstants(
        0.5 * alpha1,
        0.5 * alpha2,
        p[AT.beta1],
        p[AT.beta2],
        root / p[AT.gamma1],
        root / p[AT.gamma2],
        p1,
        p2,
        r1,
        r2,
        root / p[AT.c1],
        root / p[AT.c2],
        -0.5 * (p1 + p2),
        -0.5 * (r1 + r2),
        eps_mag,
        1.0 / eps_mag,
        l1,
        l2,
        h,
        1.0 / h,
        l1 / h,
        l2 / h,
        p[AT.delta] * p[AT.delta],
        per_magnet_jump,
    )
    for i in range(N_FITTED):
        out[N_LINK + i] = magnet[i]


def _dipole_magnet(p: Any, values: Any, out: Any) -> None:
    out[N_LINK] = VACUUM_PERMEABILITY * p[AT.pole1] * p[AT.pole2] / (4.0 * math.pi)
    out[N_LINK + 1] = p[AT.l1]
    out[N_LINK + 2] = p[AT.l2]
    out[N_LINK + 3] = p[AT.h]


def _no_magnet(p: Any, values: Any, out: Any) -> None:
    """Do nothing: without magnets there are no constants to fill in."""


@inline
def _fitted_magnet_torques(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    return fitted_torques(y[0], y[1], s1, c1, s2, c2, FittedConstants(*c[N_LINK:]))


@inline
def _dipole_magnet_torques(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    return dipole_torques(y[0], y[1], s1, c1, s2, c2, DipoleConstants(*c[N_LINK:]))


@inline
def _no_magnet_torques(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    return 0.0 * s1, 0.0 * s1


@inline
def _friction_layers(y: Any, dy: Any, k: Any) -> Any:
    """Return the boundary layers of the friction at velocity reversals in the joints: atan(eps v) has its poles at v =
    +-i/eps.
    """
    return ((y[2], dy[2], k.per_eps, k.per_reversal1), (y[3] - y[2], dy[3] - dy[2], k.per_eps, k.per_reversal2))


@inline
def _fitted_layers(y: Any, dy: Any, c: Any) -> Any:
    """Return the boundary layers of the friction, and that of the fitted magnet torque between its two bumps.

    The zero of dx, the regularised other singularity of Eq. 20, is so near that of x, and as wide,
    that one layer serves for both.
    """
    k = FittedConstants(*c[N_LINK:])
    psi_rel = wrapped(y[1] - y[0])
    u = (psi_rel + k.beta1) * k.per_gamma1
    x = wrapped(y[0]) - (k.m * psi_rel + k.n)
    magnet = (x, y[2] - k.m * (y[3] - y[2]), k.per_eps_mag, k.per_magnet_jump * exp(LN2 * (u * u)))
    friction1, friction2 = _friction_layers(y, dy, LinkConstants(*c[:N_LINK]))
    return friction1, friction2, magnet


@inline
def _plain_layers(y: Any, dy: Any, c: Any) -> Any:
    return _friction_layers(y, dy, LinkConstants(*c[:N_LINK]))


@inline
def _fitted_slopes(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    return jacobian.fitted_torque_slopes(y[0], y[1], s1, c1, s2, c2, FittedConstants(*c[N_LINK:]))


@inline
def _dipole_slopes(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    return jacobian.dipole_torque_slopes(y[0], y[1], s1, c1, s2, c2, DipoleConstants(*c[N_LINK:]))


@inline
def _no_slopes(y: Any, s1: Any, c1: Any, s2: Any, c2: Any, c: Any) -> Any:
    zero = 0.0 * s1
    return zero, zero, zero, zero


# ---- what all share: templates over magnets and drive --------------------------------------------


def _constants(frequency: Any, p: Any, out: Any) -> None:
    values = all_link_constants(frequency, p)
    for i in range(N_LINK):
        out[i] = values[i]
    fill_magnet(p, values, out)


def _forcing(t: Any, c: Any) -> Any:
    return drive_torque(t, LinkConstants(*c[:N_LINK]))


def _rhs(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    q1, q2 = magnet_torques(y, s1, c1, s2, c2, c)
    a1, a2 = solve_accelerations(s1, c1, s2, c2, w1, w2, u + q1, q2, LinkConstants(*c[:N_LINK]))
    return w1, w2, a1, a2


def _jacobian(y: Any, u: Any, c: Any) -> Any:
    psi1, psi2, w1, w2 = y
    s1, c1 = sincos(psi1)
    s2, c2 = sincos(psi2)
    _, _, a1, a2 = rhs(y, u, c)
    slopes = magnet_slopes(y, s1, c1, s2, c2, c)
    zero = 0.0 * psi1
    one = zero + 1.0
    kinematic = (zero, zero, one, zero, zero, zero, zero, one)
    k = LinkConstants(*c[:N_LINK])
    return kinematic + acceleration_slopes(s1, c1, s2, c2, w1, w2, a1, a2, slopes, k)


def _square_wave_edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """Fill in times, half-widths and jumps of a square wave's two edges: rising at the period's start, falling after
    the fraction `duty_cycle`.
    """
    k = all_link_constants(frequency, p)
    width = 1.0 / (k.eps_drive * k.omega * sincos(k.phase)[1])
    jump = math.pi * k.drive_amplitude * k.compliance1
    times[0] = 0.0
    times[1] = p[AT.duty_cycle] / frequency
    for i in range(2):
        half_widths[i] = width
        jumps[i] = abs(jump)


def _no_edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """Set no forcing edges: the sine drive is smooth."""


_MAGNETS: dict[str, tuple[int, Any, Any, Any, Any]] = {
    "fitted": (N_FITTED, _fitted_magnet, _fitted_magnet_torques, _fitted_layers, _fitted_slopes),
    "dipole": (N_DIPOLE, _dipole_magnet, _dipole_magnet_torques, _plain_layers, _dipole_slopes),
    "none": (0, _no_magnet, _no_magnet_torques, _plain_layers, _no_slopes),
}
_DRIVES: dict[str, tuple[int, Any, Any, Any]] = {
    "square": (2, square_wave_constants, drive, _square_wave_edges),
    "sine": (0, sine_constants, sine_drive, _no_edges),
}


def _system(model: Model, magnets: str, driven: str) -> System:
    """Build the system for one kind of magnets and drive from the function templates of this module."""
    n_magnet, fill, torques, layers, slopes = _MAGNETS[magnets]
    n_edges, drive_constants, drive_torque, edges = _DRIVES[driven]
    name = "pendulum_" + (magnets if driven == "square" else f"{magnets}_{driven}")
    bound: dict[str, Any] = {
        "AT": positions(model.parameter_names),
        "drive_torque": drive_torque,
        "magnet_torques": torques,
        "magnet_slopes": slopes,
        "acceleration_slopes": jacobian.acceleration_slopes,
    }

    def bind(template: Any, key: str) -> Any:
        bound[key] = inline(specialise(template, name, **bound))
        return bound[key]

    bind(drive_constants, "drive_constants")
    bind(link_constants, "all_link_constants")
    bind(fill, "fill_magnet")
    return System(
        name=name,
        state_names=model.state_names,
        is_angle=model.is_angle,
        scales=model.scales,
        parameter_names=model.parameter_names,
        n_constants=N_LINK + n_magnet,
        constants=bind(_constants, "constants"),
        forcing=bind(_forcing, "forcing"),
        rhs=bind(_rhs, "rhs"),
        n_edges=n_edges,
        edges=bind(edges, "edges"),
        layers=layers,
        jacobian=bind(_jacobian, "rhs_jacobian"),
        escape=tuple(s.escape for s in model.states),
        quantity_names=tuple(q.name for q in model.quantities),
        quantities=bind(QUANTITIES[magnets], "quantities"),
    )


PENDULUM_FITTED = _system(FITTED, "fitted", "square")
"""Fitted magnet torque (Eq. 1-20)."""

PENDULUM_FITTED_SINE = _system(FITTED_SINE, "fitted", "sine")

PENDULUM_DIPOLE = _system(DIPOLE, "dipole", "square")
"""Point dipoles (Eq. 1-16)."""

PENDULUM_DIPOLE_SINE = _system(DIPOLE_SINE, "dipole", "sine")

PENDULUM_FREE = _system(FREE, "none", "square")
"""No magnets (Eq. 1-15)."""

PENDULUM_FREE_SINE = _system(FREE_SINE, "none", "sine")
