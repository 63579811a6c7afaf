"""Draw branches of periodic orbits, their bifurcations and multipliers, and curves over maps of two parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from pipeline.analysis.branches.analysis import fixed_of, isolas_of, limits_of
from pipeline.analysis.branches.completeness import cut_words
from pipeline.analysis.branches.declaration import BranchFigureOptions, MultiplierOptions
from pipeline.analysis.branches.kinds import (
    BRANCH_POINTS,
    CURVE_KINDS,
    HOMOCLINIC,
    HOPF,
    KINDS,
    LABELS,
    LIMITS,
    MARKERS,
    NAMES,
)
from pipeline.analysis.branches.levels import at_levels, refuse_at
from pipeline.layout.vocabulary import axis_name
from pipeline.plots import labels, pixels, style
from pipeline.plots.bifurcation import Diagram, draw_bands, with_bands, with_diagram
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.plots.measured import columns_of, draw_sections, points_of, with_points
from pipeline.results.run import OpenRun
from pipeline.results.tabular import words_of

STABLE: dict[str, Any] = {"color": "black", "linewidth": 1.3, "linestyle": "-", "zorder": 6.0}
UNSTABLE: dict[str, Any] = {"color": "0.3", "linewidth": 0.7, "linestyle": (0, (4, 2)), "zorder": 5.0}
_NAME_PT = 7.0
_LEADER = {"arrowstyle": "-", "linewidth": 0.4, "color": "0.4", "shrinkA": 4.0, "shrinkB": 2.5}


@style.drawn
def plot_branches(
    ds: xr.Dataset,
    cube: xr.Dataset | None = None,
    *,
    bands: xr.Dataset | None = None,
    points: xr.Dataset | None = None,
    state: str = "",
    max_period: int | None = None,
    degrees: bool = False,
    at: Mapping[str, float] | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw branches of periodic orbits over a parameter by their section points: stable solid, unstable dashed.

    All bifurcations are marked. Where a stable orbit appears or disappears, the name and period (for example
    PD1) stand beside the curves if there is room, and so does ``isola``.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    cube
        Sweep or continuation over the same parameter, drawn below.
    bands
        From the analysis ``bands``: 95 % bands of the orbits and intervals of the bifurcations.
    points
        Measured points from `read_points`: the state over the parameter. Those at a level without branches are open.
    state, degrees, at
        As for `plot_bifurcation`.
    max_period
        Longest period drawn; by default all.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Its `data` are the branches; names with the suffix ``_diagram`` are the data of the diagram below, those with
        ``_bands`` the data of the bands. Names of measured points begin with ``measured_``.

    Raises
    ------
    ValueError
        As `plot_bifurcation`.
    """
    measure = labels.state_measure(ds, state, degrees)
    below = _below(cube, measure, degrees, at, frame)
    fig = style.new_figure(4.5, with_points(_stored(ds), points), frame)
    ax = fig.add_subplot()
    chosen = _chosen(ds, max_period)
    if below is not None:
        below.dress(ax, alone=not chosen)
    names = _draw_lines(ax, ds, chosen, measure, below is None)
    if below is None:
        _dress(ax, frame, measure)
    else:
        _hold_branches(ax, ds, chosen, measure, below.survey.empty)
    style.label_axes(ax, labels.swept_label(ds.attrs["parameter"], ds.attrs["parameter_units"]), measure.label)
    handles = [*(below.handles() if below is not None else []), *_handles(ds, chosen)]
    if points is not None:
        handles += draw_sections(ax, points, measure, [tuple(fixed_of(ds, i).items()) for i in chosen])
    if bands is not None:
        handles += draw_bands(ax, bands, measure, max_period)
        fig.data = with_bands(fig.data, bands)
    caption = below.caption if below is not None else labels.caption(ds)
    style.complete(fig, ax, style.join([caption, cut_words(ds, chosen)]), handles)
    if below is not None:
        fig.data = with_diagram(fig.data, below.draw([pixels.Panel(ax, below.layers)]))
    _name(ax, names)
    return fig


def _below(
    cube: xr.Dataset | None, measure: Measure, degrees: bool, at: Mapping[str, float] | None, frame: style.Frame
) -> Diagram | None:
    if cube is None:
        return None
    return Diagram.of(cube, state=measure.name, degrees=degrees, at=at, frame=frame)


def _dress(ax: Axes, frame: style.Frame, measure: Measure) -> None:
    style.style_axes(ax)
    ax.margins(y=0.08)
    style.limits(ax, frame)
    labels.angle_ticks(ax, measure)


def _chosen(ds: xr.Dataset, max_period: int | None) -> list[int]:
    periods = ds["orbit_period"].values.tolist()
    return [i for i, period in enumerate(periods) if max_period is None or period <= max_period]


def _draw_lines(ax: Axes, ds: xr.Dataset, chosen: list[int], measure: Measure, scale: bool) -> list[_Name]:
    for i in chosen:
        for x, y, stable in pieces(ds, i, measure):
            ax.plot(x, y, scalex=scale, scaley=scale, **(STABLE if stable else UNSTABLE))
    return _mark(ax, ds, chosen, measure, scale)


def _stored(ds: xr.Dataset) -> xr.Dataset:
    """Drop from the branches' dataset what NetCDF cannot store."""
    plain = {k: v for k, v in ds.attrs.items() if isinstance(v, str | int | float | np.ndarray)}
    return style.storable(ds, "branches of periodic orbits").assign_attrs(plain)


def pieces(ds: xr.Dataset, branch: int, measure: Measure) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Yield the lines of a branch, one for each section point and range of equal stability, cut where angles wrap."""
    period = max(int(ds["orbit_period"][branch]), 1)
    x = with_located(ds, branch, ds["parameter"], ds["value"])
    both = (ds[name].sel(state=measure.name) for name in ("section", "bifurcation_section"))
    y = with_located(ds, branch, *both)
    for first, stop, solid in stretches(ds, branch):
        for k in range(period):
            values = measure.shown(y[first:stop, k])
            jumps = np.flatnonzero((np.abs(np.diff(values)) > measure.half_turn) & measure.on_circle) + 1
            yield np.insert(x[first:stop], jumps, np.nan), np.insert(values, jumps, np.nan), solid


def with_located(ds: xr.Dataset, branch: int, of_points: xr.DataArray, of_bifurcations: xr.DataArray) -> np.ndarray:
    """Return the values along a branch, with those of its located bifurcations in their places."""
    n, own = int(ds["n_points"][branch]), ds["of_branch"].values == branch
    after = ds["after"].values[own]
    return np.insert(of_points.values[branch, :n], after + 1, of_bifurcations.values[own], axis=0)


def stretches(ds: xr.Dataset, branch: int) -> Iterator[tuple[int, int, bool]]:
    """Yield the first index, the end and the stability of each stretch of equal stability of a branch, among the values
    of `with_located`. A located point ends one stretch and begins the next.
    """
    n, after = int(ds["n_points"][branch]), ds["after"].values[ds["of_branch"].values == branch]
    located = np.insert(np.zeros(n, bool), after + 1, True)
    stable = np.insert(ds["n_unstable"].values[branch, :n] == 0, after + 1, False)
    is_solid = (stable[:-1] | located[:-1]) & (stable[1:] | located[1:]) & (stable[:-1] | stable[1:])
    edges = np.flatnonzero(np.diff(is_solid)) + 1
    for first, stop in zip([0, *edges], [*edges, len(is_solid)], strict=True):
        if stop > first:
            yield first, stop + 1, bool(is_solid[first])


@dataclass(frozen=True)
class _Name:
    """Label of a bifurcation: its text, its place, and the range of the orbit's section points there."""

    period: int
    x: float
    low: float
    high: float
    text: str


def _mark(ax: Axes, ds: xr.Dataset, chosen: list[int], measure: Measure, scale: bool) -> list[_Name]:
    """Draw markers at bifurcations. Return labels for those where a stable orbit appears or disappears."""
    names = []
    size = 3.4 if style.figure_of(ax).frame.compact else 4.5
    for kind, branch, x, states, n_unstable in [*_located(ds), *_limits(ds)]:
        if branch not in chosen:
            continue
        period = int(ds["orbit_period"][branch])
        n, stable = max(period, 1), n_unstable == 0
        y = measure.shown(states.sel(state=measure.name).values[:n])
        ax.plot(
            np.full(n, x),
            y,
            linestyle="none",
            marker=MARKERS[kind],
            markersize=size if stable else 0.62 * size,
            markerfacecolor="white" if stable else "0.75",
            markeredgecolor="black",
            markeredgewidth=0.7,
            zorder=8.0 if stable else 7.0,
            scalex=scale,
            scaley=scale,
        )
        if stable:
            text = LABELS[kind] if kind in LIMITS else f"{LABELS[kind]}{period or ''}"
            names.append(_Name(period, x, float(y.min()), float(y.max()), text))
    names += [_isola(ds, i, measure) for i in isolas_of(ds) if i in chosen]
    return sorted(names, key=lambda n: (n.period, n.x, n.low))


_Mark = tuple[str, int, float, xr.DataArray, int]
"""A mark in the figure: its kind, its branch, the parameter value, the section points and the unstable multipliers."""


def _located(ds: xr.Dataset) -> Iterator[_Mark]:
    """Yield a mark for each located bifurcation, with the smaller number of unstable multipliers beside it."""
    for k in range(ds.sizes["bifurcation"]):
        one = ds.isel(bifurcation=k)
        n_unstable = min(int(one["n_unstable_before"]), int(one["n_unstable_after"]))
        kind, branch = KINDS[int(one["kind"])], int(one["of_branch"])
        yield kind, branch, float(one["value"]), one["bifurcation_section"], n_unstable


def _limits(ds: xr.Dataset) -> Iterator[_Mark]:
    """Yield a mark for each end at which the period grows without bound, at the section points of the last cycle."""
    for branch, end in limits_of(ds):
        name = ("first_end", "last_end")[end]
        kind = words_of(ds[name])[int(ds[name][branch])]
        last = ds.isel(branch=branch, point=int(ds["n_points"][branch]) - 1 if end else 0)
        yield kind, branch, float(ds["limit_value"][branch, end]), last["section"], int(last["n_unstable"])


def _hold_branches(ax: Axes, ds: xr.Dataset, chosen: list[int], measure: Measure, alone: bool) -> None:
    """Widen the axes of a diagram to hold the branches and their bifurcations, on which cells of the diagram need not
    end. If no cell is drawn, the vertical axis is that of the branches.
    """
    events = np.isin(ds["of_branch"].values, chosen)
    sections = ds["section"].values[chosen], ds["bifurcation_section"].values[events]
    k = int(np.flatnonzero(ds["state"].values == measure.name)[0])
    y = measure.shown(np.concatenate([one[..., k].ravel() for one in sections]))
    x = np.concatenate([ds["parameter"].values[chosen].ravel(), ds["value"].values[events]])
    if alone and np.isfinite(y).any() and not measure.on_circle and style.figure_of(ax).frame.ylim is None:
        middle = float(np.nanmedian(y))
        ax.set_ylim(middle, middle + 1e-9 * max(abs(middle), 1.0))
    style.hold(ax, [x], [y])


def _isola(ds: xr.Dataset, branch: int, measure: Measure) -> _Name:
    """Return the label of an isola, at its highest section point."""
    y = measure.shown(ds["section"].sel(state=measure.name).values[branch])
    point, phase = np.unravel_index(int(np.nanargmax(y)), y.shape)
    highest = float(y[point, phase])
    x = float(ds["parameter"].values[branch, point])
    return _Name(int(ds["orbit_period"][branch]), x, highest, highest, "isola")


def _name(ax: Axes, names: list[_Name]) -> None:
    """Label bifurcations where labels cover neither lines nor one another, each with a thin line to its place.

    Short periods come first. A label without room nearby is left out; its marker remains.
    """
    figure = ax.figure
    points = 72.0 / figure.dpi
    ink = np.concatenate([np.zeros((0, 2)), *(_ink(line, points) for line in ax.get_lines())])
    box = ax.get_window_extent()
    bounds = np.array([[box.x0, box.y0], [box.x1, box.y1]]) * points + [[2.0], [-2.0]]
    taken: list[np.ndarray] = []
    for name in names:
        width, height = 0.55 * _NAME_PT * len(name.text), 0.9 * _NAME_PT
        for y, up in ((name.high, 1.0), (name.low, -1.0)):
            anchor = ax.transData.transform((name.x, y)) * points
            spot = _free(anchor, up, (width, height), ink, taken, bounds)
            if spot is None:
                continue
            taken.append(spot)
            ax.annotate(
                name.text,
                (name.x, y),
                tuple(spot - anchor),
                textcoords="offset points",
                ha="center",
                va="center",
                fontsize=_NAME_PT,
                zorder=9.0,
                gid=f"name:{name.text}",
                arrowprops=_LEADER,
                path_effects=style.halo(1.5),
            )
            break


def _ink(drawn: Line2D, points: float) -> np.ndarray:
    """Return positions along a drawn line, some 3 pt apart, which labels must not cover."""
    line = drawn.get_transform().transform(np.asarray(drawn.get_xydata(), dtype=np.float64)) * points
    line = line[np.isfinite(line).all(axis=1)]
    if len(line) < 2 or drawn.get_linestyle() == "None":
        return line
    steps = np.hypot(*np.diff(line, axis=0).T)
    parts = np.minimum(np.ceil(steps / 3.0), 60).astype(int)
    pieces = [
        a + (b - a) * np.linspace(0.0, 1.0, n + 1)[:, None] for a, b, n in zip(line, line[1:], parts, strict=False)
    ]
    return np.concatenate(pieces)


def _free(
    anchor: np.ndarray,
    up: float,
    size: tuple[float, float],
    ink: np.ndarray,
    taken: list[np.ndarray],
    bounds: np.ndarray,
) -> np.ndarray | None:
    """Return the nearest free place [pt] for a text of a given size beside a point; None if there is none."""
    half = 0.5 * np.asarray(size)
    for distance in (9.0, 14.0, 20.0, 28.0, 38.0):
        for angle in (0.0, 0.6, -0.6, 1.1, -1.1):
            spot = anchor + distance * np.array([np.sin(angle), up * np.cos(angle)])
            inside = (spot - half >= bounds[0]).all() and (spot + half <= bounds[1]).all()
            covers = (np.abs(ink - spot) < half + 1.0).all(axis=1).any()
            meets = any((np.abs(spot - other) < 2.0 * half + 1.0).all() for other in taken)
            if inside and not covers and not meets:
                return np.asarray(spot)
    return None


def _handles(ds: xr.Dataset, chosen: list[int]) -> list[Any]:
    present = {kind for kind, branch, *_ in [*_located(ds), *_limits(ds)] if branch in chosen}
    return [
        *style.handles([{**STABLE, "label": "stable"}, {**UNSTABLE, "label": "unstable"}]),
        *(
            Line2D(
                [],
                [],
                linestyle="none",
                marker=MARKERS[kind],
                markersize=4.5,
                markerfacecolor="white",
                markeredgecolor="black",
                markeredgewidth=0.7,
                label=f"{LABELS[kind]} {NAMES[kind]}",
            )
            for kind in (*KINDS, *LIMITS)
            if kind in present
        ),
    ]


def draw_branches(run: OpenRun, options: BranchFigureOptions) -> style.DataFigure:
    """Draw the figure ``branches`` of a run, over its own bifurcation diagram or that of another run."""
    other = run.of(options.over) if options.over else run
    at, notes = values_of(other, options)
    columns = columns_of(labels.state_measure(run.cube(), options.state))
    points = points_of(run, options.points, options.parameter, **columns)
    found = at_levels(run.derive("branches", parameter=options.parameter), at)
    cube = other.cube()
    below = cube if axis_name(options.parameter) in cube.dims else None
    bands = None
    if options.posterior:
        bands = run.derive("bands", posterior=options.posterior, parameter=options.parameter)
    figure = plot_branches(
        found,
        below,
        bands=bands,
        points=points,
        state=options.state,
        max_period=options.shown,
        degrees=options.degrees,
        at=at,
        frame=frame_of(options),
    )
    return noted(figure, notes)


DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)), (0, (8, 1.5, 1, 1.5, 1, 1.5)))
"""Line styles that can be told apart."""

_ON_MAP = dict(zip((*KINDS[:3], HOPF, *BRANCH_POINTS), (*DASHES[:4], *[DASHES[4]] * 3), strict=True))
_ON_MAP[HOMOCLINIC] = (0, (2.5, 1))
_STYLE_NAMES = dict(zip(DASHES, ("solid:", "dashed:", "dotted:", "dash-dotted:", "dash-dot-dotted:"), strict=True))
_STYLE_NAMES[_ON_MAP[HOMOCLINIC]] = "short-dashed:"


_CURVE_COLOURS = {
    **dict(zip(KINDS[:3], (style.BLUE, style.VERMILLION, style.GREEN), strict=True)),
    HOPF: style.ORANGE,
    HOMOCLINIC: "black",
    **dict.fromkeys(BRANCH_POINTS, style.PURPLE),
}


def curve_look(kind: str, period: int, periods: Sequence[int]) -> dict[str, Any]:
    """Return the colour, the dashes and the label of a curve; `periods` are those of all curves, in their order."""
    return {
        "color": _CURVE_COLOURS[kind],
        "linestyle": DASHES[periods.index(period) % len(DASHES)],
        "label": f"{LABELS[kind]} {NAMES[kind]}{_of_period(kind, period)}",
    }


def _of_period(kind: str, period: int) -> str:
    if kind == HOMOCLINIC:
        return ""
    return f", period {period}" if period else ", equilibrium"


def take_room(ax: Axes, at: tuple[float, float], taken: list[np.ndarray]) -> bool:
    """Reserve the place of a short name on axes. Return False if it would overlap a name already placed."""
    room = (0.045, 0.045)  # room that a short name takes, in units of the axes
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    here = np.array([(at[0] - left) / (right - left), (at[1] - bottom) / (top - bottom)])
    if any((np.abs(here - other) < room).all() for other in taken):
        return False
    taken.append(here)
    return True


def draw_over(fig: style.DataFigure, axes: Sequence[Axes], ds: xr.Dataset, x: str) -> None:
    """Draw bifurcation curves in black over panels that show a parameter plane, whose horizontal axis is `x`.

    Points of codimension two have their names if there is one panel; several are too small.
    """
    along, across = ("first", "second") if str(ds.attrs["first_parameter"]) == x else ("second", "first")
    halo = style.halo(2.2)
    for ax in axes:
        low, high = ax.get_xlim(), ax.get_ylim()
        for i in range(ds.sizes["curve"]):
            n, kind = int(ds["n_points"][i]), CURVE_KINDS[int(ds["kind"][i])]
            ax.plot(
                ds[along].values[i, :n],
                ds[across].values[i, :n],
                color="black",
                linewidth=1.0 if len(axes) == 1 else 0.7,
                linestyle=_ON_MAP[kind],
                path_effects=halo if len(axes) == 1 else None,
                gid=f"curve:{i}",
                zorder=4.0,
            )
        ax.set_xlim(low)
        ax.set_ylim(high)
        mark_points(ax, ds, along, across, fig.look.tick, named=len(axes) == 1)


def line_note(ds: xr.Dataset) -> str:
    """Return a text on which line style stands for which kind of bifurcation."""
    present = {CURVE_KINDS[int(kind)] for kind in ds["kind"].values}
    return ", ".join(
        f"{_STYLE_NAMES[_ON_MAP[kind]]} {LABELS[kind]} {NAMES[kind]}" for kind in _ON_MAP if kind in present
    )


def mark_points(ax: Axes, ds: xr.Dataset, along: str, across: str, size: float, named: bool = True) -> None:
    """Mark points of codimension two by dots and, if `named`, by short names such as CP (cusp) and R1.

    A name that would lie over another one is left out.
    """
    names = str(ds["special_kind"].attrs["flag_meanings"]).split()
    halo = style.halo()
    taken: list[np.ndarray] = []
    for k in range(ds.sizes["special"]):
        at = float(ds[f"special_{along}"][k]), float(ds[f"special_{across}"][k])
        ax.plot(*at, marker="o", markersize=3.2, color="black", markeredgecolor="white", markeredgewidth=0.5, zorder=6)
        if not (named and take_room(ax, at, taken)):
            continue
        ax.annotate(
            LABELS[names[int(ds["special_kind"][k])]],
            at,
            (3.0, 3.0),
            textcoords="offset points",
            fontsize=size,
            path_effects=halo,
            annotation_clip=True,
            zorder=7,
        )


MOST_MODULUS = 2.0
"""Multipliers beyond this modulus are left out."""


@style.drawn
def plot_multipliers(ds: xr.Dataset, branch: int = 0, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    branch
        Number of the branch.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Multipliers of modulus beyond `MOST` are left out, and their number is stated. Its `data` hold
        ``real`` and ``imaginary`` parts and the ``parameter`` of each point of the branch.

    Raises
    ------
    ValueError
        If there is no such branch.
    """
    if not 0 <= branch < ds.sizes["branch"]:
        raise ValueError(f"branch = {branch} is out of bounds: there are branches 0 to {ds.sizes['branch'] - 1}.")
    n = int(ds["n_points"][branch])
    z = (ds["multiplier_real"] + 1j * ds["multiplier_imag"]).values[branch, :n]
    x = np.repeat(ds["parameter"].values[branch, :n, None], z.shape[1], axis=1)
    fig = style.new_figure(4.8, _multipliers(ds, branch, z, x[:, 0]), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor="0.5", linewidth=0.8))
    shown = np.abs(z) <= MOST_MODULUS
    points = ax.scatter(z.real[shown], z.imag[shown], c=x[shown], s=6.0, linewidths=0.0, zorder=3)
    here = np.flatnonzero(ds["of_branch"].values == branch)
    handles = _crossings(ax, ds, here)
    for axis in (ax.axhline, ax.axvline):
        axis(0.0, color="0.8", linewidth=0.5, zorder=0)
    reach = max(1.15, float(np.abs(np.stack([z.real[shown], z.imag[shown]])).max(initial=0.0)) * 1.05)
    style.limits(ax, frame, (-reach, reach), (-reach, reach))
    ax.set_aspect("equal")
    style.label_axes(ax, r"Re $\mu$", r"Im $\mu$")
    missing = int((~shown).sum())
    title = f"branch {branch}, period {int(ds['orbit_period'][branch])}"
    fixed = labels.caption(ds, with_start=False)
    style.caption(ax, style.join([title, fixed, f"{missing} beyond |μ| = {MOST_MODULUS:g}" if missing else ""]))
    label = labels.swept_label(str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"]))
    style.style_bar(fig.colorbar(points, ax=ax, pad=0.015, aspect=32), label)
    if frame.compact:
        style.legend_below(fig, handles)
    elif handles:
        fig.legend(
            handles=handles,
            loc="outside right upper",
            frameon=False,
            fontsize=fig.look.tick,
            handletextpad=0.2,
            borderpad=0.2,
        )
    style.finish(fig)
    return fig


def _multipliers(ds: xr.Dataset, branch: int, z: np.ndarray, x: np.ndarray) -> xr.Dataset:
    units = str(ds.attrs["parameter_units"])
    return xr.Dataset(
        {
            "real": (("point", "multiplier"), z.real.copy(), {"units": "1"}),
            "imaginary": (("point", "multiplier"), z.imag.copy(), {"units": "1"}),
            "parameter": ("point", x, {"units": units, "long_name": str(ds.attrs["parameter"])}),
        },
        attrs={"title": "Floquet multipliers", "branch": branch, "orbit_period": int(ds["orbit_period"][branch])},
    )


def _crossings(ax: Axes, ds: xr.Dataset, here: np.ndarray) -> list[Line2D]:
    """Mark on the unit circle the multipliers that reach it at bifurcations, and return their legend entries."""
    critical = (ds["critical_real"] + 1j * ds["critical_imag"]).values[here]
    look: dict[str, Any] = {
        "markerfacecolor": "none",
        "markeredgecolor": style.VERMILLION,
        "linestyle": "none",
        "zorder": 4,
    }
    handles = []
    for i in np.argsort(ds["value"].values[here], kind="stable"):
        kind, mu = KINDS[int(ds["kind"][here[i]])], critical[i]
        turning = kind == "neimark_sacker"
        for value in {mu, mu.conjugate()} if turning else {mu}:
            ax.plot(value.real, value.imag, marker=MARKERS[kind], markersize=5.5, markeredgewidth=1.0, **look)
        text = f"{LABELS[kind]} {float(ds['value'][here[i]]):.4f}"
        text += f", {np.degrees(np.angle(mu)):.0f}°" if turning else ""
        handles.append(Line2D([], [], marker=MARKERS[kind], markersize=5.0, label=text, **look))
    return handles


def draw_multipliers(run: OpenRun, options: MultiplierOptions) -> style.DataFigure:
    """Draw the figure ``multipliers`` of a run."""
    refuse_at(options.at, "the figure multipliers", "--branch chooses the branch and with it the values")
    found = run.derive("branches", parameter=options.parameter)
    return plot_multipliers(found, options.branch, frame=frame_of(options))
