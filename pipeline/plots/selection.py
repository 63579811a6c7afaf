"""Select values on those axes of a run that a figure does not show."""

from __future__ import annotations

from collections.abc import Mapping

import xarray as xr

from pipeline.analysis.selection import place, select_points
from pipeline.layout.vocabulary import split_dims


def at_points(ds: xr.Dataset, at: Mapping[str, float] | None) -> xr.Dataset:
    """Select values of a result cube's swept parameters and initial states; the selected dims become scalars.

    Raises
    ------
    ValueError
        If an axis is unknown or does not have the value.
    """
    _, starts = split_dims(ds["status"])
    given = dict(at or {})
    for name in [n for n in given if n in starts and n in ds.coords]:
        ds = ds.isel({name: place(ds[name], float(given.pop(name)))})
    part = select_points(ds, given)
    return part.isel(dict.fromkeys(given, 0))
