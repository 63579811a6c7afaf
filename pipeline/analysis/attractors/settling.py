"""Define the analysis ``settling``: the evidence on whether each non-periodic set attracts or is transient."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import APERIODIC, model_of
from pipeline.products.product import Options, Table
from pipeline.results.ragged import SET, dims_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, at_point, header_of, number, plain, sets_of, values

VARIABLES = (
    "kind",
    "stability",
    "evidence",
    "n_cells",
    "n_sampled",
    "n_left",
    "n_leaving",
    "n_sets",
    "from_set",
    "to",
    "n_to",
    "time_at_risk",
    "mean_lifetime",
    "lifetime_low",
    "lifetime_high",
    "lyapunov_max",
    "lyapunov_low",
    "lyapunov_high",
    "closes_above",
    "orbit_period",
    "ran_out",
)
"""Variables of the attractors that the settling table shows."""


def settling(run: OpenRun, options: Options) -> xr.Dataset:
    """Return the evidence on whether each non-periodic set attracts or is transient."""
    found: xr.Dataset = run.derive("attractors")
    return found[list(VARIABLES)]


def settling_table(ds: xr.Dataset) -> Table:
    """Return the table of non-periodic sets. It counts the trajectories that stayed on or left each set when integrated
    further.
    """
    dims, ends = dims_of(ds), _ends(ds)
    is_open = np.isin(ds["kind"].values, APERIODIC)
    found = zip(np.flatnonzero(is_open).tolist(), sets_of(ds, is_open), strict=True)
    rows = [
        {**where, "attractor_id": int(one["attractor"]), **_row(one), "to": ", ".join(ends.get(row, ()))}
        for row, (where, one) in found
    ]
    if not rows:
        header = (*dims, "attractor_id", *header_of(ds, SET, _row), "to")
        return Table(rows, ["sets that do not close: none, so there is nothing to extend"], header=header)
    head = f"sets that do not close: {len(rows)}; lifetimes are in {model_of(ds).clock.periods}"
    return Table(rows, [head, *aligned([_words(ds, row, dims) for row in rows])])


def _ends(ds: xr.Dataset) -> dict[int, list[str]]:
    """Return for each row that cells left the ids of the sets on which they ended, with the number of cells."""
    found: dict[int, list[str]] = {}
    for row, to, count in zip(*(ds[name].values.tolist() for name in ("from_set", "to", "n_to")), strict=True):
        found.setdefault(row, []).append(f"{to} ({count})")
    return found


def _row(one: xr.Dataset) -> Row:
    counts = ("n_cells", "n_sampled", "n_left", "n_leaving")
    return values(one, "kind", "stability", *counts, "mean_lifetime", "lifetime_low", "lifetime_high")


def _words(ds: xr.Dataset, row: Row, dims: Sequence[str]) -> Words:
    mean, low, high = (number(row[name], ".0f") for name in ("mean_lifetime", "lifetime_low", "lifetime_high"))
    above = f"above {low}" if low != "-" else low
    return {
        **at_point(ds, row, dims),
        "id": str(row["attractor_id"]),
        "kind": plain(row["kind"]),
        "stability": plain(row["stability"]),
        "cells": str(row["n_cells"]),
        "extended": str(row["n_sampled"]),
        "near an orbit": str(row["n_leaving"]),
        "left later": str(row["n_left"]),
        "mean lifetime": f"{mean} ({low} to {high})" if row["n_left"] else above,
        "to": row["to"] or "-",
    }
