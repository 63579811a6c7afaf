"""Make the moving parts of an animation: points with trails, bars of the drawing, the clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb

from magpend_core.models.model import Drawing
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.labels import Measure
from pipeline.plots.trajectory import DrawnMotion, draw_portrait

TRAIL_S = 0.8
"""Seconds of film that what moves leaves a trail for."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trail:
    """Trail behind a moving point, which fades. In a film that repeats, it goes on from the end to the start."""

    n: int  # n, length: samples of the film, and of the trail
    length: int
    repeats: bool  # whether the film does
    closed: int  # samples until the motion repeats; 0 if it does not repeat within the film

    @classmethod
    def of(cls, one: xr.Dataset) -> Trail:
        """Make the trail for a motion of a film."""
        samples, times = one.sizes["sample"] - 1, one["time"].values
        length = int(TRAIL_S * one.attrs["fps"] * one.attrs["substeps"])
        period = float(one["period"])
        closed = int(np.searchsorted(times, period)) if period <= times[-1] * (1.0 + 1e-9) else 0
        return cls(samples, min(length, samples), bool(one.attrs["repeats"]), min(closed, samples))

    def before(self, i: int) -> npt.NDArray[np.intp]:
        """Return the indices of the samples that the trail shows when the point is at sample `i`."""
        if self.repeats:
            return np.arange(i - self.length, i + 1) % self.n
        return np.arange(max(0, i - self.length), i + 1)


@dataclass(frozen=True)
class Point:
    """A point that moves along a curve, with a fading trail."""

    path: Floats
    jumps: float
    trail: Trail
    comet: LineCollection
    colours: Floats
    way: Any
    dot: Any

    def at(self, i: int) -> list[Artist]:
        """Move the point to sample `i`, and return its artists, which are then drawn again."""
        samples = self.trail.before(i)
        segments, there = self._segments(samples)
        self.comet.set_segments(list(segments[there]))
        if len(samples) > 1:
            self.comet.set_color(list(map(tuple, self.colours[-len(samples) + 1 :][there])))
        self.dot.set_data(*self.path[i : i + 1].T)
        if self.way is None:
            return [self.comet, self.dot]
        gone, kept = self._segments(np.arange(i + 1))
        broken = np.where(kept[:, None], gone[:, 1], np.nan)
        self.way.set_data(*np.concatenate([self.path[:1], broken]).T)
        return [self.way, self.comet, self.dot]

    def _segments(self, samples: npt.NDArray[np.intp]) -> tuple[Floats, npt.NDArray[np.bool_]]:
        points = self.path[samples]
        segments = np.stack([points[:-1], points[1:]], axis=1)
        steps = np.abs(np.diff(points, axis=0))
        return segments, np.asarray(steps.max(axis=1, initial=0.0) < self.jumps)


def _point(ax: Axes, path: Floats, colour: str, trail: Trail, *, jumps: float, size: float, thick: float) -> Point:
    """Make a moving point with its trail and, if its motion does not repeat, the line of its path so far."""
    colours = np.empty((max(trail.length, 1), 4))
    colours[:, :3], colours[:, 3] = to_rgb(colour), np.linspace(0.0, 1.0, len(colours)) ** 1.5
    comet = LineCollection([], linewidths=thick, animated=True, capstyle="butt")
    ax.add_collection(comet, autolim=False)
    way = None
    if not trail.closed:
        (way,) = ax.plot([], [], color=colour, linewidth=0.6, alpha=0.55, animated=True)
    dot = _dots(ax, size, colour, "white", 0.8)
    dot.set_zorder(5)
    return Point(path, jumps, trail, comet, colours, way, dot)


def _dots(ax: Axes, size: float, colour: str, edge: str, thick: float) -> Any:
    look: dict[str, Any] = {"markersize": size, "color": colour, "markeredgecolor": edge, "markeredgewidth": thick}
    (dots,) = ax.plot([], [], linestyle="none", marker="o", animated=True, **look)
    return dots


def moving_portrait(ax: Axes, one: xr.Dataset, pair: tuple[str, str], trail: Trail, degrees: bool) -> Point:
    """Draw the parts of a phase portrait that do not move, and return its moving point."""
    style.style_axes(ax)
    model, colour = model_of(one), str(one["colour"].values)
    orbit = {name: one["orbit"].sel(state=name).values for name in model.state_names}
    dots = one["section"].values
    dots = dots[np.isfinite(dots).all(axis=-1)]
    section = {name: dots[:, k] for k, name in enumerate(model.state_names)}
    draw_portrait(ax, one, pair, DrawnMotion(orbit, section, colour), degrees=degrees)
    for line in ax.get_lines():
        if str(line.get_gid()).startswith("orbit:"):
            line.set_alpha(0.4 if trail.closed else 0.0)
    for lines in (ax.xaxis, ax.yaxis):
        lines.labelpad = 2.5
    states = {s.name: s for s in model.states}
    measures = [labels.state_measure(one, n, degrees and states[n].unit.startswith("rad")) for n in pair]
    path, jumps = _path(measures, [orbit[name] for name in pair])
    return _point(ax, path, colour, trail, jumps=jumps, size=6.5, thick=2.6)


def _path(measures: Sequence[Measure], values: Sequence[Floats]) -> tuple[Floats, float]:
    """Return the curve of a phase portrait in axis units, and the step length above which an angle has jumped."""
    columns, jumps = [], math.inf
    for measure, column in zip(measures, values, strict=True):
        turning = measure.on_circle and np.ptp(column) >= 2.0 * np.pi
        columns.append(measure.shown(labels.wrapped(column) if turning else column))
        jumps = min(jumps, measure.half_turn) if turning else jumps
    return np.stack(columns, axis=-1), jumps


# ---- the drawing -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """Part of the plane that contains the model's drawing in all motions of a film."""

    drawing: Drawing
    low: Floats  # low, high: corners that hold everything at all times
    high: Floats

    @classmethod
    def of(cls, ds: xr.Dataset, drawing: Drawing) -> Scene:
        """Find the part of the plane that contains the model's drawing in all motions of a film."""
        places = ds["points"].values.reshape(-1, 2)
        if "fixed" in ds:
            places = np.concatenate([places, ds["fixed"].values.reshape(-1, 2)])
        return cls(drawing, np.nanmin(places, axis=0), np.nanmax(places, axis=0))

    def limit(self, ax: Axes) -> float:
        """Set the limits of axes, with equal scales, so that the drawing is always inside. Return their width."""
        box = ax.get_window_extent()
        shape = np.array([box.width, box.height])
        scale = 1.22 * max(*((self.high - self.low) / shape), 1e-12)
        middle, half = 0.5 * (self.low + self.high), 0.5 * scale * shape
        ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
        ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
        return float(2.0 * half[0])


@dataclass(frozen=True)
class Machine:
    """Moving parts of the model's drawing: lines, joints, and a point whose path is traced."""

    lines: tuple[Any, ...]
    corners: tuple[Floats, ...]
    joints: Any
    places: Floats
    traced: Point

    def at(self, i: int) -> list[Artist]:
        """Move the drawing to sample `i`, and return its artists, which are then drawn again."""
        for line, corners in zip(self.lines, self.corners, strict=True):
            line.set_data(*corners[i].T)
        self.joints.set_data(*self.places[i].T)
        *behind, dot = self.traced.at(i)
        return [*behind, *self.lines, self.joints, dot]


def moving_machine(ax: Axes, scene: Scene, one: xr.Dataset, trail: Trail, *, named: bool) -> Machine:
    """Draw the parts of the model's drawing that do not move, and return its moving parts."""
    drawing, colour = scene.drawing, str(one["colour"].values)
    ax.set_axis_off()
    width = scene.limit(ax)
    moved = {str(n): one["points"].sel(place=n).values for n in one["place"].values}
    still: dict[str, Floats] = {}
    if "fixed" in one:
        still = {str(n): one["fixed"].sel(fixed_place=n).values for n in one["fixed_place"].values}
    n = one.sizes["sample"]
    everywhere = {**moved, **{name: np.tile(p, (n, 1)) for name, p in still.items()}}
    path = moved[drawing.trace]
    if trail.closed:
        ax.plot(*path[: trail.closed + 1].T, color=colour, linewidth=0.9, alpha=0.4, gid=f"path:{drawing.trace}")
    _fix(ax, still, scene, named)
    if named:
        _scale_bar(ax, width, drawing.unit)
    corners = tuple(np.stack([everywhere[name] for name in names], axis=1) for names in drawing.lines)
    lines = tuple(
        ax.plot([], [], color="0.25", linewidth=4.0, solid_capstyle="round", solid_joinstyle="round", animated=True)[0]
        for _ in drawing.lines
    )
    places = np.stack([p for name, p in moved.items() if name != drawing.trace] or [path], axis=1)
    joints = _dots(ax, 5.5, "white", "0.25", 1.4)
    traced = _point(ax, path, colour, trail, jumps=math.inf, size=9.0, thick=2.2)
    return Machine(lines, corners, joints, places, traced)


def _fix(ax: Axes, still: dict[str, Floats], scene: Scene, named: bool) -> None:
    """Draw the points of the model's drawing that do not move, with their names if `named`."""
    ends = {name for names in scene.drawing.lines for name in names}
    for name, place in still.items():
        held = name in ends
        size, colour, marker = (8.0, "0.6", "^") if held else (6.0, "0.15", "s")
        style.points(ax, place[:1], place[1:], size, colour, marker=marker, zorder=1.5, gid=f"fixed:{name}")
        if not named:
            continue
        ax.annotate(
            name,
            (place[0], place[1]),
            (9.0, 4.0 if held else -6.0),
            textcoords="offset points",
            fontsize=style.look_of(ax).tick - 1.0,
            color="0.35",
        )


def _scale_bar(ax: Axes, width: float, unit: str) -> None:
    power = 10.0 ** math.floor(math.log10(0.25 * width))
    length = max(f * power for f in (1.0, 2.0, 5.0) if f * power <= 0.25 * width)
    share = length / width
    ax.plot([0.03, 0.03 + share], [0.035] * 2, color="0.35", linewidth=1.4, transform=ax.transAxes)
    ax.text(
        0.03,
        0.05,
        f"{length:g} {unit}",
        transform=ax.transAxes,
        color="0.35",
        fontsize=style.look_of(ax).tick - 1.0,
        va="bottom",
    )


@dataclass(frozen=True)
class TimeLabel:
    """Text that shows the time of the model in a film, in drive periods or in seconds."""

    text: Any
    time: Floats
    period: float

    def at(self, i: int) -> list[Artist]:
        """Show the time of sample `i`, and return the artist of the text, which is then drawn again."""
        if self.period:
            self.text.set_text(f"{self.time[i] / self.period:.2f} drive periods")
        else:
            self.text.set_text(f"{self.time[i]:.2f} s")
        return [self.text]


def moving_clock(fig: style.DataFigure, ds: xr.Dataset) -> TimeLabel:
    """Write the speed of a film into its figure, and return the label that shows the time of the model."""
    frequencies = ds["drive_frequency"].values
    forced = model_of(ds).clock.has_drive and np.ptp(frequencies) == 0.0
    width, height = fig.get_size_inches()
    size = fig.look.tick - 1.0
    y = 0.06 / height
    text = fig.text(0.1 / width, y, "", fontsize=size, color="0.35", va="bottom", animated=True)
    speed = float(ds.attrs["speed"])
    told = "real time" if abs(speed - 1.0) < 5e-3 else f"{speed:.2g} \N{MULTIPLICATION SIGN} real time"
    drive = f"drive {float(frequencies[0]):.6g} Hz, " if forced else ""
    # as many entries as fit beside the time
    for words in (f"{drive}{told}", told):
        if 0.48 * size / 72.0 * len(words) <= width - 1.5:
            fig.text(1.0 - 0.1 / width, y, words, fontsize=size, color="0.35", va="bottom", ha="right")
            break
    period = 1.0 / float(frequencies[0]) if forced else 0.0
    return TimeLabel(text, ds["time"].values, period)
