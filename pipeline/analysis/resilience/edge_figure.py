"""Draw edge states, alone or over the basins whose boundary they are on."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.analysis.basins.figure import plot_basins
from pipeline.analysis.resilience.declaration import EdgeFigureOptions, EdgeOptions
from pipeline.layout.vocabulary import EQUILIBRIUM, PERIODIC_ORBIT, is_grid_dim, is_start_dim
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import with_diagram
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun

_MARKS: dict[str, dict[str, Any]] = {
    "edge orbit": {"marker": "D", "markersize": 7.0, "markerfacecolor": "white", "markeredgecolor": "black"},
    "edge equilibrium": {"marker": "s", "markersize": 7.0, "markerfacecolor": "white", "markeredgecolor": "black"},
    "edge set": {"marker": "o", "markersize": 2.6, "markerfacecolor": "white", "markeredgecolor": "black"},
}
"""Markers of edge states: white with a black rim, to be seen over every colour of a basin."""


@style.drawn
def plot_edge(
    ds: xr.Dataset,
    basins: style.DataFigure | None = None,
    axes: tuple[str, str] | None = None,
    *,
    degrees: bool = False,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the section points of edge states, alone or on a figure of basins over the states `axes`.

    By default these are the first two states; points are projected on their plane.
    """
    names = axes or tuple(str(name) for name in ds["state"].values[:2])
    measures = [labels.state_measure(ds, name, degrees) for name in names]
    stored = ds.assign_attrs(title="edge states")
    fig = basins
    if fig is None:
        fig = style.new_figure(4.6, stored, frame)
        style.style_axes(fig.add_subplot())
        style.label_axes(fig.axes[0], *(measure.label for measure in measures))
        style.caption(fig.axes[0], labels.caption(ds, with_start=False))
    else:
        fig.data = with_diagram(stored, fig.data)
    ax = fig.axes[0]
    limits = (ax.get_xlim(), ax.get_ylim()) if basins is not None else None
    shown = _draw_points(ax, ds, names, measures)
    if limits:
        ax.set_xlim(limits[0])
        ax.set_ylim(limits[1])
    style.limits(ax, frame)
    handles = [ax.plot([], [], linestyle="none", label=name, **_MARKS[name])[0] for name in _MARKS if name in shown]
    if handles:
        style.legend_inside(ax, handles)
    style.finish(fig)
    return fig


def _draw_points(ax: Axes, ds: xr.Dataset, names: tuple[str, ...], measures: list[labels.Measure]) -> set[str]:
    """Draw the section points of each edge state; return the names of the markers used."""
    kinds = {PERIODIC_ORBIT: "edge orbit", EQUILIBRIUM: "edge equilibrium"}
    columns = [list(ds["state"].values).index(name) for name in names]
    shown = set()
    # orbits last, since they are few
    for i in np.argsort(ds["kind"].values == PERIODIC_ORBIT, kind="stable"):
        name = kinds.get(int(ds["kind"][i]), "edge set")
        points = ds["section"].values[i, : int(ds["n_points"][i])][:, columns]
        x, y = (
            measure.factor * (labels.wrapped(column) if measure.on_circle else column)
            for measure, column in zip(measures, points.T, strict=True)
        )
        rim = 0.4 if name == "edge set" else 1.0
        ax.plot(x, y, linestyle="none", markeredgewidth=rim, zorder=5.0, gid=f"{name}:{i}", **_MARKS[name])
        shown.add(name)
    return shown


def draw_edge(run: OpenRun, options: EdgeFigureOptions) -> style.DataFigure:
    """Draw the figure ``edge`` of a run, over the basins if its initial states form a grid in two states."""
    at, notes = values_of(run, options)
    found = run.derive("edge", **{**options.part(EdgeOptions), "at": at})
    frame, below, axes = frame_of(options), None, None
    cube = run.cube()
    grid = [str(d) for d in cube["status"].dims if is_start_dim(str(d)) and is_grid_dim(str(d))]
    if len(grid) == 2:
        below = plot_basins(run.derive("attractors"), at=at, degrees=options.degrees, frame=frame)
        axes = (grid[0].removesuffix("_0"), grid[1].removesuffix("_0"))
    return noted(plot_edge(found, below, axes, degrees=options.degrees, frame=frame), notes)
