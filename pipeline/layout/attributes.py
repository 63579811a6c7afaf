"""Convert dataset attributes to types that every file format accepts: numbers, lists of numbers, texts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr


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
