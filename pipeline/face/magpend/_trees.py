"""Open a run with the kept results of its analyses as one `xarray.DataTree`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import xarray as xr

from pipeline.products.registry import COMMANDS
from pipeline.runs.derive import stale, stored_each

if TYPE_CHECKING:
    from magpend._runs import Run

CUBE = "cube"
"""Name of the cube's node."""


def tree_of(run: Run, chunks: Any = None, check: bool | None = None) -> xr.DataTree:
    """Return the cube and the kept results of a run as a tree; see `magpend.open_run`."""
    nodes = {CUBE: run.cube(chunks, check=check)}
    for name in COMMANDS:
        for k, result in enumerate(stored_each(run, name, lazy=True)):
            folder = str(result.encoding["source"]).rpartition("/")[2]
            nodes[folder.removesuffix(".zarr") if k else name] = result if chunks is None else result.chunk(chunks)
    computed = sum(run.plan.cells_in(i) for i in run.commits)
    attrs = {
        "title": run.info.title,
        "source": str(nodes[CUBE].attrs["source"]),
        "digest": run.info.digest,
        "cells": run.plan.n_cells,
        "computed": computed,
        "pending": run.plan.n_cells - computed,
        "left_out": [name.rpartition("/")[2] for name in stale(run)],
    }
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=attrs), **nodes}, name=run.name.rpartition("/")[2])
