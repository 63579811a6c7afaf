"""Write figures to files, and the data that they show beside them, both with their provenance."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure

from pipeline.layout.writing import write_atomically, write_netcdf
from pipeline.plots.looks import DPI, LOCK, VECTORS
from pipeline.plots.style import DataFigure

SUFFIXES = (".png", ".pdf", ".svg")
VECTOR_DPI = 400
"""Resolution of the images inside PDF and SVG files, which get magnified."""


def save_figure(fig: Figure, path: str | Path) -> Path:
    """Write a figure as PNG, PDF or SVG; the suffix of the path decides.

    The file holds no time stamp of its own and no random identifier: the same figure gives the same bytes
    with the same version of matplotlib. Texts of PDF and SVG stay texts; PDF embeds the fonts as outlines.
    The file is written only after the drawing is complete.

    Parameters
    ----------
    fig
        The figure. The attributes of the data of a `DataFigure` go into the file's metadata.
    path
        File to write; the folder must exist. An existing file is replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ValueError
        If the suffix is none of .png, .pdf, .svg.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(
            f"cannot write a figure as {str(path)!r}: the suffix {path.suffix!r} is not one of {', '.join(SUFFIXES)}"
        )
    buffer = io.BytesIO()
    options: dict[str, Any] = {
        "format": suffix[1:],
        "dpi": _dpi(fig, suffix),
        "metadata": _metadata(fig.data.attrs if isinstance(fig, DataFigure) else {}, suffix),
        "facecolor": fig.get_facecolor(),
    }
    with LOCK, rc_context(VECTORS):
        fig.savefig(buffer, **options)
    write_atomically(path, buffer.getvalue())
    return path


def save_data(fig: DataFigure, path: str | Path) -> Path:
    """Write the data of a figure as NetCDF beside the figure's file, with the suffix ``.nc``.

    Empty variables are left out, because NetCDF reads a dim of length 0 as an unlimited one.
    """
    target = Path(path).with_suffix(".nc")
    empty = [name for name, variable in fig.data.variables.items() if variable.size == 0]
    write_netcdf(target, fig.data.drop_vars(empty))
    return target


def with_provenance(ds: xr.Dataset, provenance: Mapping[str, Any]) -> xr.Dataset:
    """Add provenance to the attributes of a dataset. Values other than text or numbers become JSON."""
    plain = {
        key: value if isinstance(value, str | int | float) else json.dumps(value, sort_keys=True)
        for key, value in provenance.items()
    }
    return ds.assign_attrs({**ds.attrs, **plain})


def _dpi(fig: Figure, suffix: str) -> float:
    if not isinstance(fig, DataFigure):
        return DPI if suffix == ".png" else VECTOR_DPI
    return fig.file_dpi if suffix == ".png" else fig.frame.dpi or VECTOR_DPI


def _metadata(attrs: Mapping[Any, Any], suffix: str) -> dict[str, Any]:
    title, source = str(attrs.get("title", "")), str(attrs.get("source", "magpend"))
    rest = {k: v for k, v in attrs.items() if isinstance(v, str | int | float) and k not in ("title",)}
    about = "; ".join(f"{key}: {value}" for key, value in rest.items()).replace("\n", ", ")
    if suffix == ".png":
        return {"Title": title, "Source": source, "Description": about} if attrs else {}
    if suffix == ".pdf":
        own = {"Title": title, "Creator": source, "Subject": about} if attrs else {}
        return {**own, "CreationDate": None}
    own = {"Title": title, "Source": source, "Description": about} if attrs else {}
    return {**own, "Date": None}
