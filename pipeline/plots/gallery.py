"""Gallery of attractors: portraits of both links, and the path of the moving magnet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoMinorLocator, MaxNLocator

from pipeline.plots import palette, style
from pipeline.plots.trajectory import on_circle, wrapped

MAX_ROWS = 8
_LEFT_IN, _WIDTH_IN = (0.6, 2.85, 5.22), (1.65, 1.65, 1.65)
_ROW_IN, _PANEL_IN, _BOTTOM_IN, _TOP_IN = 1.3, 0.88, 0.42, 0.5


def plot_gallery(attractors: xr.Dataset, portraits: xr.Dataset) -> style.DataFigure:
    """Draw each attractor of one parameter point in a row: both phase portraits and the magnet's path.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match`; gives colours and names.
    portraits
        Result of `pipeline.analysis.attractors.portraits.portraits` for a parameter point of it.

    Returns
    -------
    DataFigure
        7 in wide. Lines are the motion, dots its stroboscopic section. The portrait of a link that turns
        over is drawn on the circle, from -pi to pi. The `MAX_ROWS` attractors with the largest share are
        drawn, in the order of their ids. Its `data` are the portraits of these.

    Raises
    ------
    ValueError
        If there is no attractor.
    """
    n = portraits.sizes["attractor"]
    if n == 0:
        raise ValueError("there is no attractor at this parameter point: nothing to draw")
    ranked = np.argsort(-portraits["share"].values, kind="stable")[:MAX_ROWS]
    data = portraits.isel(attractor=np.sort(ranked))
    cast = palette.cast_of(attractors, _described(attractors, portraits))
    rows = data.sizes["attractor"]
    fig = style.new_data_figure(_TOP_IN + _BOTTOM_IN + rows * _ROW_IN - (_ROW_IN - _PANEL_IN), data)
    for row in range(rows):
        _draw_row(fig, row, data.isel(attractor=row), cast, last=row == rows - 1)
    _head(fig, data, portraits, n)
    style.style_text(fig)
    return fig


def _described(attractors: xr.Dataset, portraits: xr.Dataset) -> xr.Dataset:
    """The attractors at the portraits' point."""
    at = {
        d: float(portraits[d]) for d in attractors["kind"].dims if d in portraits.coords and d != "attractor"
    }
    return attractors.sel(at)


def _draw_row(fig: style.DataFigure, row: int, one: xr.Dataset, cast: palette.Cast, *, last: bool) -> None:
    width, height = fig.get_size_inches()
    bottom = height - _TOP_IN - row * _ROW_IN - _PANEL_IN
    number = int(one["attractor"])
    colour = cast.colours[number]
    letter = palette.letter(number)
    axes = []
    for left, panel in zip(_LEFT_IN, _WIDTH_IN, strict=True):
        ax = fig.add_axes((left / width, bottom / height, panel / width, _PANEL_IN / height))
        style.style_axes(ax)
        axes.append(ax)
    share = palette.percent(float(one["share"]))
    axes[0].text(
        0.0, 1.05, f"{cast.names[number]}, {share} of the cells", transform=axes[0].transAxes,
        fontsize=style.LEGEND_PT,
    )  # fmt: skip
    for ax, link in zip(axes, "12", strict=False):
        _portrait(ax, one, link, colour, letter)
        ax.set_ylabel(style.state_label(f"psi{link}_dot"), fontsize=style.LEGEND_PT, labelpad=1.0)
        if last:
            ax.set_xlabel(style.state_label(f"psi{link}"), fontsize=style.LABEL_PT, labelpad=2.0)
    _path(axes[2], one, colour, letter)
    axes[2].set_ylabel("$y$ [m]", fontsize=style.LEGEND_PT)
    axes[2].yaxis.set_label_coords(-0.31, 0.5)
    if last:
        axes[2].set_xlabel("$x$ [m]", fontsize=style.LABEL_PT, labelpad=2.0)


def _portrait(ax: Axes, one: xr.Dataset, link: str, colour: str, letter: str) -> None:
    names = (f"psi{link}", f"psi{link}_dot")
    angle, rate = (one["orbit"].sel(state=name).values for name in names)
    there = np.isfinite(angle)
    angle, rate = angle[there], rate[there]
    points, rates = (one["attractor_points"].sel(state=name).values for name in names)
    turns = np.ptp(angle) >= 2.0 * math.pi
    x, y = on_circle(angle, rate) if turns else (angle, rate)
    dots = (
        wrapped(points)
        if turns
        else points + 2.0 * math.pi * np.round((np.mean(angle) - points) / (2.0 * math.pi))
    )
    ax.plot(x, y, color=colour, linewidth=0.7, gid=f"orbit:{letter}:psi{link}")
    ax.plot(
        dots, rates, linestyle="none", marker="o", markersize=2.6, color="black", markeredgecolor="white",
        markeredgewidth=0.4, zorder=3, gid=f"section:{letter}:psi{link}",
    )  # fmt: skip
    ax.margins(0.08)
    if turns:
        ax.set_xlim(-math.pi, math.pi)
    style.set_angle_ticks(ax, *ax.get_xlim(), degrees=False, axis="x")
    ax.yaxis.set_major_locator(MaxNLocator(4))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(AutoMinorLocator(2))


def _path(ax: Axes, one: xr.Dataset, colour: str, letter: str) -> None:
    x, y = (one["magnet"].sel(axis=name).values for name in "xy")
    ax.plot(x, y, color=colour, linewidth=0.7, gid=f"path:{letter}")
    ax.plot(
        [0.0], [one.attrs["fixed_magnet_y"]], linestyle="none", marker="s", markersize=4.0, color="0.2",
        markeredgewidth=0.0, gid="fixed_magnet", clip_on=False,
    )  # fmt: skip
    # a metre is as long along both axes, and the magnets' vertical is in the middle
    low, high = min(float(np.nanmin(y)), one.attrs["fixed_magnet_y"]), float(np.nanmax(y))
    scale = 1.16 * max(2.0 * float(np.nanmax(np.abs(x))) / _WIDTH_IN[2], (high - low) / _PANEL_IN)
    middle = 0.5 * (low + high)
    ax.set_xlim(-0.5 * scale * _WIDTH_IN[2], 0.5 * scale * _WIDTH_IN[2])
    ax.set_ylim(middle - 0.5 * scale * _PANEL_IN, middle + 0.5 * scale * _PANEL_IN)
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.yaxis.set_major_locator(MaxNLocator(4))


def _head(fig: style.DataFigure, data: xr.Dataset, portraits: xr.Dataset, n: int) -> None:
    width, height = fig.get_size_inches()
    text = palette.caption(portraits, with_start=False)
    if (rest := n - data.sizes["attractor"]) > 0:
        share = palette.percent(float(portraits["share"].sum() - data["share"].sum()))
        text += f"; {rest} more attractors, {share} of the cells, are not shown"
    fig.text(0.62 / width, 1.0 - 0.16 / height, text, fontsize=style.LEGEND_PT, va="center")
    dots: dict[str, Any] = {"linestyle": "none", "markeredgewidth": 0.0}
    handles: list[Any] = [
        Line2D([], [], marker="o", markersize=3.0, color="black", label="once per drive period", **dots),
        Line2D([], [], marker="s", markersize=4.0, color="0.2", label="fixed magnet", **dots),
    ]  # fmt: skip
    fig.legend(
        handles=handles, loc="center right", bbox_to_anchor=(6.95 / width, 1.0 - 0.16 / height), ncols=2,
        frameon=False, fontsize=style.LEGEND_PT, borderpad=0.0, borderaxespad=0.0, handletextpad=0.2,
        columnspacing=1.0, handlelength=1.2,
    )  # fmt: skip
