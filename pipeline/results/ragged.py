"""Rows of sets: one for each set on which cells end at each parameter point, in the order of the points.

A result keeps them as contiguous ragged arrays (CF conventions, section 9.3.3): ``n_sets`` (parameter dims) is the
number of rows of each point along the dim ``set``, and ``n_points`` (set) is the number of section points of each row
along the dim ``sample``. The coordinate ``attractor`` (set) holds ids. So memory grows with the number of rows alone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

SET, SAMPLE, TRANSITION = "set", "sample", "transition"
"""Dims of the rows, of their section points, and of the counts of cells that left one set for another."""

ROW_SIZE, N_POINTS, N_IDS = "n_sets", "n_points", "n_ids"
"""Numbers of rows of each parameter point, of section points of each row, and (an attribute) of ids."""


def is_ragged(ds: xr.Dataset) -> bool:
    """Return whether a dataset has rows of sets."""
    return ROW_SIZE in ds


def dims_of(ds: xr.Dataset) -> tuple[str, ...]:
    """Return the parameter dims of a result with rows."""
    return tuple(str(d) for d in ds[ROW_SIZE].dims)


def point_of_rows(ds: xr.Dataset) -> np.ndarray:
    """Return for each row the number of its parameter point, in C order of the parameter dims."""
    sizes = ds[ROW_SIZE].values.ravel()
    return np.repeat(np.arange(sizes.size), sizes)


def index_of_rows(ds: xr.Dataset) -> tuple[np.ndarray, ...]:
    """Return for each row its index along each parameter dim."""
    return tuple(np.unravel_index(point_of_rows(ds), ds[ROW_SIZE].shape)) if ds[ROW_SIZE].ndim else ()


def places_of_rows(ds: xr.Dataset, dims: Sequence[str]) -> list[np.ndarray]:
    """Return the value of each parameter dim at each row; its index where it has no coordinate."""
    index = dict(zip(dims_of(ds), index_of_rows(ds), strict=True))
    return [ds[d].values[index[d]] if d in ds.coords else index[d] for d in dims]


def row_of_cells(ds: xr.Dataset) -> np.ndarray:
    """Return for each cell the row of its set, -1 for none, on the parameter dims and then the start dims."""
    dims = dims_of(ds)
    starts = [d for d in ds["attractor_id"].dims if d not in dims]
    ids = ds["attractor_id"].transpose(*dims, *starts).values
    width = int(ds.attrs[N_IDS]) + 1  # the last place of each point is of cells without a set
    table = np.full((ds[ROW_SIZE].size, width), -1, np.int64)
    table[point_of_rows(ds), ds["attractor"].values] = np.arange(ds.sizes[SET])
    points = np.arange(ds[ROW_SIZE].size).reshape(*ds[ROW_SIZE].shape, *(1 for _ in starts))
    return np.asarray(table[points, ids])


def rows_at(ds: xr.Dataset) -> dict[tuple[int, ...], range]:
    """Return the rows of each parameter point."""
    ends = np.cumsum(ds[ROW_SIZE].values.ravel())
    begins = np.concatenate([[0], ends[:-1]])
    places = np.ndindex(*ds[ROW_SIZE].shape)
    return {at: range(int(a), int(b)) for at, a, b in zip(places, begins, ends, strict=True)}


def points_of_rows(ds: xr.Dataset) -> list[np.ndarray]:
    """Return the section points of each row, (point, state)."""
    points = ds["attractor_points"].transpose(SAMPLE, "state").values
    return np.split(points, np.cumsum(ds[N_POINTS].values)[:-1]) if ds.sizes[SET] else []


def isel(ds: xr.Dataset, at: Mapping[Any, Any]) -> xr.Dataset:
    """Select along dims by position, as `xarray.Dataset.isel`, together with the rows of the points that are left.

    Parameters
    ----------
    ds
        Dataset, with rows or without. Slices and arrays of positions must rise.
    at
        Position, slice or array of positions by dim; the dim of the rows is not among them.
    """
    here = {k: v for k, v in at.items() if k in ds[ROW_SIZE].dims} if is_ragged(ds) else {}
    if not here:
        return ds.isel(at)
    numbers = xr.DataArray(np.arange(ds[ROW_SIZE].size).reshape(ds[ROW_SIZE].shape), dims=ds[ROW_SIZE].dims)
    left = np.zeros(numbers.size, bool)
    left[numbers.isel(here).values.ravel()] = True
    return take(ds.isel(at), np.flatnonzero(left[point_of_rows(ds)]))


def take(ds: xr.Dataset, rows: np.ndarray) -> xr.Dataset:
    """Return a dataset with some of its rows, in their order."""
    chosen = {SET: rows}
    sizes = ds[N_POINTS].values if N_POINTS in ds and SAMPLE in ds.dims else None
    if sizes is not None:
        begins = np.cumsum(sizes) - sizes
        parts = [np.arange(begins[i], begins[i] + sizes[i]) for i in rows.tolist()]
        chosen[SAMPLE] = np.concatenate(parts) if parts else np.zeros(0, np.int64)
    if TRANSITION in ds.dims:
        new = np.full(ds.sizes[SET], -1, np.int64)
        new[rows] = np.arange(len(rows))
        origin = new[ds["from_set"].values]
        chosen[TRANSITION] = np.flatnonzero(origin >= 0)
        ds = ds.assign(from_set=ds["from_set"].copy(data=origin))
    return ds.isel(chosen)


def joined(parts: Sequence[xr.Dataset], blocks: Sequence[Mapping[str, slice]], sizes: Mapping[str, int]) -> xr.Dataset:
    """Join the results of blocks of parameter points to the result of all points.

    Parameters
    ----------
    parts
        Result of each block. What is neither on the parameter dims nor on rows is taken from the first.
    blocks
        Slice of each parameter dim, by block, in the C order of the points.
    sizes
        Size of each parameter dim.
    """
    first = parts[0]
    of_rows = {SET, SAMPLE, TRANSITION} if is_ragged(first) else set()
    n_rows = np.cumsum([0, *(part.sizes.get(SET, 0) for part in parts)])
    variables: dict[str, Any] = {}
    for name, variable in first.variables.items():
        own = [part.variables[name] for part in parts]
        dims = set(map(str, variable.dims))
        if name == "from_set":
            own = [one.copy(data=one.values + n) for one, n in zip(own, n_rows[:-1], strict=True)]
        if dims & of_rows:
            values = np.concatenate([one.values for one in own])
            variables[str(name)] = xr.Variable(variable.dims, values, variable.attrs)
        elif dims & sizes.keys():
            whole = np.empty([sizes.get(str(d), n) for d, n in variable.sizes.items()], variable.dtype)
            for one, block in zip(own, blocks, strict=True):
                whole[tuple(block.get(str(d), slice(None)) for d in variable.dims)] = one.values
            variables[str(name)] = xr.Variable(variable.dims, whole, variable.attrs)
        else:
            variables[str(name)] = variable
    coords = {name: variables.pop(str(name)) for name in first.coords}
    attrs = dict(first.attrs)
    if N_IDS in attrs:
        attrs[N_IDS] = max(int(part.attrs[N_IDS]) for part in parts)
    return xr.Dataset(variables, coords, attrs)


def stacked(parts: Sequence[xr.Dataset], dim: str) -> xr.Dataset:
    """Join results along the dim of their rows; pad them along other dims with NaN to the longest.

    What has no rows is taken from the first.
    """
    first = parts[0]
    longest = {str(d): max(part.sizes[d] for part in parts) for d in first.dims if d != dim}
    variables: dict[str, xr.Variable] = {}
    for name, variable in first.variables.items():
        if dim in variable.dims:
            own = [_padded_to(part.variables[name], longest) for part in parts]
            values = np.concatenate(own, axis=variable.dims.index(dim))
            variables[str(name)] = xr.Variable(variable.dims, values, variable.attrs)
        else:
            variables[str(name)] = variable
    return xr.Dataset(variables, attrs=first.attrs).set_coords([str(name) for name in first.coords])


def _padded_to(variable: xr.Variable, sizes: Mapping[str, int]) -> np.ndarray:
    more = [(0, sizes.get(str(d), n) - n) for d, n in variable.sizes.items()]
    return np.pad(variable.values, more, constant_values=np.nan) if any(n for _, n in more) else variable.values


def dense(ds: xr.Dataset, names: Collection[str] = (), *, points: bool = False) -> xr.Dataset:
    """Return a result with its rows on the parameter dims and the dim ``attractor``, over all ids of the run.

    It is as large as the number of parameter points times the number of ids. Figures use it, and analyses of single
    parameter points.

    Parameters
    ----------
    ds
        Result; one without rows is returned as it is.
    names
        Variables of sets to keep; all if none is named.
    points
        Whether to keep the section points, on the dim ``point``.

    Returns
    -------
    Dataset
        Where a point lacks a set, numbers are NaN, counts, codes and shares 0, and ids of other sets -1.
    """
    if not is_ragged(ds):
        return ds
    dims, own = dims_of(ds), ds["attractor"].values
    ids = np.union1d(own[own < 0], np.arange(int(ds.attrs[N_IDS]))).astype(np.int32)
    at = (*index_of_rows(ds), np.searchsorted(ids, own))
    found: dict[str, Any] = {}
    for name, variable in ds.data_vars.items():
        if SET in variable.dims and not (name == N_POINTS and SAMPLE in ds.dims) and (name in names or not names):
            rows = variable.transpose(SET, ...)
            found[str(name)] = (rows.dims[1:], rows.values, variable.attrs)
    if points and "attractor_points" in ds:
        own_points = padded(points_of_rows(ds), ds.sizes["state"])
        found["attractor_points"] = (("point", "state"), own_points, ds["attractor_points"].attrs)
    result = ds.drop_dims([SET, SAMPLE, TRANSITION], errors="ignore").drop_vars(ROW_SIZE)
    for name, (own_dims, values, attrs) in found.items():
        table = np.full((*ds[ROW_SIZE].shape, len(ids), *values.shape[1:]), _fill(name, values.dtype), values.dtype)
        table[at] = values
        result[name] = ((*dims, "attractor", *own_dims), table, attrs)
    return result.assign_coords(attractor=("attractor", ids, ds["attractor"].attrs))


def _fill(name: str, dtype: np.dtype[Any]) -> float:
    if name == "mirror_partner" or name.endswith("_to"):
        return -1
    return 0 if dtype.kind in "iu" or name in ("share", "fraction") else np.nan


def padded(rows: Sequence[np.ndarray], n_states: int) -> np.ndarray:
    """Return lists of points, each (any, n_states), as one array (row, point, state); NaN beyond the end of a list."""
    table = np.full((len(rows), max(map(len, rows), default=0), n_states), np.nan)
    for one, points in zip(table, rows, strict=True):
        one[: len(points)] = points
    return table


def sets(ds: xr.Dataset) -> xr.Dataset:
    """Return the rows of a result as a dataset of their own: dim ``set``, with ``attractor_id`` and the values of the
    swept parameters as coordinates along it.

    Examples
    --------
    ``sets(found)["share"].groupby("attractor_id").sum()``; ``sets(found).drop_dims("sample").to_dataframe()``
    """
    index = index_of_rows(ds)
    own = [str(k) for k, v in ds.variables.items() if v.dims and set(v.dims).isdisjoint(_cell_dims(ds))]
    rows = ds[own].drop_vars("attractor")
    axes = {d: (SET, ds[d].values[i], ds[d].attrs) for d, i in zip(dims_of(ds), index, strict=True) if d in ds.coords}
    scalars = {k: v for k, v in ds.coords.items() if not v.ndim}
    number = (SET, ds["attractor"].values, ds["attractor"].attrs)
    return rows.assign_coords({**scalars, **axes, "attractor_id": number}).assign_attrs(ds.attrs)


def _cell_dims(ds: xr.Dataset) -> set[Any]:
    return {*ds[ROW_SIZE].dims, *(ds["attractor_id"].dims if "attractor_id" in ds else ())}
