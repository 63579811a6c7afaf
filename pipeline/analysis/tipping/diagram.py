"""Draw which trajectories track, return and tip, over one or two swept numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from pipeline.analysis.tipping.declaration import COURSES, TippingFigureOptions, TippingOptions
from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import START, axis_name, split_dims
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.selection import place
from pipeline.results.tabular import plain

COLOURS = (palette.GREYS["not settled"], style.BLUE, style.ORANGE, style.VERMILLION, style.PURPLE)
"""Colours of `COURSES`, which those who are blind to colours can tell apart."""

_CRITICAL: dict[str, Any] = {"linestyle": "none", "color": "black", "zorder": 4}


@style.drawn
def plot_tipping(
    ds: xr.Dataset, *, start: int = 0, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw whether trajectories track, return or tip, as a map over two swept numbers or as bands over one.

    Parameters
    ----------
    ds
        Result of `pipeline.analysis.tipping.analysis.tipping`.
    start
        Number of the initial condition of a map; bands show all.
    at
        Values of further swept numbers.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Lines lie between different courses, and dots on the critical values that were bisected. Its `data` hold
        ``course`` and the critical values that are drawn.

    Raises
    ------
    ValueError
        If more than two swept numbers are left, or there is no such initial condition.
    """
    x = axis_name(str(ds.attrs["parameter"]))
    part = _selected(ds, at, x)
    left, _ = split_dims(part["course"])
    others = [d for d in left if d != x]
    if len(others) > 1 or x not in left:
        raise ValueError(
            "a diagram has the swept number of --parameter, and at most one other; left are "
            f"{', '.join(left) or 'none'}: choose values of others with --at"
        )
    y = others[0] if others else START
    if others:
        n = part.sizes[START]
        if not 0 <= start < n:
            raise ValueError(f"start = {start}: the run has the initial conditions 0 to {n - 1}")
        part = part.isel({START: start}).sel(critical=part["critical_start"].values == start)
    data = part[["course", *(name for name in part if str(name).startswith("critical_"))]]
    data = data.assign_attrs({**ds.attrs, "title": "tracking and tipping"})
    codes = data["course"].transpose(y, x).values
    shown = np.unique(codes)
    entries: list[palette.Entry] = [(plain(COURSES[k]), COLOURS[k]) for k in (*shown[shown > 0], *shown[shown == 0])]
    if data.sizes["critical"]:
        entries.append(style.dot("critical value", "black", 2.5))
    fig, ax = palette.new_panel(data, entries, frame, 4.3 if others else 1.6 + 0.4 * min(data.sizes[y], 8))
    edges = [style.edges(data[d].values.astype(np.float64)) for d in (x, y)]
    looks: dict[str, Any] = {"cmap": ListedColormap(COLOURS), "vmin": -0.5, "vmax": len(COLOURS) - 0.5}
    ax.pcolormesh(*edges, codes, rasterized=True, gid="courses", **looks)
    _draw_borders(ax, codes, *edges)
    heights = data[f"critical_at_{y}"] if others else data["critical_start"]
    ax.plot(data["critical_value"], heights, marker="o", markersize=2.5, gid="critical", **_CRITICAL)
    style.limits(ax, frame, style.span(data[x].values), style.span(data[y].values))
    style.label_axes(ax, labels.parameter_label(data[x]), labels.parameter_label(data[y]))
    if not others:
        ax.set_yticks(data[y].values[:: -(-data.sizes[y] // 8)])
    style.caption(ax, labels.caption(part, drop=[x, y]), 1.0 if frame.compact else 0.85)
    style.finish(fig)
    return fig


def _selected(ds: xr.Dataset, at: Mapping[str, float] | None, x: str) -> xr.Dataset:
    """Select values of swept numbers, and number the initial conditions along one dim."""
    keep = np.ones(ds.sizes["critical"], bool)
    for name, value in (at or {}).items():
        index = place(ds[name], float(value), rate_of(ds))
        if name != x:
            keep &= ds[f"critical_at_{name}"].values == ds[name].values[index]
        ds = ds.isel({name: index})
    dims, starts = split_dims(ds["course"])
    ds = ds.squeeze([d for d in dims if ds.sizes[d] == 1 and d != x]).sel(critical=keep[: ds.sizes["critical"]])
    ds = ds.stack({"number": starts}, create_index=False).drop_vars(starts, errors="ignore").rename(number=START)
    about = {"long_name": "initial condition"}
    return ds.assign_coords({START: (START, np.arange(ds.sizes[START]), about)})


def _draw_borders(ax: Axes, codes: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Draw lines between cells with different courses."""
    rows, columns = np.nonzero(codes[:, 1:] != codes[:, :-1])
    ax.vlines(x[columns + 1], y[rows], y[rows + 1], colors="black", linewidth=0.8, gid="borders")
    rows, columns = np.nonzero(codes[1:] != codes[:-1])
    ax.hlines(y[rows + 1], x[columns], x[columns + 1], colors="black", linewidth=0.8)


def draw_tipping(run: OpenRun, options: TippingFigureOptions) -> style.DataFigure:
    """Draw the figure ``tipping`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("tipping", **options.part(TippingOptions))
    return noted(plot_tipping(found, start=options.condition, at=at, frame=frame_of(options)), notes)
