"""Give attractors ids that stay the same along the swept parameters.

Meaning of an id
----------------
An id stands for an attractor that varies continuously with the parameters. It is a branch of closed orbits (over
several parameters a sheet), stable where it is listed and possibly unstable in between. It includes the orbits of twice
the period that take over stability at a period doubling. So

* orbits that continuation connects have one id, however long the unstable part between them is (for example a
  chaotic band inside a branch); at a fold the branch turns back, and the attractor beyond it is another one;
* over two parameters a closed path around a cusp returns on another sheet. Both have one id each where they
  coexist, and the id changes once on the way around, far from there (`grouped`);
* an orbit of twice the period keeps the id of the orbit that it branches from, unless both attract at one
  parameter point: attractors that coexist anywhere have different ids;
* sets that no branch connects are matched by distance, and only with sets of the same kind: a bounded set
  never takes the id of an orbit. An orbit never takes the id of another orbit if no doubling relates their
  periods, if their sides differ, or if following their branches to the ends did not connect them.

`match_basis` states the evidence for every appearance's id, strongest first: a followed branch, a doubling,
or distance alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from magpend_core.engine.system import System
from magpend_core.models.model import Parameters
from magpend_core.ordering import SAME_DIGITS
from pipeline.analysis.branches.connecting import Web, connect
from pipeline.analysis.branches.problems import FREQUENCY
from pipeline.analysis.branches.sheets import GOING, OPEN, UNTRIED, Axis, Grid
from pipeline.layout.vocabulary import PERIODIC_ORBIT, frequency_of, model_of, parameters_of
from pipeline.products.reporting import track
from pipeline.results.ragged import N_IDS, ROW_SIZE, SET, dims_of, point_of_rows, points_of_rows, rows_at, take
from pipeline.results.sets import Geometry, mean_distance, order_by_points

BASES = ("absent", "first_appearance", "branch", "doubling", "distance")
"""Meanings of `match_basis`."""

_, _FIRST, _BRANCH, _DOUBLING, _DISTANCE = range(len(BASES))


@dataclass(frozen=True, eq=False)
class Seen:
    """Attractor at one parameter point, from one row of the stored features."""

    number: int
    kind: int
    period: int
    side: int
    points: np.ndarray
    rotation: np.ndarray

    @property
    def family(self) -> int:
        """Odd part of the period, equal for all orbits of one doubling cascade; 0 for bounded sets."""
        return self.period // (self.period & -self.period) if self.period else 0


@dataclass(frozen=True, eq=False)
class Rule:
    """Rule for matching attractors by distance: which of them may match, and up to which distance."""

    threshold: float
    geometry: Geometry
    neutral: frozenset[int]
    known: Connections

    def distance(self, axis: int, before: Seen, here: Seen) -> float:
        """Return the distance of an attractor from an earlier one along an axis; infinite if they may not match."""
        return self.alike(before, here) if self.known.may_be_one(axis, before.number, here.number) else np.inf

    def alike(self, before: Seen, here: Seen) -> float:
        """Return the distance of two attractors at one parameter point; infinite if their kinds, periods or sides
        exclude that they are one.
        """
        if not self._alike(before, here):
            return np.inf
        turned = float(np.nan_to_num(np.abs(before.rotation - here.rotation)).max(initial=0.0))
        return mean_distance(before.points, here.points, self.geometry) + turned

    def _alike(self, a: Seen, b: Seen) -> bool:
        sides = {a.side, b.side} - self.neutral
        return a.kind == b.kind and a.family == b.family and len(sides) <= 1


def match(
    attractors: xr.Dataset,
    *,
    threshold: float = 0.3,
    look_back: int = 3,
    connect: bool = True,
    parameters: Parameters | np.ndarray | None = None,
    system: System | None = None,
) -> xr.Dataset:
    """Give each attractor an id that stays the same along the sweep; the docstring of this module defines ids.

    Closed orbits are first connected by continuation (`pipeline.analysis.branches.connecting`). Then the
    parameter points are visited in the order of their axes. An appearance that is connected with an earlier
    one takes its id. The others are assigned to ids at neighbouring points: up to `look_back` steps back
    along each axis, with the nearest appearance of each id. The assignment minimises the sum of the
    distances (Hungarian algorithm); a distance beyond the threshold, or no partner, costs the threshold.

    The distance is the mean distance of the stored points from those of the other set, the larger of both
    directions, plus the difference of the mean rotations in turns per drive period. It is infinite between
    appearances that may not match. An appearance without a partner within the threshold gets a new id; new
    ids at one point follow the lexicographic order of the least section points. So ids depend on the
    attractors alone.

    Parameters
    ----------
    attractors
        Result of `identify`, or of `match`.
    threshold
        Largest distance between two appearances that are matched by distance alone.
    look_back
        Most steps back along each axis to an appearance that is matched by distance.
    connect
        Whether to follow polished orbits along the axes, which integrates; otherwise ids rest on distance.
    parameters, system
        Parameters and system of the run, see `identify`; by default from the attributes.

    Returns
    -------
    Dataset
        `attractors` with ids, the rows of each point in their order, and the variable `match_basis`.

    Raises
    ------
    ValueError
        If an option is out of bounds, or orbits are to be followed and the parameters are missing.
    """
    if not threshold > 0.0:
        raise ValueError(f"threshold = {threshold!r} is out of bounds: it must be greater than 0.")
    if look_back < 1:
        raise ValueError(f"look_back = {look_back!r} is out of bounds: it must be 1 or more.")
    # first, as it takes the most memory
    links = _connections(attractors, parameters, system) if connect else Connections.none(attractors.sizes[SET])
    appearances, rows = seen_in(attractors), rows_at(attractors)
    where = [index for index, own in rows.items() for _ in own]
    rule = Rule(threshold, geometry_of(attractors, system), neutral_sides(attractors), links)
    ids = _Ids(where, rule)
    seen: dict[tuple[int, ...], dict[int, Seen]] = {}
    for index in track(list(rows), "matching attractors"):
        seen[index] = ids.at([appearances[row] for row in rows[index]], _known(seen, index, look_back))
    attrs = {
        **attractors.attrs,
        "matched": 1,
        N_IDS: len(ids.taken),
        "match_threshold": threshold,
        "match_look_back": look_back,
        "match_connect": int(connect),
    }
    flags = {"flag_values": np.arange(len(BASES), dtype=np.int8), "flag_meanings": " ".join(BASES)}
    about = flags
    return _renumbered(attractors.assign(match_basis=(SET, ids.basis, about)), ids.ids).assign_attrs(attrs)


def _connections(
    attractors: xr.Dataset, parameters: Parameters | np.ndarray | None, system: System | None
) -> Connections:
    if not dims_of(attractors) or sum(followable(attractors)) < 2:
        return Connections.none(attractors.sizes[SET])
    base = parameters_of(attractors) if parameters is None else parameters
    if isinstance(base, Parameters):
        system, packed = system or base.model.system, base.pack()
    else:
        packed = np.array(base, np.float64)
    assert system is not None
    model = base.model if isinstance(base, Parameters) else None
    fixed = frequency_of(model, {str(k): v for k, v in attractors.coords.items() if not v.ndim})
    return connections(attractors, packed, fixed, system)


def geometry_of(attractors: xr.Dataset, system: System | None = None) -> Geometry:
    """Return the geometry of the states, from the given system or else from the model."""
    told: Any = system or model_of(attractors)
    return Geometry(told.is_angle, told.scales)


def neutral_sides(attractors: xr.Dataset) -> frozenset[int]:
    """Return the classifier codes that are compatible with every other code."""
    classifier = model_of(attractors).classifier
    return frozenset(classifier.neutral if classifier else ())


class _Ids:
    """Ids given to attractors so far; the parameter points are visited one by one.

    `ids` and `basis` (row) have each appearance's id and the basis for it. `taken` has the parameter points at which
    each id is, or will be, used.
    """

    def __init__(self, where: Sequence[tuple[int, ...]], rule: Rule) -> None:
        self.ids = np.full(len(where), -1, np.int64)
        self.basis = np.zeros(len(where), np.int8)
        self.taken: list[set[tuple[int, ...]]] = []
        self._rule = rule
        self._group = [int(g) for g in rule.known.group]
        self._branch = [int(b) for b in rule.known.branch]
        self._where: dict[int, set[tuple[int, ...]]] = {}
        for group, index in zip(self._group, where, strict=True):
            self._where.setdefault(group, set()).add(index)
        self._by_group: dict[int, int] = {}
        self._met: set[int] = set()

    def at(self, here: Sequence[Seen], known: Mapping[int, list[tuple[int, Seen]]]) -> dict[int, Seen]:
        """Give ids to the attractors of the next parameter point. Return the attractors by id."""
        free = [one for one in here if self._group[one.number] not in self._by_group]
        for one in here:
            if one not in free:
                self._settle(one, _BRANCH if self._branch[one.number] in self._met else _DOUBLING)
        for one, identity in zip(free, _assign(free, known, self._rule, self._has_room), strict=True):
            if identity is not None:
                self._give(one, identity)
                self._settle(one, _DISTANCE)
        new = [one for one in free if self._group[one.number] not in self._by_group]
        for i in order_by_points([one.points for one in new], self._rule.geometry):
            self.taken.append(set())
            self._give(new[i], len(self.taken) - 1)
            self._settle(new[i], _FIRST)
        self._met |= {self._branch[one.number] for one in here}
        return {self._by_group[self._group[one.number]]: one for one in here}

    def _has_room(self, one: Seen, identity: int) -> bool:
        """Return whether an id is still free at all parameter points at which an attractor's branch occurs."""
        return not self._where[self._group[one.number]] & self.taken[identity]

    def _give(self, one: Seen, identity: int) -> None:
        group = self._group[one.number]
        self._by_group[group] = identity
        self.taken[identity] |= self._where[group]

    def _settle(self, one: Seen, basis: int) -> None:
        self.ids[one.number] = self._by_group[self._group[one.number]]
        self.basis[one.number] = basis


def seen_in(attractors: xr.Dataset) -> list[Seen]:
    """Return the sets of all rows."""
    n = attractors.sizes[SET]
    side = attractors["side"].values if "side" in attractors else np.zeros(n, np.int64)
    rotation = attractors["rotation"].values if "rotation" in attractors else np.zeros((n, 0))
    kind, period = attractors["kind"].values, attractors["orbit_period"].values
    return [
        Seen(i, int(kind[i]), int(period[i]), int(side[i]), points, rotation[i])
        for i, points in enumerate(points_of_rows(attractors))
    ]


def _known(
    seen: dict[tuple[int, ...], dict[int, Seen]], index: tuple[int, ...], look_back: int
) -> dict[int, list[tuple[int, Seen]]]:
    """Return for each id its nearest earlier attractor along each parameter axis, as pairs (axis, attractor)."""
    known: dict[int, list[tuple[int, Seen]]] = {}
    for axis in range(len(index)):
        along: dict[int, Seen] = {}
        for step in range(1, min(look_back, index[axis]) + 1):
            back = (*index[:axis], index[axis] - step, *index[axis + 1 :])
            for identity, appearance in seen[back].items():
                along.setdefault(identity, appearance)
        for identity, appearance in along.items():
            known.setdefault(identity, []).append((axis, appearance))
    return known


def _assign(
    here: Sequence[Seen], known: Mapping[int, list[tuple[int, Seen]]], rule: Rule, is_free: Callable[[Seen, int], bool]
) -> list[int | None]:
    """Choose for each attractor the existing id of the nearest earlier attractor; None for a new attractor."""
    given: list[int | None] = [None] * len(here)
    if not here or not known:
        return given
    identities = sorted(known)

    def cost_of(a: Seen, identity: int) -> float:
        if not is_free(a, identity):
            return np.inf
        return min(rule.distance(axis, b, a) for axis, b in known[identity])

    cost = np.array([[cost_of(a, identity) for identity in identities] for a in here])
    # clip, so that an assignment beyond the threshold costs as much as none
    for row, column in zip(*linear_sum_assignment(_leveled(np.minimum(cost, rule.threshold))), strict=True):
        if cost[row, column] < rule.threshold:
            given[row] = identities[column]
    return given


def _leveled(cost: np.ndarray) -> np.ndarray:
    """Make costs equal that differ by last digits, so that the order of the rows decides between mirror images."""
    order = np.argsort(cost, axis=None)
    values = cost.ravel()[order]
    first = np.maximum.accumulate(np.where(np.diff(values, prepend=-np.inf) > SAME_DIGITS, np.arange(len(order)), 0))
    leveled = np.empty_like(values)
    leveled[order] = values[first]
    return leveled.reshape(cost.shape)


def _renumbered(attractors: xr.Dataset, ids: np.ndarray) -> xr.Dataset:
    """Order the rows of each parameter point by their ids, and replace numbers of sets by ids everywhere."""
    dims = dims_of(attractors)
    cells = attractors["attractor_id"].transpose(*dims, ...)
    rows = rows_at(attractors)
    changed, order, ends = cells.values.copy(), [], attractors["to"].values.copy()
    partners = attractors["mirror_partner"].values.copy() if "mirror_partner" in attractors else np.zeros(0, np.int64)
    left_at, old = attractors["from_set"].values, attractors["attractor"].values
    for index, own in rows.items():
        table = np.full(old.max(initial=-1) + 2, -1)  # by old id; the last entry is of cells without one
        table[old[own.start : own.stop]] = ids[own.start : own.stop]
        changed[index] = table[changed[index]]
        if partners.size:
            partners[own.start : own.stop] = table[partners[own.start : own.stop]]
        here = slice(*np.searchsorted(left_at, [own.start, own.stop]))
        ends[here] = table[ends[here]]
        order += [own.start + int(i) for i in np.argsort(ids[own.start : own.stop])]
    found = attractors.assign_coords(attractor=(SET, ids.astype(np.int32), attractors["attractor"].attrs))
    found["attractor_id"] = cells.copy(data=changed).transpose(*attractors["attractor_id"].dims)
    found["to"] = attractors["to"].copy(data=ends)
    if partners.size:
        found["mirror_partner"] = attractors["mirror_partner"].copy(data=partners)
    return take(found, np.array(order, np.int64))


Appearances = Mapping[tuple[int, ...], Seen]
"""Appearances of one attractor by the index of the parameter point."""


def match_across(runs: Sequence[xr.Dataset], *, threshold: float = 0.3) -> list[np.ndarray]:
    """Give the attractors of several runs common ids.

    Parameters
    ----------
    runs
        Results of the analysis ``attractors`` over the same parameter points. The first one is the reference.
    threshold
        Largest distance between attractors that may be the same, as in `match`.

    Returns
    -------
    list of ndarray
        For each run the common id of each of its attractors, (attractor,); -1 for sets that attract no cell.

    Notes
    -----
    An attractor of a run is assigned to the id with the least mean distance over the parameter points at which both
    appear (Hungarian algorithm over all of them), so that no id occurs twice in a run. The distance is that of `match`.
    Attractors without a partner within the threshold get new ids, which later runs may match.
    """
    known: list[Appearances] = []
    found = []
    for run in runs:
        own = _attracting(run)
        rule = Rule(threshold, geometry_of(run), neutral_sides(run), Connections.none(0))
        ids = np.full(int(run.attrs[N_IDS]), -1, np.int64)
        cost = np.array([[_distance(rule, old, new) for old in known] for new in own.values()])
        cost = cost.reshape(len(own), len(known))
        rows = list(own)
        for i, j in zip(*linear_sum_assignment(np.minimum(cost, threshold)), strict=True):
            if cost[i, j] < threshold:
                ids[rows[i]] = j
        for row, appearances in own.items():
            if ids[row] < 0:
                ids[row] = len(known)
                known.append(appearances)
        found.append(ids)
    return found


def _attracting(run: xr.Dataset) -> dict[int, Appearances]:
    """Return the appearances of each set of a run that attracts cells, by its index."""
    share, number = run["share"].values, run["attractor"].values
    seen = seen_in(run)
    found: dict[int, dict[tuple[int, ...], Seen]] = {}
    for place, rows in rows_at(run).items():
        for row in rows:
            if share[row] > 0.0:
                found.setdefault(int(number[row]), {})[place] = seen[row]
    return {number: found[number] for number in sorted(found)}


def _distance(rule: Rule, first: Appearances, second: Appearances) -> float:
    """Return the mean distance of two attractors over the parameter points at which they may be the same."""
    distances = [rule.alike(first[place], second[place]) for place in first.keys() & second.keys()]
    finite = [d for d in distances if np.isfinite(d)]
    return float(np.mean(finite)) if finite else np.inf


@dataclass(frozen=True, eq=False)
class Connections:
    """Which attractors of different parameter points lie on one branch, found by following their orbits."""

    group: np.ndarray  # least number among the appearances that are connected with each
    branch: np.ndarray  # least number among those that are connected without a period doubling
    followed: np.ndarray  # whether each was followed
    # bool, (appearance, dim, 2): whether following its branch ended somewhere for an unknown reason, or was not
    # needed, up and down each dim
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
