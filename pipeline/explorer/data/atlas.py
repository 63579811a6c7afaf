"""Read the atlas of a plane of two parameters for the page: regions, lines, and changes that are not explained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import to_hex

from pipeline.analysis.atlas.figure import region_tints
from pipeline.analysis.atlas.sentences import member_text, members_of, region_text
from pipeline.analysis.atlas.shapes import line_places, rings_of
from pipeline.analysis.atlas.table import kind_text, open_changes, told_change
from pipeline.explorer.data.explored import ExploredRun
from pipeline.layout.own_words import axis_in_own_words, in_own_words, rate_of
from pipeline.layout.vocabulary import axis_name
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import isel
from pipeline.results.tabular import words_of
from pipeline.runs.derive import options_of

_SIDES = ("first", "second")


def atlas(run: ExploredRun) -> dict[str, Any] | None:
    """Return what an atlas has beside its curves; None if none is stored.

    ``regions`` have ``rings`` (the boundary, then holes), a tint, and texts on their attractors. ``marks`` are changes
    that are not explained, with the reason and the cells on both sides. ``grid`` has the parameter points of the run:
    values and indices on both axes, and the region of each point, the second axis varying first.
    """
    found = run.atlas()
    if found is None:
        return None
    ds = in_own_words(found)
    tints, rings = region_tints(ds), rings_of(ds)
    fixed = _fixed(run, found)
    return {
        "regions": [_region(ds, k, rings[k], tints) for k in range(ds.sizes["region"])],
        "lines": list(_lines(ds)),
        "marks": list(_marks(run, found, ds, fixed)),
        "grid": _grid(run, found, fixed),
    }


def _xy(places: np.ndarray) -> dict[str, list[float]]:
    return {"x": places[:, 0].tolist(), "y": places[:, 1].tolist()}


def _region(ds: xr.Dataset, number: int, rings: list[np.ndarray], tints: Mapping[str, Any]) -> dict[str, Any]:
    label = str(ds["region_label"].values[number])
    thin = "; a basin of 1 % may be missing, as fewer than 299 cells are known" if ds["is_thin"][number] else ""
    return {
        "label": label,
        "colour": to_hex(tints[label]),
        "area": float(ds["area"][number]),
        "x": float(ds["label_first"][number]),
        "y": float(ds["label_second"][number]),
        "rings": [_xy(ring) for ring in rings],
        "text": f"{region_text(ds, number)}{thin}.",
        "attractors": [member_text(ds, row) for row in members_of(ds, number)],
    }


def _lines(ds: xr.Dataset) -> Iterator[dict[str, Any]]:
    for number, code in enumerate(ds["line_what"].values.tolist()):
        yield {"kind": kind_text(words_of(ds["line_what"])[code]), **_xy(line_places(ds, number))}


def _marks(run: ExploredRun, found: xr.Dataset, ds: xr.Dataset, fixed: Mapping[str, int]) -> Iterator[dict[str, Any]]:
    attractors = run.kept("attractors")
    ids = None if attractors is None else outcomes(isel(attractors, fixed) if fixed else attractors)
    for k in open_changes(found):
        here, there = (_index(run, found, k, side, fixed) for side in ("here", "there"))
        yield {
            "x": float(ds["change_first"][k]),
            "y": float(ds["change_second"][k]),
            "text": f"not explained: {told_change(ds, k)}",
            "why": str(ds["why"].values[k]),
            "cells": list(_cells(run, ids, int(found["change_attractor"][k]), here, there)),
        }


def _cells(
    run: ExploredRun,
    ids: xr.DataArray | None,
    attractor: int,
    here: Mapping[str, int] | None,
    there: Mapping[str, int] | None,
) -> Iterator[dict[str, Any]]:
    """Yield a cell on an attractor, and the cell with the same start at the neighbouring point; none beside the run."""
    if ids is None or here is None:
        return
    one = ids.isel({name: i for name, i in here.items() if name in ids.dims})
    own = np.argwhere((one == attractor).values)
    if not len(own):
        return
    start = dict(zip(map(str, one.dims), own[0].tolist(), strict=True))
    for text, at in (("on it", here), ("the same start", there)):
        if at is not None:
            yield {"text": text, "at": dict(at), "cell": run.number({**start, **at})}


def _fixed(run: ExploredRun, found: xr.Dataset) -> dict[str, int]:
    """Return the index on each further axis of the run at which the plane lies."""
    given = {axis_name(name): value for name, value in options_of(found.attrs)["at"].items()}
    names = [str(found.attrs[f"{which}_parameter"]) for which in _SIDES]
    further = [axis for axis in run.axes if axis.swept and axis.name not in names]
    return {
        axis.name: int(np.abs(axis.values - given[axis.name]).argmin()) if axis.name in given else 0 for axis in further
    }


def _index(run: ExploredRun, found: xr.Dataset, k: int, side: str, fixed: Mapping[str, int]) -> dict[str, int] | None:
    """Return the index of a point beside a change on the run's axes; None for a further point, beside the run."""
    at = dict(fixed)
    for which in _SIDES:
        name = str(found.attrs[f"{which}_parameter"])
        near = np.flatnonzero(np.isclose(run.axis(name).values, float(found[f"{side}_{which}"][k]), rtol=1e-12, atol=0))
        if not len(near):
            return None
        at[name] = int(near[0])
    return at


def _grid(run: ExploredRun, found: xr.Dataset, fixed: Mapping[str, int]) -> dict[str, Any]:
    axes = [run.axis(str(found.attrs[f"{which}_parameter"])) for which in _SIDES]
    orders = [np.argsort(axis.values, kind="stable") for axis in axes]
    own = [axis_in_own_words(axis.name, rate_of(found)) for axis in axes]
    n = len(axes[0].values) * len(axes[1].values)
    return {
        "axes": [axis.name for axis in axes],
        "names": [name for name, _ in own],
        "values": [
            as_given(axis.values[order]).tolist() for axis, order, (_, as_given) in zip(axes, orders, own, strict=True)
        ],
        "indices": [order.tolist() for order in orders],
        "region": found["node_region"].values[:n].tolist(),
        "at": dict(fixed),
    }
