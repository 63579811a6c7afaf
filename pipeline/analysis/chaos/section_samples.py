"""Read the section points of computed cells from a run's result cube, for the indicators of chaos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.chaos.declaration import CHAOS_COLUMNS, DIMENSION_COLUMNS
from pipeline.layout.columns import described
from pipeline.layout.vocabulary import model_of
from pipeline.results.sets import Geometry

Floats = npt.NDArray[np.float64]


def geometry_of(ds: xr.Dataset, geometry: Geometry | None = None) -> Geometry:
    """Return the given geometry of the states or, if it is None, that of the model of the result cube."""
    return Geometry.of(model_of(ds)) if geometry is None else geometry


def computed(ds: xr.Dataset, geometry: Geometry) -> xr.DataArray:
    """Return the section points of a result cube, with NaN in the cells that were not computed to the end.

    Raises
    ------
    ValueError
        If there are no sections, or the geometry has another number of states.
    """
    if "section" not in ds:
        raise ValueError("The dataset has no section; give the dataset of pipeline.open_run.")
    section = ds["section"]
    if section.sizes["state"] != len(geometry.scales):
        raise ValueError(
            f"section has {section.sizes['state']} states, the geometry {len(geometry.scales)}: give the "
            "geometry of the system that was integrated"
        )
    if "status" not in ds:
        return section
    return section.where(ds["status"].isin((Status.PERIODIC, Status.BOUNDED, Status.INFERRED)))


def at_least(name: str, value: int, least: int) -> int:
    """Return a number, or raise ValueError if it is below a given minimum."""
    if value < least:
        raise ValueError(f"{name} is {value}, below {least}: give {least} or more")
    return int(value)


def with_coords(ds: xr.Dataset, dims: Sequence[object], variables: Mapping[str, Any]) -> xr.Dataset:
    """Build a dataset from variables on the given dims, with the coordinates that another dataset has on these dims."""
    coords = {name: c for name, c in ds.coords.items() if set(c.dims) <= set(dims)}
    # of a cube in memory, too, without the door of stored results
    return described(xr.Dataset(variables, coords=coords), (*CHAOS_COLUMNS, *DIMENSION_COLUMNS))
