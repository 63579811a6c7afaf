"""Map of regimes: which attractors, periods, or how many, over two swept parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.colors import ListedColormap, to_hex
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoMinorLocator

from pipeline.analysis.basins.basins import outcomes
from pipeline.analysis.basins.numbers import basin_fractions, binomial_interval
from pipeline.analysis.selection import choose, parameter_dims, start_dims
from pipeline.plots import palette, style
from pipeline.plots.fractions import new_panel

KINDS = ("periods", "attractors", "number")
SHARE_LIMIT = 0.05
"""Share of cells without an attractor from which a point of the map is marked."""


def plot_regimes(
    attractors: xr.Dataset, *, show: str = "periods", at: Mapping[str, float] | None = None
) -> style.DataFigure:
    """Draw what coexists at each point of two swept parameters.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` for a run over two parameters or more.
    show
        ``periods``: which periods [drive periods] and whether motions that are not periodic coexist;
        ``attractors``: which ids do; ``number``: how many attractors.
    at
        Values of further swept parameters; the nearest ones are drawn.

    Returns
    -------
    DataFigure
        7 in wide. Of more than twelve regimes the most frequent have own colours. A cross marks points
        where more than `SHARE_LIMIT` of the cells have no attractor, so that one may be missing. Its
        `data` hold ``regime`` (index of the names in ``label``), ``n_attractors``, ``share_without``, and
        ``share`` of each attractor. Of a sweep also ``low`` and ``high``, the 95 % Wilson interval of each
        share, and ``unseen_high``: a basin larger than this shows in one of the cells whose outcome is
        known with a probability of 95 % or more. The largest such bound, points with a cross left out,
        stands above the map.

    Raises
    ------
    ValueError
        For an unknown `show`, and if there are not two swept parameters left.
    """
    style.check_choice("show", show, KINDS)
    x, y = _axes(attractors, at)
    part = choose(
        attractors, at, (x, y, *start_dims(attractors)), f"a map of regimes has the axes {x} and {y}"
    )
    data = _regimes(part, x, y, show)
    colours, entries = _looks(data, show)
    row, column = np.nonzero(data["share_without"].values > SHARE_LIMIT)
    cross: dict[str, Any] = {
        "marker": "x",
        "markersize": 3.0,
        "markeredgewidth": 0.6,
        "color": "black",
        "linestyle": "none",
    }
    if row.size:
        label = f"over {100 * SHARE_LIMIT:g} % of the cells\nwithout an attractor"
        entries.append(Line2D([], [], label=label, **cross))
    fig, ax = new_panel(data, entries)
    edges = [style.edges(data[d].values.astype(np.float64)) for d in (x, y)]
    ax.pcolormesh(
        *edges, data["regime"].values, cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5,
        rasterized=True, gid="regimes",
    )  # fmt: skip
    if row.size:
        ax.plot(data[x].values[column], data[y].values[row], gid="without", **cross)
    ax.tick_params(which="both", direction="out", top=False, right=False)
    ax.set_xlim(*sorted((float(edges[0][0]), float(edges[0][-1]))))
    ax.set_ylim(*sorted((float(edges[1][0]), float(edges[1][-1]))))
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.yaxis.set_minor_locator(AutoMinorLocator())
    ax.set_xlabel(style.parameter_label(data[x]), fontsize=style.LABEL_PT)
    ax.set_ylabel(style.parameter_label(data[y]), fontsize=style.LABEL_PT, labelpad=2.0)
    titles = {"periods": "periods of the coexisting attractors", "attractors": "coexisting attractors"}
    parts = [titles.get(show, "number of attractors"), palette.caption(part), _about(data)]
    ax.text(0.0, 1.015, ", ".join(filter(None, parts)), transform=ax.transAxes, fontsize=style.LEGEND_PT)
    style.style_text(fig)
    return fig


def _axes(attractors: xr.Dataset, at: Mapping[str, float] | None) -> tuple[str, str]:
    dims = parameter_dims(attractors)
    left = [d for d in dims if d not in (at or {})]
    long = [d for d in left if attractors.sizes[d] > 1]
    chosen = long if len(long) >= 2 else left
    if len(chosen) != 2:
        left_of = f"{len(chosen)} are left of {', '.join(dims)}" if dims else "this run sweeps none"
        raise ValueError(
            f"a map of regimes has two swept parameters, and {left_of}; "
            "sweep two, and choose values of any others"
        )
    return ("frequency", next(d for d in chosen if d != "frequency")) if "frequency" in chosen else (
        chosen[0], chosen[1],
    )  # fmt: skip


def _regimes(part: xr.Dataset, x: str, y: str, show: str) -> xr.Dataset:
    """Regime of each point, the most frequent first."""
    present = part["kind"].transpose(y, x, "attractor").values > 0
    periods = part["orbit_period"].transpose(y, x, "attractor").values
    labels = np.empty(present.shape[:2], object)
    for index in np.ndindex(labels.shape):
        labels[index] = _label(np.flatnonzero(present[index]), periods[index], show)
    counts = Counter(labels.ravel().tolist())
    names = sorted(counts, key=lambda name: (-counts[name], name))
    if show == "number":
        names.sort(key=int)
    without = (part["attractor_id"] < 0).mean(start_dims(part)).transpose(y, x)
    number = {name: i for i, name in enumerate(names)}
    regime = np.array([number[label] for label in labels.ravel()], np.int32).reshape(labels.shape)
    attrs = {"units": "1", "long_name": "regime, an index of label"}
    return xr.Dataset(
        {
            "regime": ((y, x), regime, attrs),
            "n_attractors": ((y, x), present.sum(axis=-1).astype(np.int32), {"units": "1"}),
            "share_without": ((y, x), without.values, {"units": "1", "long_name": "share without attractor"}),
            **_numbers(part, x, y),
        },
        coords={x: part[x], y: part[y], "label": ("label", names)},
        attrs={"title": "regimes", "show": show},
    )  # fmt: skip


def _numbers(part: xr.Dataset, x: str, y: str) -> dict[str, Any]:
    """Share of each attractor, its interval, and the bound on what was not seen."""
    dims = (y, x, "attractor")
    share = part["share"].transpose(*dims).values
    numbers: dict[str, Any] = {"share": (dims, share, {"units": "1", "long_name": "share of all cells"})}
    if "branch" in start_dims(part):
        return numbers
    fractions = basin_fractions(outcomes(part), dims=start_dims(part), ids=part["attractor"].values.tolist())
    low, high = binomial_interval(part["n_cells"].transpose(*dims).values, fractions["n_cells"].max().item())
    unseen = fractions["unseen_high"].transpose(y, x).values
    return numbers | {
        "low": (dims, low, {"units": "1", "long_name": "95 % interval of the share, low end"}),
        "high": (dims, high, {"units": "1", "long_name": "95 % interval of the share, high end"}),
        "unseen_high": ((y, x), unseen, {"units": "1", "long_name": "95 % bound on a basin not seen"}),
    }


def _about(data: xr.Dataset) -> str:
    if "unseen_high" not in data:
        return ""
    bound = float(data["unseen_high"].where(data["share_without"] <= SHARE_LIMIT).max())
    return f"basins below {palette.percent(bound)} may be missing" if np.isfinite(bound) else ""


def _label(present: np.ndarray, periods: np.ndarray, show: str) -> str:
    if show == "number":
        return str(present.size)
    if not present.size:
        return "none"
    if show == "attractors":
        return " + ".join(palette.letter(int(i)) for i in present)
    found = sorted({int(p) for p in periods[present]} - {0})
    words = [str(p) for p in found] + (["not periodic"] if (periods[present] == 0).any() else [])
    return " + ".join(words)


def _looks(data: xr.Dataset, show: str) -> tuple[list[str], list[palette.Entry]]:
    """Colour of each regime, and the legend."""
    labels = [str(v) for v in data["label"].values]
    if show == "number":
        ramp = matplotlib.colormaps["cividis"]
        shades = {label: to_hex(ramp(i / max(len(labels) - 1, 1))) for i, label in enumerate(labels)}
        shades |= {"0": palette.GREYS["pending"]} if "0" in shades else {}
        return list(shades.values()), list(shades.items())
    own = [label for label in labels if label != "none"][: len(palette.COLOURS)]
    colours = dict(zip(own, palette.COLOURS, strict=False))
    rest = [label for label in labels if label not in colours and label != "none"]
    colours |= dict.fromkeys(rest, palette.OTHERS) | {"none": palette.GREYS["pending"]}
    entries: list[palette.Entry] = [(label, colours[label]) for label in own]
    entries += [(f"{len(rest)} others", palette.OTHERS)] if rest else []
    entries += [("none", colours["none"])] if "none" in labels else []
    return [colours[label] for label in labels], entries
