"""Tabulate the attractors reached after a drift, and the critical values."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.tabular import Row, aligned, counted, plain, unit_of
from pipeline.analysis.tipping.endings import NONE
from pipeline.layout.vocabulary import axis_name, letter, split_dims
from pipeline.products.product import Table

MOST_VALUES = 40
"""Most values of the swept number that are listed one by one."""


def outcome_word(outcome: int) -> str:
    """Return the name of an outcome: a letter, diverged, or not decided."""
    return {DIVERGED: "diverged", NONE: "not decided"}.get(outcome) or letter(outcome)


def tipping_table(ds: xr.Dataset) -> Table:
    """Return a row per critical value; the lines also list the attractors and the cells that reach them."""
    rows = [_row(ds.isel(critical=i)) for i in range(ds.sizes["critical"])]
    lines = ["attractors reached at the final parameters", *aligned(_attractors(ds)), *_counts(ds)]
    axis = str(ds.attrs["parameter"])
    dim = axis_name(axis)
    unit = unit_of(ds, dim) if dim in ds.coords else ""
    n, shown = int(ds.attrs["n_brackets"]), len(rows)
    lines.append(f"{counted(n, 'critical value')} of {axis}" if n else "no cell changes its attractor along the sweep")
    if shown < n:
        lines[-1] += f"; the first {shown} are bisected (--brackets)"
    return Table(rows, [*lines, *aligned([_words(row, unit) for row in rows])])


def _row(one: xr.Dataset) -> Row:
    row: Row = {
        "start": int(one["critical_start"]),
        "value": float(one["critical_value"]),
        "low": float(one["critical_low"]),
        "high": float(one["critical_high"]),
        "from": outcome_word(int(one["critical_from"])),
        "to": outcome_word(int(one["critical_to"])),
        "n_evaluated": int(one["critical_n_evaluated"]),
        "decided": bool(one["critical_decided"]),
    }
    more = {str(name)[len("critical_at_") :]: float(one[name]) for name in one if str(name).startswith("critical_at_")}
    return {**more, **row}


def _words(row: Row, unit: str) -> dict[str, str | None]:
    own = ("start", "value", "low", "high", "from", "to", "n_evaluated", "decided")
    half = 0.5 * (row["high"] - row["low"])
    digits = int(np.clip(np.ceil(-np.log10(half)), 1, 14)) if half > 0 else 14
    return {
        **{name: f"{value:g}" for name, value in row.items() if name not in own},
        "start": str(row["start"]),
        f"critical value{unit}": f"{row['value']:.{digits}f} ± {half:.1g}",
        "from": row["from"],
        "to": row["to"],
        "trajectories": str(row["n_evaluated"]),
        "evidence": "both ends decided" if row["decided"] else "a trajectory inside is not decided",
    }


def _attractors(ds: xr.Dataset) -> list[dict[str, str | None]]:
    words = []
    for i in range(ds.sizes["attractor"]):
        one = ds.isel(attractor=i)
        at = str(ds["final_parameters"].values[int(one["attractor_group"])])
        states = ", ".join(f"{x:.6g}" for x in np.atleast_1d(one["attractor_point"].values))
        words.append(
            {
                "letter": letter(i),
                "kind": plain(str(one["attractor_kind"].values)),
                "period": str(int(one["attractor_period"]) or "-"),
                "cells": str(int(one["attractor_n_cells"])),
                "a section point": f"({states})",
                "at": at or None,
            }
        )
    return words


def _counts(ds: xr.Dataset) -> list[str]:
    """Return the lines with the numbers of cells on each attractor, per value of the swept number."""
    dim = axis_name(str(ds.attrs["parameter"]))
    dims, _ = split_dims(ds["outcome"])
    outcome = ds["outcome"]
    seen = sorted({int(o) for o in np.unique(outcome.values)}, key=lambda o: (o < 0, o))
    if dim not in dims:
        counts = ", ".join(f"{outcome_word(o)} {int((outcome == o).sum())}" for o in seen)
        return [f"cells: {counts}"]
    values = ds[dim].values
    rows: list[dict[str, Any]] = []
    for i, value in enumerate(values):
        here = outcome.isel({dim: i}).values
        found = {outcome_word(o): str(int((here == o).sum())) for o in seen}
        if rows and [rows[-1][word] for word in found] == list(found.values()):
            rows[-1]["to"] = value
            continue
        rows.append({"from": value, **found, "to": value})
    head = f"{dim}{unit_of(ds, dim)}"
    words = []
    for row in rows:
        first, last = row.pop("from"), row.pop("to")
        words.append({head: f"{first:g}" if first == last else f"{first:g} to {last:g}", **row})
    return ["cells on each", *aligned(words)]
