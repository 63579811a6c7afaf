"""Compute the analytic Jacobian of the pendulum's right-hand side, including the implicit bearing loads.

The model is a residual F(a, y) = 0 in the accelerations a (Eq. 1-11); differentiating it gives
da/dy = -F_a^{-1} F_y. The friction is once continuously differentiable at v = 0: through |v| in the
Stribeck term its second derivative jumps there, the Jacobian itself is continuous.
"""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import absolute, copysign, maximum, sqrt
from magpend_core.engine.vecmath import LN2, TWO_OVER_PI, atan, exp2_falling, wrapped
from magpend_core.models.pendulum.equations import magnet_moment, stribeck


@inline
def stribeck_slope(v: Any, k: Any) -> Any:
    """Compute the derivative of `equations.stribeck` [s/rad]."""
    x = k.eps * v
    decay = k.stribeck_drop * exp2_falling(-(k.c0 * absolute(v)))
    steep = k.eps / (1.0 + x * x) * (decay + k.stribeck_floor)
    return steep - atan(x) * (decay * (LN2 * k.c0)) * copysign(1.0, v)


@inline
def magnet_moment_slopes(psi1: Any, psi_rel: Any, k: Any) -> Any:
    """Compute the derivatives of `equations.magnet_moment` by psi1 and by psi_rel [N m/rad] (Wojna et al. 2018, Eq.
    18-19).
    """
    psi1 = wrapped(psi1)
    psi_rel = wrapped(psi_rel)
    u1 = (psi_rel + k.beta1) * k.per_gamma1
    v1 = (psi1 + (k.p1 * psi_rel + k.r1)) * k.per_c1
    u2 = (psi_rel + k.beta2) * k.per_gamma2
    v2 = (psi1 + (k.p2 * psi_rel + k.r2)) * k.per_c2
    half_f1 = k.half_alpha1 * exp2_falling(-(u1 * u1 + v1 * v1))
    half_f2 = k.half_alpha2 * exp2_falling(-(u2 * u2 + v2 * v2))
    x = k.eps_mag * (psi1 - (k.m * psi_rel + k.n))
    step = TWO_OVER_PI * atan(x)
    step_slope = TWO_OVER_PI * k.eps_mag / (1.0 + x * x)
    by_psi1_1 = (-2.0 * LN2) * v1 * k.per_c1 * half_f1
    by_psi1_2 = (-2.0 * LN2) * v2 * k.per_c2 * half_f2
    by_rel_1 = (-2.0 * LN2) * (u1 * k.per_gamma1 + v1 * k.p1 * k.per_c1) * half_f1
    by_rel_2 = (-2.0 * LN2) * (u2 * k.per_gamma2 + v2 * k.p2 * k.per_c2) * half_f2
    bumps = half_f1 - half_f2
    by_psi1 = (by_psi1_1 - by_psi1_2) * step + (by_psi1_1 + by_psi1_2) + bumps * step_slope
    by_rel = (by_rel_1 - by_rel_2) * step + (by_rel_1 + by_rel_2) - bumps * step_slope * k.m
    return by_psi1, by_rel


@inline
def _torque_slopes(
    fx: Any, fy: Any, fx1: Any, fx2: Any, fy1: Any, fy2: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any
) -> Any:
    """Compute the derivatives of the generalised torques Q1, then Q2, by psi1 and psi2, from the magnet force and its
    derivatives.
    """
    return (
        k.l1 * (fx1 * c1 - fx * s1 + fy1 * s1 + fy * c1),
        k.l1 * (fx2 * c1 + fy2 * s1),
        k.l2 * (fx1 * c2 + fy1 * s2),
        k.l2 * (fx2 * c2 - fx * s2 + fy2 * s2 + fy * c2),
    )


@inline
def fitted_torque_slopes(psi1: Any, psi2: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any) -> Any:
    """Compute the derivatives of `equations.fitted_torques`: of Q1 by psi1 and psi2, then of Q2 (Wojna et al. 2018, Eq.
    20).
    """
    dx = k.l1 * s1 + k.l2 * s2
    dy = k.h - k.l1 * c1 - k.l2 * c2
    fx = magnet_moment(psi1, psi2 - psi1, k) * k.per_h
    by_psi1, by_rel = magnet_moment_slopes(psi1, psi2 - psi1, k)
    fx1 = (by_psi1 - by_rel) * k.per_h
    fx2 = by_rel * k.per_h
    per_square = 1.0 / (dx * dx + k.delta2)
    ratio = dy * dx * per_square
    by_dx = dy * (k.delta2 - dx * dx) * per_square * per_square
    by_dy = dx * per_square
    fy1 = fx1 * ratio + fx * (by_dx * k.l1 * c1 + by_dy * k.l1 * s1)
    fy2 = fx2 * ratio + fx * (by_dx * k.l2 * c2 + by_dy * k.l2 * s2)
    return _torque_slopes(fx, fx * ratio, fx1, fx2, fy1, fy2, s1, c1, s2, c2, k)


@inline
def dipole_torque_slopes(psi1: Any, psi2: Any, s1: Any, c1: Any, s2: Any, c2: Any, k: Any) -> Any:
    """Compute the derivatives of `equations.dipole_torques`: of Q1 by psi1 and psi2, then of Q2 (Wojna et al. 2018, Eq.
    16).
    """
    dx = k.l1 * s1 + k.l2 * s2
    dy = k.h - k.l1 * c1 - k.l2 * c2
    r2 = dx * dx + dy * dy
    per_length = k.strength / (r2 * sqrt(r2))
    shrink = -3.0 * per_length / r2
    by1 = shrink * (dx * k.l1 * c1 + dy * k.l1 * s1)
    by2 = shrink * (dx * k.l2 * c2 + dy * k.l2 * s2)
    fx1 = by1 * dx + per_length * k.l1 * c1
    fx2 = by2 * dx + per_length * k.l2 * c2
    fy1 = by1 * dy + per_length * k.l1 * s1
    fy2 = by2 * dy + per_length * k.l2 * s2
    return _torque_slopes(per_length * dx, per_length * dy, fx1, fx2, fy1, fy2, s1, c1, s2, c2, k)


@inline
def acceleration_slopes(
    s1: Any, c1: Any, s2: Any, c2: Any, w1: Any, w2: Any, a1: Any, a2: Any, torque_slopes: Any, k: Any
) -> Any:
    """Compute the derivatives of the accelerations a1, then a2, by the four states (psi1, psi2, psi1_dot, psi2_dot).

    `a1` and `a2` are the accelerations at the state (see `equations.solve_accelerations`) and
    `torque_slopes` the derivatives of Q1 and Q2 by psi1 and psi2.
    """
    s12 = s1 * c2 - c1 * s2
    c12 = c1 * c2 + s1 * s2
    v2 = w2 - w1
    # the force in joint 2 along and across link 1, and its derivatives (see `equations.loads`)
    swing = k.m2_e2 * (w2 * w2 * s12 + c12 * a2)
    reach = k.m2_e2 * (w2 * w2 * c12 - s12 * a2)
    along = k.m2_g * c1 + k.m2_l1 * w1 * w1 + reach
    across = k.m2_g * s1 + swing + k.m2_l1 * a1
    along1 = along + k.m1_g * c1 + k.m1_e1 * w1 * w1
    across1 = across + k.m1_g * s1 + k.m1_e1 * a1
    # weightless joints at rest have load 0 and no gradient
    n2 = maximum(sqrt(along * along + across * across), 1e-290)
    n1 = maximum(sqrt(along1 * along1 + across1 * across1), 1e-290)
    x2, y2 = along / n2, across / n2
    x1, y1 = along1 / n1, across1 / n1
    m_g = k.m1_g + k.m2_g
    n1_p1 = x1 * (-m_g * s1 - swing) + y1 * (m_g * c1 + reach)
    n1_p2 = x1 * swing - y1 * reach
    n1_w1 = x1 * (2.0 * (k.m2_l1 + k.m1_e1) * w1)
    n1_w2 = (x1 * c12 + y1 * s12) * (2.0 * k.m2_e2 * w2)
    n1_a1 = y1 * k.m1_e1_m2_l1
    n1_a2 = (y1 * c12 - x1 * s12) * k.m2_e2
    n2_p1 = x2 * (-k.m2_g * s1 - swing) + y2 * (k.m2_g * c1 + reach)
    n2_p2 = x2 * swing - y2 * reach
    n2_w1 = x2 * (2.0 * k.m2_l1 * w1)
    n2_w2 = (x2 * c12 + y2 * s12) * (2.0 * k.m2_e2 * w2)
    n2_a1 = y2 * k.m2_l1
    n2_a2 = (y2 * c12 - x2 * s12) * k.m2_e2
    # friction: its slope in the relative velocity, and its torque per load
    d1 = (k.T1 + k.mu * n1) * stribeck_slope(w1, k) + k.viscous1
    d2 = (k.T2 + k.mu * n2) * stribeck_slope(v2, k) + k.viscous2
    u1 = k.mu * stribeck(w1, k)
    u2 = k.mu * stribeck(v2, k)
    q1_p1, q1_p2, q2_p1, q2_p2 = torque_slopes
    coupling = k.N12 * s12
    turning = k.N12 * c12
    f1_p1 = -coupling * a2 + turning * w2 * w2 + k.M1 * c1 + u1 * n1_p1 - u2 * n2_p1 - q1_p1
    f2_p1 = -coupling * a1 - turning * w1 * w1 + u2 * n2_p1 - q2_p1
    f1_p2 = coupling * a2 - turning * w2 * w2 + u1 * n1_p2 - u2 * n2_p2 - q1_p2
    f2_p2 = coupling * a1 + turning * w1 * w1 + k.M2 * c2 + u2 * n2_p2 - q2_p2
    f1_w1 = d1 + u1 * n1_w1 + d2 - u2 * n2_w1
    f2_w1 = -2.0 * coupling * w1 - d2 + u2 * n2_w1
    f1_w2 = 2.0 * coupling * w2 + u1 * n1_w2 - d2 - u2 * n2_w2
    f2_w2 = d2 + u2 * n2_w2
    f1_a1 = k.B1 + u1 * n1_a1 - u2 * n2_a1
    f1_a2 = turning + u1 * n1_a2 - u2 * n2_a2
    f2_a1 = turning + u2 * n2_a1
    f2_a2 = k.B2 + u2 * n2_a2
    per_det = 1.0 / (f1_a1 * f2_a2 - f1_a2 * f2_a1)
    i11, i12, i21, i22 = f2_a2 * per_det, f1_a2 * per_det, f2_a1 * per_det, f1_a1 * per_det
    return (
        i12 * f2_p1 - i11 * f1_p1,
        i12 * f2_p2 - i11 * f1_p2,
        i12 * f2_w1 - i11 * f1_w1,
        i12 * f2_w2 - i11 * f1_w2,
        i21 * f1_p1 - i22 * f2_p1,
        i21 * f1_p2 - i22 * f2_p2,
        i21 * f1_w1 - i22 * f2_w1,
        i21 * f1_w2 - i22 * f2_w2,
    )
