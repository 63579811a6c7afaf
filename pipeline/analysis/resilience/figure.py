"""Draw basin stability, critical shocks and arrival times of attractors, over a swept parameter or side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.analysis.resilience.declaration import ResilienceFigureOptions, ResilienceOptions
from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import ATTRACTS, letter, model_of
from pipeline.plots import labels, palette, style
from pipeline.plots.bifurcation import swept_parameters
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.results.ragged import dense, dims_of, isel
from pipeline.results.run import OpenRun
from pipeline.results.selection import place

_LOOK: dict[str, Any] = {"linewidth": 0.9, "markersize": 4.0, "capsize": 2.0, "elinewidth": 0.9}


@style.drawn
def plot_resilience(
    ds: xr.Dataset, attractors: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw how attractors respond to shocks: basin stability, smallest shocks, arrival times.

    Bars are intervals. In the middle panel filled markers are the smallest critical shock of the chosen states, open
    ones the distance to the boundary in any direction; triangles stand for sizes up to which no shock led away. In the
    lower panel filled markers are means with standard errors, open ones the longest times. Raise ValueError if more
    than one swept parameter is left.
    """
    part, along = _selected(ds, at or {})
    cast = palette.cast_of(attractors)
    shown = [i for i in range(part.sizes["attractor"]) if (part["stability"].isel(attractor=i) == ATTRACTS).any()]
    listed = [i for i in cast.order if i in shown]
    handles = [Line2D([], [], color=cast.colours[i], marker="o", markersize=4.0, label=cast.names[i]) for i in listed]
    data = part[[str(n) for n, v in part.data_vars.items() if v.dtype.kind != "O"]].assign_attrs(title="resilience")
    fig = style.new_figure(6.4, data, frame)
    panels = fig.subplots(3, 1, sharex=True)
    for ax in panels:
        style.style_axes(ax, minor=False)
    positions = part[along].values.astype(np.float64) if along else None
    for k, i in enumerate(shown):
        one = part.isel(attractor=i)
        x = np.array([float(k)]) if positions is None else positions
        _stability(panels[0], one, x, cast.colours[i])
        _sizes(panels[1], one, x, cast.colours[i])
        _times(panels[2], one, x, cast.colours[i])
    _dress(panels, part, along, [letter(i) for i in shown])
    style.limits(panels[2], style.Frame(frame.width, frame.xlim))
    style.legend_above(fig, [*handles, *_keys()])
    style.finish(fig)
    return fig


def _selected(ds: xr.Dataset, at: Mapping[str, float]) -> tuple[xr.Dataset, str]:
    """Return the part of a result at the given values, and the one swept parameter that is left (empty: none)."""
    dims = dims_of(ds)
    for name, value in at.items():
        if name in dims and ds.sizes[name] > 1:
            ds = isel(ds, {name: place(ds[name], value, rate_of(ds))})
    left = [d for d in dims if d in ds.dims and ds.sizes[d] > 1]
    _check_axes(ds, left)
    return dense(isel(ds, {d: 0 for d in dims if d in ds.dims and d not in left})), left[0] if left else ""


def _check_axes(ds: xr.Dataset, left: list[str]) -> None:
    """Raise ValueError if more than one swept parameter is left."""
    if len(left) > 1:
        value = float(ds[left[-1]].values[0])
        raise ValueError(
            f"resilience is drawn over one swept parameter, and {', '.join(left)} are left; choose values of the "
            f"others, such as {left[-1]}={value:g}"
        )


def _values(one: xr.Dataset, name: str) -> np.ndarray:
    return np.atleast_1d(one[name].values.astype(np.float64))


def _bars(ax: Axes, one: xr.Dataset, x: np.ndarray, name: str, colour: str) -> None:
    y, low, high = (_values(one, f"{name}{end}") for end in ("", "_low", "_high"))
    ends = np.maximum(np.stack([y - low, high - y]), 0.0)
    ax.errorbar(x, y, ends, color=colour, marker="o", linestyle="-", gid=f"{name}:{int(one['attractor'])}", **_LOOK)


def _stability(ax: Axes, one: xr.Dataset, x: np.ndarray, colour: str) -> None:
    _bars(ax, one, x, "weighted_stability", colour)


def _sizes(ax: Axes, one: xr.Dataset, x: np.ndarray, colour: str) -> None:
    for name, face in (("shock", colour), ("distance", "white")):
        low, high = _values(one, f"{name}_low"), _values(one, f"{name}_high")
        none = np.isinf(high)
        y = np.where(none, low, high)
        ends = np.stack([np.where(none, 0.0, high - low), np.zeros(len(y))])
        dash = "-" if name == "shock" else ":"
        ax.errorbar(
            x, y, ends, color=colour, markerfacecolor=face, marker="o", linestyle=dash,
            gid=f"{name}:{int(one['attractor'])}", **_LOOK,
        )  # fmt: skip
        ax.plot(x[none], y[none], linestyle="none", marker="^", color=colour, markersize=7.0, gid=f"{name}_above")


def _times(ax: Axes, one: xr.Dataset, x: np.ndarray, colour: str) -> None:
    mean, error, longest = (_values(one, name) for name in ("mean_time", "mean_time_stderr", "longest_time"))
    about = {"color": colour, **_LOOK}
    ax.errorbar(x, mean, np.nan_to_num(error), marker="o", linestyle="-", gid=f"mean:{int(one['attractor'])}", **about)
    ax.plot(x, longest, marker="o", markerfacecolor="white", color=colour, linestyle=":", linewidth=0.9, markersize=4.0)


def _keys() -> list[Line2D]:
    grey: dict[str, Any] = {"color": "0.35", "marker": "o", "markersize": 4.0, "linewidth": 0.9}
    return [
        Line2D([], [], label="shock of the chosen states; mean time", **grey),
        Line2D([], [], label="any direction; longest time", **grey, markerfacecolor="white", linestyle=":"),
    ]


def _dress(panels: Any, part: xr.Dataset, along: str, letters: list[str]) -> None:
    """Label the axes, and write what was disturbed."""
    periods = model_of(part).clock.periods
    for ax, text in zip(panels, ("basin stability", "smallest shock", f"arrival [{periods}]"), strict=True):
        style.label_axes(ax, None, text)
        ax.set_ylim(0.0, 1.08 * max(float(ax.dataLim.y1), 1e-300))
    panels[0].set_ylim(0.0, 1.0)
    if along:
        style.label_axes(panels[2], labels.parameter_label(part[along]), None)
    else:
        panels[2].set_xticks(range(len(letters)), letters)
        panels[2].set_xlim(-0.5, len(letters) - 0.5)
        style.label_axes(panels[2], "attractor", None)
    about = [f"shocks of {part.attrs['resilience_states']}", f"{part.attrs['resilience_phases']} phases"]
    style.caption(panels[0], style.join([labels.caption(part, with_start=False), *about]))


def draw(run: OpenRun, options: ResilienceFigureOptions) -> style.DataFigure:
    """Draw the figure ``resilience`` of a run."""
    at, notes = values_of(run, options)
    cube = at_points(run.cube(), at)
    _check_axes(cube, [name for name in swept_parameters(cube) if cube.sizes[name] > 1])
    found = run.derive("resilience", **{**options.part(ResilienceOptions), "at": at})
    figure = plot_resilience(found, run.derive("attractors"), at=at, frame=frame_of(options))
    return noted(figure, notes)
