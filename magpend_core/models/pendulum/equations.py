"""Define the equations of the pendulum with magnets: Wojna et al., J. Sound Vib. 430 (2018) 214-230, by equation
number.

Functions of numbers that are compiled for a float64 or for a group of lanes. The state is
``(psi1, psi2, psi1_dot, psi2_dot)``: absolute angles of the links from the downward vertical [rad]
and their rates [rad/s]; ``psi_rel = psi2 - psi1``. SI units throughout.

Where the model completes or corrects the paper:

* The magnetic torques stand on the right-hand side of Eq. 1, positive where they increase the
  angle, so that a repelling magnet pushes the pendulum away from the bottom.
* The bearing loads contain the accelerations (Eq. 9-11), which makes the model implicit. It is
  solved, not simplified: a linear solve without the load-dependent friction, then two Newton steps.
  The relative residual is below 1e-12 on the preset and grows with the fifth power of mu: 2e-12 at
  twice the preset's mu, 6e-9 at ten times.
* In the drive (Eq. 12) the constant `a` is added to the sine, and the phase is half of what Eq. 14
  prints, so that the rising edge is at t = 0 and the high state lasts the fraction `duty_cycle`.
* In Eq. 19 the second bracket is a sum, ``f1 + f2``.
* Angles enter the magnet's torque modulo one turn: after a full rotation a link is where it was.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import absolute, maximum, multiply_add, sqrt
from magpend_core.engine.vecmath import LOG2_E, TWO_OVER_PI, TWO_PI, atan, exp2_falling, sin, wrapped

VACUUM_PERMEABILITY = 1.25663706212e-6  # N/A2, CODATA 2018


class LinkConstants(NamedTuple):
    """Constants of motion, friction and drive that follow from the parameters."""

    B1: Any  # kg m2, J1 + e1^2 m1 + l1^2 m2
    B2: Any  # kg m2, J2 + e2^2 m2
    N12: Any  # kg m2, m2 e2 l1
    M1: Any  # N m, m1 g e1 + m2 g l1
    M2: Any  # N m, m2 g e2
    B1_B2: Any
    m1_g: Any  # N
    m2_g: Any  # N
    m1_e1: Any  # kg m
    m2_e2: Any  # kg m
    m2_l1: Any  # kg m
    m1_e1_m2_l1: Any  # kg m
    T1: Any  # N m
    T2: Any  # N m
    viscous1: Any  # N m s, 2 c
    viscous2: Any  # N m s, c
    mu: Any  # m
    stribeck_floor: Any  # 2 mu0/pi
    stribeck_drop: Any  # 2 (1 - mu0)/pi
    c0: Any  # s/rad, times log2(e): for powers of two
    eps: Any  # s/rad
    per_eps: Any  # rad/s
    omega: Any  # rad/s, of the drive
    phase: Any  # rad, Eq. 14 corrected
    offset: Any  # a of Eq. 13
    drive_amplitude: Any  # N m, 2 q/pi of the square wave, q of the sine
    eps_drive: Any
    compliance1: Any  # 1/(kg m2), acceleration per torque on link 1, links in line
    per_reversal1: Any  # 1/(rad2/s3), see `System.layers`
    per_reversal2: Any


class FittedConstants(NamedTuple):
    """Constants of the fitted magnet torque (Wojna et al. 2018, Eq. 18-20)."""

    half_alpha1: Any  # N m
    half_alpha2: Any
    beta1: Any  # rad
    beta2: Any
    per_gamma1: Any  # 1/rad, times sqrt(log2(e)): for powers of two
    per_gamma2: Any
    p1: Any
    p2: Any
    r1: Any  # rad
    r2: Any
    per_c1: Any  # 1/rad, times sqrt(log2(e))
    per_c2: Any
    m: Any  # slope of the middle of the peaks
    n: Any  # rad
    eps_mag: Any  # 1/rad
    per_eps_mag: Any  # rad
    l1: Any  # m
    l2: Any
    h: Any
    per_h: Any  # 1/m
    l1_per_h: Any
    l2_per_h: Any
    delta2: Any  # m2
    per_magnet_jump: Any  # 1/(rad2/s2), see `System.layers`


class DipoleConstants(NamedTuple):
    """Constants of the point-dipole torque (Wojna et al. 2018, Eq. 16)."""

    strength: Any  # N m2, mu_0 pole1 pole2/(4 pi)
    l1: Any  # m
    l2: Any
    h: Any


N_LINK = len(LinkConstants._fields)
N_FITTED = len(FittedConstants._fields)
N_DIPOLE = len(DipoleConstants._fields)


def link_constants(frequency: Any, p: Any) -> Any:
    """Derive `LinkConstants` from the drive frequency [Hz] and the packed parameters.

    A template: `AT` tells where each parameter stands, `drive_constants` is that of the drive.
    """
    g, l1, m1, m2, e1, e2 = p[AT.g], p[AT.l1], p[AT.m1], p[AT.m2], p[AT.e1], p[AT.e2]
    T1, T2, c, mu, mu0, eps = p[AT.T1], p[AT.T2], p[AT.c], p[AT.mu], p[AT.mu0], p[AT.eps]
    B1 = p[AT.J1] + e1 * e1 * m1 + l1 * l1 * m2
    B2 = p[AT.J2] + e2 * e2 * m2
    N12 = m2 * e2 * l1
    phase, offset, amplitude, eps_drive = drive_constants(p)
    per_det = 1.0 / (B1 * B2 - N12 * N12)
    jump1 = 2.0 * (T1 + mu * g * (m1 + m2)) * B2 * per_det
    jump2 = 2.0 * (T2 + mu * g * m2) * (B1 + N12) * per_det
    return LinkConstants(
        B1,
        B2,
        N12,
        m1 * g * e1 + m2 * g * l1,
        m2 * g * e2,
        B1 * B2,
        m1 * g,
        m2 * g,
        m1 * e1,
        m2 * e2,
        m2 * l1,
        m1 * e1 + m2 * l1,
        T1,
        T2,
        2.0 * c,
        c,
        mu,
        TWO_OVER_PI * mu0,
        TWO_OVER_PI * (1.0 - mu0),
        LOG2_E * p[AT.c0],
        eps,
        1.0 / eps,
        TWO_PI * frequency,
        phase,
        offset,
        amplitude,
        eps_drive,
        B2 * per_det,
        eps / max(jump1, 1e-30),
        eps / max(jump2, 1e-30),
    )


def square_wave_constants(p: Any) -> Any:
    """Return the constants of a square-wave drive: phase and offset (Wojna et al. 2018, Eq. 13, 14, corrected),
    amplitude over pi/2, and steepness.
    """
    phase = (math.pi - TWO_PI * p[AT.duty_cycle]) / 2.0
    return phase, -sin(phase), TWO_OVER_PI * p[AT.q], p[AT.eps_drive]


def sine_constants(p: Any) -> Any:
    """Return a sine drive's constants: phase 0, offset 0, its amplitude, and a steepness of 1, which is not used."""
    return 0.0, 0.0, p[AT.q], 1.0


@inline
def sine_drive(t: Any, k: Any) -> Any:
    """Compute the driving torque [N m] of a sine drive at time `t` [s] after a zero with rising torque (in place of Eq.
    12 of Wojna et al. 2018).
    """
    return k.drive_amplitude * sin(k.omega * t)


@inline
def drive(t: Any, k: Any) -> Any:
    """Compute the driving torque M_e [N m] at time `t` [s] after a rising edge (Wojna et al. 2018, Eq. 12-15)."""
    return k.drive_amplitude * atan(k.eps_drive * (sin(k.omega * t + k.phase) + k.offset))


@inline
def stribeck(v: Any, k: Any) -> Any:
    """Compute the factor of the dry friction at relative velocity `v` [rad/s], in (-1, 1) (Wojna et al.
    2018, Eq. 7-8).
    """
    return atan(k.eps * v) * (k.stribeck_drop * exp2_falling(-(k.c0 * absolute(v))) + k.stribeck_floor)


@inline
def magnet_moment(psi1: Any, psi_rel: Any, k: Any) -> Any:
    """Compute the fitted torque M_M of the magnets about joint 1 [N m] (Wojna et al. 2018, Eq. 18-19)."""
    psi1 = wrapped(psi1)
    psi_rel = wrapped(psi_rel)
    u1 = (psi_rel + k.beta1) * k.per_gamma1
    v1 = (psi1 + (k.p1 * psi_rel + k.r1)) * k.per_c1
    u2 = (psi_rel + k.beta2) * k.per_gamma2
    v2 = (psi1 + (k.p2 * psi_rel + k.r2)) * k.per_c2
    bump1 = exp2_falling(-multiply_add(u1, u1, v1 * v1))
    half_f2 = k.half_alpha2 * exp2_falling(-multiply_add(u2, u2, v2 * v2))
    step = TWO_OVER_PI * atan(k.eps_mag * (psi1 - (k.m * psi_rel + k.n)))
    difference = multiply_add(k.half_alpha1, bump1, -half_f2)
    return difference * step + multiply_add(k.half_alpha1, bump1, half_f2)


@inline
def fitted_torques(psi1: Any, psi2: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any) -> Any:
    """Compute the generalised torques (Q1, Q2) [N m] of the fitted magnet force (Wojna et al. 2018, Eq. 20)."""
    dx = multiply_add(k.l1, s1, k.l2 * s2)
    dy = k.h - k.l1 * c1 - k.l2 * c2
    moment = magnet_moment(psi1, psi2 - psi1, k)
    slope = dy * dx / (dx * dx + k.delta2)  # Fy/Fx
    return (moment * k.l1_per_h) * (c1 + slope * s1), (moment * k.l2_per_h) * (c2 + slope * s2)


@inline
def dipole_torques(psi1: Any, psi2: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any) -> Any:
    """Compute the generalised torques (Q1, Q2) [N m] of the point-dipole force (Wojna et al. 2018, Eq. 16)."""
    dx = multiply_add(k.l1, s1, k.l2 * s2)
    dy = k.h - k.l1 * c1 - k.l2 * c2
    r2 = dx * dx + dy * dy
    per_length = k.strength / (r2 * sqrt(r2))
    fx = per_length * dx
    fy = per_length * dy
    return k.l1 * (fx * c1 + fy * s1), k.l2 * (fx * c2 + fy * s2)


@inline
def loads(s1: Any, c1: Any, s12: Any, c12: Any, w1: Any, w2: Any, a1: Any, a2: Any, k: Any) -> Any:
    """Compute the bearing loads (N1, N2) [N] (Wojna et al. 2018, Eq. 9-11).

    The force that link 2 puts on joint 2 is written in the frame of link 1, along and across it:
    there N1 and N2 share most of their terms, and the acceleration of link 1 leaves the first.
    """
    w1w1 = w1 * w1
    w2w2 = k.m2_e2 * (w2 * w2)
    along = k.m2_g * c1 + k.m2_l1 * w1w1 + w2w2 * c12 - k.m2_e2 * s12 * a2
    across = k.m2_g * s1 + w2w2 * s12 + k.m2_l1 * a1 + k.m2_e2 * c12 * a2
    along1 = along + (k.m1_g * c1 + k.m1_e1 * w1w1)
    across1 = across + (k.m1_g * s1 + k.m1_e1 * a1)
    return sqrt(along1 * along1 + across1 * across1), sqrt(along * along + across * across)


class _LoadTerms(NamedTuple):
    """Terms of the forces in the joints as linear functions of the accelerations, in the frame of link 1 (see
    `loads`).
    """

    along0: Any  # N, joint 2, what does not depend on the accelerations
    across0: Any
    along10: Any  # N, joint 1
    across10: Any
    sine: Any  # kg m, m2 e2 sin(psi1 - psi2)
    cosine: Any  # kg m, m2 e2 cos(psi1 - psi2)


@inline
def _loads_and_components(a1: Any, a2: Any, f: Any, k: Any) -> Any:
    """Compute the loads of both joints, then the forces along and across link 1 in joint 1, then in joint 2 (see
    `loads`).
    """
    along_a = f.sine * a2
    across_a = f.cosine * a2
    along1 = f.along10 - along_a
    across1 = f.across10 + multiply_add(k.m1_e1_m2_l1, a1, across_a)
    along2 = f.along0 - along_a
    across2 = f.across0 + multiply_add(k.m2_l1, a1, across_a)
    load1 = sqrt(multiply_add(along1, along1, across1 * across1))
    load2 = sqrt(multiply_add(along2, along2, across2 * across2))
    return load1, load2, along1, across1, along2, across2


@inline
def _newton_change(r1: Any, r2: Any, loads_there: Any, effect: Any, f: Any, k: Any) -> Any:
    """Compute one Newton step for (a1, a2), given the residual (r1, r2) of the equation a = a_free + P N(a).

    With K = P dN/da, about 2e-3 in size, the inverse of 1 - K is taken as 1 + K.
    """
    p11, p12, p21, p22 = effect
    load1, load2, along1, across1, along2, across2 = loads_there
    # change of the loads along (r1, r2); weightless joints have load 0 and no gradient
    sine = f.sine * r2
    cosine = f.cosine * r2
    turned1 = multiply_add(k.m1_e1_m2_l1, r1, cosine)
    turned2 = multiply_add(k.m2_l1, r1, cosine)
    change1 = multiply_add(across1, turned1, -(along1 * sine)) / maximum(load1, 1e-290)
    change2 = multiply_add(across2, turned2, -(along2 * sine)) / maximum(load2, 1e-290)
    return (r1 + multiply_add(p11, change1, p12 * change2), r2 + multiply_add(p21, change1, p22 * change2))


@inline
def _solve_implicit(a1_free: Any, a2_free: Any, effect: Any, f: Any, k: Any) -> Any:
    """Solve a = a_free + P N(a), where N are the bearing loads, by two Newton steps from a_free."""
    p11, p12, p21, p22 = effect
    there = _loads_and_components(a1_free, a2_free, f, k)
    r1 = multiply_add(p11, there[0], p12 * there[1])
    r2 = multiply_add(p21, there[0], p22 * there[1])
    change1, change2 = _newton_change(r1, r2, there, effect, f, k)
    a1, a2 = a1_free + change1, a2_free + change2
    there = _loads_and_components(a1, a2, f, k)
    r1 = (a1_free - a1) + multiply_add(p11, there[0], p12 * there[1])
    r2 = (a2_free - a2) + multiply_add(p21, there[0], p22 * there[1])
    change1, change2 = _newton_change(r1, r2, there, effect, f, k)
    return a1 + change1, a2 + change2


@inline
def solve_accelerations(
    s1: Any, c1: Any, s2: Any, c2: Any, w1: Any, w2: Any, torque1: Any, torque2: Any, k: Any
) -> Any:
    """Solve the equations of motion (Wojna et al. 2018, Eq. 1-11), implicit in the bearing loads, for the accelerations
    (a1, a2) [rad/s2].

    `torque1` and `torque2` [N m] are the drive plus Q1, and Q2.
    """
    # sums of two products say which is fused (see `simd.multiply_add`): the bits depend on it
    s12 = multiply_add(s1, c2, -(c1 * s2))
    c12 = multiply_add(c1, c2, s1 * s2)
    w1w1 = w1 * w1
    w2w2 = w2 * w2
    v2 = w2 - w1
    g1 = stribeck(w1, k)
    g2 = stribeck(v2, k)
    r2 = multiply_add(k.T2, g2, k.viscous2 * v2)
    b1 = torque1 - (k.N12 * s12) * w2w2 - k.M1 * s1 - multiply_add(k.T1, g1, k.viscous1 * w1) + r2
    b2 = torque2 + (k.N12 * s12) * w1w1 - k.M2 * s2 - r2
    n12 = k.N12 * c12
    per_det = 1.0 / (k.B1_B2 - n12 * n12)
    a1_free = multiply_add(k.B2, b1, -(n12 * b2)) * per_det
    a2_free = multiply_add(k.B1, b2, -(n12 * b1)) * per_det
    # a = a_free + P N(a): what a load of one newton does to the accelerations
    u1 = (k.mu * per_det) * g1
    u2 = (k.mu * per_det) * g2
    p11 = -(k.B2 * u1)
    p12 = (k.B2 + n12) * u2
    p21 = n12 * u1
    p22 = -((k.B1 + n12) * u2)
    # the loads of `loads`, split into what does and does not depend on the accelerations
    m2e2w2w2 = k.m2_e2 * w2w2
    along0 = multiply_add(m2e2w2w2, c12, multiply_add(k.m2_l1, w1w1, k.m2_g * c1))
    across0 = multiply_add(m2e2w2w2, s12, k.m2_g * s1)
    along10 = along0 + multiply_add(k.m1_e1, w1w1, k.m1_g * c1)
    across10 = multiply_add(k.m1_g, s1, across0)
    effect = (p11, p12, p21, p22)
    terms = _LoadTerms(along0, across0, along10, across10, k.m2_e2 * s12, k.m2_e2 * c12)
    return _solve_implicit(a1_free, a2_free, effect, terms, k)
