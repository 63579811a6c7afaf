"""Write and read blocks of an unfinished product: a file each, so that a block costs one write on any file system."""

from __future__ import annotations

import io
import json
import zipfile
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.store.errors import DamagedError
from pipeline.store.files import Files
from pipeline.store.products import coded, plain, with_words

if TYPE_CHECKING:
    import xarray as xr

_ABOUT = "about.json"


def write_block(files: Files, key: str, ds: xr.Dataset) -> None:
    """Write a dataset to a file, whole or not at all."""
    arrays, variables = {}, {}
    for name in map(str, ds.variables):
        arrays[name], attrs = coded(name, ds.variables[name])
        variables[name] = [list(map(str, ds.variables[name].dims)), attrs]
    about = {"attrs": plain(ds.attrs), "coords": list(map(str, ds.coords)), "variables": variables}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(_ABOUT, json.dumps(about))
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
    files.write(key, content.getvalue())


def read_block(files: Files, key: str) -> xr.Dataset:
    """Read a dataset that `write_block` has written.

    Raises
    ------
    FileNotFoundError
        If there is none.
    DamagedError
        If its content has changed.
    """
    import xarray as xr

    try:
        with zipfile.ZipFile(io.BytesIO(files.read(key))) as archive:
            about: dict[str, Any] = json.loads(archive.read(_ABOUT))
            variables = {
                name: (
                    dims,
                    np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False),
                    attrs,
                )
                for name, (dims, attrs) in about["variables"].items()
            }
        ds = xr.Dataset({name: xr.Variable(*parts) for name, parts in variables.items()}, attrs=about["attrs"])
        ds = ds.set_coords(about["coords"])
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{files.name}/{key}: {error}") from None
    return ds.assign(with_words(ds))
