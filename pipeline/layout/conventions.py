"""Describe variables by the attributes of the CF conventions, from which cf-xarray and pint-xarray read axes and units.

Attributes are not part of a run's identity. They are written into new cubes, and added when a cube or a stored
result of an analysis is opened, so that results of earlier versions have them, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.layout.units import GIVEN, readable_unit
from pipeline.layout.vocabulary import BRANCH

if TYPE_CHECKING:
    import xarray as xr

CONVENTIONS = "CF-1.11"

AXES = ("X", "Y", "Z")
"""Values of the attribute ``axis`` for the first dims with values on a continuous scale."""

ADDED = {
    "units": "of numbers, in a form that UDUNITS and pint read, such as `m/s^2`",
    GIVEN: "instead of `units`: a unit of the model's text that they do not know, such as `widgets`",
    "long_name": "the meaning in words",
    "standard_name": "`status_flag` for the status of cells, `quality_flag` for flags of trust, `time`, `realization`",
    "axis": "`X`, `Y`, `Z` for the first dims with a coordinate of floats with a unit; `T` for time",
    "cf_role": "`trajectory_id` for the branches of a continuation",
    "flag_values": "codes, in the type of the variable",
    "flag_meanings": "their words",
    "ancillary_variables": "the status of the cells, and errors and flags of the variable",
}
"""Attributes of variables, with their contents. A cell is computed at its coordinates, so these have no ``bounds``."""

_STANDARD_NAMES = {"status": "status_flag", "time": "time", "realization": "realization"}
_FLAG = "_flag"
_ANCILLARY = ("_stderr", "_error", "_low", "_high", _FLAG)
"""Ends of names of variables that qualify the variable with the name before them."""


_OWN = ("standard_name", "axis", "cf_role", "ancillary_variables")
"""Attributes that are given here alone."""


class Described(NamedTuple):
    """A variable to describe: its dims, its data type, its attributes."""

    dims: tuple[str, ...]
    dtype: np.dtype[Any]
    attrs: Mapping[str, Any]


def conventional(ds: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the attributes of the CF conventions; values and existing texts stay.

    `ADDED` lists the attributes.
    """
    entries = {
        str(name): Described(tuple(map(str, v.dims)), v.dtype, {str(k): a for k, a in v.attrs.items()})
        for name, v in ds.variables.items()
    }
    found = ds.copy(deep=False)
    for name, attrs in conventional_attributes(entries).items():
        if "flag_values" in attrs:  # CF: of the type of the variable
            attrs["flag_values"] = np.asarray(attrs["flag_values"], entries[name].dtype)
        found.variables[name].attrs = attrs
    found.attrs = {"Conventions": CONVENTIONS, **ds.attrs}
    return found


def conventional_attributes(entries: Mapping[str, Described]) -> dict[str, dict[str, Any]]:
    """Return the attributes of all variables of a dataset, by name, with those of the CF conventions; see `ADDED`."""
    axes = dict(zip(_continuous(entries), AXES, strict=False))
    found = {}
    for name, entry in entries.items():
        # an analysis may have copied attributes of another variable
        attrs = {key: value for key, value in _with_units(entry).items() if key not in _OWN}
        attrs.setdefault("long_name", name.replace("_", " "))
        standard = "quality_flag" if name.endswith(_FLAG) else _STANDARD_NAMES.get(name)
        if standard and not (name == "time" and attrs.get("units") != "s"):
            attrs["standard_name"] = standard
        if name in axes:
            attrs["axis"] = axes[name]
        if attrs.get("standard_name") == "time" and entry.dims == (name,):
            attrs["axis"] = "T"
        if name == BRANCH and entry.dims == (BRANCH,):
            attrs["cf_role"] = "trajectory_id"
        if others := _ancillary(name, entries):
            attrs["ancillary_variables"] = " ".join(others)
        found[name] = attrs
    return found


def _continuous(entries: Mapping[str, Described]) -> list[str]:
    """Return the dims with a coordinate of floats that has a unit, in the order of the variable with the most dims."""
    no_dims: tuple[str, ...] = ()
    dims = max((entry.dims for entry in entries.values()), key=len, default=no_dims)
    rest = (dim for entry in entries.values() for dim in entry.dims)
    own = [dim for dim in dict.fromkeys([*dims, *rest]) if dim in entries and entries[dim].dims == (dim,)]
    return [d for d in own if entries[d].dtype.kind == "f" and d != "time" and {"units", GIVEN} & set(entries[d].attrs)]


def _with_units(entry: Described) -> dict[str, Any]:
    attrs = dict(entry.attrs)
    given = attrs.get("units")
    if given is None:
        return attrs
    del attrs["units"]
    if entry.dtype.kind not in "biuf":
        return attrs
    if str(given).startswith("see ") or "," in str(given):
        return {"comment": f"units of the components: {given}", **attrs}
    units = readable_unit(str(given))
    return {GIVEN: str(given), **attrs} if units is None else {"units": units, **attrs}


def _ancillary(name: str, entries: Mapping[str, Described]) -> list[str]:
    """Return the variables that qualify another: its errors and flags, and the status of the cells."""
    if name in entries[name].dims or name == "status":
        return []
    found = [name + end for end in _ANCILLARY if name + end in entries]
    cells = entries["status"].dims if "status" in entries else ()
    inside = bool(cells) and entries[name].dims[: len(cells)] == cells and not name.endswith(_ANCILLARY)
    return [*found, *(["status"] if inside else [])]
