"""Ids that follow attractors along the swept parameters.

A pass over what `identify` stored: it integrates nothing and can be repeated with other options.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment

from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline.analysis.sets import Geometry, hausdorff_distance, mean_distance, order_by_points

_PER_ATTRACTOR = "attractor"

OTHER_FAMILY = 3.0
"""Weight of the distance between orbits whose periods no doubling connects, or an orbit and a bounded set."""


@dataclass(frozen=True)
class _Seen:
    """An attractor where it was last seen: one row of the stored features."""

    points: np.ndarray
    rotation: np.ndarray
    family: int


def match(
    attractors: xr.Dataset, *, threshold: float = 0.3, look_back: int = 3, geometry: Geometry | None = None
) -> xr.Dataset:
    """Give attractors ids that follow them along the sweep.

    The parameter points are taken in the order of their axes. At each, the attractors are assigned to
    the ids seen at the neighbours: up to `look_back` steps back along each axis, each id by its nearest
    such appearance. The assignment minimises the sum of the distances, a distance beyond the threshold
    (and no partner at all) costing the threshold (Hungarian algorithm). The distance is the mean
    distance of the stored points from those of the other set, the larger of both directions, plus the
    difference of the mean rotations in turns per drive period. Between a closed orbit and a bounded set,
    and between orbits whose periods no doubling connects (3 and 7, but not 3 and 6), it is three times
    the largest distance instead of the mean one: narrow bands of chaos keep the id of the orbit that they
    sprang from, an orbit inside of wide chaos does not get that of the chaos. What is not assigned within
    the threshold gets the next new id; new ids at one point come in lexicographic order of the
    attractors' least section points. So ids depend on the attractors alone.

    Parameters
    ----------
    attractors
        Result of `identify`, or of `match`.
    threshold
        Largest distance between two appearances of one id.
    look_back
        Steps of each axis over which an id may be absent, plus one.
    geometry
        Of the states; by default the pendulum's.

    Returns
    -------
    Dataset
        As `attractors`; the dim `attractor` runs over the ids.

    Raises
    ------
    ValueError
        If an option is out of bounds.
    """
    if not threshold > 0.0:
        raise ValueError(f"threshold = {threshold!r} is out of bounds: it must be greater than 0.")
    if look_back < 1:
        raise ValueError(f"look_back = {look_back!r} is out of bounds: it must be 1 or more.")
    geometry = geometry or Geometry.of(PENDULUM_FITTED)
    dims = tuple(str(d) for d in attractors["kind"].dims if d != _PER_ATTRACTOR)
    shape = tuple(attractors.sizes[d] for d in dims)
    ids = np.full((*shape, attractors.sizes[_PER_ATTRACTOR]), -1, np.int64)
    seen: dict[tuple[int, ...], dict[int, _Seen]] = {}
    n_ids = 0
    for index in np.ndindex(*shape):
        rows = np.flatnonzero(attractors["kind"].values[index] > 0)
        here = [_seen(attractors, (*index, row)) for row in rows]
        known = _known(seen, index, look_back)
        given = _assign(here, known, threshold, geometry)
        new = [i for i, given_id in enumerate(given) if given_id < 0]
        for i in order_by_points([here[i].points for i in new], geometry):
            given[new[i]] = n_ids
            n_ids += 1
        seen[index] = dict(zip(given, here, strict=True))
        ids[(*index, rows)] = given
    attrs = {**attractors.attrs, "matched": 1, "match_threshold": threshold, "match_look_back": look_back}
    return _renumbered(attractors, ids, n_ids, dims).assign_attrs(attrs)


def _seen(attractors: xr.Dataset, at: tuple[Any, ...]) -> _Seen:
    points = attractors["attractor_points"].values[at]
    points = points[np.isfinite(points).all(axis=-1)]
    period = int(attractors["orbit_period"].values[at])
    # periods p, 2p, 4p ... belong to one cascade: the odd part tells; 0 for bounded sets
    family = period // (period & -period) if period else 0
    return _Seen(points, attractors["rotation"].values[at], family)


def _known(
    seen: dict[tuple[int, ...], dict[int, _Seen]], index: tuple[int, ...], look_back: int
) -> dict[int, list[_Seen]]:
    """Appearances to hold against: of each id the nearest along each axis."""
    known: dict[int, list[_Seen]] = {}
    for axis in range(len(index)):
        along: dict[int, _Seen] = {}
        for step in range(1, min(look_back, index[axis]) + 1):
            back = (*index[:axis], index[axis] - step, *index[axis + 1 :])
            for identity, appearance in seen[back].items():
                along.setdefault(identity, appearance)
        for identity, appearance in along.items():
            known.setdefault(identity, []).append(appearance)
    return known


def _assign(
    here: list[_Seen], known: dict[int, list[_Seen]], threshold: float, geometry: Geometry
) -> list[int]:
    """Id of each attractor, -1 for a new one."""
    given = [-1] * len(here)
    if not here or not known:
        return given
    identities = sorted(known)
    cost = np.array(
        [[min(_distance(a, b, geometry) for b in known[identity]) for identity in identities] for a in here]
    )
    # clipped, so that an assignment beyond the threshold is as good as none
    for row, column in zip(*linear_sum_assignment(np.minimum(cost, threshold)), strict=True):
        if cost[row, column] < threshold:
            given[row] = identities[column]
    return given


def _distance(a: _Seen, b: _Seen, geometry: Geometry) -> float:
    turned = float(np.nan_to_num(np.abs(a.rotation - b.rotation)).max(initial=0.0))
    if a.family == b.family:
        return mean_distance(a.points, b.points, geometry) + turned
    return OTHER_FAMILY * hausdorff_distance(a.points, b.points, geometry) + turned


def _renumbered(attractors: xr.Dataset, ids: np.ndarray, n_ids: int, dims: tuple[str, ...]) -> xr.Dataset:
    """Put every attractor into the row of its id, and its id into the cells."""
    present = np.nonzero(ids >= 0)
    target = (*present[:-1], ids[present])
    variables: dict[str, Any] = {}
    for name, variable in attractors.data_vars.items():
        if _PER_ATTRACTOR not in variable.dims:
            continue
        ordered = variable.transpose(*dims, _PER_ATTRACTOR, ...)
        values = ordered.values
        moved = np.full(
            (*values.shape[: len(dims)], n_ids, *values.shape[len(dims) + 1 :]),
            _fill(str(name), values.dtype),
        )
        moved = moved.astype(values.dtype)
        moved[target] = _partners(values, ids)[present] if name == "mirror_partner" else values[present]
        variables[str(name)] = (ordered.dims, moved, variable.attrs)
    cells = attractors["attractor_id"]
    coord = (_PER_ATTRACTOR, np.arange(n_ids, dtype=np.int32), {"units": "1", "long_name": "attractor"})
    rest = attractors.drop_vars([*variables, _PER_ATTRACTOR], errors="ignore")
    result = rest.assign(variables).assign_coords(attractor=coord)
    result["attractor_id"] = cells.copy(data=_cell_ids(cells, ids, dims))
    return result


def _fill(name: str, dtype: np.dtype[Any]) -> float:
    if name in ("mirror_partner", "is_stable"):
        return -1
    return 0 if dtype.kind in "iu" or name == "share" else np.nan


def _lookup(ids: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Ids of row numbers at one parameter point, -1 where there is none."""
    table = np.append(ids, -1)
    return np.asarray(table[rows])


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
