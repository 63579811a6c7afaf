"""Read grids of outcome labels for analyses of basins, and cut the grids into tiles for resampling.

A label is the integer code of an outcome: an attractor's id, or another code that the caller counts as an
outcome, such as divergence. *Unfinished* codes mark cells whose outcome is not known. These cells are neither
dropped silently nor counted as a basin of their own.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Codes = npt.NDArray[np.int32]

UNFINISHED = (-1,)
"""Codes of cells whose outcome is not known."""


@dataclass(frozen=True)
class LabelGrid:
    """Outcome labels of a grid or sample of cells, stored as consecutive indices."""

    codes: Codes  # index into `ids` per cell, any shape; -1 where the cell is unfinished
    ids: Ints  # the labels in rising order, without unfinished codes

    @property
    def fraction_unfinished(self) -> float:
        """Share of the cells whose outcome is unknown."""
        return float((self.codes < 0).mean())


def read_labels(
    labels: npt.ArrayLike, unfinished: Collection[int] = UNFINISHED, ids: Collection[int] = ()
) -> LabelGrid:
    """Replace outcome labels by consecutive indices, and mark the cells whose outcome is unknown.

    Parameters
    ----------
    labels
        Integers, one dim or more; a lazy array is loaded.
    unfinished
        Codes of cells whose outcome is not known.
    ids
        Labels to list even if no cell has them.

    Raises
    ------
    TypeError
        If the labels are not integers: a NaN has no meaning that could be counted.
    ValueError
        If there is no axis or no cell, or a code in `ids` is also in `unfinished`.
    """
    values = np.asarray(labels)
    if values.dtype.kind not in "biu":
        raise TypeError(
            f"labels are of dtype {values.dtype}, not integers: give each outcome an integer code, NaN "
            "the code of an unfinished cell, and convert with astype"
        )
    if values.ndim == 0 or values.size == 0:
        raise ValueError(f"labels of shape {values.shape} are no cells along an axis: give at least one")
    if both := sorted(set(ids) & set(unfinished)):
        raise ValueError(f"{both} in ids are also in unfinished: a code is an outcome or it is not; drop one")
    found, inverse = np.unique(values, return_inverse=True)
    found = found.astype(np.int64)
    known = ~np.isin(found, np.array(sorted(unfinished), dtype=np.int64))
    every = np.union1d(found[known], np.array(sorted(ids), dtype=np.int64))
    number = np.full(found.size, -1, dtype=np.int32)
    number[known] = np.searchsorted(every, found[known])
    return LabelGrid(codes=number[inverse].reshape(values.shape), ids=every)


def check_confidence(confidence: float) -> None:
    """Raise ValueError unless a confidence level is between 0 and 1."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence is {confidence}, not between 0 and 1: give 0.95 for 95 %")


def check_resamples(resamples: int) -> None:
    """Raise ValueError unless there are at least two bootstrap resamples; fewer give no standard error."""
    if resamples < 2:
        raise ValueError(f"resamples is {resamples}, below 2: a spread needs at least 2, an interval 200")


def bootstrap_weights(n: int, resamples: int, seed: int) -> Iterator[Floats]:
    """Yield, for each bootstrap resample, how often each of `n` units is drawn."""
    rng = np.random.default_rng(seed)
    for _ in range(resamples):
        yield np.bincount(rng.integers(n, size=n), minlength=n).astype(np.float64)


def spread(resampled: Floats, confidence: float) -> tuple[Floats, Floats, Floats]:
    """Compute the standard error and the percentile interval of resampled values (first axis: resamples); NaN if a
    value is NaN.
    """
    tail = 50.0 * (1.0 - confidence)
    low, high = np.percentile(resampled, [tail, 100.0 - tail], axis=0)
    return np.asarray(resampled.std(axis=0, ddof=1)), np.asarray(low), np.asarray(high)


def tiles_per_side(shape: tuple[int, ...]) -> int:
    """Return how many tiles to cut a grid into along each axis (at least 2), for about `total` tiles in all."""
    return max(2, int(np.rint(64 ** (1.0 / len(shape)))))


def tile_numbers(
    shape: tuple[int, ...], grid: tuple[int, ...], step: int = 1, margin: tuple[int, ...] | None = None
) -> Ints:
    """Return, for each element of an array over a grid, the number of the tile of the grid that it lies in.

    Parameters
    ----------
    shape
        Shape of the array.
    grid
        Shape of the grid of cells that the tiles divide.
    step
        Side of an element [cells].
    margin
        Cell at which the array starts, per axis; None stands for 0.
    """
    per_side = tiles_per_side(grid)
    number = np.zeros((), dtype=np.int64)
    for n, side, start in zip(shape, grid, margin or (0,) * len(grid), strict=True):
        centre = start + (np.arange(n) + 0.5) * step
        tile = np.minimum((centre * per_side / side).astype(np.int64), per_side - 1)
        number = number[..., None] * per_side + tile
    return number


def tile_sums(values: npt.NDArray[np.generic], tile: Ints, n_tiles: int) -> Floats:
    """Sum the values of an array over each tile of a grid."""
    weights = values.ravel().astype(np.float64)
    return np.bincount(tile.ravel(), weights=weights, minlength=n_tiles).astype(np.float64)
