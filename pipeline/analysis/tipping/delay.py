"""Find the value of a moving parameter at which trajectories leave a periodic orbit: delayed bifurcations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.drift.ramps import Ramp
from magpend_core.models.model import Model
from pipeline.analysis.tipping.declaration import DelayOptions
from pipeline.layout.cells import at_section
from pipeline.layout.vocabulary import drift_attributes, model_attribute, model_of, split_dims
from pipeline.products.product import Table
from pipeline.results.run import OpenRun
from pipeline.results.sets import Geometry
from pipeline.results.tabular import Row, aligned, at_point, counted, number, points_of


def lags(section: np.ndarray, period: int, model: Model) -> np.ndarray:
    """Return the distance of each section from the one `period` sections before, in units of the states' scales.

    Sections have the shape (..., n_keep, n_states). NaN for the first `period` of them.
    """
    found = np.full(section.shape[:-1], np.nan)
    geometry = Geometry(tuple(model.is_angle), tuple(model.scales))
    found[..., period:] = geometry.distance(section[..., period:, :], section[..., :-period, :])
    return found


def left_at(lag: np.ndarray, distance: float) -> np.ndarray:
    """Return the index at which a trajectory has left an orbit: the first lag above a distance after one below it.

    -1 if the trajectory was never on such an orbit, or does not leave it. Lags (..., n_keep) are those of `lags`.
    """
    with np.errstate(invalid="ignore"):
        near, far = lag <= distance, lag > distance
    leaves = far & np.maximum.accumulate(near, axis=-1)
    return np.where(leaves.any(axis=-1), leaves.argmax(axis=-1), -1)


def needs_sections(run: OpenRun, options: DelayOptions) -> None:
    """Raise ValueError unless the parameter moves and enough sections are kept."""
    spec = run.spec
    name = moving_parameter(spec.ramps, options.moving)
    ends = np.asarray(run.cube()[at_section(name)].values)
    if spec.integration.n_keep <= 2 * options.period or not np.ptp(ends):
        raise ValueError(
            f"{name} does not move over the kept sections; lower integration.n_transient, and keep the sections "
            "of the ramp (n_keep)."
        )


def moving_parameter(ramps: Sequence[Ramp], wanted: str) -> str:
    """Return the moving parameter that is named, or the only one; raise ValueError if there is none."""
    names = [ramp.parameter for ramp in ramps]
    if not names:
        raise ValueError("no parameter moves in this run; give its specification a table [drift.NAME].")
    if wanted and wanted not in names:
        raise ValueError(f"{wanted} does not move in this run; moving: {', '.join(names)}.")
    if not wanted and len(names) > 1:
        raise ValueError(f"several parameters move: choose with {' or '.join(f'--moving={name}' for name in names)}.")
    return wanted or names[0]


def delay(run: OpenRun, options: DelayOptions) -> xr.Dataset:
    """Find for each cell the value of the moving parameter at which it leaves an orbit of a given period."""
    cube, model = run.cube(), model_of(run.cube())
    name = moving_parameter(run.spec.ramps, options.moving)
    dims, starts = split_dims(cube["status"])
    order = (*dims, *starts)
    section = cube["section"].transpose(*order, "period_index", "state").values
    at = left_at(lags(section, options.period, model), options.distance)
    values = cube[at_section(name)].broadcast_like(cube["section"].isel(state=0)).transpose(*order, "period_index")
    left = np.take_along_axis(values.values, np.maximum(at, 0)[..., None], axis=-1)[..., 0]
    left = np.where(at >= 0, left, np.nan)
    variables: dict[str, Any] = {"left": (order, left), "left_index": (order, at.astype(np.int32))}
    attrs: dict[str, Any] = {"model": model_attribute(model), **drift_attributes(model)}
    attrs |= {"moving": name, "period": options.period, "distance": options.distance}
    if options.static is not None:
        attrs["static"] = options.static
        variables["delay"] = (order, left - options.static)
    return xr.Dataset(variables, {k: v for k, v in cube.coords.items() if set(v.dims) <= set(order)}, attrs)


def delay_table(ds: xr.Dataset) -> Table:
    """Return a row per parameter point: the range of the values at which its cells leave the orbit."""
    dims, _ = split_dims(ds["left"])
    rows: list[Row] = []
    for at, where in points_of(ds, dims):
        left = ds["left"].isel(at).values.ravel()
        known = left[np.isfinite(left)]
        row: Row = {**where, "n_cells": left.size, "n_left": len(known)}
        for key, summary in (("low", np.min), ("median", np.median), ("high", np.max)):
            row[key] = float(summary(known)) if len(known) else np.nan
        if "static" in ds.attrs:
            row["delay"] = row["median"] - float(ds.attrs["static"])
        rows.append(row)
    name = str(ds.attrs["moving"])
    words = [
        {
            **at_point(ds, row, dims),
            "cells": str(row["n_cells"]),
            "leave": str(row["n_left"]),
            f"at {name}": number(row["median"], ".6g"),
            "from": number(row["low"], ".6g") if row["n_left"] > 1 else None,
            "to": number(row["high"], ".6g") if row["n_left"] > 1 else None,
            "delay": number(row["delay"], ".4g") if "delay" in row else None,
        }
        for row in rows
    ]
    period, distance = int(ds.attrs["period"]), float(ds.attrs["distance"])
    head = f"where sections {counted(period, 'period')} apart first differ by more than {distance:g}"
    return Table(rows, [head, *aligned(words)])
