"""Write any Dataset as a MAT-file of MATLAB and Octave: variables, their dims, and all attributes.

Each variable and coordinate is an array of its name. The struct ``about`` has the rest: ``about.attributes`` of the
Dataset, and for each variable ``about.variables.NAME`` with its ``name``, its ``dims`` (a cell array), whether it is a
``coordinate``, and its ``attributes``. Names that MATLAB forbids are changed (`legal_names`), and ``about`` has the
original ones. Numbers keep their type and their bits; the order of the dims stays.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr

NAME_LENGTH = 63
"""Most characters of a name in MATLAB (``namelengthmax``)."""

VARIABLE_BYTES = 2**31 - 1
"""Largest variable of a MAT-file of version 7."""

_KEYWORDS = frozenset(
    (
        *("break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global"),
        *("if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while"),
    )
)

DESCRIPTION_BYTES = 116
"""Bytes of the description with which a MAT-file begins."""


def legal_names(names: Iterable[str]) -> dict[str, str]:
    """Return for each name one that MATLAB takes: letters, digits and underscores, a letter first, distinct."""
    found: dict[str, str] = {}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
        plain = plain if re.match(r"[A-Za-z]", plain) else f"x{plain}"
        plain = f"{plain}_" if plain in _KEYWORDS else plain
        own, n = plain[:NAME_LENGTH], 1
        while own in found.values():
            n += 1
            own = f"{plain[: NAME_LENGTH - len(str(n)) - 1]}_{n}"
        found[name] = own
    return found


def matlab_bytes(ds: xr.Dataset) -> bytes:
    """Return a Dataset as the bytes of a MAT-file, which depend on the Dataset alone.

    Raises
    ------
    SpecError
        If a variable has more bytes than a MAT-file holds.
    """
    from scipy.io import savemat

    for name, variable in ds.variables.items():
        if variable.nbytes > VARIABLE_BYTES:
            raise SpecError(
                f"{name}: has {variable.nbytes:,} bytes, and a variable of a MAT-file at most {VARIABLE_BYTES:,}; "
                "select a part of the Dataset, or write NetCDF (.nc)."
            )
    names = legal_names(["about", *map(str, ds.variables)])
    about = {names[str(name)]: _about(ds, str(name)) for name in ds.variables}
    data = {names[str(name)]: _value(variable.values) for name, variable in ds.variables.items()}
    file = io.BytesIO()
    whole = {**data, "about": {"attributes": _struct(ds.attrs), "variables": about}}
    savemat(file, whole, long_field_names=True, do_compression=True, oned_as="column")
    text = f"MATLAB 5.0 MAT-file, written by magpend {metadata.version('magpend')}".ljust(DESCRIPTION_BYTES)
    return text.encode() + file.getvalue()[DESCRIPTION_BYTES:]


def _about(ds: xr.Dataset, name: str) -> dict[str, Any]:
    dims = _value(np.array(list(map(str, ds[name].dims)), dtype=object))
    return {"name": name, "dims": dims, "coordinate": name in ds.coords, "attributes": _struct(ds[name].attrs)}


def _struct(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as the fields of a struct; if names were changed, the field ``names`` has the original ones."""
    names = legal_names(map(str, attrs))
    found = {names[str(name)]: _value(value) for name, value in attrs.items()}
    changed = {own: name for name, own in names.items() if own != name}
    return {**found, legal_names([*names.values(), "names"])["names"]: changed} if changed else found


def _value(value: Any) -> Any:
    """Return a value that `savemat` writes: texts in arrays become cells, tables become structs."""
    if isinstance(value, Mapping):
        return _struct(value)
    if isinstance(value, (list, tuple)):
        is_plain = all(isinstance(one, (int, float)) for one in value)
        value = np.array(value) if is_plain else np.array(list(map(str, value)), dtype=object)
    if isinstance(value, np.ndarray) and value.dtype.kind not in "biufc":
        return np.array([str(one) for one in value.ravel()], dtype=object).reshape(value.shape)
    return value if isinstance(value, (str, bool, int, float, complex, np.ndarray, np.generic)) else str(value)
