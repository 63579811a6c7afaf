"""Basin fractions over the swept parameter, as bands."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.ticker import AutoMinorLocator

from pipeline.plots import palette, style

_LEFT_IN, _RIGHT_IN, _BOTTOM_IN, _TOP_IN, _HEIGHT_IN = 0.58, 4.55, 0.5, 0.3, 3.4


def plot_fractions(attractors: xr.Dataset, *, at: Mapping[str, float] | None = None) -> style.DataFigure:
    """Draw the share of the initial states that end on each attractor, over the swept parameter.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.match` for a sweep over one parameter or more.
    at
        Values of the other swept parameters, such as ``{"q": 1.5}``; the nearest ones are drawn.

    Returns
    -------
    DataFigure
        7 in wide. Bands are stacked, the largest at the bottom; cells without an attractor are grey, at
        the top. Each value of the parameter is a column, for between two of them nothing is known. Its
        `data` hold ``fraction`` and the number of cells, ``n_cells``.

    Raises
    ------
    ValueError
        If there is not one swept parameter left.
    """
    parameter = swept_parameter(attractors, at, "fractions")
    keep = (parameter, *palette.start_dims(attractors))
    part = palette.choose(attractors, at, keep, f"fractions are drawn over {parameter}")
    cast = palette.cast_of(attractors, part)
    data = _fractions(part, parameter, cast)
    fig = style.new_data_figure(_HEIGHT_IN + _BOTTOM_IN + _TOP_IN, data)
    width, height = fig.get_size_inches()
    ax = fig.add_axes(
        (_LEFT_IN / width, _BOTTOM_IN / height, (_RIGHT_IN - _LEFT_IN) / width, _HEIGHT_IN / height)
    )
    entries = _draw(ax, data, parameter, cast)
    palette.legend_column(fig, entries[::-1], _RIGHT_IN + 0.15, _TOP_IN)
    n = int(data["n_cells"].max())
    text = ", ".join(filter(None, [palette.caption(part), f"{n} initial states each"]))
    ax.text(0.0, 1.015, text, transform=ax.transAxes, fontsize=style.LEGEND_PT)
    style.style_text(fig)
    return fig


def swept_parameter(attractors: xr.Dataset, at: Mapping[str, float] | None, what: str) -> str:
    """Return the one swept parameter that `at` leaves."""
    dims = palette.parameter_dims(attractors)
    left = [d for d in dims if d not in (at or {})]
    long = [d for d in left if attractors.sizes[d] > 1]
    chosen = long or left
    if len(chosen) == 1:
        return chosen[0]
    if not dims:
        raise ValueError(f"{what} are drawn over a swept parameter, and this run sweeps none")
    example = dims[-1] if dims[0] == "frequency" else dims[0]
    value = float(attractors[example].values[0])
    raise ValueError(
        f"{what} are drawn over one swept parameter, and {len(chosen)} are left of {', '.join(dims)}; "
        f"choose values of the others, such as {example}={value:g}"
    )


def _fractions(part: xr.Dataset, parameter: str, cast: palette.Cast) -> xr.Dataset:
    """Share of each attractor and of each kind of cell without one, per value of the parameter."""
    n = part.sizes[parameter]
    ids = part["attractor_id"].transpose(parameter, ...).values.reshape(n, -1)
    status = part["status"].transpose(parameter, ...).values.reshape(n, -1)
    kinds = list(palette.UNASSIGNED)
    codes = ids.astype(np.int64)
    for k, chosen in enumerate(palette.UNASSIGNED.values()):
        codes[(ids < 0) & np.isin(status, chosen)] = len(cast.names) + k
    width = len(cast.names) + len(kinds)
    counts = np.array([np.bincount(row, minlength=width) for row in codes])
    labels = [*(palette.letter(i) for i in range(len(cast.names))), *kinds]
    names = [*cast.names.values(), *kinds]
    fraction = counts / max(ids.shape[1], 1)
    return xr.Dataset(
        {
            "fraction": (
                (parameter, "outcome"),
                fraction,
                {"units": "1", "long_name": "share of the initial states"},
            ),
            "n_cells": (
                (parameter,),
                np.full(n, ids.shape[1], np.int32),
                {"units": "1", "long_name": "cells"},
            ),
        },
        coords={
            parameter: part[parameter],
            "outcome": labels,
            "name": ("outcome", names),
        },
        attrs={"title": "basin fractions"},
    )


def _draw(ax: Axes, data: xr.Dataset, parameter: str, cast: palette.Cast) -> list[tuple[str, str]]:
    """Draw the bands from below; return the legend's entries in the same order."""
    share = data["fraction"].values
    edges = style.edges(data[parameter].values.astype(np.float64))
    n = len(cast.names)
    total = share[:, :n].sum(axis=0)
    own = sorted((i for i in cast.main if total[i] > 0), key=lambda i: (-total[i], i))
    rest = [i for i in range(n) if i not in cast.main and total[i] > 0]
    bands = [(cast.names[i], cast.colours[i], share[:, i], palette.letter(i)) for i in own]
    if rest:
        bands.append((f"{len(rest)} others", palette.OTHERS, share[:, rest].sum(axis=1), ""))
    for k, name in enumerate(palette.UNASSIGNED):
        if share[:, n + k].any():
            bands.append((name, palette.GREYS[name], share[:, n + k], ""))
    floor = np.zeros(len(share))
    for name, colour, height, mark in bands:
        looks = {"facecolor": colour, "edgecolor": "none", "linewidth": 0.0}
        style.fill_columns(ax, edges, floor, floor + height, looks, f"band:{mark or name}")
        _write_letter(ax, edges, floor, height, mark)
        floor = floor + height
    ax.set_xlim(float(edges.min()), float(edges.max()))
    ax.set_ylim(0.0, 1.0)
    style.style_axes(ax)
    ax.tick_params(which="both", direction="out", top=False, right=False)
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.yaxis.set_minor_locator(AutoMinorLocator(2))
    ax.set_xlabel(style.parameter_label(data[parameter]), fontsize=style.LABEL_PT)
    ax.set_ylabel("basin fraction", fontsize=style.LABEL_PT)
    return [(name, colour) for name, colour, _, _ in bands]


def _write_letter(ax: Axes, edges: np.ndarray, floor: np.ndarray, height: np.ndarray, mark: str) -> None:
    """Write a letter into the highest column of a band, the middle one of a row of them."""
    if not mark or height.max() < 0.06:
        return
    smooth = np.convolve(np.pad(height, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    best = np.flatnonzero(np.isclose(smooth, smooth.max()))
    i = int(best[len(best) // 2])
    ax.text(
        0.5 * (edges[i] + edges[i + 1]), floor[i] + 0.5 * height[i], mark, ha="center", va="center",
        fontsize=style.LABEL_PT, path_effects=[withStroke(linewidth=2.0, foreground="white")],
    )  # fmt: skip
