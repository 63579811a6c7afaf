"""Apply a look through matplotlib's rcParams: magpend's style to a new figure, then the style that a user gives.

Figures that are drawn into axes of the user keep the rcParams of the user. All that reads or changes the rcParams
holds `LOCK`, since all threads share them.
"""

from __future__ import annotations

import contextlib
import difflib
import threading
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import rc_context
from matplotlib import style as matplotlib_style
from matplotlib.colors import to_hex
from matplotlib.font_manager import FontProperties
from matplotlib.rcsetup import cycler

from pipeline.specification.problems import SpecError

rcParams: Any = matplotlib.rcParams  # noqa: N816 -- matplotlib's name
rcParamsDefault: Any = matplotlib.rcParamsDefault  # noqa: N816

LOCK = threading.RLock()
"""Held while rcParams differ from the user's, and while texts are measured or drawn: matplotlib parses mathematics
with one parser for all threads.
"""

MM = 1.0 / 25.4
"""Inches per millimetre."""

WIDE_MM, COMPACT_MM = 178.0, 130.0
"""Default width of figures; narrower ones than the second have smaller letters, and legends below."""

DPI = 200

# the first six: Okabe & Ito, https://jfly.uni-koeln.de/color/
PALETTE = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7",
    "#5B3A1E", "#F0E442", "#332288", "#882255", "#BBDDFF", "#B08D57",
)  # fmt: skip
"""Colours of magpend's style, in the order of attractors; see `pipeline.plots.palette`."""

BLUE, VERMILLION, GREEN, ORANGE, SKY, PURPLE = (f"C{k}" for k in range(6))
"""Colours of a figure's style, named as they are in magpend's."""

_DATA: dict[str, Any] = {"axes.prop_cycle": cycler(color=PALETTE), "image.cmap": "cividis"}
"""Colours of data; in axes of the user they hold unless the user has changed matplotlib's."""

VECTORS: Any = {"svg.hashsalt": "magpend", "svg.fonttype": "none", "pdf.fonttype": 42}
"""Texts of PDF and SVG stay texts, and equal figures have equal bytes."""

_OWN: dict[str, Any] = {
    **_DATA,
    **VECTORS,
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 9.0,
    "axes.labelsize": 10.0,
    "axes.titlesize": 9.0,
    "axes.titlepad": 4.0,
    "axes.labelpad": 3.0,
    "axes.linewidth": 0.7,
    "lines.linewidth": 1.0,
    "legend.fontsize": 9.0,
    "legend.framealpha": 0.9,
    "figure.dpi": DPI,
    "figure.figsize": (WIDE_MM * MM, 4.3),
    "xtick.top": True,
    "ytick.right": True,
    **{
        f"{axis}tick.{key}": value
        for axis in "xy"
        for key, value in {
            "direction": "in",
            "labelsize": 9.0,
            "major.width": 0.7,
            "minor.width": 0.7,
            "major.size": 4.0,
            "minor.size": 2.2,
        }.items()
    },
}

_NARROW: dict[str, Any] = {
    "font.size": 7.0,
    "axes.labelsize": 8.0,
    "axes.titlesize": 7.0,
    "legend.fontsize": 7.0,
    **{
        f"{axis}tick.{key}": value
        for axis in "xy"
        for key, value in {"labelsize": 7.0, "major.size": 3.0, "minor.size": 1.7}.items()
    },
}

Style = str | Path | list[str | Path | dict[str, Any]] | dict[str, Any]
"""What `matplotlib.style.context` takes; an empty text for none."""


@dataclass(frozen=True)
class Frame:
    """Width of a figure, the ranges of its axes, and its style.

    Attributes
    ----------
    width : float
        [mm]; 85 is a journal's column. The default stands for the width of the style.
    xlim, ylim : tuple of float, optional
        Range of the axes, in the units on them; by default what is there.
    style : str, Path, list or dict
        Style of matplotlib that changes magpend's: what `matplotlib.style.context` takes.
    dpi : float, optional
        Resolution; by default that of the style.
    """

    width: float = WIDE_MM
    xlim: tuple[float, float] | None = None
    ylim: tuple[float, float] | None = None
    style: Style = ""
    dpi: float | None = None

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
class Sizes:
    """Font sizes [pt] of a figure: axis labels, ticks, legend and title."""

    label: float
    tick: float
    legend: float
    title: float


def sizes() -> Sizes:
    """Return the font sizes of the rcParams."""
    keys = ("axes.labelsize", "xtick.labelsize", "legend.fontsize", "axes.titlesize")
    return Sizes(*(FontProperties(size=rcParams[key]).get_size_in_points() for key in keys))


@dataclass(frozen=True)
class Look:
    """A look while it is applied."""

    # its rcParams that differ from matplotlib's defaults; empty in axes of the user
    rc: Mapping[str, Any] = field(default_factory=dict)
    width_mm: float = WIDE_MM  # width of figures for which none is given
    dpi: float = DPI  # resolution of files
    asked_dpi: float | None = None  # resolution for which the user asked
    line: float = 1.0  # width of lines [pt] that have the width 1 in magpend's style
    colours: tuple[str, ...] = PALETTE  # colours of data, each once


_PLAIN = Look()

LOOK: ContextVar[Look] = ContextVar("LOOK", default=_PLAIN)
"""Look of the figure that this thread draws."""

_GIVEN: ContextVar[tuple[Style, float | None]] = ContextVar("_GIVEN", default=("", None))


def use(style: Style) -> None:
    """Change the rcParams by a style, or by each of a list; raise SpecError for what matplotlib does not know."""
    for one in style if isinstance(style, list | tuple) else [style]:
        if one == "":
            continue
        try:
            matplotlib_style.use(one)
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise SpecError(_problem(one, error)) from error


def check_style(style: Style) -> None:
    """Raise SpecError with a sentence unless matplotlib knows a style."""
    if style:
        with LOCK, rc_context():
            use(style)


def _problem(one: Any, error: Exception) -> str:
    if isinstance(one, Mapping):
        wrong = next((key for key in one if key not in rcParams), None)
        near = difflib.get_close_matches(str(wrong), list(rcParams), n=1) if wrong is not None else []
        hint = f"did you mean {near[0]!r}?" if near else "names and values are those of matplotlib.rcParams."
        return f"style: {wrong!r} is no rcParam; {hint}" if wrong is not None else f"style: {error}; {hint}"
    near = difflib.get_close_matches(str(one), matplotlib_style.available, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return (
        f"style = {str(one)!r}: is neither a style of matplotlib nor a readable style file; {hint}"
        f"Available: {', '.join(matplotlib_style.available)}."
    )


@contextlib.contextmanager
def given(style: Style, dpi: float | None) -> Iterator[None]:
    """Use a style and a resolution for all figures drawn in this context that have none of their own."""
    check_style(style)
    token = _GIVEN.set((style, dpi))
    try:
        yield
    finally:
        _GIVEN.reset(token)


@contextlib.contextmanager
def look(style: Style = "", dpi: float | None = None, width_mm: float = WIDE_MM, guest: bool = False) -> Iterator[Look]:
    """Apply the look of a figure, in which it is drawn.

    The style changes magpend's or, if the figure is drawn into axes of the user (`guest`), theirs. The default
    resolution is that of the style; the default width stands for that of the style.
    """
    style, dpi = style or _GIVEN.get()[0], dpi or _GIVEN.get()[1]
    with LOCK, rc_context():
        if guest:
            rcParams.update({key: value for key, value in _DATA.items() if rcParams[key] == rcParamsDefault[key]})
            use(style)
            found = Look({}, width_mm, dpi or DPI, dpi, rcParams["lines.linewidth"], _colours())
        else:
            found = _own(style, dpi, width_mm)
        # widths in the code are those of magpend's style, until `pipeline.plots.style.finish`
        rcParams.update({"axes.prop_cycle": cycler(color=found.colours), "lines.linewidth": 1.0})
        token = LOOK.set(found)
        try:
            yield found
        finally:
            LOOK.reset(token)


def _own(style: Style, dpi: float | None, width_mm: float) -> Look:
    """Change the rcParams to those of a new figure."""
    matplotlib_style.use("default")
    before = dict(rcParams.copy())
    rcParams.update(_OWN)
    use(style)
    width = rcParams["figure.figsize"][0] / MM if width_mm == WIDE_MM else width_mm
    if width < COMPACT_MM:
        rcParams.update(_NARROW)
        use(style)
    if dpi:
        rcParams.update({"figure.dpi": dpi, "savefig.dpi": "figure"})
    rc = {key: value for key, value in dict(rcParams.copy()).items() if value != before[key]}
    saved = rcParams["savefig.dpi"]
    of_files = rcParams["figure.dpi"] if saved == "figure" else saved
    return Look(rc, width, float(of_files), dpi, rcParams["lines.linewidth"], _colours())


def _colours() -> tuple[str, ...]:
    found = rcParams["axes.prop_cycle"].by_key().get("color", PALETTE)
    return tuple(dict.fromkeys(to_hex(colour).upper() for colour in found))


@contextlib.contextmanager
def restored(rc: Mapping[str, Any]) -> Iterator[None]:
    """Apply the rcParams of a figure again, to draw or save it."""
    with LOCK, rc_context():
        if rc:
            matplotlib_style.use("default")
            rcParams.update(rc)
        yield


def as_hex(colour: Any) -> str:
    """Return a colour as ``#rrggbb``; one of a style's is that of the present look."""
    if isinstance(colour, str) and colour[:1] == "C" and colour[1:].isdigit():
        colours = LOOK.get().colours
        return colours[int(colour[1:]) % len(colours)]
    return str(to_hex(colour))
