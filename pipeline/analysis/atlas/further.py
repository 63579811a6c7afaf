"""Spend cells where an atlas is worst: more starts in regions that few cells have seen, and points between neighbours
whose attractors differ without an explanation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.orbits import scaled_distance
from pipeline.analysis.atlas.plane import Array, Plane, columns_of
from pipeline.analysis.atlas.verdicts import SAME_AT_POINT
from pipeline.analysis.events.kinds import UNDECIDED
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import SAMPLE, SET
from pipeline.results.tabular import words_of

SEEN = 299
"""Fewest cells of which one is in a basin of 1 % with a probability of 95 %: ln .05 / ln .99."""

SHORTEST = 1e-3
"""Shortest distance of neighbouring points, in units of the plane, that is divided."""


class Wanted(NamedTuple):
    """A further parameter point: its values, its number of starts, and the nodes it lies at or between (-1 none)."""

    values: tuple[float, float]
    n_starts: int
    node: int = -1
    edge: tuple[int, int] = (-1, -1)


def wanted(plane: Plane, ds: xr.Dataset, region: Array, budget: int) -> list[Wanted]:
    """Choose further points: first between neighbours with orbits whose end is not explained, then in thin regions.

    Parameters
    ----------
    plane
        The plane, with the further points that it has already.
    ds
        Its atlas.
    region
        Region of each node.
    budget
        Most cells of all points.
    """
    found: dict[tuple[float, float], Wanted] = {}
    n = int(plane.n_cells.min())
    what, sets = words_of(ds["what"]), ds["change_set"].values
    place = {tuple(values): node for node, values in enumerate(plane.values.tolist())}
    for k, code in enumerate(ds["what"].values.tolist()):
        ends = [tuple(float(ds[f"{role}_{which}"][k]) for which in ("first", "second")) for role in ("here", "there")]
        long = np.abs(np.diff(plane.scaled(np.array(ends)), axis=0)).max() > SHORTEST
        if what[code] == UNDECIDED and sets[k] not in APERIODIC and long:
            middle = tuple(0.5 * (a + b) for a, b in zip(*ends, strict=True))
            found[middle] = Wanted(middle, n, edge=(place[ends[0]], place[ends[1]]))
    labels = np.stack([ds[f"label_{which}"].values for which in ("first", "second")], axis=-1)
    for number in np.flatnonzero(ds["is_thin"].values).tolist():
        nodes = np.flatnonzero(region == number)
        cells = int(ds["region_cells"][number])
        if len(nodes):
            away = np.linalg.norm(plane.scaled(plane.values[nodes]) - plane.scaled(labels[number]), axis=1)
            node = int(nodes[away.argmin()])
            if plane.n_cells[node] > n:  # more starts settled too few of the cells
                continue
            values = tuple(plane.values[node].tolist())
            found[values] = Wanted(values, SEEN - cells + int(plane.n_cells[node]), node)
        else:
            values = tuple(labels[number].tolist())
            found[values] = Wanted(values, SEEN)
    chosen, left = [], budget
    for one in found.values():
        if one.n_starts <= left:
            chosen.append(one)
            left -= one.n_starts
    return chosen


def dataset_of(points: list[Wanted], results: list[xr.Dataset], states: Sequence[str]) -> xr.Dataset:
    """Return the sets that were found at further points as rows, see `pipeline.results.ragged`."""
    rows = [np.flatnonzero(one["stability"].values == ATTRACTS) for one in results]
    columns = [columns_of(one, own) for one, own in zip(results, rows, strict=True)]
    names = ("set_kind", "set_period", "set_cells", "set_is_polished")
    variables: dict[str, Any] = {
        "point_first": ("further", np.array([one.values[0] for one in points])),
        "point_second": ("further", np.array([one.values[1] for one in points])),
        "at_node": ("further", np.array([one.node for one in points], np.int32)),
        "between_nodes": (("further", "side"), np.array([one.edge for one in points], np.int32).reshape(-1, 2)),
        "point_cells": ("further", np.array([one["attractor_id"].size for one in results], np.int32)),
        "point_known": ("further", np.array([int((outcomes(one) != -1).sum()) for one in results], np.int32)),
        "of_point": (SET, np.repeat(np.arange(len(points)), [len(own) for own in rows]).astype(np.int32)),
    }
    for k, name in enumerate(names, 1):
        variables[name] = (SET, np.concatenate([np.zeros(0, np.int32), *(one[k] for one in columns)]))
    parts = [part for one in columns for part in one[5]]
    variables["set_points"] = (SET, np.array([len(part) for part in parts], np.int32))
    variables["further_section"] = ((SAMPLE, "state"), np.concatenate([np.zeros((0, len(states))), *parts]))
    return xr.Dataset(variables, {"state": list(states)})


def with_further(plane: Plane, ds: xr.Dataset, system: System) -> Plane:
    """Return a plane with further points.

    A node with more starts has the attractors that they found, and not those known before. A point between two
    neighbours divides their edge.

    Sets at further points have ids of their own, unless they are orbits that were known at the node.
    """
    values = np.stack([ds["point_first"].values, ds["point_second"].values], axis=-1)
    at, between = ds["at_node"].values, ds["between_nodes"].values
    fresh = np.flatnonzero(at < 0)
    node_of = at.astype(int).copy()
    node_of[fresh] = len(plane.values) + np.arange(len(fresh))
    n_cells, n_known = (np.concatenate([one, np.zeros(len(fresh), int)]) for one in (plane.n_cells, plane.n_known))
    n_cells[node_of], n_known[node_of] = ds["point_cells"].values, ds["point_known"].values
    edges, parent, parted = plane.edges.tolist(), plane.parent.tolist(), plane.is_parted.tolist()
    number = {frozenset(edge): k for k, edge in enumerate(edges)}
    for k in fresh[between[fresh, 0] >= 0].tolist():
        edge = number[frozenset(between[k].tolist())]
        a, b = edges[edge]
        for part in ([a, int(node_of[k])], [int(node_of[k]), b]):
            number[frozenset(part)] = len(edges)
            edges.append(part)
            parent.append(parent[edge])
            parted.append(False)
        parted[edge] = True
    kept = ~np.isin(plane.node, at[at >= 0])
    points = np.split(ds["further_section"].values, np.cumsum(ds["set_points"].values))[:-1]
    node = node_of[ds["of_point"].values]
    numbers = _numbers(plane, node, points, ds["set_kind"].values, system)

    def joined(own: Array, more: Array) -> Array:
        return np.concatenate([own[kept], more.astype(own.dtype)])

    return replace(
        plane,
        values=np.concatenate([plane.values, values[fresh]]),
        edges=np.array(edges),
        parent=np.array(parent),
        is_parted=np.array(parted),
        n_cells=n_cells,
        n_known=n_known,
        node=joined(plane.node, node),
        attractor=joined(plane.attractor, numbers),
        kind=joined(plane.kind, ds["set_kind"].values),
        period=joined(plane.period, ds["set_period"].values),
        cells=joined(plane.cells, ds["set_cells"].values),
        is_polished=joined(plane.is_polished, ds["set_is_polished"].values),
        points=[*(plane.points[row] for row in np.flatnonzero(kept)), *points],
    )


def _numbers(plane: Plane, node: Array, points: list[Array], kinds: Array, system: System) -> Array:
    """Return the ids of sets at further points."""
    known: dict[int, list[int]] = {}
    for row, one in enumerate(plane.node.tolist()):
        known.setdefault(one, []).append(row)
    numbers = int(plane.attractor.max(initial=-1)) + 1 + np.arange(len(points))
    for k, (own, kind) in enumerate(zip(points, kinds.tolist(), strict=True)):
        rows = [row for row in known.get(int(node[k]), []) if plane.kind[row] == kind]
        if kind in APERIODIC:
            alone = len(rows) == 1 and (kinds[node == node[k]] == kind).sum() == 1
            rows = rows if alone else []
        else:
            rows = [row for row in rows if scaled_distance(plane.points[row], own[0], system).min() < SAME_AT_POINT]
        if rows:
            numbers[k] = plane.attractor[rows[0]]
    return numbers
