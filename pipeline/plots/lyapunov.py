"""Lyapunov exponents: under the bifurcation diagram, and as a map over two parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import TwoSlopeNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoMinorLocator, MaxNLocator

from pipeline.analysis.chaos.lyapunov import GOOD
from pipeline.analysis.sides import side
from pipeline.plots import style
from pipeline.plots.bifurcation import SIDE_COLOURS, draw_diagram, swept_parameter, swept_parameters

UNITS = ("s", "period")
EXPONENT_COLOURS = ("#332288", style.ORANGE, "#56B4E9", "#882255")
"""Others than those of the sides in the panel above."""

_BAND = 0.25


def plot_lyapunov(
    ds: xr.Dataset,
    *,
    spectrum: bool = False,
    per: str = "s",
    state: str = "psi1",
    degrees: bool = False,
    at: Mapping[str, float] | None = None,
) -> style.DataFigure:
    """Draw Lyapunov exponents under the bifurcation diagram, on the same axis.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov``, as `pipeline.open_run` gives it.
    spectrum
        All stored exponents, each in its colour; else the largest, coloured by the side of the motion.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period.
    state, degrees
        Of the diagram, as for `plot_bifurcation`.
    at
        Values of further swept parameters; the nearest ones are drawn.

    Returns
    -------
    DataFigure
        Points are cells, bands one standard error on either side of them; open points are cells
        whose exponents were flagged. Its `data` hold ``exponent_value``, ``exponent_stderr``,
        ``lyapunov_flag`` and ``side``.

    Raises
    ------
    ValueError
        If there are no exponents, if an option is unknown, or if more than one parameter is left.
    """
    style.check_choice("unit (per)", per, UNITS)
    _demand(ds)
    part = ds.sel(dict(at), method="nearest") if at else ds
    parameter = swept_parameter(part)
    part = part.squeeze([d for d in swept_parameters(part) if d != parameter])
    data = _values(part, per, spectrum)
    fig = style.new_data_figure(5.6, data)
    grid = fig.add_gridspec(
        2, 1, height_ratios=[1.25, 1.0], left=0.105, right=0.975, bottom=0.09, top=0.935, hspace=0.14
    )
    top = fig.add_subplot(grid[0])
    handles = draw_diagram(top, part, state=state, degrees=degrees)
    bottom = fig.add_subplot(grid[1], sharex=top)
    low_handles = _draw_exponents(bottom, data, parameter, spectrum)
    top.tick_params(labelbottom=False)
    bottom.set_xlabel(style.parameter_label(part[parameter]), fontsize=style.LABEL_PT)
    _legend(top, handles)
    _legend(bottom, low_handles)
    fig.align_ylabels([top, bottom])
    style.style_text(fig)
    return fig


def _legend(ax: Axes, handles: list[Any]) -> None:
    """Put a legend in one row on top of the axes."""
    if handles:
        ax.legend(
            handles=handles, loc="lower right", bbox_to_anchor=(1.005, 0.985), ncols=len(handles),
            frameon=False, fontsize=style.LEGEND_PT, handletextpad=0.3, columnspacing=1.0, borderpad=0.2,
            handlelength=1.2,
        )  # fmt: skip


def _demand(ds: xr.Dataset) -> None:
    if "lyapunov" not in ds:
        raise ValueError(
            "the cube has no Lyapunov exponents; run it with [products] lyapunov = {} in its specification"
        )


def _values(part: xr.Dataset, per: str, spectrum: bool) -> xr.Dataset:
    """What is drawn: exponents and errors in the unit asked for, flags and sides."""
    scale = 1.0 / part["frequency"] if per == "period" else xr.DataArray(1.0)
    chosen = part if spectrum else part.isel(exponent=slice(1))
    unit = "1/s" if per == "s" else "1"
    dims = chosen["lyapunov"].dims
    data = xr.Dataset(
        {
            "exponent_value": (chosen["lyapunov"] * scale).transpose(*dims),
            "exponent_stderr": (chosen["lyapunov_stderr"] * scale).transpose(*dims),
            "lyapunov_flag": part["lyapunov_flag"],
            "side": side(part),
        }
    ).load()
    for name in ("exponent_value", "exponent_stderr"):
        data[name].attrs.update(units=unit, per="unit time" if per == "s" else "drive period")
    keep = [c for c in data.coords if c == "exponent" or c in data["side"].dims]
    return data.drop_vars([c for c in data.coords if c not in keep]).assign_attrs(title="Lyapunov exponents")


def _draw_exponents(ax: Axes, data: xr.Dataset, parameter: str, spectrum: bool) -> list[Any]:
    style.style_axes(ax)
    x = data[parameter].values.astype(np.float64)
    order = (parameter, "cell", "exponent")
    cells = [d for d in data["side"].dims if d != parameter]
    table = data.stack(cell=cells, create_index=False) if cells else data.expand_dims("cell")
    value, error = (table[name].transpose(*order).values for name in ("exponent_value", "exponent_stderr"))
    flag, sides = (table[name].transpose(*order[:2]).values for name in ("lyapunov_flag", "side"))
    ax.axhline(0.0, color="0.4", linewidth=style.LINE_PT, zorder=1.0)
    handles: list[Any] = []
    if spectrum:
        for k in range(value.shape[2]):
            _draw_class(ax, x, value[..., k], error[..., k], flag, EXPONENT_COLOURS[k], f"exponent:{k + 1}")
            label = rf"$\lambda_{k + 1}$"
            handles.append(_dot(EXPONENT_COLOURS[k], label))
    else:
        for kind, colour in SIDE_COLOURS.items():
            own = np.where(sides == kind, value[..., 0], np.nan)
            _draw_class(ax, x, own, error[..., 0], flag, colour, f"exponent:{kind.name.lower()}")
    if ((flag > GOOD) & np.isfinite(value[..., 0])).any():
        handles.append(
            Line2D([], [], linestyle="none", marker="o", mfc="none", mec="0.3", ms=4, label="flagged")
        )
    unit = "drive period" if data["exponent_value"].attrs["per"] == "drive period" else "s"
    name = "exponents" if spectrum else "largest exponent"
    ax.set_ylabel(f"{name} [1/{unit}]", fontsize=style.LABEL_PT)
    ax.yaxis.set_minor_locator(AutoMinorLocator(2))
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    return handles


def _draw_class(
    ax: Axes, x: np.ndarray, value: np.ndarray, error: np.ndarray, flag: np.ndarray, colour: str, gid: str
) -> None:
    """Points and the band of one colour; `value` and the others have shape (x, cell)."""
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
                x[row], value[row, column], linestyle="none", marker="o", markersize=size,
                markerfacecolor=face, markeredgecolor=colour, markeredgewidth=0.4 if face == "none" else 0.0,
                rasterized=True, zorder=2.0,
            )  # fmt: skip
            line.set_gid(gid if face != "none" else f"flagged:{gid}")


def _union(value: np.ndarray, error: np.ndarray) -> list[tuple[float, float]]:
    """Intervals value +- error, those that overlap joined."""
    joined: list[tuple[float, float]] = []
    for low, high in sorted(zip((value - error).tolist(), (value + error).tolist(), strict=True)):
        if joined and low <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(high, joined[-1][1]))
        else:
            joined.append((low, high))
    return joined


def _dot(colour: str, label: str) -> Line2D:
    return Line2D(
        [], [], linestyle="none", marker="o", markersize=5, markeredgewidth=0, color=colour, label=label
    )


def plot_lyapunov_map(
    ds: xr.Dataset, *, per: str = "s", at: Mapping[str, float] | None = None
) -> style.DataFigure:
    """Draw the largest exponent over two parameters.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov`` over two swept parameters.
    per
        As for `plot_lyapunov`.
    at
        Values of further swept parameters; the nearest ones are drawn.

    Returns
    -------
    DataFigure
        At each point the largest exponent that any of its cells has: chaos shows wherever one of
        the coexisting attractors is chaotic. Grey where no cell has one. Its `data` hold
        ``exponent_value`` and ``chaotic_share``, the share of cells whose exponent is positive.

    Raises
    ------
    ValueError
        If there are no exponents, if an option is unknown, or if not two parameters are left.
    """
    style.check_choice("unit (per)", per, UNITS)
    _demand(ds)
    part = ds.sel(dict(at), method="nearest") if at else ds
    swept = [d for d in swept_parameters(part) if part.sizes[d] > 1]
    if len(swept) != 2:
        raise ValueError(
            f"a map is drawn over two swept parameters, and {len(swept)} are left "
            f"({', '.join(swept) or 'none'}); choose values of the others with at"
        )
    values = _values(part, per, spectrum=False)
    largest = values["exponent_value"].isel(exponent=0, drop=True)
    cells = [d for d in largest.dims if d not in swept]
    data = xr.Dataset(
        {
            "exponent_value": largest.max(cells, keep_attrs=True).transpose(swept[1], swept[0]),
            "chaotic_share": (largest > 0).mean(cells).transpose(swept[1], swept[0]),
        },
        attrs={"title": "largest Lyapunov exponent"},
    )
    fig = style.new_data_figure(4.4, data)
    ax = fig.add_axes((0.105, 0.12, 0.72, 0.835))
    style.style_axes(ax)
    _draw_map(ax, data, part, swept)
    style.style_text(fig)
    return fig


def _draw_map(ax: Axes, data: xr.Dataset, part: xr.Dataset, swept: list[str]) -> None:
    fig = ax.figure
    grid = data["exponent_value"].values
    x, y = (style.edges(part[d].values.astype(np.float64)) for d in swept)
    norm = _two_slopes(grid)
    ax.set_facecolor("0.8")
    image = ax.pcolormesh(x, y, np.ma.masked_invalid(grid), cmap="PuOr_r", norm=norm, rasterized=True)
    image.set_gid("map")
    ax.set_xlabel(style.parameter_label(part[swept[0]]), fontsize=style.LABEL_PT)
    ax.set_ylabel(style.parameter_label(part[swept[1]]), fontsize=style.LABEL_PT)
    bar = fig.colorbar(ScalarMappable(norm, "PuOr_r"), cax=fig.add_axes((0.845, 0.12, 0.022, 0.835)))
    bar.ax.tick_params(labelsize=style.TICK_PT, width=style.LINE_PT)
    ticks = [MaxNLocator(4).tick_values(*ends) for ends in ((norm.vmin, 0.0), (0.0, norm.vmax))]
    bar.set_ticks([t for t in np.unique(np.concatenate(ticks)) if norm.vmin <= t <= norm.vmax])
    unit = "drive period" if data["exponent_value"].attrs["per"] == "drive period" else "s"
    bar.set_label(f"largest exponent [1/{unit}]", fontsize=style.LABEL_PT)


def _two_slopes(grid: np.ndarray) -> TwoSlopeNorm:
    """White at 0; each half of the colours spans its own sign, as chaos outweighs order by far."""
    known = grid[np.isfinite(grid)]
    low, high = float(known.min(initial=0.0)), float(known.max(initial=0.0))
    least = 1e-3 * max(high - low, 1e-9)
    return TwoSlopeNorm(0.0, min(low, -least), max(high, least))
