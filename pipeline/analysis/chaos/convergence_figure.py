"""Draw how Lyapunov exponents converge in time: few cells as lines, many as bands of quantiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.analysis.chaos.declaration import ConvergenceOptions
from pipeline.analysis.chaos.lyapunov import GOOD, CellMotion, pooled_mean, rate_scale, summarise
from pipeline.analysis.chaos.lyapunov_figure import UNITS, left_out, rate_unit
from pipeline.layout.vocabulary import model_of, split_dims
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points

MOST_LINES = 24
"""Most cells of one kind of motion that are drawn as lines: more would hide one another."""

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Of the bands: the outer two, the inner two, and the median."""

_COLOURS = {
    CellMotion.REGULAR: style.BLUE,
    CellMotion.CHAOTIC: style.VERMILLION,
    CellMotion.HYPERCHAOTIC: style.PURPLE,
    CellMotion.UNDECIDED: style.GREY,
}
_DASHES: dict[CellMotion, Any] = {
    CellMotion.REGULAR: "-",
    CellMotion.UNDECIDED: (0, (1, 1)),
    CellMotion.CHAOTIC: "-",
    CellMotion.HYPERCHAOTIC: (0, (5, 1.5)),
}


@style.drawn
def plot_convergence(
    ds: xr.Dataset,
    *,
    exponent: int = 1,
    per: str = "s",
    at: Mapping[str, float] | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw how the Lyapunov exponents of all cells at one parameter point converge in time.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov``, as `pipeline.open_run` gives it.
    exponent
        Rank of the exponent; 1 is the largest.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period or return.
    at
        Values of swept parameters.
    frame
        Width of the figure, range of the periods, and of the mean.

    Returns
    -------
    DataFigure
        Above: the mean up to each block, one line per cell in the colour of its motion. For more than
        `MOST_LINES` cells: the median, and bands that hold half and nine tenths of the cells. On the right:
        the stored exponents, largest first, with their
        standard errors (open markers: flagged), and a band of one
        standard error about the mean of each class of motion. Below: the growth rate in each block, where the
        end of transient chaos shows as a step. Its `data` hold ``running``, ``in_block``, ``exponent_value``,
        ``exponent_stderr``, ``motion``.

    Raises
    ------
    ValueError
        If there are no exponents, an option is unknown, or more than one parameter point is left.
    """
    style.check_choice("unit (per)", per, UNITS)
    data = _convergence(ds, exponent, per, at)
    fig = style.new_figure(5.2, data, frame)
    grid = fig.add_gridspec(2, 2, height_ratios=[1.5, 1.0], width_ratios=[1.0, 0.17])
    top = fig.add_subplot(grid[0, 0])
    bottom = fig.add_subplot(grid[1, 0], sharex=top)
    final = fig.add_subplot(grid[0, 1], sharey=top)
    for ax in (top, bottom, final):
        style.style_axes(ax)
        ax.axhline(0.0, color="0.4", linewidth=0.7, zorder=1.0)
    handles = _draw_running(top, final, data)
    for kind, colour in _COLOURS.items():
        _draw_cells(bottom, data, "in_block", kind, colour)
    style.label_axes(top, y=f"$\\lambda_{exponent}$, mean so far [{rate_unit(data)}]")
    style.label_axes(bottom, str(data["period"].attrs["long_name"]), f"in the block [{rate_unit(data)}]")
    top.set_xlim(0.0, 1.01 * float(data["period"][-1]))
    style.limits(top, frame)
    fig.align_ylabels([top, bottom])
    style.complete(fig, top, data.attrs["place"], handles)
    return fig


def _convergence(ds: xr.Dataset, exponent: int, per: str, at: Mapping[str, float] | None) -> xr.Dataset:
    """Return the Lyapunov exponents to draw over time at one parameter point, with the dims `cell` and `period`."""
    part = select_points(ds, at, purpose="convergence is drawn at one parameter point")
    dims, starts = split_dims(part["status"])
    summary = summarise(part)
    if not 1 <= exponent <= part.sizes["exponent"]:
        raise ValueError(f"exponent is {exponent}, and the cube has 1 to {part.sizes['exponent']}")
    place = style.join([labels.caption(part, with_start=False), left_out(part)])
    scale, attrs = rate_scale(part, per)
    chosen = xr.Dataset(
        {
            "running": summary["lyapunov_running"] * scale,
            "in_block": part["lyapunov_blocks"] * scale,
            "exponent_value": part["lyapunov"] * scale,
            "exponent_stderr": part["lyapunov_stderr"] * scale,
            "motion": summary["motion"],
            "lyapunov_flag": part["lyapunov_flag"],
        }
    ).sel(exponent=exponent)
    chosen = chosen.isel(dict.fromkeys(dims, 0)).reset_coords(drop=True)
    data = chosen.stack(cell=starts, create_index=False).transpose("cell", "block").rename(block="period").load()
    n, length = data.sizes["period"], int(part.attrs.get("lyapunov_n_periods", 0))
    axis = np.arange(1, n + 1) * (length / n if length else 1.0)
    text = model_of(part).clock.periods if length else "blocks"
    data = data.assign_coords(period=("period", axis, {"long_name": text}))
    for name in ("running", "in_block", "exponent_value", "exponent_stderr"):
        data[name].attrs.update(attrs)
    return data.drop_vars([c for c in data.coords if c != "period"]).assign_attrs(
        title="convergence of a Lyapunov exponent", place=place, exponent=exponent
    )


def _own(data: xr.Dataset, kind: CellMotion) -> np.ndarray:
    return np.flatnonzero((data["motion"].values == kind) & np.isfinite(data["exponent_value"].values))


def _draw_running(ax: Axes, final: Axes, data: xr.Dataset) -> list[Any]:
    value, error = data["exponent_value"].values, data["exponent_stderr"].values
    order = np.argsort(-np.where(np.isfinite(value), value, -np.inf), kind="stable")
    rank = np.empty(value.size, int)
    rank[order] = np.arange(value.size)
    handles = []
    for kind, colour in _COLOURS.items():
        own = _own(data, kind)
        if not own.size:
            continue
        name = kind.name.lower()
        mean, stderr, _ = (float(v) for v in pooled_mean(value[own], error[own], np.ones(own.size, bool)))
        for axes in (ax, final):
            axes.axhspan(mean - stderr, mean + stderr, color=colour, alpha=0.25, linewidth=0, gid=f"band:{name}")
        _draw_cells(ax, data, "running", kind, colour)
        _draw_final(final, data, own, rank, colour)
        label = f"{name}: {own.size} cell{'s' * (own.size != 1)}"
        handles.append(Line2D([], [], color=colour, linestyle=_DASHES[kind], linewidth=1.2, label=label))
    final.set_xlim(-1.0, value.size)
    final.set_xticks([])
    final.text(
        0.5,
        0.02,
        "cells",
        transform=final.transAxes,
        ha="center",
        va="bottom",
        fontsize=style.look_of(final).legend,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
    )
    final.tick_params(labelleft=False)
    ax.tick_params(labelbottom=False)
    return handles


def _draw_final(final: Axes, data: xr.Dataset, own: np.ndarray, rank: np.ndarray, colour: str) -> None:
    """Draw the final exponents of cells over their rank, with standard errors unless there are many cells."""
    value, error = data["exponent_value"].values, data["exponent_stderr"].values
    flagged = data["lyapunov_flag"].values[own] > GOOD
    many = data.sizes["cell"] > 4 * MOST_LINES
    for which, face in ((own[~flagged], colour), (own[flagged], "none")):
        if many:
            final.plot(
                rank[which],
                value[which],
                linestyle="none",
                marker="o",
                markersize=1.4,
                color=colour,
                markerfacecolor=face,
                markeredgewidth=0.4,
                rasterized=True,
            )
        else:
            final.errorbar(
                rank[which],
                value[which],
                error[which],
                linestyle="none",
                marker="o",
                markersize=2.5,
                color=colour,
                markerfacecolor=face,
                markeredgewidth=0.6,
                elinewidth=0.7,
            )


def _draw_cells(ax: Axes, data: xr.Dataset, variable: str, kind: CellMotion, colour: str) -> None:
    """Draw the exponents of the cells of one class of motion over time, as lines or as bands of quantiles."""
    own = _own(data, kind)
    if not own.size:
        return
    x, rows = data["period"].values, data[variable].values[own]
    if variable == "in_block":
        x = x - 0.5 * x[0]
    gid = f"{variable}:{kind.name.lower()}"
    if own.size <= MOST_LINES:
        mark = {"marker": ".", "markersize": 3.0, "linewidth": 0.4, "alpha": 0.6}
        looks: dict[str, Any] = mark if variable == "in_block" else {"linewidth": 0.8, "alpha": 0.8}
        for row in rows:
            ax.plot(x, row, color=colour, linestyle=_DASHES[kind], gid=gid, **looks)
        return
    low, lower, middle, upper, high = np.nanquantile(rows, QUANTILES, axis=0)
    for bottom, top, alpha in ((low, high, 0.18), (lower, upper, 0.3)):
        ax.fill_between(x, bottom, top, color=colour, alpha=alpha, linewidth=0.0, gid=f"quantiles:{gid}")
    ax.plot(x, middle, color=colour, linestyle=_DASHES[kind], linewidth=1.2, gid=gid)


def draw(run: OpenRun, options: ConvergenceOptions) -> style.DataFigure:
    """Draw the figure ``convergence`` of a run."""
    cube = run.cube()
    at, notes = values_of(run, options)
    figure = plot_convergence(cube, exponent=options.exponent, per=options.per, at=at, frame=frame_of(options))
    return noted(figure, notes)
