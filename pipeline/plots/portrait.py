"""Draw panels for one motion: its phase portrait, and the path of a point of the model's drawing."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from magpend_core.models.model import Drawing
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.labels import Measure

_AIR = 1.16


@dataclass(frozen=True)
class Motion:
    """One motion to draw: its trajectory, its section points and its colour.

    Attributes
    ----------
    orbit : dict of ndarray
        Values of each state along the motion, angles not wrapped.
    section : dict of ndarray
        The same at the stroboscopic section; may be empty arrays.
    gid : str
        Ends the identifiers of what is drawn.
    """

    orbit: Mapping[str, np.ndarray]
    section: Mapping[str, np.ndarray]
    colour: str
    gid: str = ""


def draw_portrait(ax: Axes, ds: xr.Dataset, pair: tuple[str, str], motion: Motion, *, degrees: bool = False) -> None:
    """Draw a phase portrait: the motion as a line, and its section points as dots.

    Parameters
    ----------
    ax
        The panel.
    ds
        Dataset of the run, from which the model is read.
    pair
        States to the right and upwards.
    motion
        Motion to draw.
    degrees
        Degrees for angles and their rates.
    """
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


def draw_path(ax: Axes, drawing: Drawing, parameters: Mapping[str, float], motion: Motion) -> list[str]:
    """Draw the path of the traced point of the model's drawing, and the near points that do not move.

    Parameters
    ----------
    ax
        The panel.
    drawing
        Mechanical drawing of the model.
    parameters
        Parameter values of the model.
    motion
        Motion to draw.

    Returns
    -------
    list of str
        Names of the fixed points that are near enough to be shown. `equalise` the axes once they have
        their place.
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
