"""Give attractors ids that stay the same along the swept parameters.

Meaning of an id
----------------
An id stands for an attractor that varies continuously with the parameters. It is a branch of closed orbits,
stable where it is listed and possibly unstable in between. It includes the orbits of twice the period that
take over stability at a period doubling. So

* orbits that continuation connects have one id, however long the unstable part between them is (for example a
  chaotic band inside a branch); at a fold the branch turns back, and the attractor beyond it is another one;
* an orbit of twice the period keeps the id of the orbit that it branches from, unless both attract at one
  parameter point: attractors that coexist anywhere have different ids;
* sets that no branch connects are matched by distance, and only with sets of the same kind: a bounded set
  never takes the id of an orbit. An orbit never takes the id of another orbit if no doubling relates their
  periods, if their sides differ, or if following a branch to its end did not connect them.

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
from pipeline.analysis.attractors.matching.connections import Connections, Place, connections, followable
from pipeline.analysis.sets import Geometry, mean_distance, order_by_points
from pipeline.layout.vocabulary import frequency_of, model_of, parameters_of
from pipeline.products.reporting import track

_PER_ATTRACTOR = "attractor"

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
        ends = (before.number, before.period), (here.number, here.period)
        return self.alike(before, here) if self.known.may_be_one(axis, *ends) else np.inf

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
        `attractors` with the dim `attractor` over the ids, and the variable `match_basis`.

    Raises
    ------
    ValueError
        If an option is out of bounds, or orbits are to be followed and the parameters are missing.
    """
    if not threshold > 0.0:
        raise ValueError(f"threshold = {threshold!r} is out of bounds: it must be greater than 0.")
    if look_back < 1:
        raise ValueError(f"look_back = {look_back!r} is out of bounds: it must be 1 or more.")
    dims = tuple(str(d) for d in attractors["kind"].dims if d != _PER_ATTRACTOR)
    shape = tuple(attractors.sizes[d] for d in dims)
    kinds = attractors["kind"].transpose(*dims, _PER_ATTRACTOR).values
    places = [(index, int(row)) for index in np.ndindex(*shape) for row in np.flatnonzero(kinds[index] > 0)]
    links = Connections.none(len(places))
    if connect:
        links = _connections(attractors, places, dims, parameters, system)
    rule = Rule(threshold, geometry_of(attractors, system), neutral_sides(attractors), links)
    ids = _Ids(shape, attractors.sizes[_PER_ATTRACTOR], places, rule)
    seen: dict[tuple[int, ...], dict[int, Seen]] = {}
    numbers: dict[tuple[int, ...], list[int]] = {}
    for n, (index, _) in enumerate(places):
        numbers.setdefault(index, []).append(n)
    for index in track(list(np.ndindex(*shape)), "matching attractors"):
        here = [seen_at(attractors, n, places[n]) for n in numbers.get(index, [])]
        seen[index] = ids.at(here, _known(seen, index, look_back))
    attrs = {
        **attractors.attrs,
        "matched": 1,
        "match_threshold": threshold,
        "match_look_back": look_back,
        "match_connect": int(connect),
    }
    flags = {"flag_values": np.arange(len(BASES), dtype=np.int8), "flag_meanings": " ".join(BASES)}
    about = {"units": "1", "long_name": "what the id rests on", **flags}
    rows = attractors.assign(match_basis=((*dims, _PER_ATTRACTOR), ids.basis, about))
    return _renumbered(rows, ids.ids, len(ids.taken), dims).assign_attrs(attrs)


def _connections(
    attractors: xr.Dataset,
    places: Sequence[Place],
    dims: Sequence[str],
    parameters: Parameters | np.ndarray | None,
    system: System | None,
) -> Connections:
    if not dims or sum(followable(attractors, place) for place in places) < 2:
        return Connections.none(len(places))
    base = parameters_of(attractors) if parameters is None else parameters
    if isinstance(base, Parameters):
        system, packed = system or base.model.system, base.pack()
    else:
        packed = np.array(base, np.float64)
    assert system is not None
    model = base.model if isinstance(base, Parameters) else None
    fixed = frequency_of(model, {str(k): v for k, v in attractors.coords.items() if not v.ndim})
    return connections(attractors, places, dims, packed, fixed, system)


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

    `ids` and `basis` (one axis per parameter, then row) have each appearance's id and the basis for it, -1 and 0 where
    there is none. `taken` has the parameter points at which each id is, or will be, used.
    """

    def __init__(self, shape: tuple[int, ...], n_rows: int, places: Sequence[Place], rule: Rule) -> None:
        self.ids = np.full((*shape, n_rows), -1, np.int64)
        self.basis = np.zeros(self.ids.shape, np.int8)
        self.taken: list[set[tuple[int, ...]]] = []
        self._places, self._rule = places, rule
        self._group = [int(g) for g in rule.known.group]
        self._branch = [int(b) for b in rule.known.branch]
        self._where: dict[int, set[tuple[int, ...]]] = {}
        for group, (index, _) in zip(self._group, places, strict=True):
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
        index, row = self._places[one.number]
        self.ids[(*index, row)] = self._by_group[self._group[one.number]]
        self.basis[(*index, row)] = basis


def seen_at(attractors: xr.Dataset, number: int, place: Place) -> Seen:
    """Return the attractor of one row at one parameter point."""
    index, row = place
    at = (*index, row)
    points = attractors["attractor_points"].values[at]
    points = points[np.isfinite(points).all(axis=-1)]
    side = int(attractors["side"].values[at]) if "side" in attractors else 0
    rotation = attractors["rotation"].values[at] if "rotation" in attractors else np.zeros(0)
    kind, period = (int(attractors[name].values[at]) for name in ("kind", "orbit_period"))
    return Seen(number, kind, period, side, points, rotation)


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


def _renumbered(attractors: xr.Dataset, ids: np.ndarray, n_ids: int, dims: tuple[str, ...]) -> xr.Dataset:
    """Reorder the dataset's attractors by id, and replace the indices of attractors in its cells by ids."""
    present = np.nonzero(ids >= 0)
    target = (*present[:-1], ids[present])
    variables: dict[str, Any] = {}
    for name, variable in attractors.data_vars.items():
        if _PER_ATTRACTOR not in variable.dims:
            continue
        ordered = variable.transpose(*dims, _PER_ATTRACTOR, ...)
        values = ordered.values
        moved = np.full(
            (*values.shape[: len(dims)], n_ids, *values.shape[len(dims) + 1 :]), _fill(str(name), values.dtype)
        )
        moved = moved.astype(values.dtype)
        if name == "n_to":
            values = _destinations(values, ids, n_ids)
            moved = np.zeros((*moved.shape[:-1], n_ids), values.dtype)
        moved[target] = _partners(values, ids)[present] if name == "mirror_partner" else values[present]
        variables[str(name)] = (ordered.dims, moved, variable.attrs)
    cells = attractors["attractor_id"]
    coord = (_PER_ATTRACTOR, np.arange(n_ids, dtype=np.int32), {"units": "1", "long_name": "attractor"})
    rest = attractors.drop_vars([*variables, _PER_ATTRACTOR], errors="ignore")
    result = rest.assign(variables).assign_coords(attractor=coord)
    result["attractor_id"] = cells.copy(data=_cell_ids(cells, ids, dims))
    return result


def _fill(name: str, dtype: np.dtype[Any]) -> float:
    if name == "mirror_partner":
        return -1
    return 0 if dtype.kind in "iu" or name == "share" else np.nan


def _lookup(ids: np.ndarray, rows: np.ndarray) -> np.ndarray:
    table = np.append(ids, -1)
    return np.asarray(table[rows])


def _destinations(values: np.ndarray, ids: np.ndarray, n_ids: int) -> np.ndarray:
    """Replace indices by ids in the counts that say on which set the cells of a transient set ended."""
    moved = np.zeros((*values.shape[:-1], n_ids), values.dtype)
    for *index, row in np.argwhere(ids >= 0).tolist():
        point = tuple(index)
        moved[point][:, ids[point][row]] = values[point][:, row]
    return moved


def _partners(values: np.ndarray, ids: np.ndarray) -> np.ndarray:
    moved = np.empty_like(values)
    for index in np.ndindex(*values.shape[:-1]):
        moved[index] = _lookup(ids[index], values[index])
    return moved


def _cell_ids(cells: xr.DataArray, ids: np.ndarray, dims: tuple[str, ...]) -> np.ndarray:
    values = cells.transpose(*dims, ...).values
    moved = np.empty_like(values)
    for index in np.ndindex(*ids.shape[:-1]):
        moved[index] = _lookup(ids[index], values[index])
    return np.asarray(cells.transpose(*dims, ...).copy(data=moved).transpose(*cells.dims).values)
