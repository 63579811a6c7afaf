"""Compute the basins of attraction of a sweep: the outcome of each trajectory, basin fractions, basin boundaries.

The functions read the cube and the ids of its attractors, and integrate nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.basins.boundaries import basin_entropy, box_sides, epsilons_of, uncertainty_exponent
from pipeline.analysis.basins.numbers import basin_rows
from pipeline.analysis.basins.wada import wada_merge_test
from pipeline.analysis.outcomes import other_cells, outcomes
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import split_dims
from pipeline.products.basins import BasinOptions


def basins(ds: xr.Dataset, ids: xr.Dataset, options: BasinOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the basins of attraction at each parameter point of a sweep, with fractions and boundaries.

    Parameters
    ----------
    ds
        Cube of a sweep.
    ids
        Result of `match` or `identify` for the cube.
    options
        By default the defaults of `BasinOptions`. See `numbers.binomial_interval` for the intervals,
        `boundaries.basin_entropy` for the boxes, `boundaries.uncertainty_exponent` for the scaling, and
        `wada.wada_merge_test` for radius and metric.
    changes
        Fields of `BasinOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        On the cells: `attractor_id`, `decision`, `status`, `n_periods`, and `outcome`, the attractor that a
        cell ends on, -2 where it diverged, -1 else (`pipeline.analysis.outcomes`). One row (`pipeline.analysis.ragged`)
        for each outcome of cells at each parameter point, with `attractor`, the id or -2: the variables of
        `numbers.basin_rows`, in which cells without an outcome count as unfinished. On the
        parameter dims: `n_pending`, `n_not_settled`, `n_transient`, `n_unstable`, `n_neutral` and `n_failed`
        (step limits), which add up to `n_unfinished`.

        If the starts are a grid, evenly spaced along every axis, on the parameter dims:
        `basin_entropy`, `boundary_basin_entropy`, `uncertainty_exponent`, `wada_beyond`, each with
        `_stderr`, `_low`, `_high`; `above_ln2_surely`, `boundary_dimension`, `exponent_r_squared`;
        `wada_distance`, the smallest radius [cells] that passes the Wada test; `wada`: 1 passes with
        `radius`, 0 does not, -1 fewer than three labels; and `uncertain`, also on `epsilon`. A number that
        the grid does not allow is NaN, and the attribute ``not_computed`` gives the reason.

    Raises
    ------
    ValueError
        If the cube is a continuation, or an option is out of bounds.
    """
    options = options or BasinOptions(**changes)
    check_starts(ds)
    dims, start_dims = split_dims(ids["attractor_id"])
    labels = outcomes(ids).transpose(*dims, *start_dims)
    result = ids[["attractor_id", "decision", "status", "ran_out"]]
    result["n_periods"] = ds["n_periods"].transpose(*dims, *start_dims).load()
    result["outcome"] = labels.assign_attrs(units="1", long_name="attractor that the cell ends on")
    inferred = (ids["status"] == vocabulary.INFERRED).transpose(*dims, *start_dims)
    result = result.merge(basin_rows(labels, dims, inferred, options.confidence, options.interval))
    result = result.assign(_unfinished(ids, dims))
    if reason := _no_grid(ds, start_dims):
        missing = {"boundaries": reason}
    else:
        missing = _problems(labels.shape[len(dims) :], options)
        result = result.assign(_boundaries(labels, dims, options, missing))
    about = {f"basin_{name}": getattr(options, name) for name in type(options).model_fields}
    reasons = "\n".join(f"{name}: {reason}" for name, reason in missing.items())
    return result.assign_attrs({**ids.attrs, **about, "not_computed": reasons})


def check_starts(ds: xr.Dataset) -> None:
    """Raise ValueError unless each parameter point has several cells with independent initial conditions."""
    if "branch" in ds["status"].dims:
        raise ValueError(
            'basins need independent initial conditions, a sweep (kind = "sweep"): where a branch of a '
            "continuation starts is the end of its last point."
        )
    if not split_dims(ds["status"])[1]:
        raise ValueError("basins need several initial conditions per parameter point; this run has one.")


def _unfinished(ids: xr.Dataset, dims: tuple[str, ...]) -> dict[str, xr.DataArray]:
    """Count the cells without an outcome at each parameter point by reason, such as "not computed" or "not settled"."""
    others = other_cells(ids)
    shape = ids["attractor_id"].transpose(*dims, ...).shape
    kinds = {
        "n_pending": (("pending",), "cells not computed"),
        "n_not_settled": (("not settled",), "cells of which nothing could be shown"),
        "n_transient": (("on a transient set",), "cells on sets that others were seen to leave"),
        "n_unstable": (("on an unstable orbit or equilibrium",), "cells on sets that do not attract"),
        "n_neutral": (("on a neutral set",), "cells on neutral sets"),
        "n_failed": (
            ("step limit", "step underflow", "unreached", "no return", "chatter"),
            "cells that could not be integrated",
        ),
    }
    found = {}
    for name, (words, text) in kinds.items():
        which = np.zeros(shape, bool)
        for word in words:
            which |= others.get(word, False)
        count = which.reshape(*shape[: len(dims)], -1).sum(axis=-1, dtype=np.int64)
        found[name] = xr.DataArray(count, dims=dims, attrs={"units": "1", "long_name": text})
    return found


def _no_grid(ds: xr.Dataset, start_dims: tuple[str, ...]) -> str:
    if "initial_condition" in start_dims:
        return "the starts are no grid"
    for dim in start_dims:
        steps = np.diff(ds[dim].values)
        if np.ptp(steps) > 1e-6 * np.abs(steps).max(initial=0.0):
            return f"{dim} is not evenly spaced"
    return ""


def _problems(shape: tuple[int, ...], options: BasinOptions) -> dict[str, str]:
    """Return why measures of the boundaries cannot be computed on a grid, by measure."""
    found = {}
    checks: dict[str, Callable[[], object]] = {
        "basin entropy": lambda: box_sides(options.box, shape),
        "uncertainty exponent": lambda: epsilons_of(None, shape, options.scaling),
    }
    for name, check in checks.items():
        try:
            check()
        except ValueError as error:
            found[name] = str(error)
    return found


_LONG_NAMES = {
    "basin_entropy": ("nat", "basin entropy"),
    "boundary_basin_entropy": ("nat", "boundary basin entropy"),
    "uncertainty_exponent": ("1", "uncertainty exponent"),
    "wada_beyond": ("1", "part of all cells that is off the common boundary"),
    "above_ln2_surely": ("1", "boundary basin entropy surely above ln 2: a fractal boundary; -1 not known"),
    "boundary_dimension": ("1", "dimension of the basin boundary"),
    "exponent_r_squared": ("1", "R squared of the fit of the uncertainty exponent"),
    "wada_distance": ("cells", "largest distance between boundaries, the least radius that passes"),
    "wada": ("1", "passes the Wada merge test; -1 fewer than three labels"),
}
_FLAGS = ("above_ln2_surely", "wada")
_WITH_ERRORS = ("basin_entropy", "boundary_basin_entropy", "uncertainty_exponent", "wada_beyond")
_ERRORS = ("stderr", "low", "high")


def _boundaries(
    labels: xr.DataArray, dims: tuple[str, ...], options: BasinOptions, missing: Mapping[str, str]
) -> dict[str, Any]:
    """Measure the basin boundaries at each parameter point; return variables as (dims, values, attributes)."""
    shape, grid = labels.shape[: len(dims)], labels.shape[len(dims) :]
    points = [dict(_boundary(one, options, missing)) for one in labels.values.reshape(-1, *grid)]
    found: dict[str, Any] = {}
    for name, (units, text) in _LONG_NAMES.items():
        ends = ("", *(f"_{end}" for end in _ERRORS)) if name in _WITH_ERRORS else ("",)
        for end in ends:
            lacking = -1 if name in _FLAGS else np.nan
            values = np.array([point.get(name + end, lacking) for point in points])
            values = values.astype(np.int8 if name in _FLAGS else np.float64).reshape(shape)
            long_name = text + end.replace("_stderr", ", standard error").replace("_", ", ")
            found[name + end] = (dims, values, {"units": units, "long_name": long_name})
    if "uncertainty exponent" not in missing:
        epsilon = epsilons_of(None, grid, options.scaling)
        values = np.array([point.get("uncertain", np.full(len(epsilon), np.nan)) for point in points])
        attrs = {"units": "1", "long_name": "uncertain part of the region"}
        found["uncertain"] = ((*dims, "epsilon"), values.reshape(*shape, len(epsilon)), attrs)
        found["epsilon"] = ("epsilon", epsilon, {"units": "cells"})
    return found


def _boundary(grid: np.ndarray, options: BasinOptions, missing: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of each measure of the basin boundaries on one grid of labels."""
    if not (grid != -1).any():
        return
    common: dict[str, Any] = {name: getattr(options, name) for name in ("resamples", "confidence", "seed")}
    if "basin entropy" not in missing:
        entropy = basin_entropy(grid, options.box, block=options.block, **common)
        for ours, theirs in (("basin_entropy", "entropy"), ("boundary_basin_entropy", "boundary_entropy")):
            yield from _with_errors(entropy, ours, theirs)
        if np.isfinite(entropy["boundary_entropy_low"]):
            yield "above_ln2_surely", int(entropy["above_ln2_surely"])
    if "uncertainty exponent" not in missing:
        exponent = uncertainty_exponent(grid, method=options.scaling, **common)
        yield from _with_errors(exponent, "uncertainty_exponent", "exponent")
        yield "boundary_dimension", float(exponent["boundary_dimension"])
        yield "exponent_r_squared", float(exponent["r_squared"])
        yield "uncertain", exponent["uncertain"].values
    if np.unique(grid[grid != -1]).size >= 3:
        wada = wada_merge_test(grid, options.radius, metric=options.metric, **common).isel(radius=0)
        yield from _with_errors(wada, "wada_beyond", "beyond")
        yield "wada_distance", float(wada["hausdorff_distance"])
        yield "wada", int(wada["wada"])


def _with_errors(ds: xr.Dataset, ours: str, theirs: str) -> Iterator[tuple[str, float]]:
    yield ours, float(ds[theirs])
    for end in _ERRORS:
        yield f"{ours}_{end}", float(ds[f"{theirs}_{end}"])
