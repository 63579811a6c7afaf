"""Draw rotation numbers over parameters, and Arnold tongues in the plane of two parameters."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.branches.declaration import TongueFigureOptions, TongueOptions
from pipeline.analysis.branches.figure import take_room
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import fixed_of, swept_parameters
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.products.product import FigureOptions
from pipeline.results.run import OpenRun

UNKNOWN = "0.8"

_NAME: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "bottom"}


@style.drawn
def plot_rotation(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the rotation numbers of a run's cells over one swept parameter, or in the plane of two.

    Over one parameter every cell has a dot, blue where it is locked to the drive (closed), and steps p/q with
    denominators up to 5 have their names. Over two the colour is the median over the cells of a point; points at
    which all cells are locked have white dots. The figure's `data` hold ``rotation`` and ``locked``, the share of the
    cells that are. Raise ValueError if there are no rotation numbers, or more than two swept parameters are left.
    """
    if "rotation" not in ds:
        raise ValueError("the cube has no rotation numbers; run it with [products] rotation = {} in its specification")
    part = at_points(ds, at)
    swept = [d for d in swept_parameters(part) if part.sizes[d] > 1]
    if len(swept) not in (1, 2):
        raise ValueError(
            f"rotation numbers are drawn over one or two swept parameters, and {len(swept)} are left "
            f"({', '.join(swept) or 'none'}); choose values of the others with at"
        )
    data = rotation_data(part, swept)
    fig = style.new_figure(4.4, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=len(swept) == 1)
    text = style.join([labels.caption(part, drop=swept), _about(part)])
    if len(swept) == 1:
        _draw_staircase(fig, ax, data, part[swept[0]])
    else:
        draw_map(fig, ax, data, swept)
    style.caption(ax, text)
    style.limits(ax, frame, *(style.span(part[d].values) for d in swept))
    style.finish(fig)
    return fig


def rotation_data(part: xr.Dataset, swept: list[str]) -> xr.Dataset:
    """Return the rotation numbers to draw, and which cells (over two parameters: which share) are locked."""
    locked = (part["orbit_period"] > 0).where(part["rotation"].notnull())
    data = xr.Dataset({"rotation": part["rotation"], "locked": locked}).load()
    if len(swept) == 2:
        cells = [d for d in data["rotation"].dims if d not in swept]
        data = xr.Dataset({"rotation": data["rotation"].median(cells), "locked": data["locked"].mean(cells)})
        data = data.transpose(swept[1], swept[0])
    keep = {*data["rotation"].dims, *swept}
    data = data.drop_vars([c for c in data.coords if c not in keep])
    data["rotation"].attrs = {"units": "1", "long_name": f"turns per {model_of(part).clock.period}"}
    return data.assign_attrs(title="rotation numbers")


def _about(part: xr.Dataset) -> str:
    known, error = part["rotation"].notnull(), part["rotation_error"]
    size = f"errors up to {float(error.max()):.1g}, half of them below {float(error.median()):.1g}"
    missing = int((~known).sum())
    return style.join([size if known.any() else "", f"{missing} of {known.size} cells have none" if missing else ""])


def _draw_staircase(fig: style.DataFigure, ax: Axes, data: xr.Dataset, axis: xr.DataArray) -> None:
    rotation = data["rotation"].transpose(axis.name, ...).values.reshape(axis.size, -1)
    locked = data["locked"].transpose(axis.name, ...).values.reshape(axis.size, -1) > 0
    x = np.broadcast_to(axis.values.astype(np.float64)[:, None], rotation.shape)
    for which, colour, name in ((~locked, "0.55", "not locked"), (locked, style.BLUE, "locked: closed orbits")):
        ax.plot(x[which], rotation[which], ".", color=colour, markersize=2.5, label=name, gid=name.split(":")[0])
    style.label_axes(ax, labels.parameter_label(axis), f"rotation number [{data['rotation'].attrs['long_name']}]")
    style.legend_above(fig, [style.dot("locked: closed orbits", style.BLUE), style.dot("not locked", "0.55")])
    for fraction, (low, high) in _steps(x[locked], rotation[locked], axis).items():
        text, at = f"{fraction.numerator}/{fraction.denominator}", (0.5 * (low + high), float(fraction))
        ax.annotate(text, at, (0.0, 4.0), fontsize=fig.look.tick, annotation_clip=True, **_NAME)


def _steps(x: np.ndarray, rotation: np.ndarray, axis: xr.DataArray) -> dict[Fraction, tuple[float, float]]:
    """Return the parameter interval of each step p/q of a devil's staircase; short steps are left out."""
    # largest denominator of the steps p/q that are named, the least length of such a step in units of the axis, and the
    # largest distance of the rotation number of a closed orbit from p/q
    named, least_step, close = 5, 0.01, 1e-6
    whole = float(axis.max() - axis.min())
    found = {}
    for value in np.unique(np.round(rotation, 9)):
        fraction = Fraction(float(value)).limit_denominator(named)
        if abs(float(fraction) - value) > close:
            continue
        here = x[np.abs(rotation - value) < close]
        if here.max() - here.min() >= least_step * whole:
            found[fraction] = (float(here.min()), float(here.max()))
    return found


def draw_map(fig: style.DataFigure, ax: Axes, data: xr.Dataset, swept: list[str]) -> None:
    """Draw rotation numbers as colours in the plane of two parameters, with white dots where all cells are locked."""
    grid, locked = data["rotation"].values, data["locked"].values
    x, y = (data[d].values.astype(np.float64) for d in swept)
    known = grid[np.isfinite(grid)]
    norm = Normalize(*((known.min(), known.max()) if known.size else (0.0, 1.0)))
    ax.set_facecolor(UNKNOWN)
    ax.pcolormesh(style.edges(x), style.edges(y), np.ma.masked_invalid(grid), norm=norm, rasterized=True, gid="map")
    j, i = np.nonzero(locked == 1.0)
    ax.plot(x[i], y[j], ".", color="white", markersize=1.2, gid="locked", rasterized=True)
    style.label_axes(ax, *(labels.parameter_label(data[d]) for d in swept))
    entries: list[Artist] = [style.dot("locked: closed orbits", "black", face="white", size=3.5)] if len(i) else []
    if not np.isfinite(grid).all():
        entries.append(Patch(facecolor=UNKNOWN, label="no rotation number"))
    if entries:
        style.legend_above(fig, entries)
    bar = fig.colorbar(ScalarMappable(norm), ax=ax, pad=0.015, aspect=32, ticks=MaxNLocator(7))
    style.style_bar(bar, f"rotation number\n[{data['rotation'].attrs['long_name']}]")


def draw_rotation(run: OpenRun, options: FigureOptions) -> style.DataFigure:
    """Draw the figure ``rotation`` of a run."""
    at, notes = values_of(run, options)
    return noted(plot_rotation(run.cube(), at=at, frame=frame_of(options)), notes)


_COLOURS = (style.VERMILLION, style.BLUE, style.GREEN, style.PURPLE, "black")
"""Colours of the edges over a blank plane, by denominator; later denominators share the last."""


@style.drawn
def plot_tongues(
    ds: xr.Dataset, cube: xr.Dataset | None = None, *, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the edges of Arnold tongues in the plane of two parameters, each with its name p/q.

    Edges are black over the map of a cube's rotation numbers, if it is given; else their colour tells the denominator.
    """
    first, second = str(ds.attrs["first_parameter"]), str(ds.attrs["second_parameter"])
    stored = style.storable(ds, "Arnold tongues")
    data = rotation_data(cube, [first, second]) if cube is not None else None
    fig = style.new_figure(4.4, stored if data is None else stored.merge(data), frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=data is None)
    if data is not None:
        draw_map(fig, ax, data, [first, second])
    low, high = ax.get_xlim(), ax.get_ylim()
    _draw_edges(ax, ds, data is not None)
    if data is not None:
        ax.set_xlim(low)
        ax.set_ylim(high)
    named = ((name, shown_unit(ds[role].attrs)) for name, role in ((first, "first"), (second, "second")))
    style.label_axes(ax, *(labels.swept_label(name, unit) for name, unit in named))
    if data is None:
        _explain(fig, ds)
    found = f"{int((ds['n_branches'] > 0).sum())} of {ds.sizes['tongue']} tongues"
    told = f"{found} with denominators up to {ds.attrs['max_denominator']}"
    searched = f"searched at {second} = {ds.attrs['row']:g}"
    style.caption(ax, style.join([told, searched, labels.caption(ds, with_start=False)]))
    style.limits(ax, frame)
    _name_tongues(fig, ax, ds)
    style.finish(fig)
    return fig


def _colour(denominator: int) -> str:
    return _COLOURS[min(denominator, len(_COLOURS)) - 1]


def _draw_edges(ax: Axes, ds: xr.Dataset, over_map: bool) -> None:
    for i in range(ds.sizes["curve"]):
        n, p, q = (int(ds[name][i]) for name in ("n_points", "numerator", "denominator"))
        look: dict[str, Any] = {"color": "black", "path_effects": style.halo()} if over_map else {"color": _colour(q)}
        line = ds["first"].values[i, :n], ds["second"].values[i, :n]
        ax.plot(*line, linewidth=0.9, gid=f"tongue:{p}/{q}", **look)


def _name_tongues(fig: style.DataFigure, ax: Axes, ds: xr.Dataset) -> None:
    """Write the name p/q of each tongue at the highest point of its edges, if there is room."""
    taken: list[np.ndarray] = []
    (left, right), (bottom, ceiling) = ax.get_xlim(), ax.get_ylim()
    order = np.lexsort((ds["numerator"].values, ds["denominator"].values))
    tops: dict[tuple[int, int], np.ndarray] = {}
    for i in order:
        p, q = int(ds["numerator"][i]), int(ds["denominator"][i])
        points = np.column_stack([ds["first"].values[i], ds["second"].values[i]])
        inside = (points - [left, bottom]) / [right - left, ceiling - bottom]
        inside = inside[((inside >= 0.0) & (inside <= 1.0)).all(axis=1)]
        if q and len(inside) and inside[:, 1].max() > tops.get((p, q), np.zeros(2))[1]:
            tops[p, q] = inside[int(np.argmax(inside[:, 1]))]
    for (p, q), top in tops.items():
        at = np.minimum(top, [1.0, 0.955])
        if not take_room(ax, (left + at[0] * (right - left), bottom + at[1] * (ceiling - bottom)), taken):
            continue
        look = {**_NAME, "fontsize": fig.look.tick, "path_effects": style.halo(), "zorder": 7}
        ax.annotate(f"{p}/{q}", at, (0.0, 1.5), xycoords="axes fraction", **look)


def _explain(fig: style.DataFigure, ds: xr.Dataset) -> None:
    present = sorted({int(q) for q in ds["denominator"].values if q})
    names = [f"denominator {q}" if q < len(_COLOURS) else f"denominator {len(_COLOURS)} or more" for q in present]
    colours = dict(zip(names, map(_colour, present), strict=True))
    style.legend_above(fig, [style.dot(name, colour) for name, colour in colours.items()])


def draw_tongues(run: OpenRun, options: TongueFigureOptions) -> style.DataFigure:
    """Draw the figure ``tongues`` of a run, over its rotation numbers if the run sweeps both parameters."""
    found = run.derive("tongues", **options.part(TongueOptions))
    plane = {str(found.attrs[f"{role}_parameter"]) for role in ("first", "second")}
    cube = run.cube()
    fixed = fixed_of(at_points(cube, options.at).squeeze())
    found = found.assign_coords({name: value for name, value in fixed.items() if name not in plane})
    swept = [d for d in swept_parameters(cube) if cube.sizes[d] > 1]
    return plot_tongues(found, cube if set(swept) == plane else None, frame=frame_of(options))
