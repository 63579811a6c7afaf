"""What results of analyses lack of their declarations."""

from __future__ import annotations

from collections.abc import Iterator

import xarray as xr

from pipeline.layout.own_words import with_plain_names
from pipeline.layout.vocabulary import is_start_dim
from pipeline.products.column import POINTS, STARTS, Column
from pipeline.products.registry import ANALYSES


def complaints(ds: xr.Dataset, name: str, cube: xr.Dataset) -> Iterator[str]:
    """Yield what is missing in the result of an analysis: a declaration, its dims, a meaning, a unit, an own name."""
    columns = {column.name: column for column in ANALYSES[name].columns}
    yield from (f"{c.name}: has no own name" for c in columns.values() if c.own and c.name in ds.data_vars)
    ds = with_plain_names(ds)
    for key, variable in ds.variables.items():
        column, attrs = columns.get(str(key)), variable.attrs
        if column is None:
            # of the cube, or one for each parameter, quantity or axis, which says itself what it is
            if key not in cube.variables and attrs["long_name"] == str(key).replace("_", " "):
                yield f"{key}: not declared"
        elif (found := _dims(variable.dims, column, cube)) != (wanted := _without(column.dims.split(), found)):
            yield f"{key}: dims {found}, declared {wanted}"
        elif "long_name" not in attrs:
            yield f"{key}: no meaning"
        is_number = variable.dtype.kind in "iuf"
        has_units = {"units", "units_as_given"} & attrs.keys() or "units of the comp" in attrs.get("comment", "")
        if is_number and not has_units:
            yield f"{key}: no unit"


def _dims(dims: tuple[object, ...], column: Column, cube: xr.Dataset) -> list[str]:
    """Return dims as columns declare them: those of cells by their signs."""
    found: list[str] = []
    for dim in map(str, dims):
        is_cells = dim in cube["status"].dims and dim not in column.dims.split()
        word = (STARTS if is_start_dim(dim) else POINTS) if is_cells else dim
        found += [word] if word not in (POINTS, STARTS) or word not in found else []
    return found


def _without(declared: list[str], found: list[str]) -> list[str]:
    """Return declared dims without those of cells where the run has none, and with the model's own word for angles."""
    own = [dim for dim in found if dim not in declared]
    declared = [own[0] if dim == "angle" and "angle" not in found and own else dim for dim in declared]
    return [dim for dim in declared if dim in found or dim not in (POINTS, STARTS)]
