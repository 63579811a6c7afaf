"""Draw Lyapunov exponents below the bifurcation diagram of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from pipeline.analysis.chaos.lyapunov import GOOD, check_exponents
from pipeline.analysis.run import OpenRun
from pipeline.plots import labels, pixels, style
from pipeline.plots.bifurcation import Diagram, swept_parameter, with_diagram
from pipeline.plots.exponent_map import plot_lyapunov_map, swept_pair
from pipeline.plots.exponents import UNITS, exponent_values, rate_unit
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.missing_cells import absent_handles, draw_absent, shade_blank
from pipeline.plots.motions import motions_of
from pipeline.plots.points import Survey
from pipeline.plots.selection import at_points
from pipeline.products.figures import LyapunovFigureOptions

EXPONENT_COLOURS = ("#332288", style.ORANGE, style.SKY, "#882255", "#5B3A1E", "#999933", "#44AA99", "#AA4499")
"""Others than those of the motions in the panel above; a ninth begins again."""

_BAND = 0.25


@style.drawn
def plot_lyapunov(
    ds: xr.Dataset,
    *,
    spectrum: bool = False,
    per: str = "s",
    state: str = "",
    degrees: bool = False,
    at: Mapping[str, float] | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the Lyapunov exponents of a run below its bifurcation diagram, on the same horizontal axis.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov``, as `pipeline.open_run` gives it.
    spectrum
        All stored exponents, each in its colour; else the largest, coloured by the kind of motion.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period or return.
    state, degrees
        State and unit of the diagram, as for `plot_bifurcation`.
    at
        Values of further swept parameters.
    frame
        Width of the figure, range of the parameter, and of the exponents.

    Returns
    -------
    DataFigure
        Points are cells, bands one standard error on either side of them; open points are cells
        whose exponents were flagged. Where cells have none, a strip below shows their share at each value
        of the parameter, and the legend says how many there are and why. Its `data` hold ``exponent_value``,
        ``exponent_stderr``, ``lyapunov_flag``, and ``motion`` where motions are told apart; with the
        suffix ``_diagram`` what is drawn above.

    Raises
    ------
    ValueError
        If there are no exponents, if an option is unknown, or if more than one parameter is left.
    """
    style.check_choice("unit (per)", per, UNITS)
    check_exponents(ds)
    swept_parameter(at_points(ds, at), "draw a map with plot_lyapunov_map")
    diagram = Diagram.of(ds, state=state, degrees=degrees, at=at, frame=replace(frame, ylim=None))
    part = diagram.view.ds
    part = part.squeeze([d for d in part["status"].dims if d != diagram.parameter and part.sizes[d] == 1])
    data = exponent_values(part, per, spectrum)
    lost = _lost(diagram, data)
    with_strip = any(counts.any() for counts in lost.absent.values())
    fig = style.new_figure(5.6, data, frame)
    grid = fig.add_gridspec(3 if with_strip else 2, 1, height_ratios=[1.25, 1.0, 0.08][: 3 if with_strip else 2])
    top = fig.add_subplot(grid[0])
    diagram.dress(top)
    bottom = lowest = fig.add_subplot(grid[1], sharex=top)
    low_handles = _draw_exponents(bottom, data, diagram.parameter, spectrum, motions_of(part).colours)
    top.tick_params(labelbottom=False)
    if frame.ylim:
        bottom.set_ylim(*style.check_range("ylim", frame.ylim))
    if with_strip:
        lowest = fig.add_strip(top, grid[2])
        _draw_lost(top, bottom, lowest, diagram, lost)
    style.label_axes(lowest, x=labels.parameter_label(part[diagram.parameter]))
    fig.align_ylabels([top, bottom])
    handles = [*diagram.handles(absent=False), *low_handles, *absent_handles(lost)]
    style.complete(fig, top, diagram.caption, handles)
    fig.data = with_diagram(data, diagram.draw([pixels.Panel(top, diagram.layers)]))
    return fig


def _lost(diagram: Diagram, data: xr.Dataset) -> Survey:
    """Count the cells without points or without a Lyapunov exponent, at each parameter value and by reason."""
    found = diagram.survey
    value = data["exponent_value"].isel(exponent=0)
    others = [d for d in value.dims if d != diagram.parameter]
    without = np.zeros_like(found.cells)
    without[0] = value.isnull().sum(others).values
    without[0] -= sum(counts.sum(0) for counts in found.absent.values())
    return replace(found, absent={**found.absent, "without exponent": np.maximum(without, 0)})


def _draw_lost(top: Axes, bottom: Axes, strip: Axes, diagram: Diagram, lost: Survey) -> None:
    """Draw in a strip the share of cells without an exponent, and shade parameter values where no cell has one."""
    style.style_axes(strip, minor=False)
    shade_blank(top, diagram.x, diagram.survey, diagram.layers)
    draw_absent(bottom, strip, diagram.x, lost, diagram.layers)
    bottom.tick_params(labelbottom=False)


def _draw_exponents(ax: Axes, data: xr.Dataset, parameter: str, spectrum: bool, colours: tuple[str, ...]) -> list[Any]:
    style.style_axes(ax)
    x = data[parameter].values.astype(np.float64)
    order = (parameter, "cell", "exponent")
    cells = [d for d in data["lyapunov_flag"].dims if d != parameter]
    table = data.stack(cell=cells, create_index=False) if cells else data.expand_dims("cell")
    value, error = (table[name].transpose(*order).values for name in ("exponent_value", "exponent_stderr"))
    flag = table["lyapunov_flag"].transpose(*order[:2]).values
    motion = table["motion"].transpose(*order[:2]).values if "motion" in table else np.zeros(flag.shape, int)
    ax.axhline(0.0, color="0.4", linewidth=0.7, zorder=1.0)
    handles: list[Any] = []
    if spectrum:
        for k in range(value.shape[2]):
            colour = EXPONENT_COLOURS[k % len(EXPONENT_COLOURS)]
            _draw_class(ax, x, value[..., k], error[..., k], flag, colour, f"exponent:{k + 1}")
            handles.append(style.dot(rf"$\lambda_{{{k + 1}}}$", colour))
    else:
        for code, colour in enumerate(colours):
            own = np.where(motion == code, value[..., 0], np.nan)
            _draw_class(ax, x, own, error[..., 0], flag, colour, f"exponent:{code}")
    if ((flag > GOOD) & np.isfinite(value[..., 0])).any():
        handles.append(style.dot("flagged", "0.3", 4.0, face="none"))
    name = "exponents" if spectrum else "largest exponent"
    style.label_axes(ax, y=f"{name} [{rate_unit(data)}]")
    return handles


def _draw_class(
    ax: Axes, x: np.ndarray, value: np.ndarray, error: np.ndarray, flag: np.ndarray, colour: str, gid: str
) -> None:
    """Draw the exponents of one class of motion, or one exponent of the spectrum, with error bands."""
    there = np.isfinite(value)
    if not there.any():
        return
    edges = style.edges(x)
    boxes = [
        [(edges[i], low), (edges[i + 1], low), (edges[i + 1], high), (edges[i], high)]
        for i in np.flatnonzero(there.any(axis=1))
        for low, high in _union(value[i, there[i]], error[i, there[i]])
    ]
    area = PolyCollection(boxes, facecolor=colour, alpha=_BAND, linewidth=0.0, zorder=1.5, gid=f"band:{gid}")
    ax.add_collection(area)
    size = min(2.2, max(0.9, 300.0 / max(x.size, 1)))
    for chosen, face in ((there & (flag <= GOOD), colour), (there & (flag > GOOD), "none")):
        row, column = np.nonzero(chosen)
        if row.size:
            (line,) = ax.plot(
                x[row],
                value[row, column],
                linestyle="none",
                marker="o",
                markersize=size,
                markerfacecolor=face,
                markeredgecolor=colour,
                markeredgewidth=0.4 if face == "none" else 0.0,
                rasterized=True,
                zorder=2.0,
            )
            line.set_gid(gid if face != "none" else f"flagged:{gid}")


def _union(value: np.ndarray, error: np.ndarray) -> list[tuple[float, float]]:
    joined: list[tuple[float, float]] = []
    for low, high in sorted(zip((value - error).tolist(), (value + error).tolist(), strict=True)):
        if joined and low <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(high, joined[-1][1]))
        else:
            joined.append((low, high))
    return joined


def draw(run: OpenRun, options: LyapunovFigureOptions) -> style.DataFigure:
    """Draw the figure ``lyapunov`` of a run: over one parameter, or as colours in the plane of two."""
    cube = run.cube()
    at, notes = values_of(run, options)
    check_exponents(cube)
    if options.as_map:
        swept_pair(at_points(cube, at), "leave out --map")
        return noted(plot_lyapunov_map(cube, per=options.per, at=at, frame=frame_of(options)), notes)
    swept_parameter(at_points(cube, at), "draw a map with --map")
    figure = plot_lyapunov(
        cube,
        spectrum=options.spectrum,
        per=options.per,
        state=options.state,
        degrees=options.degrees,
        at=at,
        frame=frame_of(options),
    )
    return noted(figure, notes)
