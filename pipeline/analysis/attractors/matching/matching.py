"""Give attractors ids that stay the same along the swept parameters.

Meaning of an id
----------------
An id stands for an attractor that varies continuously with the parameters. It is a branch of closed orbits (over
several parameters a sheet), stable where it is listed and possibly unstable in between. It includes the orbits of twice
the period that take over stability at a period doubling. So

* orbits that continuation connects have one id, however long the unstable part between them is (for example a
  chaotic band inside a branch); at a fold the branch turns back, and the attractor beyond it is another one;
* over two parameters a closed path around a cusp returns on another sheet. Both have one id each where they
  coexist, and the id changes once on the way around, far from there (`connections.grouped`);
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

from magpend_core.engine.system import System
from magpend_core.models.model import Parameters
from pipeline.analysis.attractors.matching.connections import Connections, connections, followable
from pipeline.analysis.ragged import N_IDS, SET, dims_of, points_of_rows, rows_at, take
from pipeline.analysis.sets import Geometry, mean_distance, order_by_points
from pipeline.layout.vocabulary import frequency_of, model_of, parameters_of
from pipeline.products.reporting import track

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
    about = {"units": "1", "long_name": "what the id rests on", **flags}
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
    for row, column in zip(*linear_sum_assignment(np.minimum(cost, rule.threshold)), strict=True):
        if cost[row, column] < rule.threshold:
            given[row] = identities[column]
    return given


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
