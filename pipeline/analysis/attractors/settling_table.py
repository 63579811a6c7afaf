"""Tabulate the sets that do not close, with the evidence from their extended cells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import Row, aligned, number, unit_of, where_of, words_of
from pipeline.layout.period_names import periods_of
from pipeline.layout.vocabulary import APERIODIC, model_of
from pipeline.products.product import Table


def settling_table(ds: xr.Dataset) -> Table:
    """Return the table of the sets that do not close."""
    rows = settling_rows(ds)
    return Table(rows, settling_lines(ds, rows))


def settling_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per parameter point and set that does not close, with the fate of its extended cells."""
    dims = [str(d) for d in ds["kind"].dims if d != "attractor"]
    kinds, stabilities = words_of(ds["kind"]), words_of(ds["stability"])
    rows = []
    there = np.isin(ds["kind"].transpose(*dims, "attractor").values, APERIODIC)
    for *index, i in np.argwhere(there).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at).isel(attractor=i)
        row: Row = {**where_of(ds, at), "attractor_id": i, "kind": kinds[int(one["kind"])]}
        row |= {"stability": stabilities[int(one["stability"])], "n_cells": int(one["n_cells"])}
        row |= {name: int(one[name]) for name in ("n_sampled", "n_left", "n_leaving")}
        row |= {name: float(one[name]) for name in ("mean_lifetime", "lifetime_low", "lifetime_high")}
        to = [(k, c) for k, c in enumerate(one["n_to"].values.tolist()) if c]
        rows.append(row | {"to": ", ".join(f"{name} ({count})" for name, count in to)})
    return rows


def settling_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the table of the sets that do not close as lines of text."""
    if not rows:
        return ["sets that do not close: none, so there is nothing to extend"]
    periods = periods_of(model_of(ds))
    lines = [f"sets that do not close: {len(rows)}; lifetimes are in {periods}"]
    dims = [str(d) for d in ds["kind"].dims if d != "attractor"]
    table = []
    for row in rows:
        where = {f"{d}{unit_of(ds, d)}": f"{row[d]:g}" for d in dims}
        low, high = (number(row[name], ".0f") for name in ("lifetime_low", "lifetime_high"))
        lifetime = f"{number(row['mean_lifetime'], '.0f')} ({low} to {high})"
        if not row["n_left"]:
            lifetime = f"above {low}" if low != "-" else low
        counts = {"cells": "n_cells", "extended": "n_sampled", "near an orbit": "n_leaving", "left later": "n_left"}
        counts = {text: str(row[name]) for text, name in counts.items()}
        told = {name: row[name].replace("_", " ") for name in ("kind", "stability")}
        told = {"id": str(row["attractor_id"])} | told
        table.append(where | told | counts | {"mean lifetime": lifetime, "to": row["to"] or "-"})
    return lines + aligned(table)
