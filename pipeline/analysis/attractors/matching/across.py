"""Match the attractors of several runs over the same parameter points, such as runs for draws of a posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment

from pipeline.analysis.attractors.matching.connections import Connections
from pipeline.analysis.attractors.matching.matching import Rule, Seen, geometry_of, neutral_sides, seen_in
from pipeline.analysis.ragged import N_IDS, rows_at

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
