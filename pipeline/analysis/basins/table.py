"""Tabulate basin fractions and boundaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.outcomes import DIVERGED, told
from pipeline.analysis.ragged import dims_of, places_of_rows
from pipeline.analysis.tabular import (
    FEW_POINTS,
    FRACTION,
    Row,
    Words,
    largest_share,
    leading,
    point_table,
    points_of,
    ranges,
    summary,
    with_interval,
)
from pipeline.layout.vocabulary import letter
from pipeline.products.product import Table


def basins_table(ds: xr.Dataset) -> Table:
    """Return the table of basins. It has one row per outcome and parameter point, with the number of cells and the
    basin fraction.

    The lines have a table per point if there are few, otherwise ranges; the boundaries follow.
    """
    rows, dims = _rows(ds), dims_of(ds)
    confidence = f"{100 * ds.attrs['basin_confidence']:g} %"
    lines = [f"fractions of the cells that end on attractors or diverge, {ds.attrs['basin_interval']}, {confidence}"]
    if int(np.prod([ds.sizes[d] for d in dims])) > FEW_POINTS:
        shown, n_others = leading(rows, "label", "n_cells")
        lines += summary(ds, shown, dims, _label_summary, "label")
        lines += [f"  and {n_others} smaller ones; all are in --csv and --json"] if n_others else []
        lines += [_range_line(ds, name, text) for name, text in _BOUNDARY.items() if name in ds]
    else:
        for at, where in points_of(ds, dims):
            one = ds.isel(at)
            table = point_table(ds, where, rows, _basin_words)
            lines += table
            if len(table) > 1:
                bound = float(one["unseen_high"])
                lines.append(f"  an attractor that no cell shows: at most {bound:.3g} of the region")
            lines += _boundary_lines(one)
    lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return Table(rows, [*lines, _sentence(ds)])


def _rows(ds: xr.Dataset) -> list[Row]:
    dims = dims_of(ds)
    columns = dict(zip(dims, places_of_rows(ds, dims), strict=True))
    columns |= {"label": ds["attractor"].values, "n_cells": ds["count"].values}
    names = ("n_inferred", *FRACTION, "fraction_if_none", "fraction_if_all", "low_if_none", "high_if_all")
    columns |= {name: ds[name].values for name in names}
    return [dict(zip(columns, row, strict=True)) for row in zip(*(c.tolist() for c in columns.values()), strict=True)]


_OTHERS = {
    "n_pending": "pending",
    "n_not_settled": "not settled",
    "n_transient": "on a transient set",
    "n_unstable": "on an unstable orbit or equilibrium",
    "n_neutral": "on a neutral set",
    "n_failed": "that could not be integrated",
}


def _sentence(ds: xr.Dataset) -> str:
    counts = {"diverged": int(ds["count"].values[ds["attractor"].values == DIVERGED].sum())}
    counts |= {text: int(ds[name].sum()) for name, text in _OTHERS.items()}
    return told(ds["outcome"].size, {text: n for text, n in counts.items() if n})


def _basin_words(row: Row) -> Words:
    unfinished = row["fraction_if_all"] > row["fraction_if_none"]
    return {
        "id": "diverged" if row["label"] == DIVERGED else str(row["label"]),
        "cells": str(row["n_cells"]),
        "fraction": with_interval(row, FRACTION, ".4f"),
        "with the unfinished": f"{row['low_if_none']:.4f} to {row['high_if_all']:.4f}" if unfinished else None,
        "letter": "-" if row["label"] == DIVERGED else letter(row["label"]),
        "inferred cells": str(row["n_inferred"] or "") or None,
    }


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> Words:
    first = _basin_words(rows[0])
    return {
        "id": first["id"],
        **ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "max fraction": largest_share(ds, rows, dims),
        "letter": first["letter"],
        "inferred cells": str(sum(r["n_inferred"] for r in rows) or "") or None,
    }


_BOUNDARY = {
    "basin_entropy": "basin entropy",
    "boundary_basin_entropy": "boundary basin entropy",
    "uncertainty_exponent": "uncertainty exponent",
    "wada_beyond": "cells off the common boundary (Wada)",
}


def _boundary_lines(one: xr.Dataset) -> list[str]:
    lines = []
    for name, text in _BOUNDARY.items():
        if name in one and np.isfinite(float(one[name])):
            value, error, low, high = (float(one[f"{name}{end}"]) for end in ("", "_stderr", "_low", "_high"))
            known = f"± {error:.2g} ({low:.4g} to {high:.4g})"
            lines.append(f"  {text}: {value:.4g} {known if np.isfinite(error) else '(error not known)'}")
    if int(one.get("above_ln2_surely", -1)) == 1:
        lines.append("  the boundary basin entropy exceeds ln 2: the boundary is fractal")
    if int(one.get("wada", -1)) >= 0:
        verdict = "passes" if int(one["wada"]) else "does not pass"
        lines.append(
            f"  Wada merge test: {verdict} with radius {one.attrs['basin_radius']} "
            f"(it takes {float(one['wada_distance']):g} cells)"
        )
    return lines


def _range_line(ds: xr.Dataset, name: str, text: str) -> str:
    values = ds[name].values[np.isfinite(ds[name].values)]
    if not values.size:
        return f"  {text}: nowhere"
    return f"  {text}: {values.min():.4g} to {values.max():.4g} at {values.size} points"
