"""Select parameter points and axis values of a run's result cube or of its attractors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.layout.own_words import axis_in_own_words, rate_of
from pipeline.layout.vocabulary import grid_dim, has_origins, split_dims
from pipeline.results.ragged import isel
from pipeline.specification.problems import unknown_name
from pipeline.specification.tables import FREQUENCY

Floats = npt.NDArray[np.float64]


def parameter_dims(attractors: xr.Dataset) -> list[str]:
    """Return the names of the swept parameters."""
    return list(split_dims(attractors["attractor_id"])[0])


def start_dims(attractors: xr.Dataset) -> list[str]:
    """Return the names of the dims along which the cells of one parameter point differ, such as the initial
    condition.
    """
    return list(split_dims(attractors["attractor_id"])[1])


def start_states(cube: xr.Dataset, starts: tuple[str, ...]) -> npt.NDArray[np.float64]:
    """Return the initial states of the cells of a parameter point, shape (cell, state), counted from their origins."""
    shape = tuple(cube.sizes[d] for d in starts)
    columns = []
    for name in cube["state"].values:
        column = cube[grid_dim(str(name))]
        own = xr.DataArray(np.ones(shape), dims=starts) * column.drop_vars(list(column.coords))
        columns.append(own.transpose(*starts).values.ravel())
    return np.column_stack(columns)


def refuse_origins(cube: xr.Dataset, what: str) -> None:
    """Raise ValueError if the starts of cells are counted from expressions of the parameters."""
    if has_origins(cube):
        raise ValueError(
            f"{what} needs the same starts at all parameters; this run counts them from initial_conditions.origin."
        )


def listed(text: str) -> list[str]:
    """Return the names in a text, which are separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def choose(ds: xr.Dataset, at: Mapping[str, float] | None, keep: tuple[str, ...], purpose: str) -> xr.Dataset:
    """Select one value on each axis of a dataset, except on the axes in `keep`.

    Parameters
    ----------
    ds
        Dataset with `attractor_id`.
    at
        Value by axis; it must lie on the axis (see `place`).
    keep
        Axes to keep.
    purpose
        Purpose of the selection, for error messages.

    Raises
    ------
    ValueError
        If an axis is unknown, a value is not on its axis, or an axis longer than 1 is left over.
    """
    dims = [str(d) for d in ds["attractor_id"].dims]
    for name, value in (at or {}).items():
        allowed = [d for d in dims if d not in keep]
        if name not in allowed:
            raise ValueError(unknown_name("axis", name, [axis_in_own_words(d, rate_of(ds))[0] for d in allowed]))
        ds = isel(ds, {name: place(ds[name], float(value), rate_of(ds))})
    left = [d for d in ds["attractor_id"].dims if d not in keep]
    long = [str(d) for d in left if ds.sizes[d] > 1]
    if long:
        raise ValueError(f"{purpose}, and the dataset also has {_left_over(ds, long)}")
    return isel(ds, dict.fromkeys(left, 0))


def _left_over(ds: xr.Dataset, long: list[str], option: str = "") -> str:
    """Return the axes of which a value must be chosen, with an example, in the words of the specification."""
    told = [(*axis_in_own_words(d, rate_of(ds)), d) for d in long]
    axes = ", ".join(f"{name} ({ds.sizes[d]} values)" for name, _, d in told)
    name, given, d = told[0]
    one = float(given(ds[d].values[ds.sizes[d] // 2])) if d in ds.coords else 0.0
    return f"{axes}: choose a value of each, such as {option}{name}={one:.6g}"


def place(axis: xr.DataArray, value: float, rate: str = FREQUENCY) -> int:
    """Return the index of a value on an axis; ValueError if the axis does not have it. `rate` is the specification's
    word for the drive's rate, in which the error names values.

    Raises
    ------
    ValueError
        If no axis value is within 1e-6 of the spacing; the message names the values on either side.
    """
    values = axis.values.astype(np.float64)
    index = int(np.abs(values - value).argmin())
    if abs(values[index] - value) <= _slack(values, index):
        return index
    name, given = axis_in_own_words(str(axis.name), rate)
    values, value = given(values), float(given(value))
    low, high = values.min(), values.max()
    if not low < value < high:
        raise ValueError(f"{name} = {value:.10g} lies off its axis, which runs from {low:.10g} to {high:.10g}")
    below, above = values[values < value].max(), values[values > value].min()
    raise ValueError(f"{name} = {value:.10g} is not on its axis; the nearest values are {below:.10g} and {above:.10g}")


def _slack(values: Floats, index: int) -> float:
    """Return the tolerance for matching a number to an axis value: 1e-6 of the distance to the nearest other value."""
    apart = np.abs(values - values[index])
    spacing = apart[apart > 0].min() if (apart > 0).any() else abs(values[index])
    return float(1e-6 * spacing)


def snap(ds: xr.Dataset, at: Mapping[str, float]) -> dict[str, float]:
    """Replace parameter values by the nearest axis values; values outside the range of an axis stay unchanged."""
    found = {}
    for name, value in at.items():
        axis = ds[name].values.astype(np.float64).ravel() if name in ds.dims else np.array([value])
        inside = axis.min() <= value <= axis.max()
        found[name] = float(axis[np.abs(axis - value).argmin()]) if inside else float(value)
    return found


def select_points(ds: xr.Dataset, at: Mapping[str, float] | None, *, purpose: str = "") -> xr.Dataset:
    """Select values of the swept parameters of a result cube; the selected dims stay, with length 1.

    Parameters
    ----------
    ds
        Cube.
    at
        Value by parameter; it must lie on the axis (see `place`).
    purpose
        Purpose of the selection, for the error message; if given, exactly one point must remain.

    Raises
    ------
    ValueError
        If an axis is unknown, a value is not on its axis, or more than one point is left where one must be.
    """
    dims, _ = split_dims(ds["status"])
    for name, value in (at or {}).items():
        if name not in dims:
            raise ValueError(unknown_name("axis", name, [axis_in_own_words(d, rate_of(ds))[0] for d in dims]))
        index = place(ds[name], float(value), rate_of(ds))
        ds = isel(ds, {name: slice(index, index + 1)})
    long = [d for d in dims if ds.sizes[d] > 1]
    if purpose and long:
        raise ValueError(f"{purpose}, and the run also has {_left_over(ds, long, '--at ')}")
    return ds
