"""Tabulate hysteresis loops and the jumps between attractors."""

from __future__ import annotations

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import Words, aligned, counted, unit_of, values
from pipeline.products.product import Table


def hysteresis_table(ds: xr.Dataset) -> Table:
    """Return the table of hysteresis: a row per kind of jump between two attractors, and text lines on the loops."""
    names = ("jump_from", "jump_to", "jump_from_id", "jump_to_id", "jump_count")
    jumps = [ds.isel(jump=i) for i in range(ds.sizes["jump"])]
    rows = [
        {"direction": "up" if one["jump_direction"] > 0 else "down"}
        | {n.removeprefix("jump_"): v for n, v in values(one, *names).items()}
        for one in jumps
    ]
    path, n = ds.attrs["path"], ds.sizes["loop"]
    unit = f"{path}{unit_of(ds, path)}" if path in ds.coords else path
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
    lines = [
        f"{counted(n, 'loop') if n else 'no loops'}: neighbouring points where up and down meet other attractors",
        *aligned([_loop_words(ds.isel(loop=i), unit) for i in range(n)]),
        f"jumps of the branches: {sum(row['count'] for row in rows) or 'none'}",
        *aligned(words),
    ]
    return Table(rows, lines)


def _loop_words(loop: xr.Dataset, unit: str) -> Words:
    return {
        **{str(n).removeprefix("loop_at_"): f"{float(loop[n]):g}" for n in loop if "loop_at_" in str(n)},
        f"from {unit}": f"{float(loop['loop_from']):g}",
        "to": f"{float(loop['loop_to']):g}",
        "only up": _met(loop["only_up"].values),
        "only down": _met(loop["only_down"].values),
        "points": str(int(loop["loop_points"])),
    }


def _met(counts: np.ndarray) -> str:
    """Format the ids of the attractors that a continuation met, each with the number of parameter points at which it
    met them.
    """
    return ", ".join(f"{i} ({counted(counts[i], 'point')})" for i in np.flatnonzero(counts)) or "-"
