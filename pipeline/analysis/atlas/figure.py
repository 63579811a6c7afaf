"""Draw the atlas of a plane of two parameters: regions, curves, lines, and changes that nothing explains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path

from pipeline.analysis.atlas.declaration import AtlasFigureOptions, AtlasOptions
from pipeline.analysis.atlas.plane import Array
from pipeline.analysis.atlas.sentences import LEAST_AREA
from pipeline.analysis.atlas.shapes import Piece, bounds_of, line_places, pieces_of, rings_of
from pipeline.analysis.atlas.table import audit_of, kind_text
from pipeline.analysis.branches.figure import curve_look, mark_points
from pipeline.analysis.branches.kinds import CURVE_KINDS, LABELS, NAMES
from pipeline.analysis.events.kinds import EVENTS, LIVES_ON, UNDECIDED
from pipeline.layout.conventions import shown_unit
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import counted, words_of

REGION_TINT = 0.55
"""Share of white in the tints of regions: any two of the twelve differ by 6 or more, measured as in `palette`."""

_PALE = 0.5
"""Share of white in the colours of curves whose orbits are unstable on both sides."""

_GREYS = {"none": "0.8", "not seen": "1.0"}
"""Of regions without attractors, and of those without parameter points."""

_HATCH: dict[str, Any] = {"hatch": "/////", "edgecolor": "0.7", "linewidth": 0.0, "hatch_linewidth": 0.5}
_LINE: dict[str, Any] = {"color": "0.15", "linewidth": 0.9, "linestyle": (0, (1, 1.4))}
_MARK: dict[str, Any] = {"markersize": 4.0, "markerfacecolor": "white", "markeredgewidth": 0.7}


_ROOM = 0.6
"""Radius of the circle in a region into which its label fits, in units of the label's box."""


class _Marks(NamedTuple):
    """Changes that are marked alike: the name of the marks, their legend, their look, and their places."""

    gid: str
    label: str
    look: dict[str, Any]
    places: Array  # (2, change)


_MARKED = {
    UNDECIDED: ("not_explained", "not explained", {"marker": "x", "markersize": 4.5, "markeredgewidth": 1.1}),
    LIVES_ON: ("not_found", "stable, not found", {"marker": "o", "markersize": 2.6, "markeredgewidth": 0.6}),
}
_MARKED[LIVES_ON][2].update(markerfacecolor="none")


@style.drawn
def plot_atlas(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the atlas of a plane of two parameters.

    Parameters
    ----------
    ds
        From `pipeline.analysis.atlas`.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Regions with the same attractors have one tint; regions of which fewer than 299 cells are known are hatched,
        unless all are. Curves have the colours and dashes of the figure ``curves``; they are thin and pale where their
        orbits are unstable on both sides. Dotted lines join ends that lie on no curve. A cross marks each change that
        is not explained, and a circle each stable orbit that the cells of the neighbouring point do not find. Its
        `data` are the atlas.
    """
    pieces, marks = list(pieces_of(ds)), list(_marks(ds))
    tints = region_tints(ds)
    entries = [*_region_entries(ds, tints), *_curve_entries(ds, pieces), *_line_entries(ds), *_mark_entries(marks)]
    data = style.storable(ds, "atlas").assign(region_label=ds["region_label"].astype(str))
    fig, ax = palette.new_panel(data, entries, frame, 4.6, handle=2.2)
    low, high = bounds_of(ds)
    style.limits(ax, frame, (low[0], high[0]), (low[1], high[1]))
    _fill(ax, ds, tints)
    _draw_curves(ax, ds, pieces)
    _draw_lines(ax, ds)
    for one in marks:
        look = {**one.look, "markersize": one.look["markersize"] * (0.7 if frame.compact else 1.0)}
        ax.plot(*one.places, color="black", linestyle="none", gid=one.gid, zorder=5.0, **look)
    special = np.stack([ds["special_first"].values, ds["special_second"].values], axis=-1)
    within = ((special >= low) & (special <= high)).all(axis=1)
    mark_points(ax, ds.isel(special=np.flatnonzero(within)), "first", "second", fig.look.tick)
    names = [str(ds.attrs[f"{which}_parameter"]) for which in ("first", "second")]
    units = [shown_unit(ds[f"corner_{which}"].attrs) for which in ("first", "second")]
    style.label_axes(ax, *map(labels.swept_label, names, units))
    style.caption(ax, _caption(ds), 1.0 if frame.compact else 0.75)
    style.finish(fig)
    _name_regions(ax, ds, special[within], fig.look.legend)
    return fig


# ---- regions -----------------------------------------------------------------------------------


def region_tints(ds: xr.Dataset) -> dict[str, Any]:
    """Return the tint of each label of a region: the labels with the largest areas have the colours of the style."""
    total = _areas(ds)
    own = [name for name, area in total.items() if name not in _GREYS and area >= LEAST_AREA]
    tints = {name: style.tinted(colour, REGION_TINT) for name, colour in zip(own, style.colours(), strict=False)}
    return {name: tints.get(name, _GREYS.get(name, palette.OTHERS)) for name in total}


def _areas(ds: xr.Dataset) -> dict[str, float]:
    """Return the area of all regions with each label, the largest first."""
    total: dict[str, float] = {}
    for name, area in zip(ds["region_label"].values, ds["area"].values, strict=True):
        total[str(name)] = total.get(str(name), 0.0) + float(area)
    return dict(sorted(total.items(), key=lambda one: -one[1]))


def _region_entries(ds: xr.Dataset, tints: dict[str, Any]) -> list[palette.Entry]:
    total = _areas(ds)
    entries: list[palette.Entry] = [
        (f"{name}, {palette.percent(total[name])}", colour)
        for name, colour in tints.items()
        if colour != palette.OTHERS
    ]
    others = [name for name, colour in tints.items() if colour == palette.OTHERS]
    if others:
        met = palette.percent(sum(total[name] for name in others))
        entries.append((f"{len(others)} others, {met}", palette.OTHERS))
    if _is_hatched(ds).any():
        entries.append(Patch(facecolor="white", label="fewer than 299 cells", **_HATCH))
    return entries


def _is_hatched(ds: xr.Dataset) -> Array:
    """Return which regions are hatched: those with fewer than 299 known cells, unless all have so few."""
    thin = ds["is_thin"].values == 1
    return np.asarray(thin & ~thin.all())


def _fill(ax: Axes, ds: xr.Dataset, tints: dict[str, Any]) -> None:
    hatched = _is_hatched(ds)
    for number, rings in enumerate(rings_of(ds)):
        path = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
        tint = tints[str(ds["region_label"].values[number])]
        ax.add_patch(PathPatch(path, facecolor=tint, edgecolor="none", zorder=1.0, gid=f"region:{number}"))
        if hatched[number]:
            ax.add_patch(PathPatch(path, facecolor="none", zorder=1.5, gid=f"thin:{number}", **_HATCH))


# ---- curves, lines, marks ----------------------------------------------------------------------


def _look_of(ds: xr.Dataset, curve: int) -> dict[str, Any]:
    periods = sorted({int(period) for period in ds["orbit_period"].values})
    return curve_look(CURVE_KINDS[int(ds["kind"][curve])], int(ds["orbit_period"][curve]), periods)


def _curve_entries(ds: xr.Dataset, pieces: Sequence[Piece]) -> list[palette.Entry]:
    """Return the entries of the curves that are drawn, by rising period: of each, or of kinds and of dashes apart."""
    seen = {(int(ds["orbit_period"][one.curve]), int(ds["kind"][one.curve])): one.curve for one in pieces}
    looks = [_look_of(ds, seen[key]) for key in sorted(seen)]
    kinds = {code: {**look, "linestyle": "-"} for (_, code), look in zip(sorted(seen), looks, strict=True)}
    periods: dict[Any, list[int]] = {}
    for (period, _), look in zip(sorted(seen), looks, strict=True):
        if period not in periods.setdefault(look["linestyle"], []):
            periods[look["linestyle"]].append(period)
    if len(kinds) + len(periods) < len(looks):
        looks = [{**kinds[code], "label": _kind_label(code)} for code in sorted(kinds)]
        looks += [{"color": "0.3", "linestyle": dash, "label": _period_label(own)} for dash, own in periods.items()]
    if not all(one.is_stable for one in pieces):
        looks.append({"color": "0.6", "linewidth": 0.6, "label": "pale: unstable on both sides"})
    return [Line2D([], [], **{"linewidth": 1.2, **look}) for look in looks]


def _kind_label(code: int) -> str:
    return f"{LABELS[CURVE_KINDS[code]]} {NAMES[CURVE_KINDS[code]]}"


def _period_label(periods: Sequence[int]) -> str:
    return f"period {', '.join(map(str, periods))}" if periods != [0] else "equilibrium"


def _draw_curves(ax: Axes, ds: xr.Dataset, pieces: Sequence[Piece]) -> None:
    for number, places, is_stable in pieces:
        look = _look_of(ds, number) | {"label": "_"}
        if is_stable:
            look |= {"linewidth": 1.3, "zorder": 4.0}
        else:
            look |= {"linewidth": 0.6, "zorder": 3.0, "color": style.tinted(style.as_hex(look["color"]), _PALE)}
        ax.plot(*places.T, gid=f"curve:{number}", **look)


def _kinds_of_lines(ds: xr.Dataset) -> list[str]:
    """Return what lies on each line."""
    words = words_of(ds["line_what"]) if ds.sizes["line"] else []
    return [words[code] for code in ds["line_what"].values.tolist()]


def _marker_of(kind: str) -> str:
    return (EVENTS[kind].marker if kind in EVENTS else "") or "."


def _line_entries(ds: xr.Dataset) -> list[palette.Entry]:
    kinds = sorted(set(_kinds_of_lines(ds)))
    return [
        Line2D([], [], marker=_marker_of(kind), label=f"{kind_text(kind)}, on no curve", **_LINE, **_MARK)
        for kind in kinds
    ]


def _draw_lines(ax: Axes, ds: xr.Dataset) -> None:
    """Draw the lines, with the marker of their kind in the middle."""
    for number, kind in enumerate(_kinds_of_lines(ds)):
        places = line_places(ds, number)
        look = {"marker": _marker_of(kind), **_LINE, **_MARK}
        ax.plot(*places.T, markevery=[len(places) // 2], gid=f"line:{number}", zorder=4.5, **look)


def _marks(ds: xr.Dataset) -> Iterator[_Marks]:
    """Yield the changes that are marked."""
    words = words_of(ds["what"])
    for what, (gid, text, look) in _MARKED.items():
        own = ds["what"].values == words.index(what)
        if own.any():
            places = np.stack([ds[f"change_{which}"].values[own] for which in ("first", "second")])
            yield _Marks(gid, f"{text}: {int(own.sum())}", look, places)


def _mark_entries(marks: Sequence[_Marks]) -> list[palette.Entry]:
    return [Line2D([], [], color="black", linestyle="none", label=one.label, **one.look) for one in marks]


def _caption(ds: xr.Dataset) -> str:
    """Say what the tints show, what the audit counted, and the fixed values."""
    n = audit_of(ds)
    counts = (("on curves", "on_curves"), ("on lines", "on_lines"), ("not found", "not_found"))
    told = [f"{n[name]} {text}" for text, name in (*counts, ("not explained", "not_explained")) if n[name]]
    seen = f"{counted(n['seen'], 'change')}{': ' if told else ''}{', '.join(told)}"
    thin = "fewer than 299 cells in each region" if (ds["is_thin"].values == 1).all() else ""
    return style.join(["periods of the coexisting attractors; " + seen, thin, labels.caption(ds, with_start=False)])


# ---- names in regions --------------------------------------------------------------------------


def _name_regions(ax: Axes, ds: xr.Dataset, special: Array, size: float) -> None:
    """Write the label of each region into its widest part, away from lines and marks, if the label fits there.

    The axes are at their final place. `special` are the places of the named points of codimension two.
    """
    import shapely

    scale = 72.0 / ax.figure.dpi
    named = _on_page(ax, special, scale)[:, None] + [[0.0, 0.0], [0.7 * size, 0.5 * size], [1.6 * size, 0.5 * size]]
    ink = [*(shapely.linestrings(one) for one in named), *_ink(ax, scale)]
    covered = shapely.union_all(shapely.buffer(shapely.simplify(np.array(ink, object), 0.25), 1.75))
    window = shapely.box(*np.ravel(ax.get_window_extent().get_points() * scale))
    for number, rings in enumerate(rings_of(ds)):
        text = str(ds["region_label"].values[number])
        outer, *holes = (shapely.linearrings(_on_page(ax, ring, scale)) for ring in rings)
        shape = shapely.intersection(shapely.make_valid(shapely.polygons(outer, holes or None)), window)
        box = np.array([0.5 * size * len(text) + 4.0, size + 4.0])
        free = shapely.transform(shapely.difference(shape, covered), lambda xy, box=box: xy / box)
        if free.area < 1.0:
            continue
        circle = shapely.maximum_inscribed_circle(free, tolerance=0.05)
        if shapely.length(circle) > _ROOM:
            place = shapely.get_coordinates(circle)[0] * box / scale
            ax.annotate(
                text,
                place,
                xycoords="figure pixels",
                ha="center",
                va="center_baseline",
                fontsize=size,
                zorder=6.0,
                gid=f"label:{number}",
                path_effects=style.halo(1.5),
            )


def _on_page(ax: Axes, places: Array, scale: float) -> Array:
    """Return places on the page [pt]."""
    return np.asarray(ax.transData.transform(places.reshape(-1, 2)) * scale)


def _ink(ax: Axes, scale: float) -> Iterator[Any]:
    """Yield the shapes of all lines and marks [pt] that names must not cover."""
    import shapely

    for line in ax.get_lines():
        xy = _on_page(ax, np.asarray(line.get_xydata(), float), scale)
        yield shapely.multipoints(xy) if line.get_linestyle() == "None" or len(xy) < 2 else shapely.linestrings(xy)


def draw_atlas(run: OpenRun, options: AtlasFigureOptions) -> style.DataFigure:
    """Draw the figure ``atlas`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("atlas", **{**options.part(AtlasOptions), "at": at})
    return noted(plot_atlas(found, frame=frame_of(options)), notes)
