"""Follow the cycles of a flow that leave a Hopf point.

The section of such cycles is the level of the crossing state at the Hopf point, so that small cycles cross it.
The first cycle has a given amplitude along the critical eigenvector; Newton's method finds its parameter value.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magpend_core.orbits import crossed_state
from pipeline.analysis.branches.arclength import Settings, correct
from pipeline.analysis.branches.bifurcations import Bifurcation
from pipeline.analysis.branches.following import Half, half_branch
from pipeline.analysis.branches.lockstep import Steps
from pipeline.analysis.branches.problems import Family, OrbitProblem

AMPLITUDES = (0.02, 0.05, 0.1)
"""Amplitudes of the first cycle that are tried, in units of the scales."""


def cycle_family(equilibria: Family, at: Bifurcation) -> Family | None:
    """Return the family of cycles of one return through a Hopf point; None if they do not cross its level.

    That is so for a system without a section by crossing, and if the crossing state does not oscillate.
    """
    crossed = crossed_state(equilibria.system)
    if crossed is None or _direction(equilibria, at) is None:
        return None
    level = equilibria.parameters.copy()
    level[-1] = at.point.value.images[0, crossed]
    for name, value in zip(equilibria.free, equilibria.values(at.point.u), strict=True):
        level[equilibria.system.parameter_names.index(name)] = value
    return replace(equilibria, period=1, parameters=level)


def cycles_from(family: Family, at: Bifurcation, low: float, high: float, settings: Settings) -> Steps[Half | None]:
    """Follow the cycles of a family from a Hopf point; None if no small cycle is found."""
    direction = _direction(family, at)
    assert direction is not None
    normal = np.append(direction / np.linalg.norm(direction), 0.0)
    for amplitude in AMPLITUDES:
        guess = at.point.u + amplitude * np.append(direction, 0.0)
        first = yield from correct(OrbitProblem(family), guess, normal, settings)
        if first is not None:
            return (yield from half_branch(family, first, low, high, settings))
    return None


def _direction(family: Family, at: Bifurcation) -> np.ndarray | None:
    """Return the scaled direction from the equilibrium to where small cycles cross the section; None if none does.

    It is the real part of the critical eigenvector at the phase at which the crossing state passes its level in
    the section's direction; its largest component is 1.
    """
    assert family.system.section is not None
    crossed, sign = family.system.section
    values, vectors = np.linalg.eig(family.scaled(at.point.value.monodromy))
    vector = vectors[:, int(np.argmin(np.abs(values.real) + 1e300 * (values.imag <= 0.0)))]
    if abs(vector[crossed]) < 1e-6 * np.abs(vector).max():
        return None
    turned = vector * np.exp(-1j * (sign * np.pi / 2.0 + np.angle(vector[crossed])))
    found = np.asarray(turned.real)
    found[crossed] = 0.0
    largest = np.abs(found).max()
    return found / largest if largest > 1e-9 * np.abs(vector).max() else None
