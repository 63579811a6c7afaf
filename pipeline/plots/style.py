"""Define the common form of all figures: frames, axes, legends and captions.

Fonts, sizes, widths and colours are those of the rcParams; see `pipeline.plots.looks`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import wraps
from inspect import signature
from typing import Any, Literal, ParamSpec, TypeVar
from weakref import WeakSet

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import AutoMinorLocator, MaxNLocator

from pipeline.layout.own_words import arguments_in_own_words
from pipeline.plots.looks import (
    BLUE,
    DPI,
    GREEN,
    LOCK,
    LOOK,
    ORANGE,
    PALETTE,
    PURPLE,
    SKY,
    VERMILLION,
    WIDE,
    WIDE_MM,
    Frame,
    Sizes,
    as_hex,
    look,
    restored,
    sizes,
)

__all__ = [
    "BLUE", "DPI", "GREEN", "LOCK", "ORANGE", "PALETTE", "PURPLE", "SKY", "VERMILLION", "WIDE", "Frame", "as_hex",
    "sizes",
]  # fmt: skip

P = ParamSpec("P")
T = TypeVar("T")

COLUMN_MM = 85.0
"""Width of a column of a journal's page."""

GREY = "#7F7F7F"


def drawn(plot: Callable[P, T]) -> Callable[P, T]:
    """Wrap a function that draws a figure so that it draws with the look of its `frame`."""
    parameters = signature(plot)

    @wraps(plot)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        given = parameters.bind(*args, **kwargs)
        given.arguments.update(arguments_in_own_words(given.arguments))
        frame: Frame = given.arguments.get("frame", WIDE)
        with look(frame.style, frame.dpi, frame.width, is_guest()) as found:
            if "frame" in parameters.parameters:
                given.arguments["frame"] = replace(frame, width=found.width_mm)
            return plot(*given.args, **given.kwargs)

    return run


class DataFigure(Figure):
    """A matplotlib figure that also holds the data that it shows.

    Attributes
    ----------
    data : Dataset
        The numbers drawn, after every selection.
    frame : Frame
    look : Sizes
    notes : list of str
        Notes for the user who asked for the figure.
    rc : dict
        The rcParams with which it is drawn and saved; empty for those of the user.
    file_dpi : float
        Resolution of its files.
    settled : WeakSet
        Lines that have the widths and colours of the look.
    """

    data: xr.Dataset
    frame: Frame
    look: Sizes
    notes: list[str]
    rc: Mapping[str, Any] = {}
    file_dpi: float
    settled: WeakSet[Line2D]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.settled = WeakSet()
        super().__init__(*args, **kwargs)

    def draw(self, renderer: Any) -> None:
        """Draw the figure with its own rcParams, since fonts are found while texts are drawn."""
        with restored(self.rc):
            super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:
        """Save the figure with its own rcParams."""
        with restored(self.rc):
            super().savefig(*args, **kwargs)

    @property
    def panels(self) -> list[Axes]:
        """Axes of the panels: all visible axes except colour bars and strips."""
        aside = (STRIP, "<colorbar>")  # the second is matplotlib's own label
        return [ax for ax in self.axes if ax.get_visible() and ax.get_label() not in aside]

    def add_strip(self, ax: Axes, place: Any) -> Axes:
        """Add a strip below a panel, at a place of a grid, with the horizontal axis of the panel."""
        return self.add_subplot(place, sharex=ax, label=STRIP)

    def arrange(self) -> None:
        """Compute the layout, and fix it."""
        engine = self.get_layout_engine()
        if engine is not None:
            with LOCK:
                engine.execute(self)
            self.set_layout_engine("none")


STRIP = "<strip>"
"""Label of the axes of a strip, which is no panel of its own."""


@dataclass
class Target:
    """Function that makes the next figure, and the figure that it has made."""

    # ``make(figsize=..., layout=..., dpi=...)`` returns the empty figure; `dpi` may be None.
    make: Callable[..., DataFigure]
    is_guest: bool = False  # whether it lies in axes or a figure of the caller, who sets its look
    made: DataFigure | None = None  # the figure, once it is made


TARGET: ContextVar[Target | None] = ContextVar("TARGET", default=None)
"""Target of the figures that this thread makes; see `pipeline.plots.targets`."""


def new_figure(
    height: float, data: xr.Dataset, frame: Frame = WIDE, *, arranged: bool = True, exact: bool = False
) -> DataFigure:
    """Make an empty figure that holds the data to be drawn in it.

    `height` [in] is that of a figure of full width; narrow ones are lower, but not in proportion, unless it is `exact`.
    `arranged` says whether `finish` finds the places of axes, labels and legends.
    """
    share = 1.0 if exact else min(frame.width / WIDE_MM, 1.0)
    size = (frame.width_in, height * (share + 0.3 * (1.0 - share)))
    layout: Any = "constrained" if arranged else None
    target, present = TARGET.get(), LOOK.get()
    if target is None:
        figure = DataFigure(figsize=size, layout=layout)
    else:
        figure = target.made = target.make(figsize=size, layout=layout, dpi=frame.dpi or present.asked_dpi)
    frame = replace(frame, dpi=frame.dpi or present.asked_dpi)
    figure.data, figure.frame, figure.look, figure.notes = data, frame, sizes(), []
    figure.rc, figure.file_dpi = present.rc, present.dpi
    engine: Any = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.04, h_pad=0.04, hspace=0.02, wspace=0.02)
    return figure


def figure_of(ax: Axes) -> DataFigure:
    """Return the figure that contains the axes."""
    target = TARGET.get()
    figure = ax.figure if target is None or target.made is None else target.made
    assert isinstance(figure, DataFigure)
    return figure


def look_of(ax: Axes) -> Sizes:
    """Return the font sizes of the figure that contains the axes."""
    return figure_of(ax).look


def finish(figure: DataFigure) -> None:
    """Give new lines the widths and colours of the look, compute the layout of a figure, and fix it."""
    legends: Any = figure.findobj(Legend)
    lines = [*(line for ax in figure.axes for line in ax.lines), *(one for own in legends for one in own.get_lines())]
    for line in lines:
        if line not in figure.settled:
            line.set_linewidth(line.get_linewidth() * LOOK.get().line)
            for kind in ("color", "markerfacecolor", "markeredgecolor"):
                colour = getattr(line, f"get_{kind}")()
                if isinstance(colour, str) and colour[:1] == "C":
                    line.set(**{kind: as_hex(colour)})
            figure.settled.add(line)
    figure.arrange()


def style_axes(ax: Axes, *, inside: bool = True, minor: bool = True) -> None:
    """Place the ticks of axes, unless they are the user's: `inside` as in the style, or outside of an image."""
    if is_guest():
        return
    if not inside:
        ax.tick_params(which="both", direction="out", top=False, right=False)
    if minor:
        ax.xaxis.set_minor_locator(AutoMinorLocator())
        ax.yaxis.set_minor_locator(AutoMinorLocator(2))


def is_guest() -> bool:
    """Whether the figure is drawn into axes or a figure of the user."""
    target = TARGET.get()
    return target is not None and target.is_guest


def few_ticks(ax: Axes, x: int = 4, y: int = 4) -> None:
    """Limit the number of ticks on the two axes of a small panel."""
    ax.xaxis.set_major_locator(MaxNLocator(x))
    ax.yaxis.set_major_locator(MaxNLocator(y))


def style_bar(bar: Colorbar, text: str) -> None:
    """Label a colour bar, with its ticks outside of it."""
    if not is_guest():
        bar.ax.tick_params(direction="out")
    bar.set_label(text)


def label_axes(ax: Axes, x: str | None = None, y: str | None = None) -> None:
    """Write the labels of the axes."""
    if x is not None:
        ax.set_xlabel(x)
    if y is not None:
        ax.set_ylabel(y)


def caption(ax: Axes, text: str, share: float = 1.0) -> None:
    """Write a caption above axes, in lines that use at most a share of the figure's width."""
    if text:
        width = share * figure_of(ax).frame.width_in - 0.6
        ax.set_title(folded(text, width, look_of(ax).title), loc="left")


def folded(text: str, width: float, size: float, indent: str = "") -> str:
    """Break a text between words into lines that are at most `width` wide [in]."""
    lines: list[str] = []
    for word in text.split(" "):
        if lines and _width(lines[-1] + " " + word, size) <= width:
            lines[-1] += " " + word
        else:
            lines.append(indent + word if lines else word)
    return "\n".join(lines)


def _width(text: str, size: float) -> float:
    """Estimate the width of a text [in] from its number of characters."""
    plain = text.replace("$", "").replace("\\", "").replace("{", "").replace("}", "")
    return 0.48 * size / 72.0 * len(plain)


def legend_above(figure: DataFigure, handles: Sequence[Any], *, size: float | None = None) -> None:
    """Place a legend at the top right of a figure, in as few rows as fit."""
    size = figure.look.legend if size is None else size
    _legend(figure, handles, "outside upper right", size, handletextpad=0.35, handlelength=1.4)


def legend_below(figure: DataFigure, handles: Sequence[Any], length: float = 1.2) -> None:
    """Place a legend at the bottom left of a figure; `length` is that of its handles, in units of its letters."""
    _legend(figure, handles, "outside lower left", figure.look.legend, handletextpad=0.4, handlelength=length)


def _legend(figure: DataFigure, handles: Sequence[Any], place: Any, size: float, **spaces: float) -> None:
    if handles:
        figure.legend(
            handles=list(handles),
            loc=place,
            ncols=columns(figure.frame, [str(h.get_label()) for h in handles], size),
            frameon=False,
            fontsize=size,
            columnspacing=1.1,
            borderpad=0.1,
            borderaxespad=0.1,
            **spaces,
        )


def legend_inside(ax: Axes, handles: Sequence[Any]) -> None:
    """Place a legend inside axes, in another corner than a legend that is there already."""
    first = ax.get_legend()
    place: Any = "upper right" if first is None else "lower right"
    ax.legend(handles=list(handles), loc=place)
    if first is not None:
        ax.add_artist(first)  # axes have one legend of their own


def complete(figure: DataFigure, ax: Axes, text: str, handles: Sequence[Any] = ()) -> None:
    """Write the caption and the legend of a figure, then compute and fix its layout."""
    caption(ax, text)
    legend_above(figure, handles)
    finish(figure)


def columns(frame: Frame, texts: Sequence[str], size: float) -> int:
    """Return how many columns of a legend fit into the figure's width."""
    width = frame.width_in - 0.15
    for rows in range(1, len(texts)):
        n = math.ceil(len(texts) / rows)
        widest = [max(_width(t, size) for t in column) for column in np.array_split(np.array(texts), n)]
        if sum(widest) + n * 3.1 * size / 72.0 <= width:
            return n
    return 1


def colours() -> tuple[str, ...]:
    """Return the colours of data in the present look, each once."""
    return LOOK.get().colours


def dot(label: str, colour: Any, size: float = 5.0, *, face: Any = None, marker: str = "o") -> Line2D:
    """Make a legend entry that shows one marker."""
    return Line2D(
        [],
        [],
        linestyle="none",
        marker=marker,
        markersize=size,
        markeredgewidth=0.6 if face else 0.0,
        color=colour,
        markerfacecolor=colour if face is None else face,
        label=label,
    )


def points(
    ax: Axes,
    x: Any,
    y: Any,
    size: float,
    colour: Any,
    *,
    marker: str = "o",
    zorder: float = 2.0,
    rasterized: bool = False,
    gid: str | None = None,
) -> None:
    """Draw points without lines and edges; `size` is their diameter [pt]."""
    ax.plot(
        x,
        y,
        linestyle="none",
        marker=marker,
        markersize=size,
        markeredgewidth=0.0,
        color=colour,
        zorder=zorder,
        rasterized=rasterized,
        gid=gid,
    )


def tinted(colour: str, tint: float) -> tuple[float, float, float]:
    """Mix a colour with white; `tint` is the share of white, 0 to 1."""
    red, green, blue = (float(c) + (1.0 - float(c)) * tint for c in to_rgb(colour))
    return red, green, blue


def check_choice(what: str, value: str, allowed: Sequence[str]) -> None:
    """Raise ValueError, with the allowed values and the nearest of them, unless a value is allowed."""
    if value in allowed:
        return
    near = difflib.get_close_matches(str(value), allowed, n=1)
    hint = f"Did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"unknown {what} {value!r}. {hint}Allowed: {', '.join(allowed)}.")


def limits(ax: Axes, frame: Frame, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> None:
    """Set the ranges of the axes to those of the `Frame` or else to the given ones; ValueError if one is empty."""
    for axis, asked, own in (("x", frame.xlim, x), ("y", frame.ylim, y)):
        chosen = asked or own
        if chosen is not None:
            (ax.set_xlim if axis == "x" else ax.set_ylim)(*check_range(f"{axis}lim", chosen))


def check_range(name: Literal["xlim", "ylim"] | str, range_: tuple[float, float]) -> tuple[float, float]:
    """Return a range as two different finite numbers; raise ValueError if it is invalid."""
    low, high = (float(v) for v in range_)
    if not (math.isfinite(low) and math.isfinite(high) and low != high):
        raise ValueError(f"{name} = {low:g}, {high:g}: must be two different finite numbers")
    return low, high


def edges(x: np.ndarray) -> np.ndarray:
    """Return the edges of the columns that are centred on parameter values, one more than there are values."""
    if x.size == 1:
        width = 0.05 * abs(float(x[0])) or 0.5
        return np.array([x[0] - width, x[0] + width])
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[1.5 * x[0] - 0.5 * x[1]], middle, [1.5 * x[-1] - 0.5 * x[-2]]])


def span(x: np.ndarray) -> tuple[float, float]:
    """Return the range that the columns centred on given parameter values cover."""
    limits = edges(np.asarray(x, dtype=np.float64))
    return float(limits.min()), float(limits.max())


def fill_columns(
    ax: Axes, edges: np.ndarray, low: np.ndarray, high: np.ndarray, looks: Mapping[str, Any], gid: str
) -> PolyCollection:
    """Fill each column of a plot from `low` to `high`; equal columns beside each other share a rectangle."""
    levels = np.column_stack([low, high])
    starts = np.flatnonzero(np.r_[True, (np.diff(levels, axis=0) != 0).any(1)])
    ends = np.r_[starts[1:], len(levels)]
    kept = high[starts] > low[starts]
    corners = zip(edges[starts[kept]], edges[ends[kept]], *levels[starts[kept]].T, strict=True)
    boxes = [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)] for x0, x1, y0, y1 in corners]
    area = PolyCollection(boxes, gid=gid, **looks)
    ax.add_collection(area, autolim=False)
    return area


def join(parts: Iterable[str]) -> str:
    """Join the texts that are not empty with commas."""
    return ", ".join(part for part in parts if part)


def halo(width: float = 2.0) -> list[AbstractPathEffect]:
    """Return the path effects of a text or a line with a white rim [pt], which is read over colours."""
    return [withStroke(linewidth=width, foreground="white")]


def handles(looks: Iterable[Mapping[str, Any]]) -> list[Line2D]:
    """Return the legend entries of lines and markers with given looks."""
    return [Line2D([], [], **{name: value for name, value in look.items() if name != "zorder"}) for look in looks]


def hold(ax: Axes, x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> None:
    """Widen axes so that they hold some coordinates, but for an axis whose range the user chose."""
    frame = figure_of(ax).frame
    for values, chosen, get, put in (
        (x, frame.xlim, ax.get_xlim, ax.set_xlim),
        (y, frame.ylim, ax.get_ylim, ax.set_ylim),
    ):
        known = np.concatenate([np.ravel(v) for v in values]) if values else np.zeros(0)
        known = known[np.isfinite(known)]
        low, high = get()
        if chosen is None and len(known) and (known.min() < min(low, high) or known.max() > max(low, high)):
            room = 0.03 * max(abs(high - low), np.ptp(known))
            ends = min(low, high, known.min() - room), max(low, high, known.max() + room)
            put(*(ends if low <= high else ends[::-1]))


def storable(ds: xr.Dataset, title: str) -> xr.Dataset:
    """Return a dataset with a title and without what NetCDF cannot store."""
    return ds.drop_vars([name for name, v in ds.variables.items() if v.dtype == object]).assign_attrs(title=title)


def write(ax: Axes, text: str) -> None:
    """Write a text in the middle of a panel that has no data."""
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center")
