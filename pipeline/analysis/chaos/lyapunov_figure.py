"""Draw Lyapunov exponents over one swept parameter, or the largest as colours over two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.chaos.declaration import LyapunovFigureOptions
from pipeline.analysis.chaos.lyapunov import GOOD, check_exponents, rate_scale
from pipeline.plots import labels, pixels, style
from pipeline.plots.bifurcation import (
    Diagram,
    absent_handles,
    draw_absent,
    shade_blank,
    swept_parameter,
    swept_parameters,
    with_diagram,
)
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.plots.palette import motion_codes, motions_of
from pipeline.plots.points import ABSENT, DRAWN, Survey
from pipeline.results.run import OpenRun

UNITS = ("s", "period")
"""Units of time that exponents are given per."""


def left_out(part: xr.Dataset) -> str:
    """Return a text on how many cells have no Lyapunov exponent, and why; an empty text if all have one."""
    status = part["status"]
    missing = part["lyapunov"].isel(exponent=0, drop=True).isnull().transpose(*status.dims)
    counts = {name: int((missing & status.isin(codes)).sum()) for name, codes in ABSENT.items()}
    counts["without exponent"] = int((missing & status.isin(DRAWN)).sum())
    listed = style.join(f"{n} {name}" for name, n in counts.items() if n)
    return f"left out of {status.size} cells: {listed}" if listed else ""


def exponent_values(part: xr.Dataset, per: str, spectrum: bool) -> xr.Dataset:
    """Return the Lyapunov exponents and their errors per second or per period, with flags and classes of motion."""
    scale, attrs = rate_scale(part, per)
    chosen = part if spectrum else part.isel(exponent=slice(1))
    dims = chosen["lyapunov"].dims
    variables = {
        "exponent_value": (chosen["lyapunov"] * scale).transpose(*dims),
        "exponent_stderr": (chosen["lyapunov_stderr"] * scale).transpose(*dims),
        "lyapunov_flag": part["lyapunov_flag"],
    }
    if motions_of(part).told:
        variables["motion"] = motion_codes(part)
    data = xr.Dataset(variables).load()
    for name in ("exponent_value", "exponent_stderr"):
        data[name].attrs.update(attrs)
    # NetCDF cannot store object labels; the numbers of branches and starts suffice
    keep = {"exponent", *data["lyapunov_flag"].dims}
    keep |= {str(c) for c, v in data.coords.items() if not v.ndim and v.dtype.kind == "f"}
    return data.drop_vars([c for c in data.coords if c not in keep]).assign_attrs(title="Lyapunov exponents")


def rate_unit(data: xr.Dataset) -> str:
    """Return the unit of the Lyapunov exponents, for an axis label."""
    per = str(data["exponent_value"].attrs["per"])
    return "1/s" if per == "unit time" else f"1/{per.split()[-1]}"


_NO_EXPONENT = "0.8"


@style.drawn
def plot_lyapunov_map(
    ds: xr.Dataset, *, per: str = "s", at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the largest Lyapunov exponent as colours in the plane of two swept parameters.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov`` over two swept parameters.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period or return.
    at
        Values of further swept parameters.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Each point shows the largest exponent among its cells, so chaos shows wherever one of the
        coexisting attractors is chaotic. White is 0; equal distances from 0 have the same depth of colour
        on both sides. A point is grey where no cell has an exponent. The line above says how many cells
        have none, and why. Its `data` hold ``exponent_value`` and
        ``chaotic_share``, the share of cells whose exponent is positive.

    Raises
    ------
    ValueError
        If there are no exponents, if an option is unknown, or if not exactly two parameters are left.
    """
    style.check_choice("unit (per)", per, UNITS)
    check_exponents(ds)
    part = at_points(ds, at)
    swept = swept_pair(part, "draw a diagram with plot_lyapunov")
    values = exponent_values(part, per, spectrum=False)
    largest = values["exponent_value"].isel(exponent=0, drop=True)
    cells = [d for d in largest.dims if d not in swept]
    data = xr.Dataset(
        {
            "exponent_value": largest.max(cells, keep_attrs=True).transpose(swept[1], swept[0]),
            "chaotic_share": (largest > 0).mean(cells).transpose(swept[1], swept[0]),
        },
        attrs={"title": "largest Lyapunov exponent, maximum over the cells of each point"},
    )
    fig = style.new_figure(4.4, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=False)
    _draw_map(fig, ax, data, part, swept)
    style.caption(ax, style.join([labels.caption(part, drop=swept), left_out(part)]))
    style.limits(ax, frame, *(style.span(part[d].values) for d in swept))
    style.finish(fig)
    return fig


def swept_pair(part: xr.Dataset, instead: str) -> list[str]:
    """Return the names of the two swept parameters of a result cube; raise ValueError if there are not two.

    `instead` says what to do if there are fewer.
    """
    swept = [d for d in swept_parameters(part) if part.sizes[d] > 1]
    if len(swept) != 2:
        raise ValueError(
            f"a map is drawn over two swept parameters, and {len(swept)} are left ({', '.join(swept) or 'none'}); "
            + ("choose values of the others with --at" if len(swept) > 2 else instead)
        )
    return swept


def _draw_map(fig: style.DataFigure, ax: Axes, data: xr.Dataset, part: xr.Dataset, swept: list[str]) -> None:
    grid = data["exponent_value"].values
    x, y = (style.edges(part[d].values.astype(np.float64)) for d in swept)
    norm, extend = _scale(grid)
    ax.set_facecolor(_NO_EXPONENT)
    image = ax.pcolormesh(x, y, np.ma.masked_invalid(grid), cmap="PuOr_r", norm=norm, rasterized=True)
    image.set_gid("map")
    style.label_axes(ax, *(labels.parameter_label(part[d]) for d in swept))
    if not np.isfinite(grid).all():
        style.legend_above(fig, [Patch(facecolor=_NO_EXPONENT, label="no cell has an exponent")])
    bar = fig.colorbar(ScalarMappable(norm, "PuOr_r"), ax=ax, extend=extend, pad=0.015, aspect=32, ticks=MaxNLocator(7))
    text = f"largest exponent [{rate_unit(data)}]\nmaximum over the cells of each point"
    style.style_bar(bar, text)


def _scale(grid: np.ndarray) -> tuple[Normalize, str]:
    """Return a colour scale that is symmetric about 0, and a word for the ends at which values lie outside it."""
    held = 0.98  # share of the points whose exponents the scale holds, so that a few do not pale all others
    known = grid[np.isfinite(grid)]
    most = float(np.abs(known).max(initial=0.0))
    half = float(np.quantile(np.abs(known), held)) if known.size else 1.0
    half = half if half > 0.0 else most or 1.0
    if most <= 1.5 * half:
        half = most or 1.0
    ends = (bool((known < -half).any()), bool((known > half).any()))
    return Normalize(-half, half), {
        (False, False): "neither",
        (True, False): "min",
        (False, True): "max",
        (True, True): "both",
    }[ends]


EXPONENT_COLOURS = ("#332288", style.ORANGE, style.SKY, "#882255", "#5B3A1E", "#999933", "#44AA99", "#AA4499")
"""Others than those of the motions in the panel above; a ninth begins again."""


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
    alpha = 0.25
    there = np.isfinite(value)
    if not there.any():
        return
    edges = style.edges(x)
    boxes = [
        [(edges[i], low), (edges[i + 1], low), (edges[i + 1], high), (edges[i], high)]
        for i in np.flatnonzero(there.any(axis=1))
        for low, high in _union(value[i, there[i]], error[i, there[i]])
    ]
    area = PolyCollection(boxes, facecolor=colour, alpha=alpha, linewidth=0.0, zorder=1.5, gid=f"band:{gid}")
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
