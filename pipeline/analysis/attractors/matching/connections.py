"""Connect closed orbits at different parameter points by following their branches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from pipeline.analysis.branches.connecting import OPEN, Found, Link, connect, grouped
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.layout.vocabulary import PERIODIC_ORBIT

Place = tuple[tuple[int, ...], int]
"""A parameter point's index, and the row of an attractor there."""


@dataclass(frozen=True, eq=False)
class Connections:
    """Connections between attractors at different parameter points, found by following orbits; attractors are numbered.

    Attributes
    ----------
    group : ndarray
        Least number among the appearances that are connected with each.
    branch : ndarray
        Least number among those that are connected without a period doubling.
    followed : ndarray of bool
        Whether each was followed.
    outcomes : dict
        Reason why following an orbit ended, by axis, direction (1 or -1) and number; values as in
        `pipeline.analysis.branches.connecting.Links`.
    """

    group: np.ndarray
    branch: np.ndarray
    followed: np.ndarray
    outcomes: Mapping[tuple[int, int, int], str] = field(default_factory=dict)

    @classmethod
    def none(cls, n: int) -> Connections:
        """Return the connections of `n` attractors that were not followed: none is connected to another."""
        return cls(np.arange(n), np.arange(n), np.zeros(n, bool))

    def may_be_one(self, axis: int, first: tuple[int, int], second: tuple[int, int]) -> bool:
        """Return whether two attractors may be matched by distance: following their orbits neither linked nor separated
        them.

        Parameters
        ----------
        axis
            Index of the axis between them.
        first, second
            Number and period of each.
        """
        (a, a_period), (b, b_period) = first, second
        if not (self.followed[a] and self.followed[b]):
            return True
        way, number = (-1, b) if b_period > a_period else (1, a)
        return self.outcomes.get((axis, way, number)) == OPEN


def followable(attractors: xr.Dataset, at: Place) -> bool:
    """Return whether an attractor at one parameter point is a closed orbit on which Newton's method converged."""
    index, row = at
    if "is_polished" not in attractors:
        return False
    one = (*index, row)
    return bool(attractors["kind"].values[one] == PERIODIC_ORBIT and attractors["is_polished"].values[one])


def connections(
    attractors: xr.Dataset,
    places: Sequence[Place],
    dims: Sequence[str],
    packed: np.ndarray,
    frequency: float,
    system: System,
) -> Connections:
    """Follow all closed orbits along every swept parameter.

    Parameters
    ----------
    attractors
        From `identify`.
    places
        The appearances.
    dims
        Parameter dims.
    packed
        Packed parameters; the axes replace the values of the same name.
    frequency
        Drive frequency [Hz], used if it is not an axis.
    system
        System of the run.
    """
    orbits = {n: _orbit(attractors, place) for n, place in enumerate(places) if followable(attractors, place)}
    followed = np.zeros(len(places), bool)
    lines: list[list[Found]] = []
    axes: list[int] = []
    for axis, dim in enumerate(dims):
        values = attractors[dim].values.astype(float)
        if dim not in (FREQUENCY, *system.parameter_names) or len(values) < 2 or not (np.diff(values) > 0).all():
            continue
        own: dict[tuple[int, ...], list[Found]] = {}
        for n, points in orbits.items():
            index = places[n][0]
            at = {d: float(attractors[d].values[i]) for d, i in zip(dims, index, strict=True)}
            family = _family(system, len(points), packed, frequency, at, dim, float(np.ptp(values)))
            rest = (*index[:axis], *index[axis + 1 :])
            own.setdefault(rest, []).append(Found(n, index[axis], family, points, at[dim]))
            followed[n] = True
        lines += own.values()
        axes += [axis] * len(own)
    links: list[Link] = []
    outcomes: dict[tuple[int, int, int], str] = {}
    for axis, found in zip(axes, connect(lines), strict=True):
        links += found.links
        for way, ends in ((1, found.up), (-1, found.down)):
            outcomes.update({(axis, way, n): outcome for n, outcome in ends.items()})
    where = [index for index, _ in places]
    group, used = grouped(where, links)
    branch, _ = grouped(where, [link for link in used if not link.n_doublings])
    return Connections(group, branch, followed, outcomes)


def _orbit(attractors: xr.Dataset, place: Place) -> np.ndarray:
    index, row = place
    period = int(attractors["orbit_period"].values[(*index, row)])
    return np.asarray(attractors["attractor_points"].values[(*index, row)][:period])


def _family(
    system: System, period: int, packed: np.ndarray, frequency: float, at: Mapping[str, float], free: str, scale: float
) -> Family:
    own = packed.copy()
    for name, value in at.items():
        if name in system.parameter_names:
            own[system.parameter_names.index(name)] = value
    return Family(system, period, at.get(FREQUENCY, frequency), own, (free,), (scale,))
