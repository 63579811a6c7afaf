"""Compute tipping probabilities from the overlaps of basins at two parameter values."""

from __future__ import annotations

import numpy as np
import xarray as xr

from pipeline.analysis.basins.analysis import check_starts
from pipeline.analysis.tipping.analysis import outcome_word
from pipeline.analysis.tipping.declaration import OVERLAPS_COLUMNS, OverlapOptions
from pipeline.layout.columns import on_points
from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import axis_name
from pipeline.products.product import Table
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.results.selection import choose, place, refuse_origins, start_dims
from pipeline.results.tabular import Row, aligned, with_interval

NO_LABEL_KNOWN = -1


def overlap_counts(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count the initial states in the overlap of each basin before with each basin after a change.

    Labels before and after are those of the same initial states; states with a label -1, without an outcome, are left
    out. Returns the labels that occur before and after, rising, and the counts (before, after).
    """
    known = (before != NO_LABEL_KNOWN) & (after != NO_LABEL_KNOWN)
    first, i = np.unique(before[known], return_inverse=True)
    last, j = np.unique(after[known], return_inverse=True)
    counts = np.zeros((len(first), len(last)), np.int64)
    np.add.at(counts, (i, j), 1)
    return first, last, counts


def needs_basins(run: OpenRun, options: OverlapOptions) -> None:
    """Raise ValueError unless the run has basins at both values of the parameter."""
    cube = run.cube()
    check_starts(cube)
    refuse_origins(cube, "the overlap of basins")
    axis = axis_name(options.parameter)
    if axis not in cube["status"].dims:
        raise ValueError(f"{options.parameter} is not an axis of this run; sweep it over both values.")
    for value in (options.before, options.after):
        place(cube[axis], value, rate_of(cube))


def overlaps(run: OpenRun, options: OverlapOptions) -> xr.Dataset:
    """Compute the probability of tipping from each attractor before to each attractor after a jump of a parameter.

    The definition is that of Kaszas, Feudel and Tel (Sci. Rep. 9, 8654, 2019): the overlap of two basins over the
    first one, with uniform weight on the starts of the run.
    """
    found = dense(run.derive("attractors"))
    axis = axis_name(options.parameter)
    whole = found.assign(outcome=outcomes(found))
    part = choose(whole, options.at, (axis, *start_dims(found)), "overlaps are those of one parameter point")
    before, after = (
        part["outcome"].isel({axis: place(part[axis], value)}).values for value in (options.before, options.after)
    )
    first, last, counts = overlap_counts(before, after)
    total = counts.sum(axis=1, keepdims=True)
    low, high = binomial_interval(counts, np.broadcast_to(total, counts.shape), confidence=options.confidence)
    values = {"count": counts, "probability": counts / np.maximum(total, 1), "low": low, "high": high}
    values["n_unknown"] = np.array(((before == NO_LABEL_KNOWN) | (after == NO_LABEL_KNOWN)).sum())
    attrs = {"parameter": axis, "value_before": options.before, "value_after": options.after}
    coords = {"before": first, "after": last}
    return xr.Dataset(on_points(OVERLAPS_COLUMNS, values, ()), coords, {**attrs, "confidence": options.confidence})


def overlaps_table(ds: xr.Dataset) -> Table:
    """Return a row per pair of attractors: starts in both basins, and the tipping probability with its interval."""
    rows: list[Row] = []
    for i, j in np.ndindex(ds["count"].shape):
        one = ds.isel(before=i, after=j)
        row: Row = {name: outcome_word(int(one[name])) for name in ("before", "after")}
        row |= {"count": int(one["count"]), **{name: float(one[name]) for name in ("probability", "low", "high")}}
        rows.append(row)
    words = [
        {
            "before": row["before"],
            "after": row["after"],
            "starts": str(row["count"]),
            "probability": with_interval(row, ("probability", "low", "high"), ".4f"),
        }
        for row in rows
        if row["count"]
    ]
    a = ds.attrs
    head = f"{a['parameter']} from {a['value_before']:g} to {a['value_after']:g}: probabilities of tipping"
    lines = [head, *aligned(words)]
    if n := int(ds["n_unknown"]):
        lines.append(f"{n} starts have no outcome at one of the two values and are left out")
    return Table(rows, lines)
