"""Write figures to files: the picture and the data it shows, both with their provenance."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import xarray as xr
from matplotlib.figure import Figure

from pipeline.layout.writing import write_atomically, write_netcdf
from pipeline.plots.style import DPI, TEXT_LOCK, DataFigure

SUFFIXES = (".png", ".pdf", ".svg")
VECTOR_DPI = 400
"""Resolution of the images inside PDF and SVG files, which get magnified."""

_SETTINGS: dict[str, Any] = {"svg.hashsalt": "magpend", "svg.fonttype": "none", "pdf.fonttype": 42}


def save_figure(fig: Figure, path: str | Path) -> Path:
    """Write a figure as PNG, PDF or SVG, chosen by the suffix of the path.

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
        "dpi": DPI if suffix == ".png" else VECTOR_DPI,
        "metadata": _metadata(fig.data.attrs if isinstance(fig, DataFigure) else {}, suffix),
        "facecolor": "white",
    }
    with TEXT_LOCK:
        if suffix == ".png":
            fig.savefig(buffer, **options)
        else:
            _save_vectors(fig, buffer, options)
    write_atomically(path, buffer.getvalue())
    return path


def save_data(fig: DataFigure, path: str | Path) -> Path:
    """Write the data of a figure as NetCDF, next to the figure's file and with the suffix ``.nc``.

    Empty variables are left out, because NetCDF reads a dim of length 0 as an unlimited one.
    """
    target = Path(path).with_suffix(".nc")
    empty = [name for name, variable in fig.data.variables.items() if variable.size == 0]
    write_netcdf(target, fig.data.drop_vars(empty))
    return target


def with_provenance(ds: xr.Dataset, provenance: Mapping[str, Any]) -> xr.Dataset:
    """Return a dataset with its provenance added to the attributes; values other than text or numbers become JSON."""
    plain = {
        key: value if isinstance(value, str | int | float) else json.dumps(value, sort_keys=True)
        for key, value in provenance.items()
    }
    return ds.assign_attrs({**ds.attrs, **plain})


def _metadata(attrs: Mapping[Any, Any], suffix: str) -> dict[str, Any]:
    """Return the metadata of a figure file under the keys that its format defines."""
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


def _save_vectors(fig: Figure, buffer: io.BytesIO, options: dict[str, Any]) -> None:
    """Save a figure as PDF or SVG, with text kept as text and with reproducible identifiers.

    matplotlib reads these options from its shared settings only. The keys are set while the lock is held;
    all others stay unchanged.
    """
    settings: Any = matplotlib.rcParams
    before = {key: settings[key] for key in _SETTINGS}
    settings.update(_SETTINGS)
    try:
        fig.savefig(buffer, **options)
    finally:
        settings.update(before)
