"""Define the common look of all figures: sizes, fonts, colours, axes, legends and captions.

The look is set on each object, never through `matplotlib.rcParams`: these are shared by all threads.
"""

from __future__ import annotations

import difflib
import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colorbar import Colorbar
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import AutoMinorLocator, MaxNLocator

TEXT_LOCK = threading.Lock()
"""Held while texts are measured or drawn: matplotlib parses mathematics with one parser for all threads."""

MM = 1.0 / 25.4
"""Inches per millimetre."""

WIDE_MM, COLUMN_MM = 178.0, 85.0
"""Widths of two columns and of one of a journal's page."""

COMPACT_MM = 130.0
"""Figures narrower than this have smaller letters, and legends below instead of beside."""

DPI = 200
FONT, MATH_FONT = "STIXGeneral", "stix"
LINE_PT = 0.7

# Okabe & Ito, https://jfly.uni-koeln.de/color/
BLUE, VERMILLION, GREEN, PURPLE, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"
SKY, GREY = "#56B4E9", "#7F7F7F"


@dataclass(frozen=True)
class Frame:
    """Width of a figure, and the ranges of its axes.

    Attributes
    ----------
    width : float
        [mm]; 85 is a journal's column.
    xlim, ylim : tuple of float, optional
        Range of the axes, in the units on them; by default what is there.
    """

    width: float = WIDE_MM
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None

    @property
    def compact(self) -> bool:
        """Whether the figure is too narrow for a legend beside its axes."""
        return self.width < COMPACT_MM

    @property
    def width_in(self) -> float:
        """Return the figure's width [in]."""
        return self.width * MM


WIDE = Frame()


@dataclass(frozen=True)
class Look:
    """Font sizes [pt] of a figure: axis labels, ticks and legend."""

    label: float
    tick: float
    legend: float


_LOOKS = {False: Look(10.0, 9.0, 9.0), True: Look(8.0, 7.0, 7.0)}


class DataFigure(Figure):
    """A matplotlib figure that also holds the data that it shows.

    Attributes
    ----------
    data : Dataset
        The numbers drawn, after every selection.
    frame : Frame
    look : Look
    notes : list of str
        Notes for the user who asked for the figure.
    """

    data: xr.Dataset
    frame: Frame
    look: Look
    notes: list[str]

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
            with TEXT_LOCK:
                engine.execute(self)
            self.set_layout_engine("none")


STRIP = "<strip>"
"""Label of the axes of a strip, which is no panel of its own."""


@dataclass
class Target:
    """Function that makes the next figure, and the figure that it has made.

    Attributes
    ----------
    make : callable
        ``make(figsize=..., layout=...)`` returns the empty figure.
    made : DataFigure, optional
        The figure, once it is made.
    """

    make: Callable[..., DataFigure]
    made: DataFigure | None = None


TARGET: ContextVar[Target | None] = ContextVar("TARGET", default=None)
"""Target of the figures that this thread makes; see `pipeline.plots.targets`."""


def new_figure(
    height: float, data: xr.Dataset, frame: Frame = WIDE, *, arranged: bool = True, exact: bool = False
) -> DataFigure:
    """Make an empty figure that holds the data to be drawn in it.

    Parameters
    ----------
    height
        [in] of a figure of full width; narrow ones are lower, but not in proportion.
    data
        Data that will be drawn.
    frame
        Width of the figure and ranges of its axes.
    arranged
        Whether `finish` finds the places of axes, labels and legends.
    exact
        Whether the height holds whatever the width.
    """
    share = 1.0 if exact else min(frame.width / WIDE_MM, 1.0)
    size = (frame.width_in, height * (share + 0.3 * (1.0 - share)))
    layout: Any = "constrained" if arranged else None
    target = TARGET.get()
    if target is None:
        figure = DataFigure(figsize=size, dpi=DPI, facecolor="white", layout=layout)
    else:
        figure = target.made = target.make(figsize=size, layout=layout)
    figure.data, figure.frame, figure.look, figure.notes = data, frame, _LOOKS[frame.compact], []
    engine: Any = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.04, h_pad=0.04, hspace=0.02, wspace=0.02)
    return figure


def look_at(frame: Frame) -> Look:
    """Return the font sizes for a figure of a given width."""
    return _LOOKS[frame.compact]


def figure_of(ax: Axes) -> DataFigure:
    """Return the figure that contains the axes."""
    target = TARGET.get()
    figure = ax.figure if target is None or target.made is None else target.made
    assert isinstance(figure, DataFigure)
    return figure


def look_of(ax: Axes) -> Look:
    """Return the font sizes of the figure that contains the axes."""
    return figure_of(ax).look


def finish(figure: DataFigure) -> None:
    """Set the common font on all texts of a figure, compute its layout, and fix it."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_fontfamily(FONT)
        text.set_math_fontfamily(MATH_FONT)
    figure.arrange()


def style_axes(ax: Axes, *, inside: bool = True, minor: bool = True) -> None:
    """Give axes the common style of lines, ticks and fonts.

    Parameters
    ----------
    ax
        The axes.
    inside
        Ticks inside, on all four sides; else outside, where they do not lie on an image.
    minor
        Whether to have ticks between the ticks.
    """
    look = look_of(ax)
    ax.tick_params(
        which="both",
        direction="in" if inside else "out",
        top=inside,
        right=inside,
        width=LINE_PT,
        labelsize=look.tick,
        labelfontfamily=FONT,
    )
    ax.tick_params(which="major", length=4.0 if look.tick > 8.0 else 3.0)
    ax.tick_params(which="minor", length=2.2 if look.tick > 8.0 else 1.7)
    for spine in ax.spines.values():
        spine.set_linewidth(LINE_PT)
    if minor:
        ax.xaxis.set_minor_locator(AutoMinorLocator())
        ax.yaxis.set_minor_locator(AutoMinorLocator(2))


def few_ticks(ax: Axes, x: int = 4, y: int = 4) -> None:
    """Limit the number of ticks on the two axes of a small panel."""
    ax.xaxis.set_major_locator(MaxNLocator(x))
    ax.yaxis.set_major_locator(MaxNLocator(y))


def style_bar(figure: DataFigure, bar: Colorbar, text: str) -> None:
    """Style a colour bar, and set its label."""
    bar.outline.set_linewidth(LINE_PT)
    bar.ax.tick_params(labelsize=figure.look.tick, width=LINE_PT, labelfontfamily=FONT)
    bar.set_label(text, fontsize=figure.look.label)


def label_axes(ax: Axes, x: str | None = None, y: str | None = None) -> None:
    """Write the labels of the axes."""
    size = look_of(ax).label
    if x is not None:
        ax.set_xlabel(x, fontsize=size, labelpad=2.0)
    if y is not None:
        ax.set_ylabel(y, fontsize=size, labelpad=3.5)


def caption(ax: Axes, text: str, share: float = 1.0) -> None:
    """Write a caption above axes, in lines that use at most a share of the figure's width."""
    if text:
        look = look_of(ax)
        width = share * figure_of(ax).frame.width_in - 0.6
        ax.set_title(folded(text, width, look.legend), fontsize=look.legend, loc="left", pad=4.0)


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


def legend_below(figure: DataFigure, handles: Sequence[Any]) -> None:
    """Place a legend at the bottom left of a figure."""
    _legend(figure, handles, "outside lower left", figure.look.legend, handletextpad=0.4, handlelength=1.2)


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
    ax.legend(handles=list(handles), loc=place, framealpha=0.9, fontsize=look_of(ax).tick)
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
    """Raise ValueError unless a value is among the allowed ones.

    Raises
    ------
    ValueError
        Naming the value, the allowed values and the nearest of them.
    """
    if value in allowed:
        return
    near = difflib.get_close_matches(str(value), allowed, n=1)
    hint = f"Did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"unknown {what} {value!r}. {hint}Allowed: {', '.join(allowed)}.")


def limits(ax: Axes, frame: Frame, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> None:
    """Set the ranges of the axes to those of the `Frame` or, if it has none, to the given ones.

    Raises
    ------
    ValueError
        If a range is empty.
    """
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
    """Return the edges of the columns that are centred on given parameter values; there is one more edge than
    values.
    """
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
