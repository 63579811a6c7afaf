"""Test whether degenerate orbits and equilibria attract, by trajectories that start beside them.

If a multiplier lies on the unit circle within its error, the linear map does not decide stability.
Trajectories start on both sides along the critical directions. If all come nearer, the orbit attracts, as for
``x' = -x**3``, where distances fall as one over the square root of time. In a centre distances do not fall.
An equilibrium with one critical direction can also be half-stable, as for ``x' = x**2``: trajectories of one side come
nearer, those of the other leave.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from magpend_core.status import Status
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, scaled_derivative
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.attractors.finding.requests import LEG, Leg, Work
from pipeline.results.sets import Geometry


@dataclass(frozen=True)
class ProbeSettings:
    """Numbers of the probes of a degenerate orbit or equilibrium by trajectories."""

    # scaled distances at which trajectories start, tried in turn until one shows an approach; smaller ones show weaker
    # approaches, and take more legs
    distances: tuple[float, ...] = (0.5, 0.05, 0.01)
    legs: int = 32  # number of legs; more show slower approaches
    fall: float = 0.7  # largest share of the distance left after them that shows an approach
    # a trajectory that is further away than this share of its distance, or than `whole`, has left, even if it comes
    # back from the other side
    gone: float = 10.0
    whole: float = 1.0


def probe_orbit(orbit: Orbit, geometry: Geometry, settings: ProbeSettings = ProbeSettings()) -> Work[float]:
    """Find the scaled distance from which trajectories on both sides approach an orbit; 0 if they do not approach
    it.
    """
    matrix = scaled_derivative(orbit, geometry)
    values, vectors = np.linalg.eig(matrix)
    critical = vectors[:, np.abs(np.abs(values) - 1.0) <= orbit.multiplier_error]
    return (yield from _probe(orbit.points, critical, geometry, settings))


def probe_equilibrium(
    one: Equilibrium, geometry: Geometry, settings: ProbeSettings = ProbeSettings()
) -> Work[Equilibrium]:
    """Return the equilibrium with the scaled distance from which trajectories approach it, on both sides or on one; 0
    if they do not approach it.
    """
    values, vectors = np.linalg.eig(one.jacobian)
    critical = vectors[:, np.abs(values.real) <= one.eigenvalue_error]
    within = yield from _probe(one.state[None], critical, geometry, settings)
    if within or critical.shape[1] != 1:
        return replace(one, approached_within=within)
    return (yield from _probe_sides(one, critical[:, 0].real, geometry, settings))


def _probe_sides(
    one: Equilibrium, direction: np.ndarray, geometry: Geometry, settings: ProbeSettings
) -> Work[Equilibrium]:
    """Test whether trajectories approach an equilibrium on one side of its only critical direction and leave it on the
    other.
    """
    values, left = np.linalg.eig(one.jacobian.T)
    across = left[:, np.argmin(np.abs(values))].real
    direction = direction / np.abs(direction).max()
    for size in settings.distances:
        offset = size * direction * np.asarray(geometry.scales)
        for side in (1.0, -1.0):
            near, far = one.state[None] + side * offset, one.state[None] - side * offset
            if (yield from _falls(near, one.state[None], size, geometry, settings)) and (
                yield from _leaves(far, one.state, size, geometry, settings)
            ):
                return replace(one, approached_within=size, side=side * across / float(across @ direction))
    return one


def _probe(points: np.ndarray, critical: np.ndarray, geometry: Geometry, settings: ProbeSettings) -> Work[float]:
    directions = np.concatenate([critical.T.real, critical.T.imag])
    length = np.abs(directions).max(axis=1, initial=0.0)
    directions = directions[length > 1e-6] / length[length > 1e-6, None]
    if not len(directions):
        return 0.0
    for size in settings.distances:
        offset = size * np.concatenate([directions, -directions]) * np.asarray(geometry.scales)
        if (yield from _falls(points[0] + offset, points, size, geometry, settings)):
            return size
    return 0.0


def _falls(
    state: np.ndarray, points: np.ndarray, size: float, geometry: Geometry, settings: ProbeSettings
) -> Work[bool]:
    """Return whether trajectories that start at the distance `size` from an orbit or equilibrium come steadily nearer
    to it.
    """
    step, before = np.zeros(len(state)), np.full(len(state), np.inf)
    for _ in range(settings.legs):
        leg = yield Leg(state, step)
        waits = leg.status == Status.NO_RETURN
        if not (np.isin(leg.status, (Status.PERIODIC, Status.BOUNDED)) | waits).all():
            return False
        state, step = leg.state, np.where(waits, 0.0, leg.step)
        sections = np.where(waits[:, None, None], leg.state[:, None], leg.section[:, LEG // 2 :])
        away = _distance(sections, points, geometry)
        if (_distance(leg.section, points, geometry) > min(settings.gone * size, settings.whole))[~waits].any():
            return False
        if (away > np.minimum(before, 2.0 * size) + 1e-9).any():
            return False
        before = away
    return bool(before.max() <= settings.fall * size)


def _leaves(
    state: np.ndarray, point: np.ndarray, size: float, geometry: Geometry, settings: ProbeSettings
) -> Work[bool]:
    """Return whether a trajectory that starts at the distance `size` from an equilibrium comes to twice this
    distance.
    """
    step = np.zeros(len(state))
    for _ in range(settings.legs):
        leg = yield Leg(state, step)
        if (leg.status == Status.DIVERGED).all():
            return True
        waits = leg.status == Status.NO_RETURN
        if not (np.isin(leg.status, (Status.PERIODIC, Status.BOUNDED)) | waits).all():
            return False
        state, step = leg.state, np.where(waits, 0.0, leg.step)
        if (geometry.distance(state, point) > 2.0 * size).all():
            return True
    return False


def _distance(section: np.ndarray, points: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return each trajectory's largest distance from the given points, over its section points."""
    away = np.stack([geometry.distance(section, point) for point in points])
    return np.asarray(away.min(axis=0).max(axis=1))


def is_approaching(section: np.ndarray, orbit: Orbit, geometry: Geometry) -> np.ndarray:
    """Return for each cell whether its section points (cell, period_index, state) approach an orbit that was probed."""
    half = section.shape[1] // 2
    early = _distance(section[:, :half], orbit.points, geometry) if half else np.full(len(section), np.inf)
    late = _distance(section[:, half:], orbit.points, geometry)
    return np.asarray((early <= orbit.approached_within) & (late <= early))
