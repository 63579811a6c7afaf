"""Convergence of Lyapunov exponents, and the correlation sum behind a dimension."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoMinorLocator

from pipeline.analysis.chaos.lyapunov import GOOD, Motion, pooled_mean, summarise
from pipeline.analysis.selection import select_points
from pipeline.layout.vocabulary import split_dims
from pipeline.plots import style

UNITS = ("s", "period")
_COLOURS = {
    Motion.REGULAR: style.BLUE, Motion.UNDECIDED: style.GREY, Motion.CHAOTIC: style.VERMILLION,
    Motion.HYPERCHAOTIC: style.PURPLE,
}  # fmt: skip
_DASHES: dict[Motion, Any] = {
    Motion.REGULAR: "-", Motion.UNDECIDED: (0, (1, 1)), Motion.CHAOTIC: "-",
    Motion.HYPERCHAOTIC: (0, (5, 1.5)),
}  # fmt: skip


def plot_convergence(
    ds: xr.Dataset, *, exponent: int = 1, per: str = "s", at: Mapping[str, float] | None = None
) -> style.DataFigure:
    """Draw how the exponents of the cells of one parameter point converge.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov``, as `pipeline.open_run` gives it.
    exponent
        Which one, 1 the largest.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period.
    at
        Values of swept parameters; the nearest ones are drawn.

    Returns
    -------
    DataFigure
        Above, the mean up to each block, a line per cell in the colour of its motion; on the right the
        stored exponents with their standard errors (open: flagged), and bands of one standard error about
        the mean of each kind of motion. Below, the growth rate in each block: there chaos that ends shows
        as a step.
        Its `data` hold ``running``, ``in_block``, ``exponent_value``, ``exponent_stderr``, ``motion``.

    Raises
    ------
    ValueError
        If there are no exponents, an option is unknown, or more than one parameter point is left.
    """
    style.check_choice("unit (per)", per, UNITS)
    data = _convergence(ds, exponent, per, at)
    fig = style.new_data_figure(5.2, data)
    grid = fig.add_gridspec(
        2, 2, height_ratios=[1.5, 1.0], width_ratios=[1.0, 0.17], left=0.105, right=0.985, bottom=0.09,
        top=0.94, hspace=0.1, wspace=0.03,
    )  # fmt: skip
    top = fig.add_subplot(grid[0, 0])
    bottom = fig.add_subplot(grid[1, 0], sharex=top)
    final = fig.add_subplot(grid[0, 1], sharey=top)
    unit = "s" if per == "s" else "drive period"
    _draw_running(top, final, data)
    _draw_blocks(bottom, data)
    top.set_ylabel(f"$\\lambda_{exponent}$, mean so far [1/{unit}]", fontsize=style.LABEL_PT)
    bottom.set_ylabel(f"in the block [1/{unit}]", fontsize=style.LABEL_PT)
    bottom.set_xlabel(str(data["period"].attrs["long_name"]), fontsize=style.LABEL_PT)
    top.set_title(data.attrs["place"], fontsize=style.LABEL_PT, loc="left")
    fig.align_ylabels([top, bottom])
    style.style_text(fig)
    return fig


def _convergence(ds: xr.Dataset, exponent: int, per: str, at: Mapping[str, float] | None) -> xr.Dataset:
    """What is drawn, with the dims `cell` and `period`."""
    part = select_points(ds, at, purpose="convergence is drawn at one parameter point")
    dims, starts = split_dims(part["status"])
    summary = summarise(part)
    if not 1 <= exponent <= part.sizes["exponent"]:
        raise ValueError(f"exponent is {exponent}, and the cube has 1 to {part.sizes['exponent']}")
    scale = 1.0
    if per == "period":
        scale = 1.0 / float(
            part["frequency"].values[0] if "frequency" in dims else part.attrs["frequency_hz"]
        )
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
    place = ", ".join(f"{_name(part[d])} {float(part[d].values[0]):g}{_unit(part[d])}" for d in dims)
    chosen = chosen.isel(dict.fromkeys(dims, 0)).reset_coords(drop=True)
    data = (
        chosen.stack(cell=starts, create_index=False).transpose("cell", "block").rename(block="period").load()
    )
    n, length = data.sizes["period"], int(part.attrs.get("lyapunov_n_periods", 0))
    axis, text = (
        np.arange(1, n + 1) * (length / n if length else 1.0),
        "drive periods" if length else "blocks",
    )
    data = data.assign_coords(period=("period", axis, {"long_name": text}))
    for name in ("running", "in_block", "exponent_value", "exponent_stderr"):
        data[name].attrs.update(
            units="1/s" if per == "s" else "1", per="unit time" if per == "s" else "drive period"
        )
    return data.drop_vars([c for c in data.coords if c != "period"]).assign_attrs(
        title="convergence of a Lyapunov exponent", place=place, exponent=exponent
    )


def _name(axis: xr.DataArray) -> str:
    return str(axis.name)


def _unit(axis: xr.DataArray) -> str:
    unit = axis.attrs.get("units", "1")
    return "" if unit == "1" else f" {unit}"


def _draw_running(ax: Axes, final: Axes, data: xr.Dataset) -> None:
    style.style_axes(ax)
    style.style_axes(final)
    x, motion = data["period"].values, data["motion"].values
    value, error = data["exponent_value"].values, data["exponent_stderr"].values
    handles = []
    for axes in (ax, final):
        axes.axhline(0.0, color="0.4", linewidth=style.LINE_PT, zorder=1.0)
    for kind, colour in _COLOURS.items():
        own = (motion == kind) & np.isfinite(value)
        if not own.any():
            continue
        name = kind.name.lower()
        mean, stderr, _ = (float(v) for v in pooled_mean(value, error, own))
        for axes in (ax, final):
            axes.axhspan(
                mean - stderr, mean + stderr, color=colour, alpha=0.25, linewidth=0, gid=f"band:{name}"
            )
        for i in np.flatnonzero(own):
            ax.plot(x, data["running"].values[i], color=colour, linestyle=_DASHES[kind], linewidth=0.8,
                    alpha=0.8, gid=f"running:{name}")  # fmt: skip
        place = np.flatnonzero(own)
        flagged = data["lyapunov_flag"].values[place] > GOOD
        for which, face in ((~flagged, colour), (flagged, "none")):
            final.errorbar(place[which], value[place[which]], error[place[which]], linestyle="none",
                           marker="o", markersize=2.5, color=colour, markerfacecolor=face,
                           markeredgewidth=0.6, elinewidth=0.7)  # fmt: skip
        label = f"{name}: {int(own.sum())} cell{'s' * (int(own.sum()) != 1)}"
        handles.append(Line2D([], [], color=colour, linestyle=_DASHES[kind], linewidth=1.2, label=label))
    final.set_xlim(-1.0, value.size)
    final.set_xticks([])
    final.set_xlabel("cells", fontsize=style.LABEL_PT)
    final.tick_params(labelleft=False)
    ax.tick_params(labelbottom=False)
    ax.set_xlim(0.0, 1.01 * x[-1])
    ax.yaxis.set_minor_locator(AutoMinorLocator())
    if handles:
        ax.figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.985, 1.0), ncols=len(handles),
                         frameon=False, fontsize=style.LEGEND_PT, handlelength=2.0)  # fmt: skip


def _draw_blocks(ax: Axes, data: xr.Dataset) -> None:
    """Growth in each block, at its middle."""
    style.style_axes(ax)
    ax.axhline(0.0, color="0.4", linewidth=style.LINE_PT, zorder=1.0)
    ends = data["period"].values
    middle = ends - 0.5 * ends[0]
    for row, kind in zip(data["in_block"].values, data["motion"].values.tolist(), strict=True):
        if kind in _COLOURS:
            ax.plot(middle, row, marker=".", markersize=3, color=_COLOURS[kind], linewidth=0.4, alpha=0.6,
                    gid="in_block")  # fmt: skip
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.yaxis.set_minor_locator(AutoMinorLocator())


def plot_dimension(ds: xr.Dataset) -> style.DataFigure:
    """Draw the correlation sum over the radius, with the fit and the local slope.

    Parameters
    ----------
    ds
        Result of `pipeline.analysis.chaos.dimensions.correlation_dimension` for one set of points, or of
        `pipeline.analysis.chaos.chaos.section_dimension` for one parameter point.

    Returns
    -------
    DataFigure
        Its `data` hold ``correlation_sum`` and ``local_slope`` over ``radius``, and the numbers of the fit.

    Raises
    ------
    ValueError
        If there is more than one set, or nothing to draw.
    """
    several = [str(d) for d in ds["correlation_dimension"].dims if ds.sizes[d] > 1]
    if several:
        raise ValueError(f"a correlation sum is drawn of one set, and {', '.join(several)} has several")
    data = _correlation(ds)
    fig = style.new_data_figure(5.2, data)
    grid = fig.add_gridspec(
        2, 1, height_ratios=[1.5, 1.0], left=0.105, right=0.975, bottom=0.09, top=0.94, hspace=0.08
    )
    top = fig.add_subplot(grid[0])
    bottom = fig.add_subplot(grid[1], sharex=top)
    for ax in (top, bottom):
        style.style_axes(ax)
    fit = tuple(float(data[name]) for name in ("fit_low", "fit_high"))
    value, error = (float(data[f"correlation_dimension{end}"]) for end in ("", "_stderr"))
    radius, share = data["radius"].values, data["correlation_sum"].values
    top.loglog(
        radius, share, linestyle="none", marker="o", markersize=3, color="black", gid="correlation_sum"
    )
    bottom.semilogx(radius, data["local_slope"].values, "o-", markersize=3, linewidth=0.7, color="black",
                    gid="local_slope")  # fmt: skip
    if np.isfinite(fit).all():
        bottom.text(np.sqrt(fit[0] * fit[1]), 0.06, "fit", transform=bottom.get_xaxis_transform(),
                    ha="center", fontsize=style.LEGEND_PT)  # fmt: skip
        inside = (radius >= fit[0] * (1 - 1e-9)) & (radius <= fit[1] * (1 + 1e-9)) & (share > 0)
        height = np.exp(
            np.log(share[inside]).mean() + value * (np.log(radius) - np.log(radius[inside]).mean())
        )
        near = (radius > fit[0] / 3) & (radius < fit[1] * 3)
        top.plot(radius[near], height[near], color=style.VERMILLION, linewidth=1.0, zorder=1.5, gid="fit")
        for ax in (top, bottom):
            ax.axvspan(*fit, color=style.ORANGE, alpha=0.25, linewidth=0, zorder=0.5, gid="fit_range")
        bottom.axhspan(value - error, value + error, color=style.VERMILLION, alpha=0.25, linewidth=0)
        bottom.axhline(value, color=style.VERMILLION, linewidth=1.0, zorder=1.5)
    text = f"$D_2$ = {value:.2f} ± {error:.2f}" if np.isfinite(value) else "no range to fit"
    top.text(0.03, 0.94, f"{text}\n{int(data['n_points'])} points", transform=top.transAxes, va="top",
             fontsize=style.LABEL_PT)  # fmt: skip
    top.set_title(data.attrs["place"], fontsize=style.LABEL_PT, loc="left")
    top.tick_params(labelbottom=False)
    top.set_ylabel("correlation sum C(r)", fontsize=style.LABEL_PT)
    bottom.set_ylabel("local slope", fontsize=style.LABEL_PT)
    bottom.set_xlabel("scaled radius r (1 for 1 rad, 10 rad/s)", fontsize=style.LABEL_PT)
    steep = data["local_slope"].values
    bottom.set_ylim(0.0, 1.15 * max(float(np.nanmax(steep, initial=1.0)), 1.0))
    fig.align_ylabels([top, bottom])
    style.style_text(fig)
    return fig


def _correlation(ds: xr.Dataset) -> xr.Dataset:
    """What is drawn: radii with pairs, the share of pairs, the slope between neighbouring radii."""
    dims = [str(d) for d in ds["correlation_dimension"].dims]
    one = ds.isel(dict.fromkeys(dims, 0))
    x, y = one["log_radius"].values, one["log_correlation_sum"].values
    there = np.isfinite(x) & np.isfinite(y)
    if there.sum() < 3:
        raise ValueError("there is no correlation sum to draw: no chaotic cell, or all points are one")
    x, y = x[there], y[there]
    numbers = ("correlation_dimension", "correlation_dimension_stderr", "fit_low", "fit_high", "n_points")
    place = ", ".join(
        f"{_name(ds[d])} {float(ds[d].values[0]):g}{_unit(ds[d])}" for d in dims if d in ds.coords
    )
    return xr.Dataset(
        {
            "correlation_sum": ("radius", np.exp(y), {"units": "1", "long_name": "share of pairs closer"}),
            "local_slope": ("radius", np.gradient(y, x), {"units": "1", "long_name": "local slope"}),
            **{name: ((), one[name].values, one[name].attrs) for name in numbers},
        },
        coords={"radius": ("radius", np.exp(x), {"units": "1", "long_name": "scaled radius"})},
        attrs={"title": "correlation sum", "place": place},
    )
