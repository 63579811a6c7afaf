"""Cut the plane into regions, and list the attractors that cells find in each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.analysis.atlas.arrangement import Arrangement, arranged
from pipeline.analysis.atlas.further import SEEN
from pipeline.analysis.atlas.lines import Line
from pipeline.analysis.atlas.plane import Array, Plane
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.results.intervals import binomial_interval
from pipeline.results.tabular import plain

_LEAST_TOLERANCE = 1e-6


def variables_of_regions(
    plane: Plane, tracks: Sequence[Array], stable: Sequence[Array], lines: Sequence[Line], same: Array
) -> dict[str, Any]:
    """Return the variables of the regions between the stable parts of curves, and lines.

    Parameters
    ----------
    plane
        The plane.
    tracks, stable
        Points of curves in units of the plane, and whether the orbits beside them may be stable.
    lines
        Further lines. The number of a border is that of a curve; those of lines follow.
    same
        Pairs of rows (pair, 2) that are one attractor though their ids differ.
    """
    owner, tolerances, parts = [], [], []
    for number, (track, good) in enumerate(zip(tracks, stable, strict=True)):
        for part in _runs(track, good):
            owner.append(number)
            parts.append(part)
    for number, line in enumerate(lines, len(tracks)):
        if len(line.places) > 1:
            owner.append(number)
            parts.append(plane.scaled(line.places))
    tolerances = [_bend(part) for part in parts]
    found = arranged(parts, tolerances)
    region = found.region_of(plane.scaled(plane.values))
    return {**_regions(plane, found, region), **_members(plane, region, same), **_borders(found, owner, plane)}


def _runs(track: Array, good: Array) -> Iterator[Array]:
    """Yield the parts of a curve whose points are all good."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(int)))
    for first, stop in edges.reshape(-1, 2).tolist():
        if stop - first > 1:
            yield track[first:stop]


def _bend(track: Array) -> float:
    """Bound the distance of a smooth curve from the chords between its points."""
    if len(track) < 3:
        return _LEAST_TOLERANCE
    return max(_LEAST_TOLERANCE, float(np.linalg.norm(np.diff(track, 2, axis=0), axis=1).max()) / 8.0)


def _regions(plane: Plane, found: Arrangement, region: Array) -> dict[str, Any]:
    n = len(found.regions)
    points = np.bincount(region, minlength=n)
    cells = np.bincount(region, plane.n_known, minlength=n)
    labels = np.array([one.label for one in found.regions]) * plane.size + plane.low
    return {
        "area": ("region", np.array([one.area for one in found.regions])),
        "region_points": ("region", points.astype(np.int32)),
        "region_cells": ("region", cells.astype(np.int64)),
        "is_thin": ("region", (cells < SEEN).astype(np.int8)),
        "label_first": ("region", labels[:, 0]),
        "label_second": ("region", labels[:, 1]),
        "region_label": ("region", np.array(_names(plane, region, n), object)),
        "node_region": ("node", region.astype(np.int32)),
    }


def _names(plane: Plane, region: Array, n: int) -> list[str]:
    """Return the attractors that most points of a region have, as a text."""
    names = []
    for number in range(n):
        nodes = np.flatnonzero(region == number)
        own = np.isin(plane.node, nodes)
        sets: dict[int, list[tuple[int, int]]] = {int(node): [] for node in nodes}
        for node, kind, period in zip(plane.node[own], plane.kind[own], plane.period[own], strict=True):
            sets[int(node)].append((int(kind), int(period)))
        common = Counter(tuple(sorted(one)) for one in sets.values()).most_common(1)
        names.append(" + ".join(_name(*one) for one in common[0][0]) if common else "not seen")
    return [name or "none" for name in names]


def _name(kind: int, period: int) -> str:
    if kind == PERIODIC_ORBIT:
        return str(period) if period else "cycle"
    return "rest" if kind == EQUILIBRIUM else plain(SETS[kind])


def _members(plane: Plane, region: Array, same: Array) -> dict[str, Any]:
    """Return the attractors of each region: rows in it that have one id, or are known to be one."""
    where = region[plane.node]
    pairs = same[where[same[:, 0]] == where[same[:, 1]]]
    order = np.lexsort((plane.attractor, where))
    is_same = (np.diff(where[order]) == 0) & (np.diff(plane.attractor[order]) == 0)
    pairs = np.concatenate([pairs, np.stack([order[:-1], order[1:]], axis=-1)[is_same]])
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(where),) * 2)
    n, which = connected_components(links, directed=False)
    first = np.full(n, len(where))
    np.minimum.at(first, which, np.arange(len(where)))
    order = np.lexsort((plane.attractor[first], where[first]))
    first, which = first[order], np.argsort(order)[which]
    cells = np.bincount(which, plane.cells, minlength=n)
    total = np.maximum(np.bincount(region, plane.n_cells, minlength=int(region.max(initial=0)) + 1)[where[first]], 1)
    low, high = binomial_interval(cells, total)
    points = [len(np.unique(plane.node[which == k])) for k in range(n)]
    return {
        "of_region": ("member", where[first].astype(np.int32)),
        "member_attractor": ("member", plane.attractor[first].astype(np.int32)),
        "member_set": ("member", plane.kind[first].astype(np.int8), code_flags(SETS)),
        "member_period": ("member", plane.period[first].astype(np.int32)),
        "member_points": ("member", np.array(points, np.int32)),
        "member_share": ("member", cells / total),
        "member_share_low": ("member", low),
        "member_share_high": ("member", high),
    }


def _borders(found: Arrangement, owner: Sequence[int], plane: Plane) -> dict[str, Any]:
    rings = [(number, k, ring) for number, one in enumerate(found.regions) for k, ring in enumerate(one.rings)]
    corners = np.concatenate([ring for _, _, ring in rings]) * plane.size + plane.low
    return {
        "between": ("border", np.array([owner[one.line] for one in found.borders], np.int32)),
        "border_length": ("border", np.array([one.length for one in found.borders], float)),
        "neighbour": (("border", "side"), np.array([one.regions for one in found.borders], np.int32).reshape(-1, 2)),
        "ring_region": ("ring", np.array([number for number, _, _ in rings], np.int32)),
        "ring_size": ("ring", np.array([len(ring) for _, _, ring in rings], np.int32)),
        "is_hole": ("ring", np.array([k > 0 for _, k, _ in rings], np.int8)),
        "corner_first": ("corner", corners[:, 0]),
        "corner_second": ("corner", corners[:, 1]),
    }
