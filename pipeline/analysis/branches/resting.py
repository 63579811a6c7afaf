"""Find the saddles near the last cycle of a branch, at which it comes to rest if its period grows without bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.equilibria import find_equilibria
from magpend_core.orbits import scaled_distance
from magpend_core.pointwise import rates_at
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, sample
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.problems import Family
from pipeline.results.tolerances import BRANCH_RTOL


@dataclass(frozen=True)
class RestSettings:
    """Numbers of the search for the equilibrium at which cycles come to rest."""

    near: float = 0.05  # largest distance of an equilibrium that is near to an orbit, in units of the orbit's size
    samples: int = 4000  # points on the last orbit
    # most slow places of the orbit from which equilibria are looked for; more find those that are hardly met
    guesses: int = 8


def last_orbit(family: Family, end: Point, settings: RestSettings) -> np.ndarray:
    """Return states of a flow's last orbit on a branch, at equal intervals of time, shape (time, state)."""
    rows, seconds = family.rows(end.u[None]), end.value.seconds
    times, drive = np.linspace(0.0, seconds, settings.samples), Drive(np.array([seconds]))
    packed = rows.parameters[:1]
    orbit = sample(family.system, packed, rows.states, [times], drives=[drive], **tolerances_at(BRANCH_RTOL))
    return np.asarray(orbit.states[0][np.isfinite(orbit.states[0]).all(axis=1)])


def saddles_near(
    family: Family, end: Point, states: np.ndarray, settings: RestSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the saddles near an orbit, shape (saddle, state), and their eigenvalues by falling real part [1/s]."""
    system = family.system
    none = np.empty((0, system.n_states))
    if not len(states):
        return none, none
    packed, size = family.rows(end.u[None]).parameters[0], size_of(family, states)
    found = find_equilibria(system, states[slow_places(family, packed, states, settings)], packed)
    places, eigenvalues = none, none
    for place, own in zip(found.states[found.converged], found.eigenvalues[found.converged], strict=True):
        is_near = scaled_distance(states, place, system).min() <= settings.near * size
        is_known = bool((scaled_distance(places, place, system) < settings.near * size).any())
        if is_near and not is_known and own.real.min() < 0.0 < own.real.max():
            places, eigenvalues = np.vstack([places, place]), np.vstack([eigenvalues, own])
    return places, eigenvalues


def size_of(family: Family, states: np.ndarray) -> float:
    """Return the largest range of an orbit's states [their scales]."""
    return float((np.ptp(states, axis=0) / np.asarray(family.system.scales)).max())


def slow_places(family: Family, packed: np.ndarray, states: np.ndarray, settings: RestSettings) -> np.ndarray:
    """Return the indices of the slow places of an orbit, the slowest first."""
    speed = np.linalg.norm(rates_at(family.system, states, packed) / np.asarray(family.system.scales), axis=1)
    slow = np.flatnonzero((speed <= np.roll(speed, 1)) & (speed <= np.roll(speed, -1)))
    return np.asarray(slow[np.argsort(speed[slow])][: settings.guesses])
