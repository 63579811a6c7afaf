"""Define the double pendulum's equations as a system that the engine integrates; `models` describes it."""

from __future__ import annotations

import math
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import absolute, multiply_add
from magpend_core.engine.system import System, positions
from magpend_core.engine.vecmath import LN2, LOG2_E, TWO_PI, atan, exp2_falling, sin, sincos
from magpend_core.models.double_pendulum.models import PARAMETERS, QUANTITIES, STATES

AT = positions(tuple(p.name for p in PARAMETERS))
C = positions(
    (
        "B1",
        "B2",
        "N12",
        "M1",
        "M2",
        "c1",
        "c2",
        "T1",
        "T2",
        "drop",
        "floor",
        "c0",
        "eps",
        "per_eps",
        "per_reversal1",
        "per_reversal2",
        "l1",
        "drag1",
        "near",
        "middle",
        "far",
        "outer",
        "inner",
        "q",
        "omega",
    )
)

TWO_OVER_PI = 2.0 / math.pi
GAUSS = math.sqrt(0.15)
"""Distance of the outer of three Gauss points from the middle, in lengths."""


@inline
def _constants(frequency: Any, p: Any, out: Any) -> None:
    g, l1, m1, m2, e1, e2 = p[AT.g], p[AT.l1], p[AT.m1], p[AT.m2], p[AT.e1], p[AT.e2]
    B1 = p[AT.J1] + m1 * e1 * e1 + m2 * l1 * l1
    B2 = p[AT.J2] + m2 * e2 * e2
    N12 = m2 * e2 * l1
    per_det = 1.0 / (B1 * B2 - N12 * N12)
    out[C.B1], out[C.B2], out[C.N12] = B1, B2, N12
    out[C.M1], out[C.M2] = m1 * g * e1 + m2 * g * l1, m2 * g * e2
    out[C.c1], out[C.c2], out[C.T1], out[C.T2] = p[AT.c1], p[AT.c2], p[AT.T1], p[AT.T2]
    out[C.drop], out[C.floor] = TWO_OVER_PI * (1.0 - p[AT.mu0]), TWO_OVER_PI * p[AT.mu0]
    out[C.c0], out[C.eps], out[C.per_eps] = LOG2_E * p[AT.c0], p[AT.eps], 1.0 / p[AT.eps]
    # the change of the accelerations across a reversal, links in line
    out[C.per_reversal1] = p[AT.eps] / max(2.0 * p[AT.T1] * B2 * per_det, 1e-30)
    out[C.per_reversal2] = p[AT.eps] / max(2.0 * p[AT.T2] * (B1 + N12) * per_det, 1e-30)
    out[C.l1] = l1
    out[C.drag1] = 0.25 * p[AT.k1] * l1 * l1 * l1 * l1
    out[C.near], out[C.middle] = (0.5 - GAUSS) * p[AT.l2], 0.5 * p[AT.l2]
    out[C.far] = (0.5 + GAUSS) * p[AT.l2]
    out[C.outer], out[C.inner] = p[AT.k2] * p[AT.l2] * 5.0 / 18.0, p[AT.k2] * p[AT.l2] * 8.0 / 18.0
    out[C.q], out[C.omega] = p[AT.q], TWO_PI * frequency


@inline
def _forcing(t: Any, c: Any) -> Any:
    return c[C.q] * sin(c[C.omega] * t)


@inline
def _dry(v: Any, c: Any) -> Any:
    """Compute the dry friction at relative velocity `v` as a fraction of its amplitude, and the derivative of this
    fraction with respect to `v`.
    """
    fading = c[C.drop] * exp2_falling(-(c[C.c0] * absolute(v)))
    size = fading + c[C.floor]
    u = c[C.eps] * v
    angle = atan(u)
    # d/dv of |v| is v/|v|, and atan(u) v/|v| = |atan(u)|
    falling = (-LN2 * c[C.c0]) * fading
    slope = multiply_add(c[C.eps] / multiply_add(u, u, 1.0), size, absolute(angle) * falling)
    return angle * size, slope


@inline
def _air(c12: Any, w1: Any, w2: Any, c: Any) -> Any:
    """Integrate the air drag on link 2 by Gauss quadrature: force, moment, and three sums that give their
    derivatives.
    """
    across = c[C.l1] * (w1 * c12)
    near, middle, far = c[C.near], c[C.middle], c[C.far]
    v1 = multiply_add(near, w2, across)
    v2 = multiply_add(middle, w2, across)
    v3 = multiply_add(far, w2, across)
    a1, a2, a3 = c[C.outer] * absolute(v1), c[C.inner] * absolute(v2), c[C.outer] * absolute(v3)
    force = multiply_add(a1, v1, multiply_add(a2, v2, a3 * v3))
    moment = multiply_add(near * a1, v1, multiply_add(middle * a2, v2, far * a3 * v3))
    s0 = 2.0 * (a1 + a2 + a3)
    s1 = 2.0 * multiply_add(near, a1, multiply_add(middle, a2, far * a3))
    s2 = 2.0 * multiply_add(near * near, a1, multiply_add(middle * middle, a2, far * far * a3))
    return force, moment, s0, s1, s2


@inline
def _torques(y: Any, c: Any) -> Any:
    w1, w2 = y[2], y[3]
    c12 = sincos(y[0] - y[1])[1]
    v = w2 - w1
    friction1 = multiply_add(c[C.T1], _dry(w1, c)[0], c[C.c1] * w1)
    friction2 = multiply_add(c[C.T2], _dry(v, c)[0], c[C.c2] * v)
    force, moment, _, _, _ = _air(c12, w1, w2, c)
    drag1 = multiply_add(c[C.drag1] * absolute(w1), w1, c[C.l1] * (c12 * force))
    return friction1, friction2, drag1, moment


@inline
def _accelerations(y: Any, u: Any, c: Any) -> Any:
    """Compute the accelerations of both links; also return sine and cosine of the angle between them, and
    1/determinant.
    """
    w1, w2 = y[2], y[3]
    s12, c12 = sincos(y[0] - y[1])
    friction1, friction2, drag1, drag2 = _torques(y, c)
    n12 = c[C.N12]
    swing = n12 * s12
    r1 = u - friction1 + friction2 - drag1
    r1 = r1 - multiply_add(swing * w2, w2, c[C.M1] * sin(y[0]))
    r2 = multiply_add(swing * w1, w1, -(c[C.M2] * sin(y[1]))) - friction2 - drag2
    cross = n12 * c12
    per_det = 1.0 / multiply_add(c[C.B1], c[C.B2], -(cross * cross))
    a1 = multiply_add(c[C.B2], r1, -(cross * r2)) * per_det
    a2 = multiply_add(c[C.B1], r2, -(cross * r1)) * per_det
    return a1, a2, s12, c12, per_det


@inline
def _rhs(y: Any, u: Any, c: Any) -> Any:
    a1, a2, _, _, _ = _accelerations(y, u, c)
    return y[2], y[3], a1, a2


@inline
def _solved(d1: Any, d2: Any, cross: Any, per_det: Any, c: Any) -> Any:
    """Compute how both accelerations change if the torques change by `d1` and `d2`."""
    return (multiply_add(c[C.B2], d1, -(cross * d2)) * per_det, multiply_add(c[C.B1], d2, -(cross * d1)) * per_det)


@inline
def _jacobian(y: Any, u: Any, c: Any) -> Any:
    w1, w2 = y[2], y[3]
    a1, a2, s12, c12, per_det = _accelerations(y, u, c)
    n12, l1 = c[C.N12], c[C.l1]
    cross, swing = n12 * c12, n12 * s12
    force, _, s0, s1, s2 = _air(c12, w1, w2, c)
    # the angle between the links turns the coupling and the velocity across link 2: by its sine
    tilt = -(l1 * (w1 * s12))
    drag1_angle = multiply_add(l1 * c12 * s0, tilt, -(l1 * (s12 * force)))
    drag2_angle = s1 * tilt
    angle1 = multiply_add(swing, a2, -(cross * w2 * w2)) - drag1_angle
    angle2 = multiply_add(swing, a1, cross * w1 * w1) - drag2_angle
    dry1 = multiply_add(c[C.T1], _dry(w1, c)[1], c[C.c1])
    dry2 = multiply_add(c[C.T2], _dry(w2 - w1, c)[1], c[C.c2])
    lever = l1 * c12
    by_w1 = -(dry1 + dry2) - multiply_add(lever * lever, s0, 2.0 * c[C.drag1] * absolute(w1))
    by_w2 = dry2 - multiply_add(lever, s1, 2.0 * swing * w2)
    back_w1 = multiply_add(2.0 * swing, w1, dry2) - lever * s1
    back_w2 = -dry2 - s2
    psi1 = _solved(angle1 - c[C.M1] * sincos(y[0])[1], angle2, cross, per_det, c)
    psi2 = _solved(-angle1, -angle2 - c[C.M2] * sincos(y[1])[1], cross, per_det, c)
    rate1 = _solved(by_w1, back_w1, cross, per_det, c)
    rate2 = _solved(by_w2, back_w2, cross, per_det, c)
    zero = 0.0 * w1
    one = zero + 1.0
    return (
        zero,
        zero,
        one,
        zero,
        zero,
        zero,
        zero,
        one,
        psi1[0],
        psi2[0],
        rate1[0],
        rate2[0],
        psi1[1],
        psi2[1],
        rate1[1],
        rate2[1],
    )


@inline
def _quantities(t: Any, y: Any, dy: Any, u: Any, c: Any) -> Any:
    w1, w2 = y[2], y[3]
    c12 = sincos(y[0] - y[1])[1]
    half1, half2 = sin(0.5 * y[0]), sin(0.5 * y[1])
    kinetic = multiply_add(0.5 * c[C.B1] * w1, w1, multiply_add(0.5 * c[C.B2] * w2, w2, c[C.N12] * c12 * w1 * w2))
    height = 2.0 * multiply_add(c[C.M1] * half1, half1, c[C.M2] * half2 * half2)
    friction1, friction2, drag1, drag2 = _torques(y, c)
    lost = multiply_add(friction1, w1, friction2 * (w2 - w1)) + multiply_add(drag1, w1, drag2 * w2)
    return kinetic + height, u * w1, lost, u, friction1, friction2, drag1, drag2


@inline
def _layers(y: Any, dy: Any, c: Any) -> Any:
    """Return the boundary layers of the friction at velocity reversals in the joints: atan(eps v) has its poles at v =
    +-i/eps.
    """
    return (
        (y[2], dy[2], c[C.per_eps], c[C.per_reversal1]),
        (y[3] - y[2], dy[3] - dy[2], c[C.per_eps], c[C.per_reversal2]),
    )


DOUBLE_PENDULUM = System(
    name="double_pendulum",
    state_names=tuple(s.name for s in STATES),
    is_angle=tuple(s.on_circle for s in STATES),
    scales=tuple(s.scale for s in STATES),
    parameter_names=tuple(p.name for p in PARAMETERS),
    n_constants=len(C),
    constants=_constants,
    forcing=_forcing,
    rhs=_rhs,
    layers=_layers,
    jacobian=_jacobian,
    escape=tuple(s.escape for s in STATES),
    quantity_names=tuple(q.name for q in QUANTITIES),
    quantities=_quantities,
)
