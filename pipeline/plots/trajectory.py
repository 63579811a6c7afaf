"""Draw trajectories and phase portraits: curves of states over time or over each other."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec, SubplotSpec
from matplotlib.lines import Line2D

from magpend_core.models.model import Drawing, Model
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import model_of, parameters_of
from pipeline.plots import labels, style
from pipeline.plots.labels import Measure

_AIR = 1.16


@dataclass(frozen=True)
class DrawnMotion:
    """One motion to draw: its trajectory, its section points and its colour."""

    orbit: Mapping[str, np.ndarray]  # values of each state along the motion, angles not wrapped
    section: Mapping[str, np.ndarray]  # the same at the stroboscopic section; may be empty arrays
    colour: str
    gid: str = ""  # ends the identifiers of what is drawn


def draw_portrait(
    ax: Axes, ds: xr.Dataset, pair: tuple[str, str], motion: DrawnMotion, *, degrees: bool = False
) -> None:
    """Draw a phase portrait (`pair` to the right and upwards): the motion as a line, and its section points as dots."""
    states = {s.name: s for s in model_of(ds).states}
    measures = [labels.state_measure(ds, n, degrees and states[n].unit.startswith("rad")) for n in pair]
    lines = [np.asarray(motion.orbit[name], dtype=np.float64) for name in pair]
    dots = [np.asarray(motion.section[name], dtype=np.float64) for name in pair]
    there = np.isfinite(lines[0]) & np.isfinite(lines[1])
    lines = [values[there] for values in lines]
    turning = [m.on_circle and _turns(values) for m, values in zip(measures, lines, strict=True)]
    for i, measure in enumerate(measures):
        if turning[i]:
            folded = labels.on_circle(lines[i], *lines)
            lines = [folded[0] if k == i else folded[1 + k] for k in range(2)]
            dots[i] = labels.wrapped(dots[i])
        elif measure.on_circle and lines[i].size:
            dots[i] = dots[i] + 2.0 * np.pi * np.round((lines[i].mean() - dots[i]) / (2.0 * np.pi))
    x, y = (m.shown(values) for m, values in zip(measures, lines, strict=True))
    gid = ":".join(part for part in (motion.gid, pair[0]) if part)
    ax.plot(x, y, color=motion.colour, linewidth=0.7, gid=f"orbit:{gid}")
    if dots[0].size:
        ax.plot(
            *(m.shown(values) for m, values in zip(measures, dots, strict=True)),
            linestyle="none",
            marker="o",
            markersize=2.8,
            color="black",
            markeredgecolor="white",
            markeredgewidth=0.4,
            zorder=3,
            gid=f"section:{gid}",
        )
    _dress(ax, measures, turning)


def _turns(angle: np.ndarray) -> bool:
    return bool(angle.size) and bool(np.ptp(angle) >= 2.0 * np.pi)


def _dress(ax: Axes, measures: list[Measure], turning: list[bool]) -> None:
    ax.margins(0.08)
    if turning[0]:
        ax.set_xlim(-measures[0].half_turn, measures[0].half_turn)
    if turning[1]:
        ax.set_ylim(-measures[1].half_turn, measures[1].half_turn)
    style.few_ticks(ax)
    labels.angle_ticks(ax, measures[0], "x", 4.0)
    labels.angle_ticks(ax, measures[1], "y", 4.0)
    style.label_axes(ax, measures[0].label, measures[1].label)


def draw_path(ax: Axes, drawing: Drawing, parameters: Mapping[str, float], motion: DrawnMotion) -> list[str]:
    """Draw the path of the traced point of the model's drawing, and the near points that do not move.

    Return the names of those points. `equalise` the axes once they have their place.
    """
    states = np.stack([motion.orbit[name] for name in motion.orbit], axis=-1)
    place = drawing.points(states, parameters)[drawing.trace]
    place = place[np.isfinite(place).all(axis=-1)]
    fixed = drawing.fixed(parameters)
    gid = f"path:{motion.gid}" if motion.gid else "path"
    ax.plot(place[:, 0], place[:, 1], color=motion.colour, linewidth=0.7, gid=gid)
    shown = _near(fixed, place)
    for name in shown:
        marker, at = _marker(fixed, name), fixed[name]
        style.points(ax, at[:1], at[1:], 4.0, "0.2", marker=marker, zorder=2.5, gid=f"fixed:{name}")
    style.few_ticks(ax)
    style.label_axes(ax, f"$x$ [{drawing.unit}]", f"$y$ [{drawing.unit}]")
    return shown


_MARKERS = ("s", "D", "^", "v", "P")


def _marker(fixed: Mapping[str, np.ndarray], name: str) -> str:
    return _MARKERS[list(fixed).index(name) % len(_MARKERS)]


def fixed_handles(drawing: Drawing, parameters: Mapping[str, float], shown: Collection[str]) -> list[Any]:
    """Return legend entries for those shown points of the model's drawing that do not move."""
    fixed = drawing.fixed(parameters)
    return [style.dot(n, "0.2", 4.0, marker=_marker(fixed, n)) for n in fixed if n in shown]


def _near(fixed: Mapping[str, np.ndarray], place: np.ndarray) -> list[str]:
    """Return the names of the points of the model's drawing that do not move and lie near a path."""
    if not place.size:
        return list(fixed)
    size = max(float(np.ptp(place, axis=0).max()), 1e-12)
    middle = 0.5 * (place.min(axis=0) + place.max(axis=0))
    away = {name: float(np.abs(point - middle).max()) / size for name, point in fixed.items()}
    nearest = min(away, key=lambda name: away[name], default="")
    return [name for name, far in away.items() if far <= (3.0 if name == nearest else 1.0)]


def equalise(ax: Axes) -> None:
    """Set the limits of axes so that both scales are equal and all lines are inside."""
    points = np.concatenate([line.get_xydata() for line in ax.get_lines()])
    box = ax.get_window_extent()
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    shape = np.array([box.width, box.height])
    scale = _AIR * max(*((high - low) / shape), 1e-12)
    middle, half = 0.5 * (low + high), 0.5 * scale * shape
    ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
    ax.set_ylim(middle[1] - half[1], middle[1] + half[1])


COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)
"""Of the pairs of states that portraits show; a seventh begins again."""


@style.drawn
def plot_trajectory(ds: xr.Dataset, *, degrees: bool = False, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw one trajectory: its time series, its phase portraits, and the path of a point of the model's drawing.

    Parameters
    ----------
    ds
        The states of the model over `time` [s], angles with steps that are short against a turn; further
        variables over `time` get a panel each. The stroboscopic section is marked at the coordinate or
        variable `section_times` [s] or, without it, at the whole periods of the attribute `frequency_hz`;
        without either, it is not marked. With the attribute ``parameters`` the path of the point that the
        model's drawing traces is drawn, too.
    degrees
        Degrees instead of radians.
    frame
        Width of the figure, and the range of time.

    Returns
    -------
    DataFigure
        States of one unit share a panel; the two of a portrait have one colour. The portrait of an angle
        that turns over is drawn on the circle, from -pi to pi. Its `data` are `ds` and the path, as
        ``path`` over ``time`` and ``axis``.

    Raises
    ------
    ValueError
        If a state is missing, there are no two points of time, or degrees are asked for without an angle.
    """
    model = model_of(ds)
    labels.some_angle(model, degrees, "trajectories")
    _check(ds, model)
    time = np.asarray(ds["time"].values, dtype=np.float64)
    series = {s.name: _values(ds, s.name, s.on_circle) for s in model.states}
    strobe = _section_times(ds, time)
    section = {name: np.interp(strobe, time, values) for name, values in series.items()}
    drawing = model.drawing if "parameters" in ds.attrs else None
    rows = [*_units(model), *_others(ds, model)]
    n_panels = len(model.portraits) + (drawing is not None)
    height = max(4.0, 1.25 * len(rows) + 0.8, 1.6 * n_panels + 0.8)
    fig = style.new_figure(height, _data(ds, series, drawing), frame)
    left, right = _grids(fig, len(rows), n_panels)
    axes = [fig.add_subplot(spec) for spec in left]
    _draw_series(axes, ds, time, series, rows, degrees)
    for k, pair in enumerate(model.portraits):
        ax = fig.add_subplot(right[k])
        style.style_axes(ax)
        draw_portrait(ax, ds, pair, DrawnMotion(series, section, _colour(k)), degrees=degrees)
    handles = _handles(ds, model, bool(strobe.size))
    path = fig.add_subplot(right[-1]) if drawing is not None else None
    if drawing is not None and path is not None:
        handles += _draw_path(path, ds, drawing, DrawnMotion(series, section, "0.35"))
    if frame.xlim:
        axes[-1].set_xlim(*style.check_range("xlim", frame.xlim))
    if path is not None:
        equalise(path)  # set the ticks before the layout is computed
    fig.align_ylabels(axes)
    style.complete(fig, axes[0], _place(ds), handles)
    if path is not None:
        equalise(path)
    return fig


def _draw_path(ax: Axes, ds: xr.Dataset, drawing: Drawing, motion: DrawnMotion) -> list[Any]:
    style.style_axes(ax)
    parameters = parameters_of(ds).as_dict()
    shown = draw_path(ax, drawing, parameters, motion)
    line = Line2D([], [], color=motion.colour, linewidth=1.2, label=f"path of the {drawing.trace}")
    return [line, *fixed_handles(drawing, parameters, shown)]


def _place(ds: xr.Dataset) -> str:
    frequency = ds.attrs.get("frequency_hz")
    if frequency is None:
        return ""
    head = "recorded drive, mean " if "drive_file" in ds.attrs else ""
    return f"{head}$f$ = {float(frequency):.6g}\u00a0Hz"


def _grids(fig: style.DataFigure, n_rows: int, n_panels: int) -> tuple[list[SubplotSpec], list[SubplotSpec]]:
    """Return the places of the time series and of the phase portraits: side by side or, in a narrow figure, stacked."""
    if not fig.frame.compact:
        outer = fig.add_gridspec(1, 2, width_ratios=[1.35, 1.0])
        left, right = outer[0].subgridspec(n_rows, 1), outer[1].subgridspec(n_panels, 1)
        return [left[i] for i in range(n_rows)], [right[i] for i in range(n_panels)]
    rows = math.ceil(n_panels / 2)
    fig.set_size_inches(fig.frame.width_in, 0.85 * n_rows + 1.25 * rows + 0.9)
    both: GridSpec = fig.add_gridspec(2, 1, height_ratios=[0.85 * n_rows, 1.25 * rows])
    top, bottom = both[0].subgridspec(n_rows, 1), both[1].subgridspec(rows, 2)
    last = [bottom[i // 2, i % 2] for i in range(n_panels)]
    if n_panels % 2:
        last[-1] = bottom[rows - 1, :]
    return [top[i] for i in range(n_rows)], last


def _check(ds: xr.Dataset, model: Model) -> None:
    needed = (*model.state_names, "time")
    missing = [name for name in needed if name not in ds]
    if missing:
        raise ValueError(f"a trajectory needs {', '.join(needed)}; missing: {', '.join(missing)}")
    if ds.sizes["time"] < 2:
        raise ValueError(f"a trajectory needs at least two points of time, and this one has {ds.sizes['time']}")


def _values(ds: xr.Dataset, name: str, on_circle: bool) -> np.ndarray:
    values = np.asarray(ds[name].values, dtype=np.float64)
    return np.unwrap(values) if on_circle else values


def _data(ds: xr.Dataset, series: dict[str, np.ndarray], drawing: Drawing | None) -> xr.Dataset:
    if drawing is None:
        return ds
    states = np.stack(list(series.values()), axis=-1)
    path = drawing.points(states, parameters_of(ds).as_dict())[drawing.trace]
    attrs = {"units": drawing.unit, "long_name": f"path of the {drawing.trace}"}
    return ds.assign(path=(("time", "axis"), path, attrs)).assign_coords(axis=["x", "y"])


def _section_times(ds: xr.Dataset, time: np.ndarray) -> np.ndarray:
    if "section_times" in ds:
        times = np.asarray(ds["section_times"].values, dtype=np.float64)
    elif "frequency_hz" in ds.attrs:
        frequency = float(ds.attrs["frequency_hz"])
        slack = 1e-9 * (abs(time[0]) + abs(time[-1])) * frequency
        first, last = math.ceil(time[0] * frequency - slack), math.floor(time[-1] * frequency + slack)
        times = np.clip(np.arange(first, last + 1) / frequency, time[0], time[-1])
    else:
        return np.zeros(0)
    inside = (times >= time[0]) & (times <= time[-1])
    return np.asarray(times[inside])


def _units(model: Model) -> list[tuple[str, ...]]:
    """Group the states into panels by unit; angles, and each dimensionless state, have panels of their own."""
    kinds: dict[tuple[str, bool], tuple[str, ...]] = {}
    for s in model.states:
        key = (s.unit, s.on_circle) if s.unit != "1" else (s.name, False)
        kinds[key] = (*kinds.get(key, ()), s.name)
    return list(kinds.values())


def _others(ds: xr.Dataset, model: Model) -> list[tuple[str, ...]]:
    """Group the other variables of the time series into panels by unit, up to a limit."""
    most_panels, most_lines = 3, 2  # most panels of variables that are no states, and most lines in each
    found: dict[str, tuple[str, ...]] = {}
    for name, values in ds.data_vars.items():
        if values.dims == ("time",) and str(name) not in (*model.state_names, "section_times"):
            unit = shown_unit(values.attrs, "")
            found[unit] = (*found.get(unit, ()), str(name))[:most_lines]
    return list(found.values())[:most_panels]


def _colour(pair: int) -> str:
    return COLOURS[pair % len(COLOURS)]


def _colours(model: Model) -> dict[str, str]:
    found: dict[str, str] = {}
    for k, pair in enumerate(model.portraits):
        for name in pair:
            found.setdefault(name, _colour(k))
    return found


def _draw_series(
    axes: Sequence[Axes],
    ds: xr.Dataset,
    time: np.ndarray,
    series: dict[str, np.ndarray],
    rows: Sequence[tuple[str, ...]],
    degrees: bool,
) -> None:
    model = model_of(ds)
    colours = _colours(model)
    for ax, names in zip(axes, rows, strict=True):
        if ax is not axes[-1]:
            ax.sharex(axes[-1])
            ax.tick_params(labelbottom=False)
        style.style_axes(ax)
        ax.set_xlim(float(time[0]), float(time[-1]))
        ax.margins(y=0.08)
        if names[0] not in model.state_names:
            _draw_others(ax, ds, time, names)
            continue
        turn = degrees and model.state(names[0]).unit.startswith("rad")
        measures = [labels.state_measure(ds, name, turn) for name in names]
        for m in measures:
            ax.plot(
                time, m.shown(series[m.name]), color=colours.get(m.name, "0.2"), linewidth=0.8, gid=f"series:{m.name}"
            )
        style.label_axes(ax, y=labels.with_unit(", ".join(m.symbol for m in measures), measures[0].unit))
        labels.angle_ticks(ax, measures[0], most=5.0)
    style.label_axes(axes[-1], x="time [s]")


def _draw_others(ax: Axes, ds: xr.Dataset, time: np.ndarray, names: Sequence[str]) -> None:
    quantities = {q.name: q.symbol for q in model_of(ds).quantities}
    symbols = [f"${quantities[n]}$" if quantities.get(n) else n.replace("_", " ") for n in names]
    for name, symbol, look in zip(names, symbols, ("0.15", style.ORANGE), strict=False):
        values = np.asarray(ds[name].values, dtype=np.float64)
        ax.plot(time, values, color=look, linewidth=0.8, gid=f"series:{name}", label=symbol)
    unit = shown_unit(ds[names[0]].attrs, "")
    style.label_axes(ax, y=labels.with_unit(", ".join(symbols), unit))
    if len(names) > 1:
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
        ax.legend(
            loc="upper right",
            ncols=len(names),
            fontsize=style.look_of(ax).tick - 1.0,
            borderpad=0.2,
            handlelength=1.0,
            framealpha=0.8,
            edgecolor="none",
            columnspacing=0.8,
            handletextpad=0.3,
        )


def _handles(ds: xr.Dataset, model: Model, with_section: bool) -> list[Any]:
    handles: list[Any] = []
    if len(model.portraits) > 1:
        for k, pair in enumerate(model.portraits):
            text = ", ".join(labels.state_measure(ds, name).symbol for name in pair)
            handles.append(Line2D([], [], color=_colour(k), linewidth=1.2, label=text))
    if with_section:
        handles.append(style.dot("once per drive period", "black", 3.6))
    return handles
