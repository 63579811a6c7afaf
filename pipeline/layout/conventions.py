"""Describe variables by the attributes of the CF conventions, and write units and attributes that other programs read.

Attributes are not part of a run's identity. They are written into new cubes, and added when a cube or a stored
result of an analysis is opened, so that results of earlier versions have them, too.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pipeline.layout.vocabulary import BRANCH

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model

CONVENTIONS = "CF-1.11"

GIVEN = "units_as_given"
"""Attribute of a variable with a unit that UDUNITS and pint do not both know; it then has no ``units``."""

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


_PREFIXES = ("", "n", "u", "m", "c", "d", "k", "M", "G")
_BASE = ("m", "g", "s", "A", "K", "mol", "cd", "rad")
_DERIVED = ("Hz", "N", "Pa", "J", "W", "C", "V", "F", "ohm", "S", "Wb", "T", "H", "bar", "L", "l", "eV")
_ALONE = ("radian", "radians", "sr", "degree", "degrees", "degC", "min", "h", "hour", "d", "day", "lm", "lx", "%")
_WORDS = ("meter", "metre", "second", "seconds", "kilogram", "newton", "hertz", "volt", "ampere", "kelvin", "percent")
_KNOWN = frozenset({*_ALONE, *_WORDS, *(prefix + unit for prefix in _PREFIXES for unit in (*_BASE, *_DERIVED))})
_SAME = {"deg": "degree", "°": "degree", "Ω": "ohm", "Ohm": "ohm", "µm": "um", "μm": "um", "sec": "s", "1": "1"}
"""Symbols that one of the two lacks or reads otherwise, and what both read."""
_COUNTS = ("", "-", "cells", "nat", "none", "dimensionless", "count", "counts")
"""Texts for numbers without a unit. pint reads `nat` as a nano-atmosphere."""

_TOKEN = re.compile(r"\s*(\*\*|[-+]?\d+|[/*.·^()]|[A-Za-zµμΩ°%]+)|\s*$")


def readable_unit(text: str) -> str | None:
    """Return a unit in a form that UDUNITS and pint read alike, such as ``m/s^2`` for ``m/s2``; None if there is none.

    Products are written with a blank or ``*``, quotients with ``/``, powers as in ``s2``, ``s^2``, ``s**2`` or
    ``s-1``. Symbols are those of the SI with the usual prefixes, and some that are used beside it (``degree``,
    ``min``, ``h``, ``%``). A text for a number without a unit becomes ``1``.
    """
    if text.strip() in _COUNTS:
        return "1"
    tokens: list[str] = []
    at = 0
    while at < len(text.rstrip()):
        match = _TOKEN.match(text, at)
        if match is None or not match[1]:
            return None
        tokens.append(match[1])
        at = match.end()
    found, left = _product(tokens)
    return found if found is not None and not left else None


def _product(tokens: list[str]) -> tuple[str | None, list[str]]:
    """Parse factors with ``/``, ``*`` or nothing between them; return their text and the tokens that are left."""
    text, left = _factor(tokens)
    while text is not None and left and left[0] != ")":
        sign = "/" if left[0] == "/" else " "
        factor, left = _factor(left[1:] if left[0] in ("/", "*", ".", "·") else left)
        text = None if factor is None else f"{text}{sign}{factor}"
    return text, left


def _factor(tokens: list[str]) -> tuple[str | None, list[str]]:
    """Parse a symbol with its power, a 1, or a product in parentheses."""
    if not tokens:
        return None, tokens
    first, left = tokens[0], tokens[1:]
    if first == "(":
        inner, left = _product(left)
        text = f"({inner})" if inner is not None and left[:1] == [")"] else None
        return text, left[1:]
    symbol = _SAME.get(first, first)
    if symbol != "1" and symbol not in _KNOWN:
        return None, left
    marked = left[:1] in (["^"], ["**"])
    power = left[int(marked) : int(marked) + 1]
    if power and re.fullmatch(r"[-+]?\d+", power[0]) and symbol != "1":
        return f"{symbol}^{int(power[0])}", left[int(marked) + 1 :]
    return (None if marked else symbol), left


def shown_unit(attrs: Mapping[Any, Any], default: str = "1") -> str:
    """Return the unit of a variable for labels and tables, as models write it: ``m/s2``."""
    return str(attrs.get(GIVEN, attrs.get("units", default))).replace("^", "")


def unit_remarks(model: Model) -> list[str]:
    """Return a line of text if a model has units that UDUNITS and pint do not both know, with their names."""
    units = [(entry.name, entry.unit) for entry in model.states]
    units += [(entry.name, entry.unit) for entry in model.parameters]
    units += [(entry.name, entry.unit) for entry in model.quantities]
    unknown: dict[str, list[str]] = {}
    for name, unit in units:
        if readable_unit(unit) is None:
            unknown.setdefault(unit, []).append(name)
    if not unknown:
        return []
    named = "; ".join(f"{unit!r} of {', '.join(names)}" for unit, names in unknown.items())
    return [
        f"units that other programs cannot read: {named}. Opened Datasets have them in the attribute {GIVEN} "
        "instead of units; write SI units such as m/s2, or 1, for results that pint-xarray converts."
    ]


def code_flags(words: Sequence[str]) -> dict[str, Any]:
    """Return the CF flag attributes of a variable with the codes 0, 1, ...: its values, and their labels `words`."""
    return {"flag_values": np.arange(len(words), dtype=np.int8), "flag_meanings": " ".join(words)}


def netcdf_safe(ds: xr.Dataset) -> xr.Dataset:
    """Return a copy of a dataset with all attributes converted to the types that NetCDF accepts."""
    safe = ds.copy(deep=False)
    safe.attrs = safe_attributes(ds.attrs)
    for variable in safe.variables.values():
        variable.attrs = safe_attributes(variable.attrs)
    return safe


def safe_attributes(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Return dataset attributes converted to the types that NetCDF accepts.

    Truth values become 0 and 1. A list of texts becomes one text, joined by spaces. Other lists and tables
    become JSON. None is left out.
    """
    return {str(name): _safe(value) for name, value in attrs.items() if value is not None}


def _safe(value: Any) -> Any:
    if isinstance(value, (bool, np.bool_)):
        return int(value)
    if isinstance(value, Mapping):
        return json.dumps(value, sort_keys=True)
    if isinstance(value, (list, tuple, np.ndarray)):
        items = np.asarray(value).tolist() if isinstance(value, np.ndarray) else list(value)
        if isinstance(items, list) and items and all(isinstance(item, str) for item in items):
            return " ".join(items)
        numbers = isinstance(items, list) and all(
            isinstance(item, (int, float)) and not isinstance(item, bool) for item in items
        )
        return value if numbers else json.dumps(items)
    return value
