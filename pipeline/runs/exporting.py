"""Write results, cubes and time series to files of other programs; `FORMATS` declares them."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.layout.conventions import netcdf_safe
from pipeline.layout.writing import netcdf_bytes, write_atomically
from pipeline.products.product import function_of
from pipeline.products.registry import ANALYSES
from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Format:
    """A kind of file: the names that it has, what it is, and ``"module:function"``, which makes the content of a
    Dataset.
    """

    pattern: str
    text: str
    content: str


FORMATS = (
    Format("*.csv", "CSV, the table of an analysis or a time series", "pipeline.runs.exporting:csv_text"),
    Format("*.nc", "NetCDF", "pipeline.runs.exporting:netcdf_content"),
    Format("*.mat", "MATLAB and Octave", "pipeline.results.matlab:matlab_bytes"),
    Format("*.dat", "a time series from which AUTO starts", "pipeline.runs.auto_files:start_text"),
    Format("*.geojson", "GeoJSON, the shapes of an atlas", "pipeline.analysis.atlas.geojson:geojson_text"),
    Format("b.*", "AUTO's table of branches", "pipeline.runs.auto_files:branches_text"),
)
"""Formats; the first whose pattern a name has is taken."""


def format_of(path: str | Path) -> Format:
    """Return the format that the name of a file asks for; raise `SpecError` if there is none, or no such folder."""
    target = Path(path)
    found = next((one for one in FORMATS if fnmatch(target.name.lower(), one.pattern)), None)
    if found is None:
        known = ", ".join(f"{one.pattern} ({one.text})" for one in FORMATS)
        raise SpecError(f"{path}: the name must be one of {known}.")
    if not target.parent.is_dir():
        raise SpecError(f"{target.parent}: no such folder; make it first.")
    return found


def save(ds: xr.Dataset, path: str | Path) -> Path:
    """Write a Dataset to a file in the format of its name, complete or not at all; return the path."""
    content = function_of(format_of(path).content)(ds)
    write_atomically(Path(path), content)
    return Path(path)


def csv_text(ds: xr.Dataset) -> str:
    """Return a result as the table that ``--csv`` writes, a time series with a column for each variable."""
    from pipeline.compute.simulate import series_csv
    from pipeline.runs.derive import shown_table

    name = str(ds.attrs.get("derived_product", ""))
    if name in ANALYSES and ANALYSES[name].table:
        return shown_table(name, ds).csv()
    if "time" in ds.sizes:
        return series_csv(ds)
    raise SpecError("*.csv: only tables of analyses and time series are; write .nc or .mat, which hold any Dataset.")


def netcdf_content(ds: xr.Dataset) -> bytes:
    """Return any Dataset as NetCDF, without empty variables: NetCDF reads a dim of length 0 as an unlimited one."""
    filled = ds.drop_vars([name for name, one in ds.variables.items() if one.size == 0])
    filled.attrs = {"source": f"magpend {metadata.version('magpend')}", **ds.attrs}
    return netcdf_bytes(netcdf_safe(filled))
