"""Tabulate basin fractions and boundaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.outcomes import DIVERGED, sentence
from pipeline.analysis.tabular import (
    FEW_POINTS,
    Row,
    largest_share,
    point_table,
    points_of,
    ranges,
    summary,
    with_interval,
)
from pipeline.layout.attractor_letters import letter
from pipeline.layout.vocabulary import split_dims
from pipeline.products.product import Table


def basins_table(ds: xr.Dataset) -> Table:
    """Return the table of fractions, with lines on the boundaries."""
    rows = basin_rows(ds)
    return Table(rows, basin_lines(ds, rows))


def basin_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per outcome and parameter point: number of cells, and fraction with its intervals."""
    dims, _ = split_dims(ds["attractor_id"])
    names = ("fraction", "low", "high", "fraction_if_none", "fraction_if_all", "low_if_none", "high_if_all")
    rows = []
    for at, where in points_of(ds, dims):
        one = ds.isel(at)
        for i, label in enumerate(ds["label"].values.tolist()):
            row = {**where, "label": label, "n_cells": int(one["count"][i])}
            row["n_inferred"] = int(one["n_inferred"][i])
            rows.append(row | {name: float(one[name][i]) for name in names})
    return rows


def basin_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return lines on fractions and boundaries: a table per point if there are few, otherwise ranges."""
    dims, _ = split_dims(ds["attractor_id"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    seen = [row for row in rows if row["n_cells"]]
    confidence = f"{100 * ds.attrs['basin_confidence']:g} %"
    lines = [f"fractions of the cells that end on attractors or diverge, {ds.attrs['basin_interval']}, {confidence}"]
    if n_points > FEW_POINTS:
        lines += summary(ds, seen, dims, _label_summary)
        lines += [_range_line(ds, name, text) for name, text in _BOUNDARY.items() if name in ds]
    else:
        for at, where in points_of(ds, dims):
            one = ds.isel(at)
            table = point_table(ds, where, seen, _basin_words)
            lines += table
            if len(table) > 1:
                bound = float(one["unseen_high"])
                lines.append(f"  an attractor that no cell shows: at most {bound:.3g} of the region")
            lines += _boundary_lines(one)
    if ds.attrs["not_computed"]:
        lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return [*lines, sentence(ds)]


def _label(code: int) -> str:
    return "diverged" if code == DIVERGED else str(code)


def _letter(code: int) -> str:
    return "-" if code == DIVERGED else letter(code)


def _basin_words(row: Row) -> dict[str, str]:
    words = {"id": _label(row["label"]), "cells": str(row["n_cells"]), "fraction": with_interval(row)}
    if row["fraction_if_all"] > row["fraction_if_none"]:
        words["with the unfinished"] = f"{row['low_if_none']:.4f} to {row['high_if_all']:.4f}"
    return words | {"letter": _letter(row["label"])} | _inferred([row])


def _inferred(rows: Sequence[Row]) -> dict[str, str]:
    """Return the column with the number of inferred cells, if there are any."""
    n = sum(row["n_inferred"] for row in rows)
    return {"inferred cells": str(n)} if n else {}


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    return {
        "id": _label(rows[0]["label"]),
        **ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "max fraction": largest_share(ds, rows, dims),
        "letter": _letter(rows[0]["label"]),
        **_inferred(rows),
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
