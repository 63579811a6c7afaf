"""Connect closed orbits at different parameter points by following their branches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from pipeline.analysis.branches.connecting import OPEN, Found, Link, connect, grouped
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.analysis.ragged import dims_of
from pipeline.layout.vocabulary import PERIODIC_ORBIT


@dataclass(frozen=True, eq=False)
class Connections:
    """Which attractors of different parameter points lie on one branch, found by following their orbits.

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
        """Return connections that connect none of `n` attractors, for attractors that were not followed."""
        return cls(np.arange(n), np.arange(n), np.zeros(n, bool))

    def may_be_one(self, axis: int, first: tuple[int, int], second: tuple[int, int]) -> bool:
        """Return whether two attractors may be matched by distance. They may if following their orbits has not shown
        that they differ.

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


def followable(attractors: xr.Dataset) -> np.ndarray:
    """Return which rows are orbits on which Newton's method converged, whose branches can be followed."""
    closed = attractors["kind"].values == PERIODIC_ORBIT
    return np.asarray(
        closed & (attractors["is_polished"].values > 0) if "is_polished" in attractors else closed & False
    )


def connections(
    attractors: xr.Dataset,
    where: Sequence[tuple[int, ...]],
    points: Sequence[np.ndarray],
    packed: np.ndarray,
    frequency: float,
    system: System,
) -> Connections:
    """Follow all closed orbits along each swept parameter, and record which of them lie on one branch.

    Parameters
    ----------
    attractors
        From `identify`.
    where, points
        Parameter point and section points of each row.
    packed
        Packed parameters; the axes replace the values of the same name.
    frequency
        Drive frequency [Hz], used if it is not an axis.
    system
        System of the run.
    """
    dims, periods = dims_of(attractors), attractors["orbit_period"].values
    orbits = {n: points[n][: periods[n]] for n in np.flatnonzero(followable(attractors)).tolist()}
    followed = np.zeros(len(where), bool)
    lines: list[list[Found]] = []
    axes: list[int] = []
    for axis, dim in enumerate(dims):
        values = attractors[dim].values.astype(float)
        if dim not in (FREQUENCY, *system.parameter_names) or len(values) < 2 or not (np.diff(values) > 0).all():
            continue
        own: dict[tuple[int, ...], list[Found]] = {}
        for n, orbit in orbits.items():
            index = where[n]
            at = {d: float(attractors[d].values[i]) for d, i in zip(dims, index, strict=True)}
            family = _family(system, len(orbit), packed, frequency, at, dim, float(np.ptp(values)))
            rest = (*index[:axis], *index[axis + 1 :])
            own.setdefault(rest, []).append(Found(n, index[axis], family, orbit, at[dim]))
            followed[n] = True
        lines += own.values()
        axes += [axis] * len(own)
    links: list[Link] = []
    outcomes: dict[tuple[int, int, int], str] = {}
    for axis, found in zip(axes, connect(lines), strict=True):
        links += found.links
        for way, ends in ((1, found.up), (-1, found.down)):
            outcomes.update({(axis, way, n): outcome for n, outcome in ends.items()})
    group, used = grouped(where, links)
    branch, _ = grouped(where, [link for link in used if not link.n_doublings])
    return Connections(group, branch, followed, outcomes)


def _family(
    system: System, period: int, packed: np.ndarray, frequency: float, at: Mapping[str, float], free: str, scale: float
) -> Family:
    own = packed.copy()
    for name, value in at.items():
        if name in system.parameter_names:
            own[system.parameter_names.index(name)] = value
    return Family(system, period, at.get(FREQUENCY, frequency), own, (free,), (scale,))
