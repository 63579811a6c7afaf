"""Compute basin fractions with their errors.

Basin entropy and uncertainty exponent are in `boundaries`, and the Wada test is in `wada`; all can also be
imported from here. They take labels: an integer per cell that names its outcome (see `labels`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import special

from pipeline.analysis.basins.boundaries import basin_entropy, uncertainty_exponent
from pipeline.analysis.basins.wada import wada_merge_test
from pipeline.results.intervals import Interval, binomial_interval
from pipeline.results.ragged import ROW_SIZE, SET

__all__ = ["basin_entropy", "basin_rows", "binomial_interval", "uncertainty_exponent", "wada_merge_test"]


def basin_rows(
    labels: xr.DataArray,
    dims: Sequence[str],
    inferred: xr.DataArray,
    confidence: float,
    method: Interval,
    weights: np.ndarray | None = None,
) -> xr.Dataset:
    """Compute the basin fractions with their errors, as rows: one for each outcome of the cells at a parameter point.

    `fraction` refers to all cells. Further variables state the largest change that cells without an outcome
    (unfinished) can make. For an attractor without cells, `unseen_high` bounds the
    fraction by the exact one-sided bound ``1 - (1 - confidence)**(1/N)``, at 95 % the "rule of three" 3/N (Hanley and
    Lippman-Hand, J. Am. Med. Assoc. 249, 1743, 1983).

    Parameters
    ----------
    labels
        Outcome per cell, the parameter dims first; -1 where it is not known.
    dims
        Parameter dims.
    inferred
        Whether each cell was inferred and not integrated.
    confidence
        Two-sided level of the intervals, one-sided level of the `unseen` bounds.
    method
        See `pipeline.results.intervals.binomial_interval`.
    weights
        Weight of each cell, shape (parameter point, cell); by default all are 1. Fractions are then shares of the
        weight, and their intervals those of as many independent cells as have the same variance, ``(sum w)^2 / sum
        w^2`` (Kish, Survey Sampling, 1965).

    Returns
    -------
    Dataset
        Rows (`pipeline.results.ragged`) with the outcome as `attractor`, and `n_sets`, their number at each point. In
        each row: `count`, and `n_inferred` of them; `fraction` of all cells, with `low` and `high`;
        `fraction_if_all`, the fraction if all unfinished cells belonged to the outcome, and `high_if_all`, the upper
        end of its interval. At each point: `n_cells`, `n_unfinished`, `n_effective`, `fraction_unfinished`,
        `unseen_high`, and `unseen_high_if_all`, the bound if all unfinished cells went to one attractor that was not
        seen.

    Notes
    -----
    The intervals hold for cells drawn independently from the region, and for each outcome separately. Cells of a
    regular grid are not independent: their error comes from the cells along the boundary and is smaller, so the
    intervals are too wide rather than too narrow. They do not include errors of a refined grid
    (`pipeline.compute.refinement`). Random drawing and even coverage of the region are not validated.
    """
    shape = labels.shape[: len(dims)]
    grid = labels.values.reshape(int(np.prod(shape)), -1)
    point, cell = np.nonzero(grid != -1)
    weights = np.ones(grid.shape) if weights is None else weights
    total = weights.sum(axis=1)
    per_weight = total / (weights**2).sum(axis=1)  # 1 if all weights are 1, so that weighed counts are the counts
    weighed = weights * per_weight[:, None]
    least = min(int(grid.min()), 0)
    width = int(grid.max()) - least + 1
    rows, inverse, count = np.unique(
        point * width + (grid[point, cell] - least), return_inverse=True, return_counts=True
    )
    point_of_row, outcome = rows // width, rows % width + least
    n_unfinished = grid.shape[1] - np.bincount(point, minlength=len(grid))
    effective, unknown = total * per_weight, (weighed * (grid == -1)).sum(axis=1)
    own = np.bincount(inverse, weights=weighed[point, cell], minlength=len(rows)).astype(np.float64)
    fractions = _with_intervals(own, effective[point_of_row], unknown[point_of_row], confidence, method)
    fractions["count"] = count
    fractions["n_inferred"] = np.bincount(
        inverse, weights=inferred.values.reshape(grid.shape)[point, cell], minlength=len(rows)
    ).astype(np.int64)
    found = xr.Dataset({name: (SET, values) for name, values in fractions.items()})
    sizes = np.bincount(point_of_row, minlength=len(grid)).astype(np.int32)
    found[ROW_SIZE] = (dims, sizes.reshape(shape))
    found = found.assign(_of_points(dims, effective.reshape(shape), unknown.reshape(shape), confidence))
    found["n_cells"] = (dims, np.full(shape, grid.shape[1]))
    found["n_unfinished"] = (dims, n_unfinished.reshape(shape))
    return found.assign_coords(attractor=(SET, outcome.astype(np.int32)))


def unseen_bound(n: npt.NDArray[Any], confidence: float = 0.95) -> npt.NDArray[np.float64]:
    """Return the one-sided bound on the basin fraction of an attractor that none of `n` cells ends on."""
    return _upper_bound(np.zeros_like(n), n, confidence)


def _with_intervals(
    count: npt.NDArray[np.float64],
    cells: npt.NDArray[np.float64],
    unknown: npt.NDArray[np.float64],
    confidence: float,
    method: Interval,
) -> dict[str, npt.NDArray[Any]]:
    """Compute from weighed counts the fraction of each outcome, its interval, and its bounds due to unfinished
    cells.
    """
    count, with_unknown = np.minimum(count, cells), np.minimum(count + unknown, cells)  # above them only by rounding
    low, high = binomial_interval(count, cells, confidence=confidence, method=method)
    _, high_if_all = binomial_interval(with_unknown, cells, confidence=confidence, method=method)
    return {
        "fraction": count / cells,
        "low": low,
        "high": high,
        "fraction_if_all": with_unknown / cells,
        "high_if_all": high_if_all,
    }


def _of_points(
    dims: Sequence[str], effective: npt.NDArray[np.float64], unknown: npt.NDArray[np.float64], confidence: float
) -> dict[str, Any]:
    """Return the variables of parameter points: weighed numbers of cells, and bounds on what no cell shows."""
    return {
        "n_effective": (dims, effective),
        "fraction_unfinished": (dims, unknown / effective),
        "unseen_high": (dims, unseen_bound(effective - unknown, confidence)),
        "unseen_high_if_all": (dims, _upper_bound(unknown, effective, confidence)),
    }


def _upper_bound(count: npt.NDArray[Any], n: npt.NDArray[Any], confidence: float) -> npt.NDArray[np.float64]:
    """Compute the one-sided upper Clopper-Pearson bound of a fraction; 1 if all `n` trials are hits or `n` is 0."""
    bound = special.betaincinv(count + 1.0, np.maximum(n - count, 1), confidence)
    return np.where(count >= n, 1.0, bound)
