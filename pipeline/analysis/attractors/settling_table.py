"""Tabulate the non-periodic sets, with the evidence from trajectories that were integrated further."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from pipeline.analysis.tabular import Row, Words, aligned, at_point, number, plain, sets_of, values
from pipeline.layout.period_names import periods_of
from pipeline.layout.vocabulary import APERIODIC, model_of
from pipeline.products.product import Table


def settling_table(ds: xr.Dataset) -> Table:
    """Return the table of non-periodic sets: how many of the cells integrated further stayed on the set or left it."""
    dims = [str(d) for d in ds["kind"].dims if d != "attractor"]
    found = sets_of(ds, ds["kind"].isin(APERIODIC), dims)
    rows = [{**where, "attractor_id": int(one["attractor"]), **_row(one)} for where, one in found]
    if not rows:
        return Table(rows, ["sets that do not close: none, so there is nothing to extend"])
    head = f"sets that do not close: {len(rows)}; lifetimes are in {periods_of(model_of(ds))}"
    return Table(rows, [head, *aligned([_words(ds, row, dims) for row in rows])])


def _row(one: xr.Dataset) -> Row:
    counts = ("n_cells", "n_sampled", "n_left", "n_leaving")
    to = [f"{name} ({count})" for name, count in enumerate(one["n_to"].values.tolist()) if count]
    row = values(one, "kind", "stability", *counts, "mean_lifetime", "lifetime_low", "lifetime_high")
    return row | {"to": ", ".join(to)}


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
