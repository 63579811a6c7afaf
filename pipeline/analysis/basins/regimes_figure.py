"""Draw maps of regimes and bifurcation curves in the plane of two parameters."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, to_hex, to_rgb
from matplotlib.lines import Line2D

from pipeline.analysis.basins.declaration import RegimeOptions
from pipeline.analysis.basins.numbers import unseen_bound
from pipeline.analysis.branches.declaration import CurveFigureOptions, CurveOptions
from pipeline.analysis.branches.figure import curve_look, draw_over, line_note, mark_points
from pipeline.analysis.branches.kinds import CURVE_KINDS
from pipeline.analysis.branches.levels import refuse_at
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import ATTRACTS, letter, parameter_name
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.outcomes import left_out, outcomes, share_interval
from pipeline.results.ragged import N_IDS, ROW_SIZE, SET, dims_of, index_of_rows
from pipeline.results.run import OpenRun
from pipeline.results.selection import choose, parameter_dims, start_dims
from pipeline.results.sets import rows_by_number

SHOWN = ("periods", "attractors", "number")
SHARE_LIMIT = 0.05
"""Share of cells without an attractor from which a point of the map is marked."""

_NEITHER = "not periodic"
_CROSS: dict[str, Any] = {
    "marker": "x",
    "markersize": 3.0,
    "markeredgewidth": 0.6,
    "color": "black",
    "linestyle": "none",
}


@style.drawn
def plot_regimes(
    attractors: xr.Dataset,
    *,
    show: str = "periods",
    at: Mapping[str, float] | None = None,
    curves: xr.Dataset | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw a regime map in the plane of two swept parameters: the coexisting attractors, their periods, or their
    number.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` for a run over two parameters or more.
    show
        ``periods``: which periods [drive periods] and whether motions that are not periodic coexist;
        ``attractors``: which ids do; ``number``: how many attractors.
    at
        Values of further swept parameters.
    curves
        Bifurcation curves in the plane of the map, drawn over it (`pipeline.analysis.branches.curves`).
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Up to twelve regimes have a colour each in one map. More are not told apart by colours: then each
        period, or each attractor, has a map of its own, dark where it is met, with the share of the cells
        as its depth. A cross marks points where more than `SHARE_LIMIT` of the cells have no attractor, so
        that one may be missing. Its `data` hold ``regime`` (index of the names in ``label``),
        ``n_attractors``, ``share_without``, ``share_of`` each ``member`` of the regimes (of more than twelve the
        rest in one, ``others``), and as rows (`pipeline.results.ragged`) the ``share`` of each attractor at each
        point. Of a sweep also ``low`` and ``high``, the 95 % Wilson interval of each share, and
        ``unseen_high``: a basin larger than this shows in one of the cells whose outcome is known with a
        probability of 95 % or more. The largest such bound, points with a cross left out, stands above
        the map.

    Raises
    ------
    ValueError
        For an unknown `show`, if there are not two swept parameters left, and for curves in another plane.
    """
    style.check_choice("show", show, SHOWN)
    x, y = _axes(attractors, at)
    keep = (x, y, *start_dims(attractors))
    part = choose(attractors, at, keep, f"a map of regimes has the axes {x} and {y}")
    data = _regimes(part, x, y, show)
    titles = {"periods": "periods of the coexisting attractors", "attractors": "coexisting attractors"}
    fixed = labels.caption(part, drop=[x, y])
    lines = line_note(curves) if curves is not None else ""
    text = style.join([titles.get(show, "number of attractors"), lines, fixed, _about(data), left_out(part)])
    several = show != "number" and np.unique(data["regime"]).size > len(style.colours())
    if curves is not None:
        data = _with_curves(data, curves, x, y)
    if several:
        fig = _draw_multiples(data, x, y, show, text, frame, palette.cast_of(attractors, part))
    else:
        fig = _draw_one(data, x, y, show, text, frame)
    if curves is not None:
        draw_over(fig, [ax for ax in fig.axes if ax.get_visible()], curves, x)
    style.finish(fig)
    return fig


def _with_curves(data: xr.Dataset, curves: xr.Dataset, x: str, y: str) -> xr.Dataset:
    plane = [str(curves.attrs[f"{role}_parameter"]) for role in ("first", "second")]
    if sorted(plane) != sorted([x, y]):
        raise ValueError(f"the curves lie in the plane of {' and '.join(plane)}, and the map in that of {x} and {y}.")
    numbers = curves.drop_vars([k for k, v in curves.variables.items() if v.dtype == object])
    names = {str(n): f"{n}_curves" for n in (*numbers.data_vars, *numbers.dims)}
    return data.merge(numbers.rename(names)).assign_attrs(data.attrs)


def _draw_one(data: xr.Dataset, x: str, y: str, show: str, text: str, frame: style.Frame) -> style.DataFigure:
    width = 0.85  # share of the figure's width for the caption of a map with a legend beside it
    colours, entries = _looks(data, show)
    if (data["share_without"] > SHARE_LIMIT).any():
        label = f"over {100 * SHARE_LIMIT:g} % of the cells\nwithout an attractor"
        entries.append(Line2D([], [], label=label, **_CROSS))
    fig, ax = palette.new_panel(data, entries, frame)
    edges = [style.edges(data[d].values.astype(np.float64)) for d in (x, y)]
    ax.pcolormesh(
        *edges,
        data["regime"].values,
        cmap=ListedColormap(colours),
        vmin=-0.5,
        vmax=len(colours) - 0.5,
        rasterized=True,
        gid="regimes",
    )
    _dress(ax, data, x, y, frame)
    style.label_axes(ax, labels.parameter_label(data[x]), labels.parameter_label(data[y]))
    style.caption(ax, text, 1.0 if frame.compact else width)
    return fig


def _draw_multiples(
    data: xr.Dataset, x: str, y: str, show: str, text: str, frame: style.Frame, cast: palette.Cast
) -> style.DataFigure:
    """Draw one panel per attractor or period, shaded by its share of the cells."""
    total = data["share_of"].sum([x, y]).values
    rest = int(data["share_of"].attrs["n_others"])
    chosen = range(data.sizes["member"] - bool(rest))
    columns = 2 if frame.compact else 4
    rows = math.ceil(len(chosen) / columns)
    width = frame.width_in / columns
    fig = style.new_figure(rows * 0.86 * width + 0.75, data, frame, exact=True)
    grid = fig.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    edges = [style.edges(data[d].values.astype(np.float64)) for d in (x, y)]
    for k, ax in enumerate(grid.ravel()):
        style.style_axes(ax, inside=False)
        style.few_ticks(ax, 3, 4)
        if k >= len(chosen):
            ax.set_visible(False)
            continue
        member = str(data["member"].values[chosen[k]])
        colour = _member_colour(member, show, cast)
        ramp = LinearSegmentedColormap.from_list("share", [style.tinted(colour, 0.75), to_rgb(colour)])
        share = np.ma.masked_equal(data["share_of"].values[..., chosen[k]], 0.0)
        mesh = ax.pcolormesh(*edges, share, cmap=ramp, vmin=0.0, vmax=1.0, rasterized=True)
        mesh.set_gid(f"member:{member}")
        _dress(ax, data, x, y, frame)
        ax.set_title(_member_name(member, show, cast), fontsize=fig.look.legend, loc="left", pad=2.5)
    fig.supxlabel(labels.parameter_label(data[x]), fontsize=fig.look.label)
    fig.supylabel(labels.parameter_label(data[y]), fontsize=fig.look.label)
    met = palette.percent(float(total[-1] / total.sum())) if rest else ""
    more = f"{rest} more, met by {met} of the cells, are not shown" if rest else ""
    note = style.join([text, "depth of colour: share of the cells", more])
    fig.suptitle(style.folded(note, frame.width_in - 0.3, fig.look.legend), fontsize=fig.look.legend, x=0.01, ha="left")
    return fig


def _member_name(member: str, show: str, cast: palette.Cast) -> str:
    if show == "attractors":
        name = next(n for n in cast.names.values() if n.startswith(f"{member}:"))
        return style.folded(name, 1.6, 8.0).partition("\n")[0].rstrip(",")
    return member if member == _NEITHER else f"period {member}"


def _member_colour(member: str, show: str, cast: palette.Cast) -> str:
    if show == "attractors":
        return next(cast.colours[i] for i in cast.colours if letter(i) == member)
    return style.VERMILLION if member == _NEITHER else style.BLUE


def _dress(ax: Axes, data: xr.Dataset, x: str, y: str, frame: style.Frame) -> None:
    """Cross out the parameter points where many cells have no attractor, and set the limits of the axes."""
    row, column = np.nonzero(data["share_without"].values > SHARE_LIMIT)
    if row.size:
        ax.plot(data[x].values[column], data[y].values[row], gid="without", **_CROSS)
    style.limits(ax, frame, style.span(data[x].values), style.span(data[y].values))


def _axes(attractors: xr.Dataset, at: Mapping[str, float] | None) -> tuple[str, str]:
    dims = parameter_dims(attractors)
    left = [d for d in dims if d not in (at or {})]
    long = [d for d in left if attractors.sizes[d] > 1]
    chosen = long if len(long) >= 2 else left
    if len(chosen) != 2:
        left_of = f"{len(chosen)} are left of {', '.join(dims)}" if dims else "this run sweeps none"
        raise ValueError(
            f"a map of regimes has two swept parameters, and {left_of}; sweep two, and choose values of any others"
        )
    (x, y) = chosen
    return (y, x) if y in labels.RATE_AXES else (x, y)


def _regimes(part: xr.Dataset, x: str, y: str, show: str) -> xr.Dataset:
    """Return the regime of each parameter point as a number; the most frequent regime has number 0."""
    shape = (part.sizes[y], part.sizes[x])
    rows = np.flatnonzero(part["stability"].values == ATTRACTS)
    index = dict(zip(dims_of(part), index_of_rows(part), strict=True))
    point = np.ravel_multi_index((index[y][rows], index[x][rows]), shape)
    periods, ids = part["orbit_period"].values[rows], part["attractor"].values[rows]
    own = rows_by_number(point)
    nothing = np.zeros(0, np.int64)
    values = [_label(np.sort(ids[k]), periods[k], show) for k in (own.get(i, nothing) for i in range(math.prod(shape)))]
    counts = Counter(values)
    names = sorted(counts, key=lambda name: (-counts[name], name))
    if show == "number":
        names.sort(key=int)
    without = (outcomes(part) < 0).mean(start_dims(part)).transpose(y, x)
    number = {name: i for i, name in enumerate(names)}
    regime = np.array([number[label] for label in values], np.int32).reshape(shape)
    n_attractors = np.bincount(point, minlength=math.prod(shape)).astype(np.int32).reshape(shape)
    attrs = {"units": "1", "long_name": "regime, an index of label"}
    data = xr.Dataset(
        {
            "regime": ((y, x), regime, attrs),
            "n_attractors": ((y, x), n_attractors, {"units": "1"}),
            "share_without": ((y, x), without.values, {"units": "1", "long_name": "share without attractor"}),
            **_numbers(part, x, y),
        },
        coords={x: part[x], y: part[y], "label": ("label", names), "attractor": part["attractor"].variable},
        attrs={"title": "regimes", "show": show, N_IDS: part.attrs[N_IDS]},
    )
    if show == "number":
        return data
    kinds, names_of = (ids, letter) if show == "attractors" else (periods, _period_name)
    met = (
        range(int(part.attrs[N_IDS]))
        if show == "attractors"
        else sorted(set(periods.tolist()), key=lambda p: p or math.inf)
    )
    share, most = part["share"].values[rows], len(style.colours())
    total = np.array([share[kinds == k].sum() for k in met])
    chosen = [met[k] for k in np.sort(np.argsort(-total, kind="stable")[:most])]
    parts = [kinds == k for k in chosen] + ([~np.isin(kinds, chosen)] if len(met) > most else [])
    tables = [np.bincount(point[own], share[own], math.prod(shape)).reshape(shape) for own in parts]
    stacked = np.stack(tables, axis=-1) if tables else np.zeros((*shape, 0))
    about = {"units": "1", "long_name": "share of all cells on attractors of this kind"}
    members = [names_of(k) for k in chosen] + ["others"] * (len(met) > most)
    shares = data.assign_coords(member=members).assign(share_of=((y, x, "member"), stacked, about))
    shares["share_of"].attrs["n_others"] = max(0, len(met) - most)
    return shares


def _period_name(period: int) -> str:
    return str(period) if period else _NEITHER


def _numbers(part: xr.Dataset, x: str, y: str) -> dict[str, Any]:
    """Return the basin fractions with their 95 % intervals, and a bound on the size of a basin that was missed."""
    about = {"units": "1", "long_name": "share of all cells"}
    found = {ROW_SIZE: part[ROW_SIZE].variable, "share": (SET, part["share"].values, about)}
    if "branch" not in start_dims(part):
        interval = share_interval(part["n_cells"].values, part["share"].values)
        for name, values in zip(("low", "high"), interval, strict=True):
            found[name] = (SET, values, {"units": "1", "long_name": f"95 % interval of the share, {name} end"})
        known = (outcomes(part) != -1).sum(start_dims(part)).transpose(y, x)
        attrs = {"units": "1", "long_name": "95 % bound on a basin not seen"}
        found["unseen_high"] = ((y, x), unseen_bound(known.values), attrs)
    return found


def _about(data: xr.Dataset) -> str:
    if "unseen_high" not in data:
        return ""
    bound = float(data["unseen_high"].where(data["share_without"] <= SHARE_LIMIT).max())
    return f"basins below {palette.percent(bound)} may be missing" if np.isfinite(bound) else ""


def _label(ids: np.ndarray, periods: np.ndarray, show: str) -> str:
    """Return the regime of a parameter point, from its attractors and their periods."""
    if show == "number":
        return str(ids.size)
    if not ids.size:
        return "none"
    if show == "attractors":
        return " + ".join(letter(int(i)) for i in ids)
    return " + ".join(_period_name(p) for p in sorted(set(periods.tolist()), key=lambda p: p or math.inf))


def _looks(data: xr.Dataset, show: str) -> tuple[list[str], list[palette.Entry]]:
    names = [str(v) for v in data["label"].values]
    if show == "number":
        ramp = matplotlib.colormaps[matplotlib.rcParams["image.cmap"]]
        shades = {name: to_hex(ramp(i / max(len(names) - 1, 1))) for i, name in enumerate(names)}
        shades |= {"0": palette.GREYS["pending"]} if "0" in shades else {}
        return list(shades.values()), list(shades.items())
    own = [name for name in names if name != "none"]
    colours = {**dict(zip(own, style.colours(), strict=False)), "none": palette.GREYS["pending"]}
    return [colours[name] for name in names], [(name, colours[name]) for name in sorted(names, key=_rank)]


def _rank(name: str) -> tuple[bool, list[tuple[float, str]]]:
    """Return the place of a regime in the legend: by rising periods, or by letters; what has no attractor last."""
    members = name.split(" + ")
    return name == "none", [(float(m) if m.isdigit() else math.inf, f"{len(m)}{m}") for m in members]


def draw_regimes(run: OpenRun, options: RegimeOptions) -> style.DataFigure:
    """Draw the figure ``regimes`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("attractors")
    curves = _curves_of(run.of(options.curves), found, at) if options.curves else None
    return noted(plot_regimes(found, show=options.show, at=at, curves=curves, frame=frame_of(options)), notes)


def _curves_of(run: OpenRun, attractors: xr.Dataset, at: Mapping[str, float]) -> xr.Dataset:
    """Compute the bifurcation curves of a run in the plane of a regime map, within the map's ranges."""
    x, y = _axes(attractors, at)
    axis = _swept_of(run, x, y)
    other = y if axis == x else x
    ranges = {name: (float(attractors[name].min()), float(attractors[name].max())) for name in (x, y)}
    return run.derive(
        "curves",
        parameter=parameter_name(axis),
        low=ranges[axis][0],
        high=ranges[axis][1],
        second=parameter_name(other),
        second_low=ranges[other][0],
        second_high=ranges[other][1],
    )


def _swept_of(run: OpenRun, x: str, y: str) -> str:
    """Return the parameter along which branches are followed: `x` or `y`, whichever the run sweeps."""
    swept = [name for name in (x, y) if run.cube().sizes.get(name, 1) > 1]
    return swept[0] if len(swept) == 1 else x


@style.drawn
def plot_curves(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw bifurcation curves and points of codimension two in the plane of two parameters.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches.curves`.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        The colour shows the kind, the dashes show the period. Points of codimension two have a dot and their
        short name. Its `data` are the curves.
    """
    fig = style.new_figure(4.4, style.storable(ds, "curves of bifurcations"), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    periods = sorted({int(p) for p in ds["orbit_period"].values})
    seen: dict[tuple[int, str], Line2D] = {}
    for i in range(ds.sizes["curve"]):
        n, period, kind = int(ds["n_points"][i]), int(ds["orbit_period"][i]), CURVE_KINDS[int(ds["kind"][i])]
        (line,) = ax.plot(
            ds["first"].values[i, :n], ds["second"].values[i, :n], linewidth=1.2, **curve_look(kind, period, periods)
        )
        seen.setdefault((period, kind), line)
    style.label_axes(
        ax,
        labels.swept_label(str(ds.attrs["first_parameter"]), shown_unit(ds["first"].attrs)),
        labels.swept_label(str(ds.attrs["second_parameter"]), shown_unit(ds["second"].attrs)),
    )
    style.limits(ax, frame)
    mark_points(ax, ds, "first", "second", fig.look.tick)
    style.caption(ax, labels.caption(ds, with_start=False))
    style.legend_above(fig, [seen[key] for key in sorted(seen)], size=fig.look.tick)
    style.finish(fig)
    return fig


def draw_curves(run: OpenRun, options: CurveFigureOptions) -> style.DataFigure:
    """Draw the figure ``curves`` of a run, alone or over the regime map of another run."""
    if not options.over:
        refuse_at(options.at, "the figure curves", "curves are drawn in the plane of both parameters")
        return plot_curves(run.derive("curves", **options.part(CurveOptions)), frame=frame_of(options))
    other = run.of(options.over)
    at, notes = values_of(other, options)
    found, below = run.derive("curves", **options.part(CurveOptions)), other.derive("attractors")
    return noted(plot_regimes(below, show=options.show, at=at, curves=found, frame=frame_of(options)), notes)
