"""Table of bounded sets that were run on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.tabular import (
    Row,
    aligned,
    number,
    unit_of,
    where_of,
    words_of,
)
from pipeline.layout.vocabulary import model_of
from pipeline.layout.words import periods_of
from pipeline.products.product import Table


def settling_table(ds: xr.Dataset) -> Table:
    """Table of the bounded sets."""
    rows = settling_rows(ds)
    return Table(rows, settling_lines(ds, rows))


def settling_rows(ds: xr.Dataset) -> list[Row]:
    """Return a row per bounded set and parameter point: what became of the sample that was run on."""
    dims = [str(d) for d in ds["verdict"].dims if d != "attractor"]
    words, n = words_of(ds["verdict"]), ds.sizes["attractor"]
    rows = []
    for *index, i in np.argwhere(ds["verdict"].values > 0).tolist():
        at = dict(zip(dims, index, strict=True))
        one = ds.isel(at).isel(attractor=i)
        row: Row = {**where_of(ds, at), "attractor_id": i, "verdict": words[int(one["verdict"])]}
        row |= {name: int(one[name]) for name in ("n_sampled", "n_left", "n_leaving")}
        row |= {name: float(one[name]) for name in ("mean_lifetime", "lifetime_low", "lifetime_high")}
        to = [(f"orbit of period {int(one['new_orbit_period'][k - n])}" if k >= n else str(k), c)
              for k, c in enumerate(one["n_to"].values.tolist()) if c]  # fmt: skip
        rows.append(row | {"to": ", ".join(f"{name} ({count})" for name, count in to)})
    return rows


def settling_lines(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the table of bounded sets."""
    n = ds.attrs["lifetimes_n_periods"]
    if not rows:
        return ["bounded sets: none, so there is nothing to run on"]
    lines = [f"bounded sets: {len(rows)}; run on for {n} {periods_of(model_of(ds))}, which lifetimes are in"]
    dims = [str(d) for d in ds["verdict"].dims if d != "attractor"]
    table = []
    for row in rows:
        where = {f"{d}{unit_of(ds, d)}": f"{row[d]:g}" for d in dims}
        low, high = (number(row[name], ".0f") for name in ("lifetime_low", "lifetime_high"))
        lifetime = f"{row['mean_lifetime']:.0f} ({low} to {high})"
        if not row["n_left"]:
            lifetime = f"above {low}" if low != "-" else low
        counts = {"sampled": "n_sampled", "near an orbit": "n_leaving", "left later": "n_left"}
        counts = {text: str(row[name]) for text, name in counts.items()}
        told = {"id": str(row["attractor_id"]), "verdict": row["verdict"]}
        table.append(where | told | counts | {"mean lifetime": lifetime, "to": row["to"] or "-"})
    return lines + aligned(table)
