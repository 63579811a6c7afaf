"""Follow the cycles of a flow that leave a Hopf point, and find them again on another section.

The section of such cycles is the level of the crossing state at the Hopf point, so that small cycles cross it.
The first cycle has a given amplitude along the critical eigenvector; Newton's method finds its parameter value.
Larger cycles often cross the section of the run as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magpend_core.orbits import crossed_state, section_map
from magpend_core.sections import run_branches
from pipeline.analysis.branches.arclength import Settings, correct
from pipeline.analysis.branches.bifurcations import Bifurcation
from pipeline.analysis.branches.following import Branch, Half, half_branch
from pipeline.analysis.branches.lockstep import Steps
from pipeline.analysis.branches.problems import Family, OrbitProblem
from pipeline.analysis.tolerances import BRANCH_RTOL

AMPLITUDES = (0.02, 0.05, 0.1)
"""Amplitudes of the first cycle that are tried, in units of the scales."""

SAME_LEVEL = 1e-9
"""Two sections this close are one [scales of the state that crosses]."""

SAME_TIME = 1e-6
"""Relative difference within which the times of some returns add up to the period of a cycle."""


def cycle_family(equilibria: Family, at: Bifurcation) -> Family | None:
    """Return the family of limit cycles near a Hopf point, on a Poincare section through this point; None if it has
    none.

    There is none if the system has no section by crossing, or if the crossing state does not oscillate.
    """
    crossed = crossed_state(equilibria.system)
    if crossed is None or _direction(equilibria, at) is None:
        return None
    level = equilibria.parameters.copy()
    at_rest = float(at.point.value.images[0, crossed])
    if abs(at_rest - level[-1]) > SAME_LEVEL * equilibria.system.scales[crossed]:
        level[-1] = at_rest
    for name, value in zip(equilibria.free, equilibria.values(at.point.u), strict=True):
        level[equilibria.system.parameter_names.index(name)] = value
    return replace(equilibria, period=1, parameters=level)


def cycles_from(family: Family, at: Bifurcation, low: float, high: float, settings: Settings) -> Steps[Half | None]:
    """Follow the limit cycles that leave a Hopf point along the parameter; None if no small cycle is found."""
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
    """Return the scaled direction from an equilibrium to the point where small limit cycles cross the section, or None.

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


def crossings_of(cycles: Branch, section: Family, most: int) -> list[tuple[np.ndarray, int]]:
    """Find where the cycles of a branch cross another section of the same flow.

    Parameters
    ----------
    cycles
        The branch.
    section
        A family of the same flow with the other section.
    most
        Largest number of crossings per cycle that is looked for.

    Returns
    -------
    list of (ndarray, int)
        For each cycle a point on the section, and the number of crossings per period, 0 if there is none.
    """
    rows = section.rows(np.array([point.u for point in cycles.points]))
    first = run_branches(
        rows.parameters[:, None],
        rows.frequency_hz[:, None],
        rows.states,
        n_transient=1,
        n_keep=1,
        rtol=BRANCH_RTOL,
        atol=BRANCH_RTOL,
        system=section.system,
    ).section[:, 0, 0]
    found = section_map(rows.parameters, rows.frequency_hz, first, most, rtol=BRANCH_RTOL, system=section.system)
    seconds = np.array([point.value.seconds for point in cycles.points])[:, None]
    closes = np.abs(np.cumsum(found.times, axis=1) - seconds) < SAME_TIME * seconds
    periods = np.where(closes.any(axis=1), closes.argmax(axis=1) + 1, 0)
    return list(zip(first, map(int, periods), strict=True))
