"""Read the noisy cells of a run, parameter point by parameter point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import split_dims


@dataclass(frozen=True)
class PointCells:
    """Cells of one parameter point, realizations and initial states in one dim.

    Attributes
    ----------
    at : dict of int
        Index of the point by dim.
    values : dict of float
        Parameter values of the point by dim.
    section : ndarray, (cell, section, state)
        NaN in cells that diverged.
    status, n_periods : ndarray, (cell,)
    """

    at: dict[str, int]
    values: dict[str, float]
    section: np.ndarray
    status: np.ndarray
    n_periods: np.ndarray


def point_dims(cube: xr.Dataset) -> list[str]:
    """Return the dims of the parameter points of a noisy run."""
    return list(split_dims(cube["status"])[0])


def cells_at_points(cube: xr.Dataset) -> Iterator[PointCells]:
    """Yield the cells of each parameter point."""
    dims, starts = split_dims(cube["status"])
    n_states = cube.sizes["state"]
    for index in np.ndindex(*(cube.sizes[d] for d in dims)):
        at = dict(zip(dims, index, strict=True))
        part = cube[["section", "status", "n_periods"]].isel(at).transpose(*starts, ...).load()
        section = part["section"].transpose(*starts, "period_index", "state").values
        yield PointCells(
            at,
            {d: float(cube[d].values[i]) for d, i in at.items()},
            section.reshape(-1, section.shape[-2], n_states),
            part["status"].values.ravel(),
            part["n_periods"].values.ravel(),
        )


def coordinates_of(cube: xr.Dataset, dims: Sequence[str]) -> dict[str, Any]:
    """Return the coordinates of a cube that lie along given dims, and its scalar ones."""
    return {str(name): c for name, c in cube.coords.items() if set(c.dims) <= set(dims)}
