"""Moving pictures: the model's own drawing and its phase portraits, motion beside motion.

What moves is drawn over a background that is drawn once; so a frame takes some milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb

from magpend_core.models.model import Drawing, Model
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.labels import Measure
from pipeline.plots.portrait import Motion, draw_portrait

SCREEN_DPI = 100
MOST_ABREAST = 4
"""Motions beside one another; more begin a second row."""

TRAIL_S = 0.8
"""Seconds of film that what moves leaves a trail for."""

Pixels = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Animation:
    """A film that is drawn as it is asked for.

    Attributes
    ----------
    figure : DataFigure
        Its `data` are what is drawn.
    movers : tuple
        What moves: each sets its artists for a sample.
    """

    figure: style.DataFigure
    movers: tuple[Any, ...]

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return int(self.figure.data.attrs["n_frames"])

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.figure.data.attrs["fps"])

    def frames(self) -> Iterator[Pixels]:
        """Draw the frames one after the other, each (height, width, 3)."""
        canvas: Any = FigureCanvasAgg(self.figure)
        with style.TEXT_LOCK:
            canvas.draw()
        background = canvas.copy_from_bbox(self.figure.bbox)
        substeps = int(self.figure.data.attrs["substeps"])
        for k in range(self.n_frames):
            with style.TEXT_LOCK:
                canvas.restore_region(background)
                for mover in self.movers:
                    for artist in mover.at(k * substeps):
                        self.figure.draw_artist(artist)
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def plot_animation(
    ds: xr.Dataset, *, degrees: bool = False, portrait: str = "", size: int = 800
) -> Animation:
    """Lay out a film of motions beside one another.

    Parameters
    ----------
    ds
        Result of `pipeline.runs.moving.filmed`, with the attribute ``fps``.
    degrees
        Degrees for angles and their rates.
    portrait
        State whose phase portrait is shown; by default of one motion all, of several the model's first.
    size
        Width of a frame [pixels]; even, as films want it.

    Returns
    -------
    Animation
        Motions that repeat within the film have their whole path behind them; of others it is drawn as it
        is gone. Dots are sections.

    Raises
    ------
    ValueError
        If there is no portrait of that state, or degrees are asked for of a model without angles.
    """
    model = model_of(ds)
    pairs = portraits_of(model, portrait, ds.sizes["motion"], degrees)
    plan = _Plan.of(ds.sizes["motion"], len(pairs), model.drawing is not None, size)
    frame = style.Frame(plan.width / style.MM)
    fig = style.new_figure(plan.height, ds, frame, arranged=False, exact=True)
    fig.set_dpi(SCREEN_DPI)
    movers: list[Any] = []
    scene = None if model.drawing is None else _Scene.of(ds, model.drawing)
    for k in range(ds.sizes["motion"]):
        one = ds.isel(motion=k)
        boxes = plan.boxes(k)
        _title(fig, plan, boxes[0], str(one["name"].values))
        trail = _Trail.of(one)
        if scene is not None:
            movers.append(_machine(fig.add_axes(boxes[0]), scene, one, trail, named=k == 0))
        places = boxes[scene is not None :]
        movers += [_portrait(fig, p, one, c, trail, degrees) for c, p in zip(pairs, places, strict=True)]
    movers.append(_clock(fig, ds))
    style.finish(fig)
    return Animation(fig, tuple(movers))


def portraits_of(model: Model, portrait: str, n: int, degrees: bool = False) -> tuple[tuple[str, str], ...]:
    """Return the pairs of states that `plot_animation` shows of each of `n` motions; raises as it does."""
    labels.some_angle(model, degrees, "animations")
    if portrait:
        found = tuple(pair for pair in model.portraits if portrait in pair)
        if not found:
            known = ", ".join(dict.fromkeys(name for pair in model.portraits for name in pair))
            raise ValueError(f"unknown portrait {portrait!r}; there are portraits of: {known}")
        return found[:1]
    return model.portraits[: 3 if n == 1 else 1]


# ---- places ------------------------------------------------------------------------------------

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Plan:
    """Places of the panels [in]: motions in columns, or what there is of a single one side by side."""

    n: int
    n_pairs: int
    drawn: bool
    width: float
    columns: int
    drawing: float
    portrait: float
    left: float
    below: float
    above: float

    @classmethod
    def of(cls, n: int, n_pairs: int, drawn: bool, size: int) -> _Plan:
        width = 2 * round(size / 2) / SCREEN_DPI
        small = width / style.MM < style.COMPACT_MM
        left, below, above = (0.5, 0.36, 0.24) if small else (0.66, 0.46, 0.3)
        columns = n if n <= MOST_ABREAST else math.ceil(n / 2)
        if n == 1:
            height = min(0.56 * width, 6.0) if drawn or n_pairs > 1 else 0.7 * width
            stacked = n_pairs if drawn else 1
            portrait = (height - above - below * (stacked + 0.6)) / stacked
            return cls(n, n_pairs, drawn, width, 1, height - above - below, portrait, left, below, above)
        pitch = width / columns
        return cls(n, n_pairs, drawn, width, columns, 0.95 * pitch if drawn else 0.0,
                   max(0.55 * (pitch - left), 0.6), left, below, above)  # fmt: skip

    @property
    def row(self) -> float:
        """Height of a row of motions."""
        if self.n == 1:
            return self.drawing + self.above
        return self.above + self.drawing + self.n_pairs * (self.portrait + self.below)

    @property
    def foot(self) -> float:
        """Height of the line below."""
        return self.below if self.n == 1 else 0.5 * self.below

    @property
    def height(self) -> float:
        """Height of the frame; an even number of pixels."""
        whole = self.foot + self.row * math.ceil(self.n / self.columns)
        return 2 * round(whole * SCREEN_DPI / 2) / SCREEN_DPI

    def boxes(self, k: int) -> list[Box]:
        """Panels of a motion: its drawing, if there is one, then its portraits."""
        return [self._box(*inches) for inches in (self._single() if self.n == 1 else self._column(k))]

    def _single(self) -> list[Box]:
        air = 0.12
        if not self.drawn:
            pitch = self.width / self.n_pairs
            top = self.foot + self.below
            high = self.height - top - self.above
            return [(i * pitch + self.left, top, pitch - self.left - air, high) for i in range(self.n_pairs)]
        half = min(0.52 * self.width, 1.25 * self.drawing)
        boxes = [(air, self.foot, half - 2.0 * air, self.drawing)]
        for i in range(self.n_pairs):
            y = self.height - self.above - (i + 1) * self.portrait - i * self.below
            boxes.append((half + self.left, y, self.width - half - self.left - air, self.portrait))
        return boxes

    def _column(self, k: int) -> list[Box]:
        air, pitch = 0.08, self.width / self.columns
        x = (k % self.columns) * pitch
        top = self.height - (k // self.columns) * self.row - self.above
        boxes = [(x + air, top - self.drawing, pitch - 2.0 * air, self.drawing)] if self.drawn else []
        for i in range(self.n_pairs):
            y = top - self.drawing - (i + 1) * self.portrait - i * self.below
            boxes.append((x + self.left, y, pitch - self.left - air, self.portrait))
        return boxes

    def _box(self, x: float, y: float, width: float, height: float) -> Box:
        return (x / self.width, y / self.height, width / self.width, height / self.height)


def _title(fig: style.DataFigure, plan: _Plan, box: Box, text: str) -> None:
    """Write a motion's name above its panels, as far as there is room."""
    room = plan.width / plan.columns - 0.2
    lines = style.folded(text, room, fig.look.legend).split("\n")
    short = lines[0] if len(lines) == 1 else lines[0].rstrip(",:") + " \N{HORIZONTAL ELLIPSIS}"
    fig.text(box[0], box[1] + box[3] + 0.07 / plan.height, short, fontsize=fig.look.legend, va="bottom")


# ---- what moves --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Trail:
    """Samples behind what moves: round the film's end where it repeats, else from the beginning on.

    Attributes
    ----------
    n, length : int
        Samples of the film, and of the trail.
    repeats : bool
        Whether the film does.
    closed : int
        Samples after which the motion has come back; 0 if it does not within the film.
    """

    n: int
    length: int
    repeats: bool
    closed: int

    @classmethod
    def of(cls, one: xr.Dataset) -> _Trail:
        samples, times = one.sizes["sample"] - 1, one["time"].values
        length = int(TRAIL_S * one.attrs["fps"] * one.attrs["substeps"])
        period = float(one["period"])
        closed = int(np.searchsorted(times, period)) if period <= times[-1] * (1.0 + 1e-9) else 0
        return cls(samples, min(length, samples), bool(one.attrs["repeats"]), min(closed, samples))

    def before(self, i: int) -> npt.NDArray[np.intp]:
        """Samples from the trail's end to `i`."""
        if self.repeats:
            return np.arange(i - self.length, i + 1) % self.n
        return np.arange(max(0, i - self.length), i + 1)


@dataclass(frozen=True)
class _Point:
    """A point that moves along a line, with its trail; behind what does not repeat the way that it came."""

    path: Floats
    jumps: float
    trail: _Trail
    comet: LineCollection
    colours: Floats
    way: Any
    dot: Any

    def at(self, i: int) -> list[Artist]:
        """Artists at a sample."""
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


def _point(
    ax: Axes, path: Floats, colour: str, trail: _Trail, *, jumps: float, size: float, thick: float
) -> _Point:
    """Make what shows a point that moves."""
    colours = np.empty((max(trail.length, 1), 4))
    colours[:, :3], colours[:, 3] = to_rgb(colour), np.linspace(0.0, 1.0, len(colours)) ** 1.5
    comet = LineCollection([], linewidths=thick, animated=True, capstyle="round")
    ax.add_collection(comet, autolim=False)
    way = None
    if not trail.closed:
        (way,) = ax.plot([], [], color=colour, linewidth=0.6, alpha=0.55, animated=True)
    (dot,) = ax.plot(
        [], [], linestyle="none", marker="o", markersize=size, color=colour, markeredgecolor="white",
        markeredgewidth=0.8, animated=True, zorder=5,
    )  # fmt: skip
    return _Point(path, jumps, trail, comet, colours, way, dot)


def _portrait(
    fig: style.DataFigure, box: Box, one: xr.Dataset, pair: tuple[str, str], trail: _Trail, degrees: bool
) -> _Point:
    """Draw what stays of a phase portrait, and return what moves in it."""
    ax = fig.add_axes(box)
    style.style_axes(ax)
    model, colour = model_of(one), str(one["colour"].values)
    orbit = {name: one["orbit"].sel(state=name).values for name in model.state_names}
    dots = one["section"].values
    dots = dots[np.isfinite(dots).all(axis=-1)]
    section = {name: dots[:, k] for k, name in enumerate(model.state_names)}
    draw_portrait(ax, one, pair, Motion(orbit, section, colour), degrees=degrees)
    for line in ax.get_lines():
        if str(line.get_gid()).startswith("orbit:"):
            line.set_alpha(0.4 if trail.closed else 0.0)
    for lines in (ax.xaxis, ax.yaxis):
        lines.labelpad = 1.5
    states = {s.name: s for s in model.states}
    measures = [labels.state_measure(one, n, degrees and states[n].unit.startswith("rad")) for n in pair]
    path, jumps = _path(measures, [orbit[name] for name in pair])
    return _point(ax, path, colour, trail, jumps=jumps, size=6.5, thick=2.6)


def _path(measures: Sequence[Measure], values: Sequence[Floats]) -> tuple[Floats, float]:
    """Line of a portrait in its units, and how far apart two of its samples are only where it is cut."""
    columns, jumps = [], math.inf
    for measure, column in zip(measures, values, strict=True):
        turning = measure.on_circle and np.ptp(column) >= 2.0 * np.pi
        columns.append(measure.shown(labels.wrapped(column) if turning else column))
        jumps = min(jumps, measure.half_turn) if turning else jumps
    return np.stack(columns, axis=-1), jumps


# ---- the drawing -------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scene:
    """The plane that all drawings of a film share.

    Attributes
    ----------
    drawing : Drawing
    low, high : ndarray
        Corners that hold everything at all times.
    """

    drawing: Drawing
    low: Floats
    high: Floats

    @classmethod
    def of(cls, ds: xr.Dataset, drawing: Drawing) -> _Scene:
        places = ds["points"].values.reshape(-1, 2)
        if "fixed" in ds:
            places = np.concatenate([places, ds["fixed"].values.reshape(-1, 2)])
        return cls(drawing, np.nanmin(places, axis=0), np.nanmax(places, axis=0))

    def limit(self, ax: Axes) -> float:
        """Set limits with one scale both ways that hold all; returns the width."""
        box = ax.get_window_extent()
        shape = np.array([box.width, box.height])
        scale = 1.22 * max(*((self.high - self.low) / shape), 1e-12)
        middle, half = 0.5 * (self.low + self.high), 0.5 * scale * shape
        ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
        ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
        return float(2.0 * half[0])


@dataclass(frozen=True)
class _Machine:
    """A model's drawing: its lines and points, and the path of the one that it traces."""

    lines: tuple[Any, ...]
    corners: tuple[Floats, ...]
    joints: Any
    places: Floats
    traced: _Point

    def at(self, i: int) -> list[Artist]:
        """Artists at a sample."""
        for line, corners in zip(self.lines, self.corners, strict=True):
            line.set_data(*corners[i].T)
        self.joints.set_data(*self.places[i].T)
        *behind, dot = self.traced.at(i)
        return [*behind, *self.lines, self.joints, dot]


def _machine(ax: Axes, scene: _Scene, one: xr.Dataset, trail: _Trail, *, named: bool) -> _Machine:
    """Draw what stays of a model's drawing, in one of them with names and scale; return what moves in it."""
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
        ax.plot(
            *path[: trail.closed + 1].T, color=colour, linewidth=0.9, alpha=0.4, gid=f"path:{drawing.trace}"
        )
    _fix(ax, still, scene, named)
    if named:
        _scale_bar(ax, width, drawing.unit)
    corners = tuple(np.stack([everywhere[name] for name in names], axis=1) for names in drawing.lines)
    lines = tuple(
        ax.plot([], [], color="0.25", linewidth=4.0, solid_capstyle="round", solid_joinstyle="round",
                animated=True)[0] for _ in drawing.lines
    )  # fmt: skip
    places = np.stack([p for name, p in moved.items() if name != drawing.trace] or [path], axis=1)
    (joints,) = ax.plot(
        [], [], linestyle="none", marker="o", markersize=5.5, color="white", markeredgecolor="0.25",
        markeredgewidth=1.4, animated=True,
    )  # fmt: skip
    traced = _point(ax, path, colour, trail, jumps=math.inf, size=9.0, thick=2.2)
    return _Machine(lines, corners, joints, places, traced)


def _fix(ax: Axes, still: dict[str, Floats], scene: _Scene, named: bool) -> None:
    """Draw points that do not move, with or without their names beside them."""
    ends = {name for names in scene.drawing.lines for name in names}
    for name, place in still.items():
        held = name in ends
        ax.plot(
            *place[:, None], linestyle="none", marker="^" if held else "s", markersize=8.0 if held else 6.0,
            color="0.6" if held else "0.15", markeredgewidth=0.0, zorder=1.5, gid=f"fixed:{name}",
        )  # fmt: skip
        if not named:
            continue
        ax.annotate(
            name, (place[0], place[1]), (9.0, 4.0 if held else -6.0), textcoords="offset points",
            fontsize=style.look_of(ax).tick - 1.0, color="0.35",
        )  # fmt: skip


def _scale_bar(ax: Axes, width: float, unit: str) -> None:
    """Draw a bar of a round length, since there are no axes."""
    power = 10.0 ** math.floor(math.log10(0.25 * width))
    length = max(f * power for f in (1.0, 2.0, 5.0) if f * power <= 0.25 * width)
    share = length / width
    ax.plot([0.03, 0.03 + share], [0.035] * 2, color="0.35", linewidth=1.4, transform=ax.transAxes)
    ax.text(0.03, 0.05, f"{length:g} {unit}", transform=ax.transAxes, color="0.35",
            fontsize=style.look_of(ax).tick - 1.0, va="bottom")  # fmt: skip


@dataclass(frozen=True)
class _Clock:
    """Time, in periods of the drive if all motions have one and the same."""

    text: Any
    time: Floats
    period: float
    word: str

    def at(self, i: int) -> list[Artist]:
        """Artists at a sample."""
        if self.period:
            self.text.set_text(f"{self.time[i] / self.period:.2f} {self.word}")
        else:
            self.text.set_text(f"{self.time[i]:.2f} s")
        return [self.text]


def _clock(fig: style.DataFigure, ds: xr.Dataset) -> _Clock:
    """Write the speed, and return what shows the time."""
    frequencies = ds["drive_frequency"].values
    forced = not model_of(ds).autonomous and np.ptp(frequencies) == 0.0
    width, height = fig.get_size_inches()
    size = fig.look.tick - 1.0
    y = 0.06 / height
    text = fig.text(0.1 / width, y, "", fontsize=size, color="0.35", va="bottom", animated=True)
    speed = float(ds.attrs["speed"])
    told = "real time" if abs(speed - 1.0) < 5e-3 else f"{speed:.2g} \N{MULTIPLICATION SIGN} real time"
    drive = f"drive {float(frequencies[0]):.6g} Hz, " if forced else ""
    fig.text(1.0 - 0.1 / width, y, f"{drive}{told}", fontsize=size, color="0.35", va="bottom", ha="right")
    period = 1.0 / float(frequencies[0]) if forced else 0.0
    return _Clock(text, ds["time"].values, period, "drive periods")
