"""Define the parameters of the pendulum in groups, from the paper (Wojna et al., J. Sound Vib. 430, 2018).

All quantities are in SI units.
"""

from __future__ import annotations

from collections.abc import Mapping

from magpend_core.models.parameters import FINITE, FRACTION, NON_NEGATIVE, POSITIVE, Parameter

LINKS = (
    Parameter("g", "m/s2", "gravitational acceleration", NON_NEGATIVE),
    Parameter("l1", "m", "distance between the joints", POSITIVE),
    Parameter("m1", "kg", "mass of link 1", POSITIVE),
    Parameter("m2", "kg", "mass of link 2", POSITIVE),
    Parameter("e1", "m", "joint 1 to the centre of mass of link 1", NON_NEGATIVE),
    Parameter("e2", "m", "joint 2 to the centre of mass of link 2", NON_NEGATIVE),
    Parameter("J1", "kg m2", "moment of inertia of link 1 about its centre of mass", POSITIVE),
    Parameter("J2", "kg m2", "moment of inertia of link 2 about its centre of mass", POSITIVE),
)
"""Masses and lengths of the two links (Table 1)."""

FRICTION = (
    Parameter("T1", "N m", "load-independent dry friction torque of joint 1", NON_NEGATIVE),
    Parameter("T2", "N m", "load-independent dry friction torque of joint 2", NON_NEGATIVE),
    Parameter("c", "N m s", "viscous coefficient of joint 2; joint 1 has twice this", NON_NEGATIVE),
    Parameter("mu", "m", "friction torque per bearing load", NON_NEGATIVE),
    Parameter("mu0", "1", "kinetic over static friction", NON_NEGATIVE),
    Parameter("c0", "s/rad", "Stribeck constant", NON_NEGATIVE),
    Parameter("eps", "s/rad", "steepness of the friction's sign function", POSITIVE),
)
"""Friction in the joints with Stribeck effect and load dependence (Eq. 7-11, Table 1)."""

SQUARE_WAVE = (
    Parameter("duty_cycle", "1", "fraction of the period in the high state", FRACTION),
    Parameter("q", "N m", "amplitude of the driving torque", FINITE),
    Parameter("eps_drive", "1", "steepness of the square wave's edges", POSITIVE),
)
"""Square-wave torque on joint 1 (Eq. 12-15)."""

SINE = (Parameter("q", "N m", "amplitude of the driving torque", FINITE),)
"""Sinusoidal torque on joint 1."""

_PLACES = (
    Parameter("l2", "m", "joint 2 to the centre of the moving magnet", POSITIVE),
    Parameter("h", "m", "joint 1 to the centre of the fixed magnet", POSITIVE),
)

FITTED_MAGNETS = (
    Parameter("alpha1", "N m", "height of the bump right of the magnet", FINITE),
    Parameter("alpha2", "N m", "height of the bump left of the magnet", FINITE),
    Parameter("beta1", "rad", "offset of bump 1 in psi_rel", FINITE),
    Parameter("beta2", "rad", "offset of bump 2 in psi_rel", FINITE),
    Parameter("gamma1", "rad", "width of bump 1 in psi_rel", POSITIVE),
    Parameter("gamma2", "rad", "width of bump 2 in psi_rel", POSITIVE),
    Parameter("p1", "1", "slope of the position of bump 1 over psi_rel", FINITE),
    Parameter("p2", "1", "slope of the position of bump 2 over psi_rel", FINITE),
    Parameter("r1", "rad", "position of bump 1 at psi_rel = 0, negated", FINITE),
    Parameter("r2", "rad", "position of bump 2 at psi_rel = 0, negated", FINITE),
    Parameter("c1", "rad", "width of bump 1 in psi1", POSITIVE),
    Parameter("c2", "rad", "width of bump 2 in psi1", POSITIVE),
    Parameter("eps_mag", "1/rad", "steepness of the change between the bumps", POSITIVE),
    *_PLACES,
    Parameter("delta", "m", "regularisation of dy/dx where the magnets are in line", POSITIVE),
)
"""Magnet torque fitted by two bumps (Eq. 18-19), turned into joint torques (Eq. 20)."""

POINT_DIPOLES = (
    Parameter("pole1", "A m", "pole strength of the fixed magnet", FINITE),
    Parameter("pole2", "A m", "pole strength of the moving magnet", FINITE),
    *_PLACES,
)
"""Point dipoles (Eq. 16), the baseline that the paper's authors rejected.

The force mu_0 pole1 pole2/(4 pi r**2) acts along the line between the magnets.
"""

NO_MAGNETS: tuple[Parameter, ...] = ()


def keep_dipoles_apart(values: Mapping[str, float]) -> list[str]:
    """Return an error sentence if point dipoles could meet, where their force is infinite."""
    reach = values["l1"] + values["l2"]
    if values["h"] > reach:
        return []
    return [
        f"h = {values['h']!r} is out of bounds: with point dipoles it must be greater than "
        f"l1 + l2 = {reach!r}, or the magnets can meet."
    ]
