"""Compute named quantities of the pendulum at a state: energy, powers, torques, loads, position of the moving magnet.

Templates for the engine: ``magnet_torques`` is bound in `systems`. Their order is that of
`models.QUANTITIES`.
"""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.vecmath import sincos
from magpend_core.models.pendulum.equations import (
    N_LINK,
    DipoleConstants,
    FittedConstants,
    LinkConstants,
    loads,
    magnet_moment,
    stribeck,
)


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
