"""Draw the section points of a result cube as markers or, if there are many, as an image that counts points per pixel.

In an image a pixel takes the colour of the motion that has most points in it, and is the darker the more
there are; all panels of a figure share one scale of darkness.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.layout.conventions import code_flags
from pipeline.plots import style
from pipeline.plots.palette import Motions
from pipeline.plots.points import Points, Range, View

MARKER_LIMIT = 200_000
"""Largest number of points drawn as markers."""

SUPERSAMPLING = 2
TINT = 0.5


@dataclass(frozen=True)
class Look:
    """Marker style for the points of one direction of a continuation."""

    diameter: float  # [pt]
    tint: float = 0.0  # share of white in its colour
    faintest: float = 0.5  # opacity of a pixel of an image that holds a single point, where others hold many


def looks(diameter: float, shown: Sequence[int]) -> dict[int, Look]:
    """Choose marker styles for the directions of a continuation: small dark markers over large light ones."""
    if len(shown) < 2:
        return {i: Look(diameter) for i in shown}
    dark = max(diameter, 0.95)
    return {i: Look(dark) if i == 0 else Look(2.0 * dark, TINT, 0.75) for i in shown}


@dataclass(frozen=True)
class Panel:
    """Axes of one panel, and the directions of continuation that are drawn in it."""

    ax: Axes
    layers: tuple[int, ...]


def draw_points(panels: Sequence[Panel], view: View, diameter: float) -> xr.Dataset:
    """Draw the points of a `View` into panels of equal size, whose positions and limits are final.

    `diameter` is that of the marker of a single layer [pt].

    Returns
    -------
    Dataset
        Drawn data on the dim ``point``: ``x``, ``y``, and the codes ``motion`` and ``direction``; for an
        image, the centres of the pixels that hold points, and the ``count`` of points in each.
    """
    ax = panels[0].ax
    x, y = _sorted(ax.get_xlim()), _sorted(ax.get_ylim())
    if view.n_points <= MARKER_LIMIT:
        parts = [points.inside(x, y) for points in view.all_points()]
        names = ("x", "y", "motion", "layer")
        points = Points(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
        for panel in panels:
            _draw_markers(panel, points, view, diameter, x, y)
        return _table(points.x, points.y, points.motion, points.layer, view)
    counts = _count(view, x, y, _pixels(ax))
    _draw_images(panels, counts, view.motions, diameter, x, y)
    return _pixel_table(counts, x, y, view)


def _sorted(limits: tuple[float, float]) -> Range:
    return min(limits), max(limits)


# ---------------------------------------------------------------- markers


def _draw_markers(panel: Panel, points: Points, view: View, diameter: float, x: Range, y: Range) -> None:
    for i, look in reversed(looks(diameter, panel.layers).items()):
        for code in view.motions.drawn:
            chosen = (points.layer == i) & (points.motion == code)
            if not chosen.any():
                continue
            where, height = distinct(points.x[chosen], points.y[chosen], x, y)
            (line,) = panel.ax.plot(
                where,
                height,
                linestyle="none",
                marker="o",
                markersize=look.diameter,
                markeredgewidth=0.0,
                color=style.tinted(view.motions.colours[code], look.tint),
                rasterized=True,
                zorder=2.0 - 0.1 * i,
                scalex=False,
                scaley=False,
            )
            line.set_gid("points:" + ":".join(n for n in (view.layers[i], view.motions.words[code]) if n))


def distinct(x: np.ndarray, y: np.ndarray, xlim: Range, ylim: Range) -> tuple[np.ndarray, np.ndarray]:
    """Drop points that would cover another point exactly.

    Many markers on one spot would darken their smoothed rims, and dots would become squares.
    """
    column, row = (
        np.round((v - low) * (10_000 / (high - low))).astype(np.int64) for v, (low, high) in ((x, xlim), (y, ylim))
    )
    _, first = np.unique(column * 20_000 + row, return_index=True)
    return x[first], y[first]


def _table(x: np.ndarray, y: np.ndarray, motion: np.ndarray, layer: np.ndarray, view: View) -> xr.Dataset:
    variables = {"x": ("point", x), "y": ("point", y)}
    ds = xr.Dataset(variables)
    if view.motions.told:
        attrs = code_flags([word.replace(" ", "_") for word in view.motions.words])
        ds["motion"] = ("point", motion.astype(np.int8), attrs)
    if view.layers != ("",):
        ds["direction"] = ("point", layer.astype(np.int8), code_flags(view.layers))
    return ds


# ---------------------------------------------------------------- images


Counts = Mapping[tuple[int, int], np.ndarray]
"""Numbers of points on pixels, rows from below, by layer and motion."""


def _pixels(ax: Axes) -> tuple[int, int]:
    """Return the height and the width of the image that fills the axes [pixels]; it is finer than a saved figure."""
    box, figure = ax.get_window_extent(), ax.figure
    fine = SUPERSAMPLING * style.figure_of(ax).file_dpi / figure.dpi
    return max(1, round(box.height * fine)), max(1, round(box.width * fine))


def _count(view: View, x: Range, y: Range, shape: tuple[int, int]) -> dict[tuple[int, int], np.ndarray]:
    height, width = shape
    n_motions = len(view.motions.words)
    counts: dict[tuple[int, int], np.ndarray] = {}
    for part in view.all_points():
        points = part.inside(x, y)
        column = np.minimum(((points.x - x[0]) * (width / (x[1] - x[0]))).astype(np.int64), width - 1)
        row = np.minimum(((points.y - y[0]) * (height / (y[1] - y[0]))).astype(np.int64), height - 1)
        pixel = row * width + column
        kinds = points.layer.astype(np.int64) * n_motions + points.motion
        for code in np.flatnonzero(np.bincount(kinds)) if kinds.size else ():
            key = (int(code) // n_motions, int(code) % n_motions)
            if key not in counts:
                counts[key] = np.zeros((height, width), dtype=np.uint32)
            np.add.at(counts[key].reshape(-1), pixel[kinds == code], np.uint32(1))
    return counts


def _draw_images(
    panels: Sequence[Panel], counts: Counts, motions: Motions, diameter: float, x: Range, y: Range
) -> None:
    by_panel = [_spread(counts, looks(diameter, panel.layers)) for panel in panels]
    most = [grid[grid > 0] for spread in by_panel for own in spread.values() for grid in own.values()]
    reference = float(np.quantile(np.concatenate(most), 0.9)) if most else 1.0
    for panel, spread in zip(panels, by_panel, strict=True):
        shape = next(iter(counts.values())).shape if counts else (1, 1)
        picture = np.ones((*shape, 3), dtype=np.float32)
        for i, look in reversed(looks(diameter, panel.layers).items()):
            paint(picture, spread[i], look, motions.colours, reference)
        image = panel.ax.imshow(
            (255.0 * picture + 0.5).astype(np.uint8),
            extent=(*x, *y),
            origin="lower",
            aspect="auto",
            interpolation="antialiased",
            zorder=1.0,
        )
        image.set_gid("points")


def _spread(counts: Counts, looks: Mapping[int, Look]) -> dict[int, dict[int, np.ndarray]]:
    """Spread the count of each pixel over the disc of a marker, for every direction and class of motion."""
    return {
        i: {
            code: _dilate(grid, _disc(look.diameter / 72.0 * style.DPI * SUPERSAMPLING))
            for (layer, code), grid in counts.items()
            if layer == i
        }
        for i, look in looks.items()
    }


def paint(
    picture: np.ndarray, spread: Mapping[int, np.ndarray], look: Look, colours: Sequence[str], reference: float
) -> None:
    """Paint points into an image. Each pixel has the colour of the class of motion that has most points there.

    The image is RGB from 0 to 1, shape (row, column, 3), and changed in place. `spread` are counts by code of motion; a
    pixel with `reference` points is fully dark.
    """
    if not spread:
        return
    table = np.array([style.tinted(colour, look.tint) for colour in colours], dtype=np.float32)
    most = np.zeros(picture.shape[:2], dtype=np.uint32)
    winner = np.zeros(picture.shape[:2], dtype=np.uint8)
    for code, grid in spread.items():
        np.copyto(winner, np.uint8(code), where=grid > most)
        np.maximum(most, grid, out=most)
    flat = picture.reshape(-1, 3)
    inked = np.flatnonzero(most)
    opacity = _opacity(most.reshape(-1)[inked], look.faintest, reference)[:, None]
    below = flat[inked]
    flat[inked] = below + opacity * (table[winner.reshape(-1)[inked]] - below)


def _opacity(counts: np.ndarray, faintest: float, reference: float) -> np.ndarray:
    """Return opacities that grow with the logarithm of counts, from `faintest` for 1 to 1 for `reference`."""
    if reference <= 1.0:
        return np.ones(counts.size, dtype=np.float32)
    depth = np.log(counts.astype(np.float32)) / np.float32(math.log(reference))
    return np.float32(faintest) + np.float32(1.0 - faintest) * np.clip(depth, 0.0, 1.0)


def _disc(diameter: float) -> list[tuple[int, int]]:
    radius = max(0.5, 0.5 * diameter)
    reach = math.ceil(radius)
    around = range(-reach, reach + 1)
    return [(i, j) for i in around for j in around if math.hypot(i, j) < radius]


def _dilate(grid: np.ndarray, dot: Sequence[tuple[int, int]]) -> np.ndarray:
    height, width = grid.shape
    result = np.zeros_like(grid)
    for i, j in dot:
        target = result[max(i, 0) : height + min(i, 0), max(j, 0) : width + min(j, 0)]
        source = grid[max(-i, 0) : height + min(-i, 0), max(-j, 0) : width + min(-j, 0)]
        np.maximum(target, source, out=target)
    return result


def _pixel_table(counts: Counts, x: Range, y: Range, view: View) -> xr.Dataset:
    """Return the pixels that have points as a dataset: place, number of points, class of motion and direction."""
    parts = []
    for (own_layer, code), grid in counts.items():
        rows, columns = np.nonzero(grid)
        ones = np.ones(rows.size, np.int64)
        parts.append((columns, rows, code * ones, own_layer * ones, grid[rows, columns]))
    if not parts:
        parts.append((np.zeros(0, np.int64),) * 5)
    column, row, motion, layer, count = (np.concatenate(p) for p in zip(*parts, strict=True))
    height, width = next(iter(counts.values())).shape if counts else (1, 1)
    ds = _table(
        x[0] + (column + 0.5) * (x[1] - x[0]) / width, y[0] + (row + 0.5) * (y[1] - y[0]) / height, motion, layer, view
    )
    ds["count"] = ("point", count.astype(np.int32), {"units": "1", "long_name": "points on the pixel"})
    return ds
