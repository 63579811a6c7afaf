"""Connect closed orbits at different parameter points by following their branches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from magpend_core.engine.system import System
from pipeline.analysis.branches.connecting import Web, connect
from pipeline.analysis.branches.problems import FREQUENCY
from pipeline.analysis.branches.sheets import GOING, OPEN, UNTRIED, Axis, Grid
from pipeline.analysis.ragged import ROW_SIZE, dims_of, point_of_rows, points_of_rows
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
    is_open : ndarray of bool, (appearance, dim, 2)
        Whether following its branch ended somewhere for an unknown reason, or was not needed, up and down each dim.
    """

    group: np.ndarray
    branch: np.ndarray
    followed: np.ndarray
    is_open: np.ndarray

    @classmethod
    def none(cls, n: int) -> Connections:
        """Return connections that connect none of `n` attractors, for attractors that were not followed."""
        return cls(np.arange(n), np.arange(n), np.zeros(n, bool), np.zeros((n, 0, 2), bool))

    def may_be_one(self, axis: int, first: int, second: int) -> bool:
        """Return whether two attractors, the second further up an axis, may be matched by distance. They may if
        following their orbits has not shown that they differ.
        """
        if not (self.followed[first] and self.followed[second]):
            return True
        return bool(self.is_open[first, axis, 0] and self.is_open[second, axis, 1])


def followable(attractors: xr.Dataset) -> np.ndarray:
    """Return which rows are orbits on which Newton's method converged, whose branches can be followed."""
    closed = attractors["kind"].values == PERIODIC_ORBIT
    return np.asarray(
        closed & (attractors["is_polished"].values > 0) if "is_polished" in attractors else closed & False
    )


def connections(attractors: xr.Dataset, packed: np.ndarray, frequency: float, system: System) -> Connections:
    """Follow all closed orbits along each swept parameter, and record which of them lie on one branch.

    Parameters
    ----------
    attractors
        From `identify`.
    packed
        Packed parameters; the axes replace the values of the same name.
    frequency
        Drive frequency [Hz], used if it is not an axis.
    system
        System of the run.
    """
    none = Connections.none(len(point_of_rows(attractors)))
    rows, grid = np.flatnonzero(followable(attractors)), _grid(attractors, packed, frequency, system)
    if len(rows) < 2 or not grid.axes:
        return none
    place, points, periods = point_of_rows(attractors), points_of_rows(attractors), attractors["orbit_period"].values
    web = connect(grid, place[rows], [points[i][: periods[i]] for i in rows.tolist()])
    group, branch = none.group.copy(), none.branch.copy()
    for found, own in zip((group, branch), grouped(web, len(rows)), strict=True):
        least = np.full(len(web.place), len(group))
        np.minimum.at(least, own[: len(rows)], rows)
        found[rows] = least[own[: len(rows)]]
    is_open, followed = np.zeros((len(group), len(grid.shape), 2), bool), none.followed.copy()
    component, ways = _components(web), np.isin(web.ways, (UNTRIED, GOING, OPEN))
    for i, axis in enumerate(grid.axes):
        by_component = np.zeros((len(web.place), 2), bool)
        np.logical_or.at(by_component, component, ways[:, i])
        is_open[rows, axis.dim] = by_component[component[: len(rows)]]
    followed[rows] = True
    return Connections(group, branch, followed, is_open)


def _grid(attractors: xr.Dataset, packed: np.ndarray, frequency: float, system: System) -> Grid:
    """Return the parameter points of a result. Axes that are no parameters, or do not rise, are not followed."""
    dims, shape, names = dims_of(attractors), attractors[ROW_SIZE].shape, system.parameter_names
    at = np.unravel_index(np.arange(int(np.prod(shape))), shape)
    many, frequencies, axes = np.tile(packed, (len(at[0]), 1)), np.full(len(at[0]), float(frequency)), []
    for i, dim in enumerate(dims):
        if dim not in (FREQUENCY, *names):
            continue
        values, column = attractors[dim].values.astype(float), -1 if dim == FREQUENCY else names.index(dim)
        if column < 0:
            frequencies = values[at[i]]
        else:
            many[:, column] = values[at[i]]
        if len(values) > 1 and (np.diff(values) > 0).all():
            axes.append(Axis(i, column, values))
    return Grid(system, shape, many, frequencies, tuple(axes))


# ---- groups ------------------------------------------------------------------------------------


def grouped(web: Web, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Group linked orbits, with at most one orbit of each parameter point per group.

    A sheet may have several orbits at one point, where a path around a cusp leads from one to the other. It is cut far
    from such points: groups grow from there outwards. Then period doublings join groups, unless given orbits of both
    are at one point.

    Parameters
    ----------
    web
        Orbits and links.
    n
        Number of orbits that were given to be linked, which come first.

    Returns
    -------
    group, branch : ndarray
        Least number of each orbit's group, with and without period doublings.
    """
    doubled = web.links[:, 2] > 0
    plain = web.links[~doubled, :2]
    level = _distance_from_crowds(web)
    ends = np.sort(level[plain], axis=1)
    order = np.lexsort((plain.max(axis=1), plain.min(axis=1), ends[:, 0], ends[:, 1]))
    branch = _united(np.arange(len(web.place)), plain[order], web.place)
    links = web.links[doubled]
    order = np.lexsort((links[:, :2].max(axis=1), links[:, :2].min(axis=1), links[:, 2]))
    group = _united(branch, links[order, :2], np.where(np.arange(len(web.place)) < n, web.place, -1))
    return group, branch


def _components(web: Web) -> np.ndarray:
    return np.asarray(connected_components(_graph(web), directed=False)[1])


def _graph(web: Web) -> coo_array:
    links, n = web.links[web.links[:, 2] == 0], len(web.place)
    return coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))


def _distance_from_crowds(web: Web) -> np.ndarray:
    """Return for each orbit the number of links to the next point at which its sheet has several orbits."""
    component = _components(web)
    _, inverse, count = np.unique(
        np.column_stack([component, web.place]), axis=0, return_inverse=True, return_counts=True
    )
    crowded = np.flatnonzero(count[inverse.ravel()] > 1)
    if not len(crowded):
        return np.zeros(len(web.place))
    return np.asarray(dijkstra(_graph(web).tocsr(), directed=False, indices=crowded, unweighted=True, min_only=True))


def _united(start: np.ndarray, links: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Unite the groups of linked orbits in the order of the links, unless both have one of the places; -1 is none."""
    group = start.copy()
    linked = np.unique(start[links])
    rows = np.flatnonzero(np.isin(start, linked))
    members: dict[int, list[int]] = {own: [] for own in linked.tolist()}
    for i, own in zip(rows.tolist(), start[rows].tolist(), strict=True):
        members[own].append(i)
    taken = {own: {int(place[i]) for i in one if place[i] >= 0} for own, one in members.items()}
    for first, second in links:
        a, b = sorted((int(group[first]), int(group[second])), key=lambda one: (-len(members[one]), one))
        if a == b or taken[a] & taken[b]:
            continue
        moved = members.pop(b)
        group[moved] = a
        members[a] += moved
        taken[a] |= taken.pop(b)
    least = np.full(len(group), len(group))
    np.minimum.at(least, group, np.arange(len(group)))
    return np.asarray(least[group])
