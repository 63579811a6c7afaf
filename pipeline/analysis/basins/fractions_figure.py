"""Draw over a swept parameter the basin fractions of attractors, and the attractors themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pipeline.analysis.basins.analysis import check_starts
from pipeline.analysis.basins.declaration import FractionFigureOptions
from pipeline.layout.vocabulary import ATTRACTS, STABILITIES, letter
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.products.product import StateOptions
from pipeline.results.expressions import check_density, weights_of
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import left_out, outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.results.selection import choose, parameter_dims, start_dims

_BAR: dict[str, Any] = {"linewidth": 0.7, "color": "black"}


@style.drawn
def plot_fractions(
    attractors: xr.Dataset,
    *,
    at: Mapping[str, float] | None = None,
    density: str = "1",
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the fraction of the initial states that end on each attractor, as stacked bands over the swept parameter.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` for a sweep over one parameter or more.
    at
        Values of the other swept parameters, for example ``{"q": 1.5}``.
    density
        Density of the initial states, an expression of states and parameters; it weighs the cells.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Bands are stacked, the largest at the bottom; cells without an attractor are grey, at
        the top. The legend lists periods in rising order.
        Each parameter value is a column, because nothing is known between two values. Its
        `data` hold ``fraction`` and the number of cells, ``n_cells``; of a sweep also ``low`` and ``high``,
        the 95 % Wilson interval of each fraction, as if the starts were drawn independently. The widest
        interval is written above. Thin bars, 60 at most, show the interval of the summed bands below
        an edge. The intervals do not cover the uncertainty from grey cells. The branches of a continuation
        are no sample of initial states, so their shares have no intervals.

    Raises
    ------
    ValueError
        If not exactly one swept parameter is left.
    """
    most = 60  # bars that are drawn: more would hide the bands
    parameter = swept_parameter(attractors, at, "fractions")
    keep = (parameter, *start_dims(attractors))
    part = choose(attractors, at, keep, f"fractions are drawn over {parameter}")
    cast = palette.cast_of(attractors, part)
    data = _fractions(part, parameter, cast, density)
    bands = _bands(data, cast)
    place = {number: k for k, number in enumerate(cast.order)}
    listed = sorted(bands, key=lambda band: place.get(band.attractor, len(place)))
    entries: list[palette.Entry] = [(band.name, band.colour) for band in listed]
    if bars := "low" in data and 0 < data.sizes[parameter] * (len(bands) - 1) <= most:
        entries.append(Line2D([], [], label="95 % interval of an edge", **_BAR))
    fig, ax = palette.new_panel(data, entries, frame)
    _draw(ax, data, parameter, bands)
    if bars:
        _draw_intervals(ax, data, parameter, bands)
    style.limits(ax, frame)
    style.caption(ax, style.join([labels.caption(part, drop=[parameter]), _about(data)]))
    style.finish(fig)
    _write_letters(ax, data, parameter, bands)
    return fig


def swept_parameter(attractors: xr.Dataset, at: Mapping[str, float] | None, what: str) -> str:
    """Return the one swept parameter that `at` does not fix; raise ValueError if there are several or none."""
    dims = parameter_dims(attractors)
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


def _fractions(part: xr.Dataset, parameter: str, cast: palette.Cast, density: str) -> xr.Dataset:
    """Return the basin fractions, and the share of cells without an attractor, at each parameter value."""
    n = part.sizes[parameter]
    ids = outcomes(part).transpose(parameter, ...).values.reshape(n, -1)
    kinds, others = list(palette.GREYS), palette.other_cells(part)
    codes = ids.astype(np.int64)
    for k, name in enumerate(kinds):
        if name in others:
            codes[others[name].reshape(n, -1)] = len(cast.names) + k
    width = len(cast.names) + len(kinds)
    starts = tuple(start_dims(part))
    weights = np.ones(ids.shape) if density == "1" else weights_of(part, [parameter], starts, density)
    # as many cells of equal weight have the same error
    weights = weights * (weights.sum(axis=1) / (weights**2).sum(axis=1))[:, None]
    counts = np.array([np.bincount(row, w, minlength=width) for row, w in zip(codes, weights, strict=True)])
    effective = weights.sum(axis=1)[:, None]
    labels = [*(letter(i) for i in range(len(cast.names))), *kinds]
    names = [*cast.names.values(), *kinds]
    branches = "branch" in start_dims(part)
    of = "branches" if branches else "initial states"
    shares = {"fraction": (counts / np.maximum(effective, 1e-300), f"share of the {of}")}
    if not branches:
        low, high = binomial_interval(np.minimum(counts, effective), effective)
        shares |= {"low": (low, "95 % interval, low end"), "high": (high, "95 % interval, high end")}
    return xr.Dataset(
        {
            **{
                variable: ((parameter, "outcome"), values, {"units": "1", "long_name": text})
                for variable, (values, text) in shares.items()
            },
            "n_cells": ((parameter,), np.full(n, ids.shape[1], np.int32), {"units": "1", "long_name": "cells"}),
        },
        coords={parameter: part[parameter], "outcome": labels, "name": ("outcome", names)},
        attrs={
            "title": f"shares of the {of}" if branches else "basin fractions",
            **({"density": density} if density != "1" else {}),
        },
    )


def _about(data: xr.Dataset) -> str:
    n = int(data["n_cells"].max())
    if "low" not in data:
        return f"{n} branches each"
    seen = data["fraction"] > 0
    half = float((0.5 * (data["high"] - data["low"])).where(seen).max())
    of = f"all {n} initial states" if "density" not in data.attrs else f"the density {data.attrs['density']}"
    return f"shares of {of}, grey ones included, 95 % intervals within ±{half:.2g}"


@dataclass(frozen=True)
class _Band:
    """One of the stacked bands: name, colour, height at each parameter value, and attractor id (-1 for none)."""

    name: str
    colour: str
    height: np.ndarray
    attractor: int = -1


def _bands(data: xr.Dataset, cast: palette.Cast) -> list[_Band]:
    """Return the bands from below: attractors by falling fraction, minor ones, cells without an attractor."""
    share = data["fraction"].values
    n = len(cast.names)
    total = share[:, :n].sum(axis=0)
    own = sorted((i for i in cast.main if total[i] > 0), key=lambda i: (-total[i], i))
    rest = [i for i in range(n) if i not in cast.main and total[i] > 0]
    bands = [_Band(cast.names[i], cast.colours[i], share[:, i], i) for i in own]
    if rest:
        bands.append(_Band(f"{len(rest)} others", palette.OTHERS, share[:, rest].sum(axis=1)))
    for k, name in enumerate(palette.GREYS):
        if share[:, n + k].any():
            bands.append(_Band(name, palette.GREYS[name], share[:, n + k]))
    return bands


def _draw(ax: Axes, data: xr.Dataset, parameter: str, bands: Sequence[_Band]) -> None:
    edges = style.edges(data[parameter].values.astype(np.float64))
    floor = np.zeros(edges.size - 1)
    for band in bands:
        looks = {"facecolor": band.colour, "edgecolor": "none", "linewidth": 0.0}
        mark = letter(band.attractor) if band.attractor >= 0 else band.name
        style.fill_columns(ax, edges, floor, floor + band.height, looks, f"band:{mark}")
        floor = floor + band.height
    ax.set_xlim(float(edges.min()), float(edges.max()))
    ax.set_ylim(0.0, 1.0)
    label = "basin fraction" if "low" in data else "share of the branches"
    style.label_axes(ax, labels.parameter_label(data[parameter]), label)


def _write_letters(ax: Axes, data: xr.Dataset, parameter: str, bands: Sequence[_Band]) -> None:
    edges = style.edges(data[parameter].values.astype(np.float64))
    codes = np.array([band.attractor for band in bands], np.int32)
    heights = np.array([band.height for band in bands])
    rising = slice(None) if edges[-1] > edges[0] else slice(None, None, -1)
    raster = _raster(edges[rising], codes, heights[:, rising], ax.get_xlim(), ax.get_ylim())
    palette.write_letters(ax, raster, codes[codes >= 0].tolist())


def _draw_intervals(ax: Axes, data: xr.Dataset, parameter: str, bands: Sequence[_Band]) -> None:
    """Draw the confidence interval of the upper edge of each band, side by side."""
    limits = style.edges(data[parameter].values.astype(np.float64))
    n = data["n_cells"].values
    floor = np.zeros(n.size)
    for k, band in enumerate(bands[:-1]):
        floor = floor + band.height
        below = np.rint(floor * n)
        low, high = binomial_interval(below, n)
        chosen = (band.height > 0) & (below < n)
        x = (limits[:-1] + np.diff(limits) * (k + 1) / len(bands))[chosen]
        mark = letter(band.attractor) if band.attractor >= 0 else band.name
        for looks in (_BAR | {"linewidth": 1.6, "color": "white"}, _BAR):
            ax.vlines(x, low[chosen], high[chosen], gid=f"interval:{mark}", **looks)


def _raster(
    edges: np.ndarray, codes: np.ndarray, heights: np.ndarray, xlim: tuple[float, float], ylim: tuple[float, float]
) -> np.ndarray:
    """Return an image of the bands that has the attractor id at each pixel, bottom row first; -1 for none."""
    place = (np.arange(300) + 0.5) / 300
    x, y = (low + place * (high - low) for low, high in (xlim, ylim))
    column = np.clip(np.searchsorted(edges, x) - 1, 0, heights.shape[1] - 1)
    tops = np.cumsum(heights, axis=0)[:, column]
    band = (y[:, None, None] >= tops[None]).sum(axis=1)
    raster = np.asarray(codes[np.minimum(band, len(codes) - 1)], np.int32)
    raster[:, (x < edges[0]) | (x > edges[-1])] = -1
    raster[(y < 0.0) | (y > 1.0)] = -1
    return raster


def needs_density(run: OpenRun, options: FractionFigureOptions) -> None:
    """Raise ValueError if cells are to be weighed, and they are no independent starts, or it is no density."""
    if options.density != "1":
        check_starts(run.cube())
        check_density(run, options.density)


def draw_fractions(run: OpenRun, options: FractionFigureOptions) -> style.DataFigure:
    """Draw the figure ``fractions`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("attractors")
    return noted(plot_fractions(found, at=at, density=options.density, frame=frame_of(options)), notes)


_UP_PT, _DOWN_PT, _TINT = 1.5, 4.2, 0.55
_SPAN: dict[str, Any] = {"facecolor": "0.9", "edgecolor": "none", "linewidth": 0.0}


@style.drawn
def plot_coexisting(
    attractors: xr.Dataset,
    *,
    state: str = "",
    at: Mapping[str, float] | None = None,
    degrees: bool = False,
    hysteresis: xr.Dataset | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the section points of all attractors of a run over the swept parameter.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` over one parameter or more.
    state
        Name of the state drawn; by default the model's first.
    at
        Values of the other swept parameters.
    degrees
        Degrees instead of radians.
    hysteresis
        Result of `pipeline.analysis.attractors.hysteresis.hysteresis`; its loops are shaded.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        In a sweep the area of each point grows with the attractor's basin fraction, divided among its points.
        In a continuation in both directions small dark points belong to the upward continuation, large light
        points to the downward one. A set that does not close is drawn by its stored points. Where a set does
        not attract, its points are small and grey.
        Its `data` hold ``value`` and the variables that set the look
        of each point: ``stability`` and ``share``, or ``present`` for each direction.

    Raises
    ------
    ValueError
        If the state is unknown, or not exactly one swept parameter is left.
    """
    measure = labels.state_measure(attractors, state, degrees)
    parameter = swept_parameter(attractors, at, "attractors")
    keep = (parameter, *start_dims(attractors))
    part = dense(choose(attractors, at, keep, f"attractors are drawn over {parameter}"), points=True)
    cast = palette.cast_of(attractors, part)
    data = _points(part, parameter, measure)
    loops = _loops(hysteresis, part, parameter) if hysteresis is not None else []
    both = "direction" in data.dims
    fig, ax = palette.new_panel(data, _entries(data, cast, both, bool(loops)), frame)
    style.style_axes(ax)
    for low, high in loops:
        ax.axvspan(low, high, gid="loop", zorder=0.5, **_SPAN)
    for number in sorted(range(len(cast.names)), key=lambda i: float(data["share"].isel(attractor=i).sum())):
        (_draw_directions if both else _draw_weighted)(ax, data.isel(attractor=number), parameter, cast)
    _draw_others(ax, data, parameter)
    ax.margins(y=0.05)
    style.limits(ax, frame, style.span(data[parameter].values))
    labels.angle_ticks(ax, measure)
    style.label_axes(ax, labels.parameter_label(data[parameter]), measure.label)
    style.complete(fig, ax, style.join([labels.caption(part, drop=[parameter]), left_out(part)]))
    return fig


def _points(part: xr.Dataset, parameter: str, measure: labels.Measure) -> xr.Dataset:
    """Return the section points to draw, with the basin fraction and the stability of each attractor."""
    values = part["attractor_points"].sel(state=measure.name, drop=True)
    values = values.transpose(parameter, "attractor", "point")
    shown = values.copy(data=measure.shown(values.values, wrap=True))
    data = xr.Dataset(
        {
            "value": shown.assign_attrs(units=measure.unit, long_name=f"{measure.name} at the section"),
            "share": part["share"].transpose(parameter, "attractor"),
            "stability": part["stability"].transpose(parameter, "attractor"),
        }
    )
    if "branch" in part["attractor_id"].dims and "direction" in part.coords:
        words = part["direction"].values.astype(str)
        names = [d for d in ("up", "down") if d in words]
        cells = part["attractor_id"].transpose(parameter, "branch").values
        ids = part["attractor"].values
        present = [(cells[:, words == d, None] == ids).any(axis=1) for d in names]
        data["present"] = (
            (parameter, "direction", "attractor"),
            np.stack(present, axis=1).astype(np.int8),
            {"units": "1", "long_name": "whether a branch of the direction is on it"},
        )
        data = data.assign_coords(direction=names)
    data = data.drop_vars([k for k in data.coords if data[k].dtype == object])
    data.attrs = {"title": "coexisting attractors"}
    return data


def _loops(found: xr.Dataset, part: xr.Dataset, parameter: str) -> list[tuple[float, float]]:
    """Return the parameter limits of the hysteresis loops at the chosen values of the other parameters."""
    axis = part[parameter].values.astype(np.float64)
    edges = style.edges(axis)
    here = np.ones(found.sizes["loop"], bool)
    for name in found.data_vars:
        other = str(name).removeprefix("loop_at_")
        if other != name and other in part.coords:
            here &= np.isclose(found[name].values, float(part[other]))
    limits = []
    for a, b in zip(found["loop_from"].values[here], found["loop_to"].values[here], strict=True):
        first, last = (int(np.abs(axis - x).argmin()) for x in (a, b))
        limits.append((float(edges[first]), float(edges[last + 1])))
    return limits


def _spread(one: xr.Dataset, parameter: str, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the chosen points of an attractor: parameter values, drawn values, indices of the parameter values."""
    values = one["value"].transpose(parameter, "point").values
    row, column = np.nonzero(np.isfinite(values) & chosen[:, None])
    return one[parameter].values[row].astype(np.float64), values[row, column], row


def _draw_weighted(ax: Axes, one: xr.Dataset, parameter: str, cast: palette.Cast) -> None:
    share = one["share"].values
    x, y, row = _spread(one, parameter, share > 0)
    number = int(one["attractor"])
    size = _diameter(share[row] / np.bincount(row)[row]) ** 2 if row.size else 1.0
    ax.scatter(x, y, s=size, c=cast.colours[number], linewidths=0.0, rasterized=True, gid=f"points:{letter(number)}")


def _draw_others(ax: Axes, data: xr.Dataset, parameter: str) -> None:
    """Draw the section points of sets that do not attract, in a grey for each kind of stability."""
    for code, grey in palette.GREY_OF.items():
        chosen = (data["stability"].values == code)[..., None] & np.isfinite(data["value"].values)
        row, *_ = np.nonzero(chosen)
        if row.size:
            x, y = data[parameter].values[row].astype(np.float64), data["value"].values[chosen]
            style.points(ax, x, y, _UP_PT, grey, zorder=1.5, rasterized=True, gid=f"points:{_word(code)}")


def _word(stability: int) -> str:
    return STABILITIES[stability].replace("_", " ")


def _diameter(share: Any) -> Any:
    least, growth = 1.1, 5.0  # diameters without and with all cells [pt]
    return np.sqrt(least**2 + growth**2 * np.asarray(share))


def _draw_directions(ax: Axes, one: xr.Dataset, parameter: str, cast: palette.Cast) -> None:
    """Draw an attractor's points for both directions of continuation: small dark ones over large light ones."""
    number = int(one["attractor"])
    for word in one["direction"].values[::-1]:
        chosen = (one["present"].sel(direction=word).values > 0) & (one["stability"].values == ATTRACTS)
        x, y, _ = _spread(one, parameter, chosen)
        up = word == "up"
        size, colour = _UP_PT if up else _DOWN_PT, style.tinted(cast.colours[number], 0.0 if up else _TINT)
        gid = f"points:{word}:{letter(number)}"
        style.points(ax, x, y, size, colour, zorder=2.2 if up else 2.0, rasterized=True, gid=gid)


def _entries(data: xr.Dataset, cast: palette.Cast, both: bool, loops: bool) -> list[palette.Entry]:
    total = data["share"].values.sum(axis=0)
    ranked = [i for i in cast.order if i in cast.main and total[i] > 0]
    met = {int(code) for code in np.unique(data["stability"].values)}
    entries: list[palette.Entry] = [(cast.names[i], cast.colours[i]) for i in ranked]
    rest = sum(total[i] > 0 for i in cast.names if i not in cast.main)
    if rest:
        entries.append((f"{rest} others", palette.OTHERS))
    entries += [(_word(code), grey) for code, grey in palette.GREY_OF.items() if code in met]
    if both:
        entries += [style.dot("up", "0.0", _UP_PT), style.dot("down", style.tinted("0.0", _TINT), _DOWN_PT)]
    else:
        sizes = ((1.0, "basin fraction per point 1"), (0.1, "0.1"), (0.0, "below 0.01"))
        entries += [style.dot(text, "0.3", float(_diameter(share))) for share, text in sizes]
    if loops:
        entries.append(Patch(label="up and down differ", **_SPAN))
    return entries


def draw_coexisting(run: OpenRun, options: StateOptions) -> style.DataFigure:
    """Draw the figure ``attractors`` of a run, with hysteresis loops if it was continued in both directions."""
    at, notes = values_of(run, options)
    found = run.derive("attractors")
    both = "direction" in found.coords and {"up", "down"} == set(found["direction"].values.astype(str).tolist())
    loops = run.derive("hysteresis") if both else None
    figure = plot_coexisting(
        found, state=options.state, at=at, degrees=options.degrees, hysteresis=loops, frame=frame_of(options)
    )
    return noted(figure, notes)
