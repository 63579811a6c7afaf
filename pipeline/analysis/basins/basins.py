"""Compute the basins of attraction of a sweep: the outcome of each trajectory, basin fractions, basin boundaries.

The functions read the cube and the ids of its attractors, and integrate nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.basins.boundaries import basin_entropy, uncertainty_exponent
from pipeline.analysis.basins.numbers import basin_fractions
from pipeline.analysis.basins.wada import wada_merge_test
from pipeline.analysis.outcomes import other_cells, outcomes
from pipeline.analysis.ragged import dense
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import ATTRACTS, split_dims
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
        cell ends on, -2 where it diverged, -1 else (`pipeline.analysis.outcomes`). On the parameter dims and
        `label`, the ids of attractors and -2: `count`, `fraction` and the other variables of
        `numbers.basin_fractions`, in which cells without an outcome count as unfinished. On the
        parameter dims: `n_pending`, `n_not_settled`, `n_transient`, `n_unstable`, `n_neutral` and `n_failed`
        (step limits), which add up to `n_unfinished`. On the parameter dims and `attractor`: `stability`.

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
    ids = dense(ids)
    dims, start_dims = split_dims(ids["attractor_id"])
    cells = ids[["attractor_id", "decision", "status", "stability", "ran_out"]]
    result = cells.assign(n_periods=ds["n_periods"].transpose(*dims, *start_dims).load())
    labels = outcomes(ids)
    result["outcome"] = labels.assign_attrs(units="1", long_name="attractor that the cell ends on")
    attract = np.flatnonzero((ids["stability"] == ATTRACTS).any(dims).values)
    fractions = basin_fractions(
        labels,
        dims=start_dims,
        ids=ids["attractor"].values[attract].tolist(),
        inferred=ids["status"] == vocabulary.INFERRED,
        confidence=options.confidence,
        method=options.interval,
    )
    result = result.assign(fractions.data_vars).assign(_unfinished(ids, dims))
    result = result.assign_coords(label=fractions["label"])
    reason = _no_grid(ds, start_dims)
    points = _Points(dims, tuple(ids.sizes[d] for d in dims))
    if not reason:
        for index in np.ndindex(*points.shape):
            grid = labels.isel(dict(zip(dims, index, strict=True))).values
            for number in _boundary(grid, options, points.missing):
                points.add(index, *number)
        result = result.assign(points.variables())
    reasons = "\n".join([reason] if reason else sorted(points.missing))
    about = {f"basin_{name}": getattr(options, name) for name in _OWN}
    return result.assign_attrs({**ids.attrs, **about, "not_computed": reasons})


_OWN = ("interval", "confidence", "box", "block", "scaling", "radius", "metric", "resamples", "seed")
"""Options of basins alone, without those of the attractors."""


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
    shape = outcomes(ids).transpose(*dims, ...).shape
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
        return "boundaries: the starts are no grid"
    for dim in start_dims:
        steps = np.diff(ds[dim].values)
        if np.ptp(steps) > 1e-6 * np.abs(steps).max(initial=0.0):
            return f"boundaries: {dim} is not evenly spaced"
    return ""


_LONG_NAMES = {
    "basin_entropy": ("nat", "basin entropy"),
    "boundary_basin_entropy": ("nat", "boundary basin entropy"),
    "above_ln2_surely": ("1", "boundary basin entropy surely above ln 2: a fractal boundary; -1 not known"),
    "uncertainty_exponent": ("1", "uncertainty exponent"),
    "boundary_dimension": ("1", "dimension of the basin boundary"),
    "exponent_r_squared": ("1", "R squared of the fit of the uncertainty exponent"),
    "wada_distance": ("cells", "largest distance between boundaries, the least radius that passes"),
    "wada_beyond": ("1", "part of all cells that is off the common boundary"),
    "wada": ("1", "passes the Wada merge test; -1 fewer than three labels"),
    "uncertain": ("1", "uncertain part of the region"),
}
_FLAGS = ("above_ln2_surely", "wada")
_ERRORS = ("stderr", "low", "high")
_SCALARS = (
    *(
        f"{name}{end}"
        for name in ("basin_entropy", "boundary_basin_entropy", "uncertainty_exponent", "wada_beyond")
        for end in ("", *(f"_{e}" for e in _ERRORS))
    ),
    "above_ln2_surely",
    "boundary_dimension",
    "exponent_r_squared",
    "wada_distance",
    "wada",
)


class _Points:
    """Arrays that collect the basin measures of all parameter points."""

    def __init__(self, dims: tuple[str, ...], shape: tuple[int, ...]) -> None:
        self.dims, self.shape = dims, shape
        self.missing: set[str] = set()
        self._scalars = {
            name: np.full(shape, -1, np.int8) if name in _FLAGS else np.full(shape, np.nan) for name in _SCALARS
        }
        self._epsilon = np.empty(0, np.int64)
        self._uncertain: dict[tuple[int, ...], np.ndarray] = {}

    def add(self, index: tuple[int, ...], name: str, value: Any) -> None:
        if name == "uncertain":
            self._epsilon, self._uncertain[index] = value["epsilon"].values, value.values
        else:
            self._scalars[name][index] = value

    def variables(self) -> dict[str, Any]:
        """Return the basin measures as (dims, values, attributes), from which xarray builds a Dataset."""
        found: dict[str, Any] = {}
        for name, values in self._scalars.items():
            base = next((name.removesuffix(f"_{e}") for e in _ERRORS if name.endswith(f"_{e}")), name)
            units, text = _LONG_NAMES[base]
            suffix = name.removeprefix(base).replace("_stderr", ", standard error").replace("_", ", ")
            found[name] = (self.dims, values, {"units": units, "long_name": text + suffix})
        if self._uncertain:
            table = np.full((*self.shape, len(self._epsilon)), np.nan)
            for index, values in self._uncertain.items():
                table[index] = values
            units, text = _LONG_NAMES["uncertain"]
            found["uncertain"] = ((*self.dims, "epsilon"), table, {"units": units, "long_name": text})
            found["epsilon"] = ("epsilon", self._epsilon, {"units": "cells"})
        return found


def _boundary(grid: np.ndarray, options: BasinOptions, missing: set[str]) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of each measure of the basin boundaries on one grid of labels."""
    if not (grid != -1).any():
        return
    common: dict[str, Any] = {name: getattr(options, name) for name in ("resamples", "confidence", "seed")}
    try:
        entropy = basin_entropy(grid, options.box, block=options.block, **common)
    except ValueError as error:
        missing.add(f"basin entropy: {error}")
    else:
        for ours, theirs in (("basin_entropy", "entropy"), ("boundary_basin_entropy", "boundary_entropy")):
            yield from _with_errors(entropy, ours, theirs)
        if np.isfinite(entropy["boundary_entropy_low"]):
            yield "above_ln2_surely", int(entropy["above_ln2_surely"])
    try:
        exponent = uncertainty_exponent(grid, method=options.scaling, **common)
    except ValueError as error:
        missing.add(f"uncertainty exponent: {error}")
    else:
        yield from _with_errors(exponent, "uncertainty_exponent", "exponent")
        yield "boundary_dimension", float(exponent["boundary_dimension"])
        yield "exponent_r_squared", float(exponent["r_squared"])
        yield "uncertain", exponent["uncertain"]
    if np.unique(grid[grid != -1]).size >= 3:
        wada = wada_merge_test(grid, options.radius, metric=options.metric, **common).isel(radius=0)
        yield from _with_errors(wada, "wada_beyond", "beyond")
        yield "wada_distance", float(wada["hausdorff_distance"])
        yield "wada", int(wada["wada"])


def _with_errors(ds: xr.Dataset, ours: str, theirs: str) -> Iterator[tuple[str, float]]:
    yield ours, float(ds[theirs])
    for end in _ERRORS:
        yield f"{ours}_{end}", float(ds[f"{theirs}_{end}"])
