"""Test whether all basins share one boundary (Wada property)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import ndimage

from pipeline.analysis.basins.labels import (
    UNFINISHED,
    Codes,
    Floats,
    Ints,
    bootstrap_weights,
    check_confidence,
    check_resamples,
    read_labels,
    spread,
    tile_numbers,
    tiles_per_side,
)

Bools = npt.NDArray[np.bool_]
Metric = Literal["taxicab", "chessboard"]


def wada_merge_test(
    labels: npt.ArrayLike | xr.DataArray,
    radius: int | Sequence[int] = 1,
    *,
    metric: Metric = "taxicab",
    unfinished: Collection[int] = UNFINISHED,
    resamples: int = 200,
    confidence: float = 0.95,
    seed: int = 0,
) -> xr.Dataset:
    """Test whether all basins share one boundary: merge all basins but one in turn, and compare the boundaries.

    For each basin in turn, all others are merged. If the basins have the Wada property, the boundary is the
    same for every basin. On a grid, each boundary then lies within every other boundary fattened by a radius
    of some cells (Daza, Wagemakers and Sanjuán, Sci. Rep. 8, 9954, 2018). The smallest radius that passes is
    the largest Hausdorff distance between two boundaries.

    Parameters
    ----------
    labels
        Outcome per cell of a regular grid, integers, any number of dims.
    radius
        Radius of the fattened boundary [cells], one or several.
    metric
        Distance between cells: ``"taxicab"`` counts steps along the axes, ``"chessboard"`` also
        diagonal ones.
    unfinished
        Codes of cells whose outcome is not known. No boundary passes between an unfinished cell and another
        cell, so unfinished cells on the boundary may hide that it is common.
    resamples, confidence, seed
        Bootstrap samples of tiles of the grid, level of the percentile interval, seed.

    Returns
    -------
    Dataset
        On `label` and `other`: `distance`, the largest distance of a boundary cell of `label` from the
        boundary of `other` [cells], infinite if one of them has none. On `radius`: `beyond`, the number of
        boundary cells farther than `radius` from the other boundary, as a fraction of all cells, largest
        over all pairs, with `beyond_stderr`, `beyond_low`, `beyond_high`; `beyond_of_boundary`, the same as
        a fraction of the boundary's cells; `wada`, whether no cell is farther. Scalar:
        `hausdorff_distance`, the largest `distance` and smallest radius that passes;
        `fraction_unfinished`. On `label`: `n_boundary`, the number of boundary cells.

    Notes
    -----
    The resolution is finite: any basins pass with a radius as large as the grid, and Wada basins fail with
    a small radius if the grid does not resolve the thinnest strips. The radius should be small against the
    basins; this is not validated. If no cell is beyond the radius the errors are 0, although a larger grid
    might show one.

    Raises
    ------
    TypeError
        If the labels are not integers.
    ValueError
        If there are fewer than three labels, a radius is below 1, or the metric is unknown.
    """
    check_confidence(confidence)
    check_resamples(resamples)
    if metric not in ("taxicab", "chessboard"):
        raise ValueError(f"metric is {metric!r}: use 'taxicab' or 'chessboard'")
    radii = np.unique(np.atleast_1d(np.asarray(radius)))
    if radii[0] < 1:
        raise ValueError(f"radius {radii[0]} is below 1 cell: give 1 or more")
    grid = read_labels(labels, unfinished)
    if grid.ids.size < 3:
        raise ValueError(
            f"{grid.ids.size} labels {grid.ids.tolist()}, but the Wada property needs 3 or more: use "
            "basin_entropy, or label a larger region"
        )
    codes = grid.codes
    boundaries = [_boundary_cells(codes, code) for code in range(grid.ids.size)]
    sizes = np.array([cells.size for cells in boundaries])
    distance, beyond = _distances(codes.shape, boundaries, radii, metric)
    counts = beyond.sum(axis=-1)  # label, other, radius
    largest = counts.max(axis=(0, 1))
    part = counts / np.maximum(sizes, 1)[:, None, None]
    weights = bootstrap_weights(beyond.shape[-1], resamples, seed)
    drawn = np.array([(beyond @ w).max(axis=(0, 1)) for w in weights]) / codes.size
    stderr, low, high = spread(drawn, confidence)
    return xr.Dataset(
        {
            "distance": (("label", "other"), distance),
            "hausdorff_distance": ((), distance.max()),
            "n_boundary": ("label", sizes),
            "beyond": ("radius", largest / codes.size, {"long_name": "cells off the common boundary"}),
            "beyond_stderr": ("radius", stderr),
            "beyond_low": ("radius", low),
            "beyond_high": ("radius", high),
            "beyond_of_boundary": ("radius", part.max(axis=(0, 1))),
            "wada": ("radius", radii >= distance.max()),
            "fraction_unfinished": ((), grid.fraction_unfinished),
        },
        coords={"label": grid.ids, "other": grid.ids, "radius": ("radius", radii, {"units": "cells"})},
        attrs={
            "metric": metric,
            "resamples": resamples,
            "confidence": confidence,
            "seed": seed,
            "unfinished_codes": sorted(unfinished),
            "references": "Daza, Wagemakers and Sanjuán, Sci. Rep. 8, 9954 (2018)",
        },
    )


def _boundary_cells(codes: Codes, code: int) -> Ints:
    """Return the flat indices of the cells on the boundary between one basin and all others merged."""
    inside, known = codes == code, codes >= 0
    edge: Bools = np.zeros(codes.shape, dtype=np.bool_)
    for axis in range(codes.ndim):
        here = tuple(slice(None, -1) if k == axis else slice(None) for k in range(codes.ndim))
        there = tuple(slice(1, None) if k == axis else slice(None) for k in range(codes.ndim))
        step = (inside[here] != inside[there]) & known[here] & known[there]
        edge[here] |= step
        edge[there] |= step
    return np.flatnonzero(edge)


def _distances(shape: tuple[int, ...], boundaries: list[Ints], radii: Ints, metric: Metric) -> tuple[Floats, Floats]:
    """Compute the largest distance of each basin boundary from each other one; count boundary cells beyond each radius.

    There is one distance transform per label, which is read at the boundary cells of each pair.
    """
    n_tiles = tiles_per_side(shape) ** len(shape)
    tile = tile_numbers(shape, shape).ravel()
    n = len(boundaries)
    distance = np.zeros((n, n))
    beyond = np.zeros((n, n, radii.size, n_tiles))
    for j, target in enumerate(boundaries):
        field = _distance_field(shape, target, metric)
        for i, cells in enumerate(boundaries):
            away = field[cells] if target.size else np.full(cells.size, np.inf)
            distance[i, j] = away.max(initial=0.0) if cells.size else np.inf
            for k, radius in enumerate(radii):
                beyond[i, j, k] = np.bincount(tile[cells[away > radius]], minlength=n_tiles)
    np.fill_diagonal(distance, 0.0)
    return distance, beyond


def _distance_field(shape: tuple[int, ...], target: Ints, metric: Metric) -> npt.NDArray[np.int32]:
    """Compute the distance of every cell from the nearest target cell, flattened."""
    outside: Bools = np.ones(int(np.prod(shape)), dtype=np.bool_)
    outside[target] = False
    field = ndimage.distance_transform_cdt(outside.reshape(shape), metric=metric)
    return np.asarray(field, dtype=np.int32).ravel()
