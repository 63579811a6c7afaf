"""Draw the manifolds of saddle orbits, alone or over basins."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.analysis.basins.figure import plot_basins
from pipeline.analysis.manifolds.declaration import ManifoldFigureOptions, ManifoldOptions
from pipeline.layout.vocabulary import has_origins, is_start_dim
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import fixed_of, with_diagram
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.results.run import OpenRun

_COLOURS = {0: style.VERMILLION, 1: style.BLUE}
_NAMES = {0: "unstable manifold", 1: "stable manifold"}


@style.drawn
def plot_manifolds(
    ds: xr.Dataset, basins: style.DataFigure | None = None, *, degrees: bool = False, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the manifolds of saddle orbits in the plane of the first two states, alone or over a figure of basins.

    Parameters
    ----------
    ds
        From `pipeline.analysis.manifolds.analysis.manifolds`.
    basins
        A figure of basins over the same two states, which is drawn on.
    degrees
        Degrees instead of radians.
    frame
        Width of the figure and ranges of its axes.
    """
    names = [str(name) for name in ds["state"].values[:2]]
    measures = [labels.state_measure(ds, name, degrees) for name in names]
    fig = basins
    if fig is None:
        fig = style.new_figure(4.6, ds.assign_attrs(title="manifolds"), frame)
        style.style_axes(fig.add_subplot())
        style.label_axes(fig.axes[0], *(measure.label for measure in measures))
        style.caption(fig.axes[0], labels.caption(ds, with_start=False))
    else:
        fig.data = with_diagram(ds.assign_attrs(title="manifolds over basins"), fig.data)
    ax = fig.axes[0]
    limits = (ax.get_xlim(), ax.get_ylim()) if basins is not None else None
    colours = _COLOURS if basins is None else {0: "black", 1: "white"}
    _draw_lines(ax, ds, [measure.factor for measure in measures], colours)
    if limits:
        ax.set_xlim(limits[0])
        ax.set_ylim(limits[1])
    style.limits(ax, frame)
    handles = [Line2D([], [], color=_shade(colours[k]), label=_NAMES[k], linewidth=1.2) for k in _NAMES]
    style.legend_inside(ax, handles)
    style.finish(fig)
    return fig


def _shade(colour: str) -> str:
    return "0.75" if colour == "white" else colour


def _draw_lines(ax: Axes, ds: xr.Dataset, scales: list[float], colours: dict[int, str]) -> None:
    for i in range(ds.sizes["curve"]):
        n, stable = int(ds["n_points"][i]), int(ds["stable"][i])
        points = ds["section"].values[i, :n, :2] * scales
        # an angle that passes its end begins again at the other side
        jumps = np.abs(np.diff(points, axis=0)) > 0.5 * np.ptp(points, axis=0)
        breaks = np.flatnonzero(jumps.any(axis=1)) + 1
        points = np.insert(points, breaks, np.nan, axis=0)
        ax.plot(*points.T, color=colours[stable], linewidth=0.8, gid=f"{_NAMES[stable]}:{i}", zorder=4.0)


def draw_manifolds(run: OpenRun, options: ManifoldFigureOptions) -> style.DataFigure:
    """Draw the figure ``manifolds`` of a run, over the basins if the run's initial states form a grid in two states."""
    at, notes = values_of(run, options)
    found = run.derive("manifolds", **options.part(ManifoldOptions))
    found = found.assign_coords(fixed_of(at_points(run.cube(), at).squeeze()))
    frame, below = frame_of(options), None
    starts = [str(d) for d in run.cube()["status"].dims if is_start_dim(str(d))]
    if len(starts) == 2 and not has_origins(run.cube()):
        attractors = run.derive("attractors")
        below = plot_basins(attractors, at=at, degrees=options.degrees, frame=frame)
    return noted(plot_manifolds(found, below, degrees=options.degrees, frame=frame), notes)
