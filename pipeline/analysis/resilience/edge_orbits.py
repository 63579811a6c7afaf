"""Find orbits on the boundary of two basins near a path that does not settle.

Where the boundary is fractal, the edge is a chaotic saddle: a path on it never settles, and saddle orbits lie dense
in it. Newton's method from points of the path finds the shortest ones. An orbit is on the boundary if arbitrarily
close to it, along its unstable direction, states of both basins are found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.analysis.attractors.destinations import UNDECIDED, Destinations
from pipeline.analysis.attractors.finding.closed_orbits import Orbit, distinct
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.branches.deflation import search_orbits
from pipeline.analysis.sets import nearest_distances
from pipeline.analysis.tolerances import RECURRENCE

MOST_RECURRENCES, N_STARTS = 64, 336
"""Points of the paths from which Newton's method starts, for each period: those that recur most closely, and others
drawn at random."""

BESIDE = 0.05
"""Scaled standard deviation by which the random ones are moved: strongly unstable orbits attract Newton's method from a
narrow strip, which few points of a path hit."""

ROUNDS = 6
"""Most rounds of the search in which known orbits are deflated."""

SHIFTS = 10.0 ** np.arange(-8.0, -3.0, 0.25)
"""Scaled distances from an orbit at which both basins are looked for."""

NEAREST = len(SHIFTS) // 2
"""How many of the smaller distances must show both basins."""


def orbits_on(
    paths: Sequence[np.ndarray], there: Destinations, between: tuple[int, int], max_period: int
) -> list[Orbit]:
    """Return the saddle orbits on the boundary that Newton's method finds from points of paths along it, and that the
    paths come near.

    Parameters
    ----------
    paths
        Section points of paths on the boundary, shape (n, state) each.
    there
        Attractors of the parameter point.
    between
        Ids of the two attractors.
    max_period
        Longest period [drive periods or returns].
    """
    point = there.point
    if not paths or not max_period or (point.can_rest and not point.is_flow):
        return []
    starts = [_starts(paths, period, there) for period in range(1, max_period + 1)]
    periods = np.repeat(np.arange(1, max_period + 1), [len(own) for own in starts])
    found = search_orbits(
        np.concatenate(starts), periods, point.frequency, point.packed, point.integrates, rounds=ROUNDS
    )
    polished = there.polished(
        np.array([one.points[0] for one in found]).reshape(len(found), point.n_states),
        np.array([one.period for one in found], np.int64),
    )
    every = np.concatenate(paths)
    near = [
        one
        for one in polished
        if one is not None
        and n_unstable(one) == 1
        and nearest_distances(one.points, every, there.geometry).min() <= RECURRENCE
    ]
    return [one for one in distinct(near, there.geometry) if is_on_boundary(one, there, between)]


def _starts(paths: Sequence[np.ndarray], period: int, there: Destinations) -> np.ndarray:
    """Return points of the paths that nearly recur after a period, and states beside others."""
    lags = np.concatenate([there.geometry.distance(path[period:], path[:-period]) for path in paths])
    recurring = np.concatenate([path[:-period] for path in paths])
    closest = recurring[np.argsort(lags, kind="stable")[:MOST_RECURRENCES]]
    every, rng = np.concatenate(paths), np.random.default_rng(0)
    drawn = every[rng.integers(len(every), size=N_STARTS)]
    moved = drawn + BESIDE * np.asarray(there.geometry.scales) * rng.standard_normal(drawn.shape)
    return np.concatenate([closest, moved])


def n_unstable(orbit: Orbit) -> int:
    """Return how many multipliers of an orbit lie outside the unit circle, by more than their error."""
    return int((np.abs(orbit.multipliers) > 1.0 + orbit.multiplier_error).sum())


def is_on_boundary(orbit: Orbit, there: Destinations, between: tuple[int, int]) -> bool:
    """Return whether states of both basins lie arbitrarily close to a saddle orbit, along its unstable direction."""
    values, vectors = np.linalg.eig(orbit.derivative)
    direction = vectors[:, int(np.abs(values).argmax())].real
    labels = _beside(orbit.points[0], direction, there)
    return set(between) <= set(labels[:, :NEAREST].ravel().tolist())


def separates(rest: Equilibrium, there: Destinations, between: tuple[int, int]) -> bool:
    """Return whether an equilibrium has one unstable direction, and leaving along it leads to one of two attractors on
    one side, and to the other on the other side.
    """
    if (rest.eigenvalues.real > rest.eigenvalue_error).sum() != 1:
        return False
    values, vectors = np.linalg.eig(rest.jacobian)
    direction = vectors[:, int(values.real.argmax())].real * np.asarray(there.geometry.scales)
    sides = [set(own.tolist()) - {UNDECIDED} for own in _beside(rest.state, direction, there)]
    return sorted(map(sorted, sides)) == [[number] for number in sorted(between)]


def _beside(state: np.ndarray, direction: np.ndarray, there: Destinations) -> np.ndarray:
    """Return the labels of states beside another along a direction, shape (side, shift)."""
    direction = direction / np.abs(direction / np.asarray(there.geometry.scales)).max()
    shifts = np.concatenate([SHIFTS, -SHIFTS])
    return np.asarray(there.follow(state + shifts[:, None] * direction).label.reshape(2, -1))
