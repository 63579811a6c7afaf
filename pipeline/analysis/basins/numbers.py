"""Compute basin fractions with their errors.

Basin entropy and uncertainty exponent are in `boundaries`, and the Wada test is in `wada`; all can also be
imported from here. They take labels: an integer per cell that names its outcome (see `labels`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import special

from pipeline.analysis.basins.boundaries import basin_entropy, uncertainty_exponent
from pipeline.analysis.basins.labels import UNFINISHED, LabelGrid, read_labels
from pipeline.analysis.basins.wada import wada_merge_test
from pipeline.analysis.intervals import REFERENCES, Interval, binomial_interval
from pipeline.analysis.ragged import ROW_SIZE, SET

__all__ = ["basin_entropy", "basin_fractions", "binomial_interval", "uncertainty_exponent", "wada_merge_test"]


def basin_fractions(
    labels: npt.ArrayLike | xr.DataArray,
    *,
    dims: Sequence[str] | None = None,
    ids: Collection[int] = (),
    unfinished: Collection[int] = UNFINISHED,
    inferred: npt.ArrayLike | xr.DataArray | None = None,
    confidence: float = 0.95,
    method: Interval = "wilson",
) -> xr.Dataset:
    """Compute the fraction of cells that end on each attractor, with its sampling error.

    `fraction` refers to the finished cells, as if the unfinished cells were distributed alike. Further
    variables state the largest change that the unfinished cells can make. A label without cells has the
    fraction 0 and an interval that extends above 0. For an attractor that is not listed, `unseen_high`
    bounds the fraction by the exact one-sided bound ``1 - (1 - confidence)**(1/N)``, at 95 % the "rule of
    three" 3/N (Hanley and Lippman-Hand, J. Am. Med. Assoc. 249, 1743, 1983).

    Parameters
    ----------
    labels
        Outcome per cell, integers of any shape.
    dims
        Dims of a DataArray to count over; None counts over all. Other dims stay, such as those of a sweep.
    ids
        Labels to list even if no cell has them.
    unfinished
        Codes of cells whose outcome is not known; ``()`` if every code is an outcome.
    inferred
        Whether each cell was inferred and not integrated (status ``INFERRED`` of a refined grid), in the
        shape or on the dims of the labels. Inferred cells count like all others.
    confidence
        Two-sided level of the intervals, one-sided level of the `unseen` bounds.
    method
        See `binomial_interval`.

    Returns
    -------
    Dataset
        On the kept dims and `label`: `count`; `fraction` with `low` and `high`; `fraction_if_none` and
        `fraction_if_all`, the fraction if none or all of the unfinished cells belonged to the label;
        `low_if_none` and `high_if_all`, the interval around both. On the kept dims: `n_cells`,
        `n_unfinished`, `fraction_unfinished`, `unseen_high`, and `unseen_high_if_all`, the bound if all
        unfinished cells went to one attractor that was not seen. NaN fractions where nothing finished.
        With `inferred`, on the kept dims and `label`: `n_inferred`, how many of `count` were inferred.

    Notes
    -----
    The intervals hold for cells drawn independently from the region, and for each label separately. Cells
    of a regular grid are not independent: their error comes from the cells along the boundary and is
    smaller, so the intervals are too wide rather than too narrow. The intervals do not include errors of
    a refined grid (`pipeline.compute.refinement`). Random drawing and even coverage of the region are not
    validated.

    Raises
    ------
    TypeError
        If the labels are not integers.
    ValueError
        If there is no cell, `dims` are not dims of a DataArray, `inferred` is not on the cells of the
        labels, or level or method are unknown.
    """
    kept, over = _kept_dims(labels, dims)
    if isinstance(labels, xr.DataArray):
        if isinstance(inferred, xr.DataArray):
            inferred = _same_cells(labels, inferred).transpose(*kept, *over)
        coords = {name: c for name, c in labels.coords.items() if set(c.dims) <= set(kept)}
        labels = labels.transpose(*kept, *over)
    else:
        coords = {}
    grid = read_labels(labels, unfinished, ids)
    shape = grid.codes.shape[: len(kept)]
    count, n_unfinished = _count_rows(grid, shape)
    n_cells = np.full(shape, grid.codes.size // max(1, int(np.prod(shape))))
    ds = xr.Dataset(coords=coords | {"label": grid.ids})
    fractions = _with_intervals(count, n_cells[..., None], n_unfinished[..., None], confidence, method)
    ds = ds.assign({name: ((*kept, "label"), values) for name, values in fractions.items()})
    ds = ds.assign(_of_points(kept, n_cells, n_unfinished, confidence))
    if inferred is not None:
        ds["n_inferred"] = ((*kept, "label"), _count_inferred(grid, np.asarray(inferred), shape))
    ds["fraction"].attrs = {"long_name": "basin fraction among the finished cells", "units": "1"}
    return ds.assign_attrs(_provenance(unfinished, confidence, method))


def basin_rows(
    labels: xr.DataArray, dims: Sequence[str], inferred: xr.DataArray, confidence: float, method: Interval
) -> xr.Dataset:
    """Compute the basin fractions as rows, one for each outcome that cells have at each parameter point.

    Parameters
    ----------
    labels
        Outcome per cell, the parameter dims first; -1 where it is not known.
    dims
        Parameter dims.
    inferred
        Whether each cell was inferred and not integrated.
    confidence, method
        See `basin_fractions`.

    Returns
    -------
    Dataset
        Rows (`pipeline.analysis.ragged`) with the outcome as `attractor`, and `n_sets`, their number at each point.
        Otherwise the variables of `basin_fractions`.
    """
    shape = labels.shape[: len(dims)]
    grid = labels.values.reshape(int(np.prod(shape)), -1)
    point, cell = np.nonzero(grid != -1)
    least = min(int(grid.min()), 0)
    width = int(grid.max()) - least + 1
    rows, inverse, count = np.unique(
        point * width + (grid[point, cell] - least), return_inverse=True, return_counts=True
    )
    point_of_row, outcome = rows // width, rows % width + least
    known = np.bincount(point, minlength=len(grid))
    n_cells, n_unfinished = np.full(len(grid), grid.shape[1]), grid.shape[1] - known
    fractions = _with_intervals(count, n_cells[point_of_row], n_unfinished[point_of_row], confidence, method)
    fractions["n_inferred"] = np.bincount(
        inverse, weights=inferred.values.reshape(grid.shape)[point, cell], minlength=len(rows)
    ).astype(np.int64)
    found = xr.Dataset({name: (SET, values) for name, values in fractions.items()})
    found["fraction"].attrs = {"long_name": "basin fraction among the finished cells", "units": "1"}
    sizes = np.bincount(point_of_row, minlength=len(grid)).astype(np.int32)
    found[ROW_SIZE] = (dims, sizes.reshape(shape), {"units": "1", "long_name": "number of outcomes"})
    found = found.assign(_of_points(dims, n_cells.reshape(shape), n_unfinished.reshape(shape), confidence))
    about = {"units": "1", "long_name": "attractor, or -2 of cells that diverged"}
    return found.assign_coords(attractor=(SET, outcome.astype(np.int32), about))


def unseen_bound(n: npt.NDArray[np.int64], confidence: float = 0.95) -> npt.NDArray[np.float64]:
    """Return the one-sided bound on the basin fraction of an attractor that none of `n` cells ends on."""
    return _upper_bound(np.zeros_like(n), n, confidence)


def _kept_dims(
    labels: npt.ArrayLike | xr.DataArray, dims: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the dims of the labels that stay in the result, and the dims over which cells are counted."""
    if dims is None:
        over = tuple(str(dim) for dim in labels.dims) if isinstance(labels, xr.DataArray) else ()
        return (), over
    if isinstance(dims, str):
        dims = (dims,)
    have = tuple(str(dim) for dim in labels.dims) if isinstance(labels, xr.DataArray) else ()
    if missing := [dim for dim in dims if dim not in have]:
        raise ValueError(f"dims {missing} are not dims of the labels, {list(have)}: name some of those")
    return tuple(dim for dim in have if dim not in dims), tuple(dims)


def _count_rows(grid: LabelGrid, shape: tuple[int, ...]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Count the cells of each label, and the unfinished cells, for each index of the leading axes (parameter
    points).
    """
    n_rows, width = int(np.prod(shape)), grid.ids.size + 1
    codes = grid.codes.reshape(n_rows, -1).astype(np.int64) + 1
    codes += width * np.arange(n_rows)[:, None]
    table = np.bincount(codes.ravel(), minlength=n_rows * width).reshape(*shape, width)
    return table[..., 1:], table[..., 0]


def _count_inferred(
    grid: LabelGrid, inferred: npt.NDArray[np.generic], shape: tuple[int, ...]
) -> npt.NDArray[np.int64]:
    if inferred.dtype != bool or inferred.shape != grid.codes.shape:
        raise ValueError(
            f"inferred is {inferred.dtype} of shape {inferred.shape}, the labels are of shape "
            f"{grid.codes.shape}: give true or false per cell, such as ds.status == Status.INFERRED"
        )
    return _count_rows(LabelGrid(np.where(inferred, grid.codes, np.int32(-1)), grid.ids), shape)[0]


def _with_intervals(
    count: npt.NDArray[np.int64],
    cells: npt.NDArray[np.int64],
    unknown: npt.NDArray[np.int64],
    confidence: float,
    method: Interval,
) -> dict[str, npt.NDArray[Any]]:
    """Compute from counts the fraction of each outcome, its interval, and its bounds due to unfinished cells."""
    finished = cells - unknown
    low, high = binomial_interval(count, finished, confidence=confidence, method=method)
    low_if_none, _ = binomial_interval(count, cells, confidence=confidence, method=method)
    _, high_if_all = binomial_interval(count + unknown, cells, confidence=confidence, method=method)
    return {
        "count": count,
        "fraction": np.where(finished > 0, count / np.maximum(finished, 1), np.nan),
        "low": low,
        "high": high,
        "fraction_if_none": count / cells,
        "fraction_if_all": (count + unknown) / cells,
        "low_if_none": low_if_none,
        "high_if_all": high_if_all,
    }


def _of_points(
    dims: Sequence[str], n_cells: npt.NDArray[np.int64], n_unfinished: npt.NDArray[np.int64], confidence: float
) -> dict[str, Any]:
    """Return the variables of parameter points: numbers of cells, and bounds on what no cell shows."""
    return {
        "n_cells": (dims, n_cells),
        "n_unfinished": (dims, n_unfinished),
        "fraction_unfinished": (dims, n_unfinished / n_cells),
        "unseen_high": (dims, unseen_bound(n_cells - n_unfinished, confidence)),
        "unseen_high_if_all": (dims, _upper_bound(n_unfinished, n_cells, confidence)),
    }


def _upper_bound(count: npt.NDArray[np.int64], n: npt.NDArray[np.int64], confidence: float) -> npt.NDArray[np.float64]:
    """Compute the one-sided upper Clopper-Pearson bound of a fraction; 1 if all `n` trials are hits or `n` is 0."""
    bound = special.betaincinv(count + 1.0, np.maximum(n - count, 1), confidence)
    return np.where(count >= n, 1.0, bound)


def _same_cells(before: xr.DataArray, after: xr.DataArray) -> xr.DataArray:
    """Transpose the second array of labels to the dims of the first; ValueError unless both have the same cells."""
    if set(before.dims) != set(after.dims):
        raise ValueError(
            f"labels before have the dims {before.dims}, after {after.dims}: select one parameter value from each"
        )
    for dim in before.dims:
        one, other = before.indexes.get(dim), after.indexes.get(dim)
        if one is not None and other is not None and not one.equals(other):
            raise ValueError(f"coordinate {dim!r} differs before and after: label the same cells at both")
    return after.transpose(*before.dims)


def _provenance(unfinished: Collection[int], confidence: float, method: Interval) -> dict[str, object]:
    return {
        "interval": method,
        "confidence": confidence,
        "unfinished_codes": sorted(unfinished),
        "references": REFERENCES[method],
    }
