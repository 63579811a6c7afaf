"""Tabulate the jumps and loops of a hysteresis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import Row, aligned, unit_of
from pipeline.products.product import Table


def hysteresis_table(ds: xr.Dataset) -> Table:
    """Return the table of jumps, with lines that describe the loops."""
    rows = jump_rows(ds)
    return Table(rows, hysteresis_lines(ds, rows))


def jump_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per kind of jump: direction, path values and attractor ids before and after, count."""
    names = ("jump_from", "jump_to", "jump_from_id", "jump_to_id", "jump_count")
    rows = []
    for i in range(ds.sizes["jump"]):
        row: Row = {"direction": "up" if ds["jump_direction"].values[i] > 0 else "down"}
        rows.append(row | {n.removeprefix("jump_"): ds[n].values[i].item() for n in names})
    return rows


def hysteresis_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return lines of text: the loops, then the table of jumps."""
    n = ds.sizes["loop"]
    lines = [f"{n or 'no'} loop{'s' * (n != 1)}: neighbouring points where up and down meet other attractors"]
    path = ds.attrs["path"]
    unit = f"{path}{unit_of(ds, path)}" if path in ds.coords else path
    lines += aligned([_loop_words(ds.isel(loop=i), unit) for i in range(n)])
    lines.append(f"jumps of the branches: {sum(row['count'] for row in rows) or 'none'}")
    words = [
        {
            "direction": r["direction"],
            f"from {unit}": f"{r['from']:g}",
            "to": f"{r['to']:g}",
            "ids": f"{r['from_id']} -> {r['to_id']}",
            "branches": str(r["count"]),
        }
        for r in rows
    ]
    return lines + aligned(words)


def _loop_words(loop: xr.Dataset, unit: str) -> dict[str, str]:
    others = {str(n).removeprefix("loop_at_"): f"{float(loop[n]):g}" for n in loop if "loop_at_" in str(n)}
    words = {f"from {unit}": f"{float(loop['loop_from']):g}", "to": f"{float(loop['loop_to']):g}"}
    for name in ("only_up", "only_down"):
        counts = loop[name].values
        met = ", ".join(f"{i} ({counts[i]} point{'s' * int(counts[i] != 1)})" for i in np.flatnonzero(counts))
        words[name.replace("_", " ")] = met or "-"
    return others | words | {"points": str(int(loop["loop_points"]))}
