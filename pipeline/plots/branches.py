"""Draw branches of periodic orbits over the bifurcation diagram of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from pipeline.analysis.run import OpenRun
from pipeline.layout.vocabulary import axis_name
from pipeline.plots import labels, pixels, style
from pipeline.plots.bands import draw_bands, with_bands
from pipeline.plots.bifurcation import Diagram, with_diagram
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.products.branches import BranchOptions
from pipeline.products.figures import BranchFigureOptions

KINDS = ("fold", "period_doubling", "neimark_sacker", "branch_point", "hopf", "pitchfork", "transcritical")
MARKERS = dict(zip(KINDS, "^soDpvX", strict=True))
SHORT = dict(zip(KINDS, ("F", "PD", "NS", "BP", "H", "PF", "TC"), strict=True))
NAMES = {
    "fold": "fold",
    "period_doubling": "period doubling",
    "neimark_sacker": "Neimark-Sacker",
    "branch_point": "branch point",
    "hopf": "Hopf",
    "pitchfork": "pitchfork",
    "transcritical": "transcritical",
}
_STABLE: dict[str, Any] = {"color": "black", "linewidth": 1.3, "linestyle": "-", "zorder": 6.0}
_UNSTABLE: dict[str, Any] = {"color": "0.3", "linewidth": 0.7, "linestyle": (0, (4, 2)), "zorder": 5.0}
_NAME_PT = 7.0
_LEADER = {"arrowstyle": "-", "linewidth": 0.4, "color": "0.4", "shrinkA": 4.0, "shrinkB": 2.5}


@style.drawn
def plot_branches(
    ds: xr.Dataset,
    cube: xr.Dataset | None = None,
    *,
    bands: xr.Dataset | None = None,
    state: str = "",
    max_period: int | None = None,
    degrees: bool = False,
    at: Mapping[str, float] | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw branches of periodic orbits over a parameter by their section points: stable solid, unstable dashed.

    All bifurcations are marked. Where a stable orbit appears or disappears, the name and period (for example
    PD1) stand beside the curves if there is room.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    cube
        Sweep or continuation over the same parameter, drawn below.
    bands
        From the analysis ``bands``: 95 % bands of the orbits and intervals of the bifurcations.
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
        ``_bands`` the data of the bands.

    Raises
    ------
    ValueError
        As `plot_bifurcation`.
    """
    measure = labels.state_measure(ds, state, degrees)
    below = _below(cube, measure, degrees, at, frame)
    fig = style.new_figure(4.5, _stored(ds), frame)
    ax = fig.add_subplot()
    if below is not None:
        below.dress(ax)
    chosen = _chosen(ds, max_period)
    names = _draw_lines(ax, ds, chosen, measure, below is None)
    if below is None:
        _dress(ax, frame, measure)
    style.label_axes(ax, labels.swept_label(ds.attrs["parameter"], ds.attrs["parameter_units"]), measure.label)
    handles = [*(below.handles() if below is not None else []), *_handles(ds, chosen)]
    if bands is not None:
        handles += draw_bands(ax, bands, measure, max_period)
        fig.data = with_bands(fig.data, bands)
    style.complete(fig, ax, below.caption if below is not None else labels.caption(ds), handles)
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
            ax.plot(x, y, scalex=scale, scaley=scale, **(_STABLE if stable else _UNSTABLE))
    return _mark(ax, ds, chosen, measure, scale)


def _stored(ds: xr.Dataset) -> xr.Dataset:
    """Drop from the branches' dataset what NetCDF cannot store."""
    plain = {k: v for k, v in ds.attrs.items() if isinstance(v, str | int | float | np.ndarray)}
    return ds.drop_vars([k for k, v in ds.variables.items() if v.dtype == object]).assign_attrs(
        {**plain, "title": "branches of periodic orbits"}
    )


def pieces(ds: xr.Dataset, branch: int, measure: Measure) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Yield the lines of a branch to draw: one for each section point and each range of equal stability, cut where an
    angle wraps.
    """
    n = int(ds["n_points"][branch])
    period = max(int(ds["orbit_period"][branch]), 1)
    x = ds["parameter"].values[branch, :n]
    y = ds["section"].sel(state=measure.name).values[branch, :n, :period]
    stable = ds["n_unstable"].values[branch, :n] == 0
    here = np.flatnonzero(ds["of_branch"].values == branch)
    own = ds.isel(bifurcation=here)
    after = own["after"].values
    # located points end one piece and begin the next
    x = np.insert(x, after + 1, own["value"].values)
    y = np.insert(y, after + 1, own["bifurcation_section"].sel(state=measure.name).values[:, :period], axis=0)
    located = np.insert(np.zeros(n, bool), after + 1, True)
    stable = np.insert(stable, after + 1, False)
    is_solid = (stable[:-1] | located[:-1]) & (stable[1:] | located[1:]) & (stable[:-1] | stable[1:])
    edges = np.flatnonzero(np.diff(is_solid)) + 1
    for first, stop in zip([0, *edges], [*edges, len(is_solid)], strict=True):
        if stop <= first:
            continue
        solid = bool(is_solid[first])
        for k in range(period):
            values = measure.shown(y[first : stop + 1, k])
            jumps = np.flatnonzero((np.abs(np.diff(values)) > measure.half_turn) & measure.on_circle) + 1
            yield np.insert(x[first : stop + 1], jumps, np.nan), np.insert(values, jumps, np.nan), solid


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
    for k in range(ds.sizes["bifurcation"]):
        branch = int(ds["of_branch"][k])
        if branch not in chosen:
            continue
        kind, period = KINDS[int(ds["kind"][k])], int(ds["orbit_period"][branch])
        x = float(ds["value"][k])
        n = max(period, 1)
        y = measure.shown(ds["bifurcation_section"].sel(state=measure.name).values[k, :n])
        stable = min(int(ds["n_unstable_before"][k]), int(ds["n_unstable_after"][k])) == 0
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
            names.append(_Name(period, x, float(y.min()), float(y.max()), f"{SHORT[kind]}{period or ''}"))
    return sorted(names, key=lambda n: (n.period, n.x, n.low))


def _name(ax: Axes, names: list[_Name]) -> None:
    """Write labels of bifurcations where they cover neither lines nor other labels, each with a thin line to its
    bifurcation.

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
                path_effects=[withStroke(linewidth=1.5, foreground="white")],
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
    own = np.isin(ds["of_branch"].values, chosen)
    present = {KINDS[int(code)] for code in ds["kind"].values[own]}
    return [
        Line2D([], [], label="stable", **{k: v for k, v in _STABLE.items() if k != "zorder"}),
        Line2D([], [], label="unstable", **{k: v for k, v in _UNSTABLE.items() if k != "zorder"}),
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
                label=f"{SHORT[kind]} {NAMES[kind]}",
            )
            for kind in KINDS
            if kind in present
        ),
    ]


def draw(run: OpenRun, options: BranchFigureOptions) -> style.DataFigure:
    """Draw the figure ``branches`` of a run, over its own bifurcation diagram or that of another run."""
    other = run.of(options.over) if options.over else run
    at, notes = values_of(other, options)
    found = run.derive("branches", **options.part(BranchOptions))
    cube = other.cube()
    below = cube if axis_name(options.parameter) in cube.dims else None
    bands = None
    if options.posterior:
        bands = run.derive("bands", posterior=options.posterior, **options.part(BranchOptions))
    figure = plot_branches(
        found,
        below,
        bands=bands,
        state=options.state,
        max_period=options.shown,
        degrees=options.degrees,
        at=at,
        frame=frame_of(options),
    )
    return noted(figure, notes)
