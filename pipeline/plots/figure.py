"""Draw a figure of a run by its name, and write figures and their data to files with their provenance.

Each figure of `pipeline.products.registry` names a function of this package, of a run and options. It reads
``run.cube()`` and ``run.derive(name, **options)``, and hands numbers to a ``plot_...`` function, which knows nothing
about runs. This module adds the request and the provenance to the figure's data.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure

from magpend_core.models.parameters import has_controls
from pipeline.layout.own_words import axis_in_own_words, rate_of
from pipeline.layout.vocabulary import split_dims, told_by
from pipeline.layout.writing import write_atomically, write_netcdf
from pipeline.plots.looks import DPI, LOCK, VECTORS
from pipeline.plots.style import DataFigure, Frame
from pipeline.products.diagrams import AnimationOptions
from pipeline.products.product import FigureOptions, Options, function_of
from pipeline.products.registry import FIGURES
from pipeline.results.run import OpenRun
from pipeline.results.selection import place, select_points, snap
from pipeline.specification.problems import unknown_name


def at_points(ds: xr.Dataset, at: Mapping[str, float] | None) -> xr.Dataset:
    """Select values of swept parameters and initial states; the dims become scalars. ValueError if one is not there."""
    _, starts = split_dims(ds["status"])
    given = dict(at or {})
    for name in [n for n in given if n in starts and n in ds.coords]:
        ds = ds.isel({name: place(ds[name], float(given.pop(name)), rate_of(ds))})
    part = select_points(ds, given)
    return part.isel(dict.fromkeys(given, 0))


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
    # XML has no place for control characters, which a dataset of others may have
    attrs = {k: "".join(c for c in v if not has_controls(c)) if isinstance(v, str) else v for k, v in attrs.items()}
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


def draw_figure(run: OpenRun, name: str, options: FigureOptions) -> DataFigure:
    """Draw a figure of a run by the figure's name, and record in its data where they come from.

    Parameters
    ----------
    run
        The run.
    name
        One of `pipeline.products.registry.FIGURES`.
    options
        The figure's options.

    Returns
    -------
    DataFigure
        The attributes of its `data` hold the provenance: the figure and its options that differ from the
        defaults, title and digest of the run, digest of the cells, model and parameters, versions,
        host, date and commit as in ``run.json``.

    Raises
    ------
    ValueError
        If the run does not have what the figure shows.
    """
    figure: DataFigure = function_of(FIGURES[name].draw)(run, options)
    figure.data = with_provenance(figure.data, {**run_provenance(run), **request(name, options)})
    for note in figure.notes:
        run.echo(note)
    return figure


def request(name: str, options: Options) -> dict[str, Any]:
    """Return what identifies a figure: its name, and the options that differ from their defaults."""
    return {"figure": name, "options": options.changed()}


def run_provenance(run: OpenRun) -> dict[str, Any]:
    """Return where a run's data come from: source, title, digests and versions."""
    info, attrs = run.info, run.cube().attrs
    found: dict[str, Any] = {
        "source": str(attrs.get("source", "magpend")),
        "run": info.title,
        "digest": info.digest,
        "cube_digest": run.digest,
        "versions": info.versions,
        **getattr(info, "provenance", {}),
    }
    return found | {key: str(value) for key, value in told_by(attrs).items()}


def frame_of(options: FigureOptions) -> Frame:
    """Return the width, the axis ranges and the style of a figure from its options."""
    return Frame(options.width, options.xlim, options.ylim, options.style, options.dpi)


def values_of(run: OpenRun, options: FigureOptions | AnimationOptions) -> tuple[dict[str, float], list[str]]:
    """Return the axis values at which a figure is drawn, and notes where they differ from the options.

    Raise ValueError, before any computation, if an axis is unknown, or lacks the value and ``nearest`` is not set.
    """
    given: Mapping[str, float] = options.at
    cube = run.cube()
    axes = [str(d) for d in cube["status"].dims if d in cube.coords]
    for name in given:
        if name not in axes:
            raise ValueError(unknown_name("axis", name, [axis_in_own_words(d, rate_of(cube))[0] for d in axes]))
    if not options.nearest:
        for name, value in given.items():
            place(cube[name], value, rate_of(cube))
        return dict(given), []
    found = snap(cube, given)
    notes = []
    for axis, value in found.items():
        if abs(value - given[axis]) > 1e-6 * max(abs(value), 1e-300):
            name, own = axis_in_own_words(axis, rate_of(cube))
            asked, near = float(own(given[axis])), float(own(value))
            notes.append(f"{name} = {asked:.10g} is not on its axis; drawn at the nearest, {near:.10g}")
    return found, notes


def noted(figure: DataFigure, notes: list[str]) -> DataFigure:
    """Add notes for the user to a figure, and return the figure."""
    figure.notes.extend(notes)
    return figure
