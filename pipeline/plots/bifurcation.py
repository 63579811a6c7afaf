"""Bifurcation diagram: kept sections over the swept parameter, coloured by side.

The cube is read block by block, twice: once for the range of the state and the shares of cells that are
absent, once for the points. So memory does not grow with the cube. Up to `MARKER_LIMIT` points are drawn
as markers; more are counted on the pixels of an image, where a pixel takes the colour of the side that
has most points in it and is the darker the more there are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import AutoMinorLocator

from pipeline.analysis.sides import Side, side
from pipeline.layout import vocabulary
from pipeline.plots import style

MARKER_LIMIT = 200_000
"""Largest number of points drawn as markers."""

LAYOUTS = ("overlay", "side")

_DRAWN = (vocabulary.PERIODIC, vocabulary.BOUNDED, vocabulary.INFERRED)
_ABSENT = {
    "pending": (vocabulary.PENDING,),
    "failed": (vocabulary.DIVERGED, vocabulary.STEP_LIMIT, vocabulary.STEP_UNDERFLOW),
    "not reached": (vocabulary.UNREACHED,),
}

SIDE_COLOURS = {
    Side.LEFT: style.BLUE,
    Side.RIGHT: style.VERMILLION,
    Side.STRADDLING: style.GREEN,
    Side.ROTATING: style.PURPLE,
    Side.UNDECIDED: style.GREY,
}
# Greys instead of hatching: some readers of SVG paint its patterns black.
_ABSENT_LOOKS: dict[str, dict[str, Any]] = {
    "pending": {"facecolor": "0.92", "edgecolor": "0.6", "linewidth": 0.4},
    "failed": {"facecolor": "0.1", "edgecolor": "0.1", "linewidth": 0.8},
    "not reached": {"facecolor": "0.62", "edgecolor": "0.62", "linewidth": 0.8},
}

_BLOCK_VALUES = 4_000_000
_SUPERSAMPLING = 2
_TINT = 0.5

_INNER_DIMS = ("period_index", "state")


@dataclass(frozen=True)
class _Points:
    """Points of one part of the cube: positions along the parameter, values, labels."""

    position: np.ndarray  # (n,) index into the parameter's values
    value: np.ndarray  # (n,) state
    side: np.ndarray  # (n,) codes of Side
    direction: np.ndarray  # (n,) index into the directions


@dataclass
class _Survey:
    """What the first reading finds out."""

    low: float = math.inf
    high: float = -math.inf
    classes: set[tuple[int, int]] = field(default_factory=set)
    absent: dict[str, np.ndarray] = field(default_factory=dict)  # (n_directions, n_x) counts
    cells: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def empty(self) -> bool:
        """Whether there is no point to draw."""
        return self.low > self.high


@dataclass(frozen=True)
class _View:
    """What to draw of which cube."""

    ds: xr.Dataset
    state: str
    degrees: bool
    parameter: str
    directions: tuple[str, ...]

    @property
    def x(self) -> np.ndarray:
        """Values of the swept parameter."""
        return np.asarray(self.ds[self.parameter].values, dtype=np.float64)

    @property
    def n_points(self) -> int:
        """Number of points, if no cell is absent."""
        return self.ds["section"].size // self.ds.sizes["state"]

    def blocks(self) -> Iterator[xr.Dataset]:
        """Yield loaded parts of the cube, each at most some tens of megabytes."""
        names = ["section", "status", *(["turns"] if "turns" in self.ds else [])]
        part = self.ds[names]
        for selection in _selections(self.ds["section"]):
            yield part.isel(selection).load()

    def all_points(self) -> Iterator[_Points]:
        """Yield the points of the cube, block by block."""
        for block in self.blocks():
            yield self.points(block)

    def direction_index(self, block: xr.Dataset) -> xr.DataArray:
        """Index of each branch's direction; a single 0 where there are no branches."""
        if self.directions == ("",):
            return xr.DataArray(np.int8(0))
        names = block["direction"].values.astype(str)
        index = np.array([self.directions.index(name) for name in names], dtype=np.int8)
        return xr.DataArray(index, dims="branch")

    def points(self, block: xr.Dataset) -> _Points:
        """Points of a loaded part that are there to be drawn."""
        value = block["section"].sel(state=self.state, drop=True)
        order = (*block["status"].dims, "period_index")
        value = value.transpose(*order)
        shape = value.shape
        cells = xr.ones_like(block["status"], dtype=np.int64)
        position = block["_position"] * cells
        direction = self.direction_index(block) * cells.astype(np.int8)
        drawn = block["status"].isin(_DRAWN).values[..., None] & np.isfinite(value.values)
        spread = [
            np.broadcast_to(array.transpose(*block["status"].dims).values[..., None], shape)[drawn]
            for array in (position, side(block), direction)
        ]
        values = value.values[drawn]
        return _Points(spread[0], np.rad2deg(values) if self.degrees else values, spread[1], spread[2])


def plot_bifurcation(
    ds: xr.Dataset, *, state: str = "psi1", degrees: bool = False, layout: str = "overlay"
) -> Figure:
    """Draw kept sections over the swept parameter, coloured by the side of the motion.

    Everything is read from the cube; nothing is integrated. For the meaning of left, right and
    straddling see `pipeline.analysis.sides`. Where cells are pending, failed or not reached, a strip
    below the diagram shows their share at each value of the parameter, and the diagram is shaded where
    no cell at all is left to draw.

    Parameters
    ----------
    ds
        Cube of a continuation or a sweep, as `pipeline.open_run` gives it: `section` and `status`, and
        `turns` if rotation is to be told. Its dims beside branches and initial conditions must be one
        swept parameter; choose values of any others first, as in ``ds.sel(q=1.5)``.
    state
        ``psi1``, ``psi2``, ``psi1_dot`` or ``psi2_dot``.
    degrees
        Degrees instead of radians.
    layout
        ``overlay``: branches up (small dark points) over branches down (larger light points) in one
        panel. ``side``: a panel each.

    Returns
    -------
    Figure
        7 in wide. For a cube without a finished cell it says so.

    Raises
    ------
    ValueError
        For an unknown state or layout, for two swept parameters, and for layout ``side`` where the cube
        has not both directions.
    """
    style.check_choice("layout", layout, LAYOUTS)
    view = _view(ds, state, degrees)
    if layout == "side" and len(view.directions) < 2:
        raise ValueError(
            "layout 'side' needs branches up and down, and this cube has "
            f"{view.directions[0] or 'no directions'} only; use layout 'overlay'"
        )
    survey = _survey(view)
    fig = style.new_figure(4.3)
    panels = _panels(fig, view, survey, layout)
    limits = _y_limits(view, survey)
    for ax, strip, chosen in panels:
        _dress(ax, view, limits)
        if strip is not None:
            _draw_absent(ax, strip, view, survey, chosen)
    if survey.empty:
        _say_empty(panels[0][0], survey)
    else:
        _draw_points(panels, view, survey, limits)
    _legend(fig, view, survey, layout)
    style.style_text(fig)
    return fig


def draw_diagram(ax: Axes, ds: xr.Dataset, *, state: str = "psi1", degrees: bool = False) -> list[Any]:
    """Draw a diagram into axes of another figure, without a strip for absent cells.

    Parameters
    ----------
    ax
        Gets its limits, ticks and the label of its y axis here; the x axis stays without one.
    ds, state, degrees
        As for `plot_bifurcation`.

    Returns
    -------
    list
        Handles for a legend.

    Raises
    ------
    ValueError
        As `plot_bifurcation`.
    """
    view = _view(ds, state, degrees)
    survey = _survey(view)
    limits = _y_limits(view, survey)
    style.style_axes(ax)
    _dress(ax, view, limits)
    ax.set_ylabel(style.state_label(state, degrees), fontsize=style.LABEL_PT)
    if survey.empty:
        _say_empty(ax, survey)
    else:
        _draw_points([(ax, None, tuple(range(len(view.directions))))], view, survey, limits)
    return _handles(view, survey, "overlay")


# ---------------------------------------------------------------- what is in the cube


def _view(ds: xr.Dataset, state: str, degrees: bool) -> _View:
    states = [str(name) for name in ds["state"].values]
    style.check_choice("state", state, [name for name in style.STATE_SYMBOLS if name in states])
    parameter = swept_parameter(ds)
    directions: tuple[str, ...] = ("",)
    if "branch" in ds["section"].dims and "direction" in ds.coords:
        present = {str(name) for name in ds["direction"].values}
        directions = tuple(sorted(present, key=lambda name: (name != "up", name)))
    position = xr.DataArray(np.arange(ds.sizes[parameter]), dims=parameter)
    return _View(ds.assign_coords(_position=position), state, degrees, parameter, directions)


def swept_parameters(ds: xr.Dataset) -> list[str]:
    """Return the swept parameters of a cube."""
    return list(vocabulary.split_dims(ds["status"])[0])


def swept_parameter(ds: xr.Dataset) -> str:
    """Return the one swept parameter of a cube; raises ValueError if there is none or more than one."""
    outer = swept_parameters(ds)
    long = [dim for dim in outer if ds.sizes[dim] > 1]
    if len(long) > 1:
        first = long[1] if long[0] == "frequency" else long[0]
        value = np.asarray(ds[first].values)[0]
        raise ValueError(
            f"the cube sweeps {' and '.join(long)}, and a diagram has one axis for them; "
            f"choose a value first, for instance ds.sel({first}={value}), or draw a map of regimes"
        )
    if not outer:
        raise ValueError("the cube sweeps no parameter: there is nothing to draw the sections over")
    return (long or outer)[0]


def _selections(section: xr.DataArray) -> Iterator[dict[str, slice]]:
    """Yield selections that tile the cells of `section`, aligned with its chunks where it has any."""
    dims = [str(dim) for dim in section.dims if dim not in _INNER_DIMS]
    inner = math.prod(section.sizes[dim] for dim in _INNER_DIMS)
    chunks = _chunk_sizes(section)
    # whole chunks along the last dims, as many as fit
    sizes: dict[str, int] = {}
    for i, dim in enumerate(reversed(dims)):
        rest = math.prod(chunks[other] for other in dims[: len(dims) - 1 - i])
        fit = _BLOCK_VALUES // max(1, inner * rest * math.prod(sizes.values()))
        n_chunks = max(1, fit // chunks[dim])
        sizes[dim] = min(n_chunks * chunks[dim], max(1, section.sizes[dim]))
    # a chunk that is too large on its own is cut
    for dim in dims:
        total = inner * math.prod(sizes.values())
        if total > _BLOCK_VALUES:
            sizes[dim] = max(1, sizes[dim] * _BLOCK_VALUES // total)
    slices = [[slice(i, i + sizes[dim]) for i in range(0, section.sizes[dim], sizes[dim])] for dim in dims]
    for chosen in product(*slices):
        yield dict(zip(dims, chosen, strict=True))


def _chunk_sizes(section: xr.DataArray) -> dict[str, int]:
    preferred = section.encoding.get("preferred_chunks") or {}
    sizes = {str(dim): int(preferred.get(dim, 1)) for dim in section.dims}
    sizes.update({str(dim): int(max(lengths)) for dim, lengths in section.variable.chunksizes.items()})
    return {dim: max(1, size) for dim, size in sizes.items()}


def _survey(view: _View) -> _Survey:
    """Read the cube once: range of the state, classes that occur, cells that are absent."""
    shape = (len(view.directions), view.x.size)
    survey = _Survey(
        absent={name: np.zeros(shape, np.int64) for name in _ABSENT}, cells=np.zeros(shape, np.int64)
    )
    for block in view.blocks():
        points = view.points(block)
        if points.value.size:
            survey.low = min(survey.low, float(points.value.min()))
            survey.high = max(survey.high, float(points.value.max()))
            code = np.flatnonzero(np.bincount(points.direction.astype(np.int64) * len(Side) + points.side))
            survey.classes |= {(int(c) // len(Side), int(c) % len(Side)) for c in code}
        _count_absent(view, block, survey)
    return survey


def _count_absent(view: _View, block: xr.Dataset, survey: _Survey) -> None:
    status = block["status"]
    ones = xr.ones_like(status, dtype=np.int64)
    direction = (view.direction_index(block) * ones).values.ravel()
    position = (block["_position"] * ones).transpose(*status.dims).values.ravel()
    where = direction * view.x.size + position
    size = survey.cells.size
    survey.cells += np.bincount(where, minlength=size).reshape(survey.cells.shape)
    for name, codes in _ABSENT.items():
        chosen = status.isin(codes).values.ravel()
        survey.absent[name] += np.bincount(where[chosen], minlength=size).reshape(survey.cells.shape)


# ---------------------------------------------------------------- axes


Panel = tuple[Axes, Axes | None, tuple[int, ...]]
"""Axes of the diagram, axes of the strip below it, and the directions shown."""


def _panels(fig: Figure, view: _View, survey: _Survey, layout: str) -> list[Panel]:
    everything = tuple(range(len(view.directions)))
    shown = [(i,) for i in everything] if layout == "side" else [everything]
    with_strip = any(counts.any() for counts in survey.absent.values())
    grid = fig.add_gridspec(
        2 if with_strip else 1, len(shown), height_ratios=[1.0, 0.075] if with_strip else None,
        left=0.095, right=0.975, bottom=0.115, top=0.925, hspace=0.035, wspace=0.09,
    )  # fmt: skip
    panels: list[Panel] = []
    for column, chosen in enumerate(shown):
        first = panels[0] if panels else (None, None)
        ax = fig.add_subplot(grid[0, column], sharey=first[0])
        strip = fig.add_subplot(grid[1, column], sharex=ax, sharey=first[1]) if with_strip else None
        panels.append((ax, strip, chosen))
        for axes in (ax, strip):
            if axes is not None:
                style.style_axes(axes)
        _outer_labels(view, ax, strip, column, len(shown) > 1)
    return panels


def _outer_labels(view: _View, ax: Axes, strip: Axes | None, column: int, titled: bool) -> None:
    lowest = ax if strip is None else strip
    lowest.set_xlabel(style.parameter_label(view.ds[view.parameter]), fontsize=style.LABEL_PT)
    if strip is not None:
        ax.tick_params(labelbottom=False)
    if column == 0:
        ax.set_ylabel(style.state_label(view.state, view.degrees), fontsize=style.LABEL_PT)
    else:
        for axes in (ax, strip):
            if axes is not None:
                axes.tick_params(labelleft=False)
    if titled:
        ax.text(
            0.045, 0.955, view.directions[column], transform=ax.transAxes, va="top", fontsize=style.LABEL_PT
        )


def _y_limits(view: _View, survey: _Survey) -> tuple[float, float]:
    half_turn = 180.0 if view.degrees else math.pi
    if survey.empty:
        return -half_turn, half_turn
    margin = max(0.04 * (survey.high - survey.low), 1e-3 * half_turn)
    low, high = survey.low - margin, survey.high + margin
    if style.is_angle(view.state):
        reach = 1.01 * half_turn
        low, high = max(low, -reach), min(high, reach)
    return low, high


def _dress(ax: Axes, view: _View, limits: tuple[float, float]) -> None:
    edges = style.edges(view.x)
    ax.set_xlim(float(edges.min()), float(edges.max()))
    ax.set_ylim(*limits)
    if style.is_angle(view.state):
        style.set_angle_ticks(ax, *limits, degrees=view.degrees)
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    ax.yaxis.set_minor_locator(AutoMinorLocator(2))


# ---------------------------------------------------------------- absent cells


def _draw_absent(ax: Axes, strip: Axes, view: _View, survey: _Survey, chosen: tuple[int, ...]) -> None:
    """Share of absent cells in the strip; shading in the diagram where no cell is left."""
    edges = style.edges(view.x)
    cells = survey.cells[list(chosen)].sum(0)
    floor = np.zeros(cells.size)
    for name, counts in survey.absent.items():
        share = counts[list(chosen)].sum(0) / np.maximum(cells, 1)
        if not share.any():
            continue
        looks = _ABSENT_LOOKS[name]
        style.fill_columns(strip, edges, floor, floor + share, looks, f"absent:{name}")
        floor = floor + share
    strip.set_ylim(0.0, 1.0)
    strip.set_yticks([0.5], ["absent"])
    strip.tick_params(axis="y", right=False, left=False)
    strip.tick_params(axis="x", which="both", top=False)
    blank = (floor >= 1.0 - 1e-12).astype(float)
    if blank.any():
        looks = {"facecolor": "0.955", "linewidth": 0.0, "zorder": 1.5}
        area = style.fill_columns(ax, edges, np.zeros(blank.size), blank, looks, "blank")
        area.set_transform(ax.get_xaxis_transform())


def _say_empty(ax: Axes, survey: _Survey) -> None:
    n_cells = int(survey.cells.sum())
    absent = {name: int(counts.sum()) for name, counts in survey.absent.items() if counts.any()}
    parts = ", ".join(f"{n} {name}" for name, n in absent.items())
    text = (
        f"nothing to draw: of {n_cells} cells, {parts}"
        if n_cells
        else "nothing to draw: the cube has no cells"
    )
    if absent.get("pending", 0) == n_cells > 0:
        text = f"nothing to draw yet: all {n_cells} cells are pending"
    ax.text(
        0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", fontsize=style.LABEL_PT, zorder=3,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
    )  # fmt: skip


# ---------------------------------------------------------------- points


@dataclass(frozen=True)
class _Look:
    """Marker of one direction.

    Attributes
    ----------
    diameter : float
        [pt]
    tint : float
        Share of white in its colour.
    faintest : float
        Opacity of a pixel of an image that holds a single point, where others hold many.
    """

    diameter: float
    tint: float
    faintest: float


_PLAIN = {"tint": 0.0, "faintest": 0.5}
_LIGHT = {"tint": _TINT, "faintest": 0.75}


def _looks(view: _View, shown: Sequence[int]) -> dict[int, _Look]:
    """Small dark points over larger light ones, so that both are seen where they coincide."""
    width_pt = 72.0 * style.WIDTH_IN * 0.88
    diameter = min(1.7, max(0.75, 0.8 * width_pt / max(view.x.size, 1)))
    if len(shown) < 2:
        return {i: _Look(diameter, **_PLAIN) for i in shown}
    dark = max(diameter, 0.95)
    return {i: _Look(dark, **_PLAIN) if i == 0 else _Look(2.0 * dark, **_LIGHT) for i in shown}


def _tinted(colour: str, tint: float) -> tuple[float, float, float]:
    red, green, blue = (float(c) + (1.0 - float(c)) * tint for c in to_rgb(colour))
    return red, green, blue


def _draw_points(panels: Sequence[Panel], view: _View, survey: _Survey, limits: tuple[float, float]) -> None:
    if view.n_points <= MARKER_LIMIT:
        _draw_markers(panels, view, limits)
    else:
        _draw_images(panels, view, limits)


def _draw_markers(panels: Sequence[Panel], view: _View, limits: tuple[float, float]) -> None:
    parts = list(view.all_points())
    names = ("position", "value", "side", "direction")
    position, value, label, direction = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
    for ax, _, shown in panels:
        for i, look in reversed(_looks(view, shown).items()):
            for kind, colour in SIDE_COLOURS.items():
                chosen = (direction == i) & (label == kind)
                if not chosen.any():
                    continue
                where, height = _distinct(position[chosen], value[chosen], limits)
                (line,) = ax.plot(
                    view.x[where], height, linestyle="none", marker="o",
                    markersize=look.diameter, markeredgewidth=0.0, color=_tinted(colour, look.tint),
                    rasterized=True, zorder=2.0 - 0.1 * i,
                )  # fmt: skip
                line.set_gid(f"points:{view.directions[i]}:{kind.name.lower()}")


def _distinct(
    position: np.ndarray, value: np.ndarray, limits: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Leave one of the points that no eye can tell apart.

    Many markers on one spot would darken their smoothed rims, and dots would become squares.
    """
    level = np.round((value - limits[0]) * (10_000 / (limits[1] - limits[0]))).astype(np.int64)
    _, first = np.unique(position.astype(np.int64) * 20_000 + level, return_index=True)
    return position[first], value[first]


def _draw_images(panels: Sequence[Panel], view: _View, limits: tuple[float, float]) -> None:
    height, width = _pixels(panels[0][0])
    counts = _count(view, limits, height, width)
    for ax, _, shown in panels:
        picture = np.ones((height, width, 3), dtype=np.float32)
        for i, look in reversed(_looks(view, shown).items()):
            own = {kind: grid for (k, kind), grid in counts.items() if k == i}
            _paint(picture, own, look)
        low, high = sorted(float(v) for v in ax.get_xlim())
        image = ax.imshow(
            (255.0 * picture + 0.5).astype(np.uint8), extent=(low, high, *limits), origin="lower",
            aspect="auto", interpolation="antialiased", zorder=1.0,
        )  # fmt: skip
        image.set_gid("points")


def _pixels(ax: Axes) -> tuple[int, int]:
    """Height and width of the image that fills the axes, finer than the page by `_SUPERSAMPLING`."""
    box = ax.get_window_extent()
    return round(box.height * _SUPERSAMPLING), round(box.width * _SUPERSAMPLING)


def _count(
    view: _View, limits: tuple[float, float], height: int, width: int
) -> dict[tuple[int, Side], np.ndarray]:
    """Count points on pixels, for each direction and side that occurs."""
    edges = style.edges(view.x)
    left, right = float(edges.min()), float(edges.max())
    column = np.clip(((view.x - left) / (right - left) * width).astype(np.int64), 0, width - 1)
    counts: dict[tuple[int, Side], np.ndarray] = {}
    for points in view.all_points():
        row = ((points.value - limits[0]) * (height / (limits[1] - limits[0]))).astype(np.int64)
        pixel = np.clip(row, 0, height - 1) * width + column[points.position]
        kinds = points.direction.astype(np.int64) * len(Side) + points.side
        for code in np.flatnonzero(np.bincount(kinds)):
            key = (int(code) // len(Side), Side(int(code) % len(Side)))
            if key not in counts:
                counts[key] = np.zeros((height, width), dtype=np.uint32)
            np.add.at(counts[key].reshape(-1), pixel[kinds == code], np.uint32(1))
    return counts


def _paint(picture: np.ndarray, counts: Mapping[Side, np.ndarray], look: _Look) -> None:
    """Paint the points of one direction over the picture, each pixel by the side with most points."""
    if not counts:
        return
    dot = _disc(look.diameter / 72.0 * style.DPI * _SUPERSAMPLING)
    colours = np.zeros((len(Side), 3), dtype=np.float32)
    most = np.zeros(picture.shape[:2], dtype=np.uint32)
    winner = np.zeros(picture.shape[:2], dtype=np.uint8)
    for kind, grid in counts.items():
        colours[kind] = _tinted(SIDE_COLOURS[kind], look.tint)
        spread = _dilate(grid, dot)
        np.copyto(winner, np.uint8(kind), where=spread > most)
        np.maximum(most, spread, out=most)
    flat = picture.reshape(-1, 3)
    inked = np.flatnonzero(most)
    opacity = _opacity(most.reshape(-1)[inked], look.faintest)[:, None]
    below = flat[inked]
    flat[inked] = below + opacity * (colours[winner.reshape(-1)[inked]] - below)


def _opacity(counts: np.ndarray, faintest: float) -> np.ndarray:
    """Opacity from `faintest` for single points to 1 for the fullest tenth of the pixels, logarithmic."""
    reference = float(np.quantile(counts, 0.9))
    if reference <= 1.0:
        return np.ones(counts.size, dtype=np.float32)
    depth = np.log(counts.astype(np.float32)) / np.float32(math.log(reference))
    return np.float32(faintest) + np.float32(1.0 - faintest) * np.clip(depth, 0.0, 1.0)


def _disc(diameter: float) -> list[tuple[int, int]]:
    """Offsets (row, column) of the pixels of a dot."""
    radius = max(0.5, 0.5 * diameter)
    reach = math.ceil(radius)
    around = range(-reach, reach + 1)
    return [(i, j) for i in around for j in around if math.hypot(i, j) < radius]


def _dilate(grid: np.ndarray, dot: Sequence[tuple[int, int]]) -> np.ndarray:
    """Largest count within a dot around each pixel."""
    height, width = grid.shape
    result = np.zeros_like(grid)
    for i, j in dot:
        target = result[max(i, 0) : height + min(i, 0), max(j, 0) : width + min(j, 0)]
        source = grid[max(-i, 0) : height + min(-i, 0), max(-j, 0) : width + min(-j, 0)]
        np.maximum(target, source, out=target)
    return result


# ---------------------------------------------------------------- legend


def _legend(fig: Figure, view: _View, survey: _Survey, layout: str) -> None:
    handles = _handles(view, survey, layout)
    if handles:
        fig.legend(
            handles=handles, loc="lower right", bbox_to_anchor=(0.98, 0.925), ncols=len(handles),
            frameon=False, fontsize=style.LEGEND_PT, handletextpad=0.3, columnspacing=1.1,
            borderpad=0.2, handlelength=1.3,
        )  # fmt: skip


def _handles(view: _View, survey: _Survey, layout: str) -> list[Any]:
    kinds = {kind for _, kind in survey.classes}
    handles: list[Any] = [
        _dot(colour, 5.0, kind.name.lower()) for kind, colour in SIDE_COLOURS.items() if kind in kinds
    ]
    if layout == "overlay" and len(view.directions) > 1 and not survey.empty:
        sizes = _looks(view, range(len(view.directions)))
        for i, name in enumerate(view.directions):
            handles.append(_dot(_tinted("black", sizes[i].tint), 3.0 if i == 0 else 6.0, name))
    for name, counts in survey.absent.items():
        if counts.any():
            handles.append(Patch(label=name, **_ABSENT_LOOKS[name]))
    return handles


def _dot(colour: Any, size: float, label: str) -> Line2D:
    return Line2D(
        [], [], linestyle="none", marker="o", markersize=size, markeredgewidth=0, color=colour, label=label
    )
