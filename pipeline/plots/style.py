"""Common look of the figures, and how they become files.

The look is set on each object, never through `matplotlib.rcParams`: these are shared by all threads.
"""

from __future__ import annotations

import difflib
import io
import math
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import Formatter, FuncFormatter, MultipleLocator

WIDTH_IN = 7.0
"""Width of a figure [in]: two columns of a journal page."""

DPI = 200
VECTOR_DPI = 400
"""Resolution of the images inside PDF and SVG files, which get magnified."""

FONT, MATH_FONT = "STIXGeneral", "stix"
LABEL_PT, TICK_PT, LEGEND_PT = 10.0, 9.0, 9.0
LINE_PT = 0.7

# Okabe & Ito, https://jfly.uni-koeln.de/color/
BLUE, VERMILLION, GREEN, PURPLE, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"
GREY = "#7F7F7F"

STATE_SYMBOLS = {
    "psi1": r"$\psi_1$",
    "psi2": r"$\psi_2$",
    "psi1_dot": r"$\dot{\psi}_1$",
    "psi2_dot": r"$\dot{\psi}_2$",
}

SUFFIXES = (".png", ".pdf", ".svg")
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {},
    ".pdf": {"CreationDate": None},
    ".svg": {"Date": None},
}
_svg_lock = threading.Lock()


class DataFigure(Figure):
    """Figure that carries what it shows.

    Attributes
    ----------
    data : Dataset
        The numbers drawn, after every selection.
    """

    data: xr.Dataset


def new_figure(height_in: float) -> Figure:
    """Make an empty figure of the common width and resolution."""
    return Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, facecolor="white")


def new_data_figure(height_in: float, data: xr.Dataset) -> DataFigure:
    """Make an empty figure that carries the data to be drawn in it."""
    fig = DataFigure(figsize=(WIDTH_IN, height_in), dpi=DPI, facecolor="white")
    fig.data = data
    return fig


def style_axes(ax: Axes) -> None:
    """Give axes the common lines, ticks and fonts."""
    ax.tick_params(
        which="both",
        direction="in",
        top=True,
        right=True,
        width=LINE_PT,
        labelsize=TICK_PT,
        labelfontfamily=FONT,
    )
    ax.tick_params(which="major", length=4.0)
    ax.tick_params(which="minor", length=2.2)
    for spine in ax.spines.values():
        spine.set_linewidth(LINE_PT)


def style_text(fig: Figure) -> None:
    """Give every text that is in the figure by now the common font."""
    for text in fig.findobj(Text):
        assert isinstance(text, Text)
        text.set_fontfamily(FONT)
        text.set_math_fontfamily(MATH_FONT)


def is_angle(state: str) -> bool:
    """Say whether a state is an angle, and not a rate."""
    return not state.endswith("_dot")


def state_label(state: str, degrees: bool = False) -> str:
    """Axis label of a state: symbol and unit."""
    unit = "deg" if degrees else "rad"
    return f"{STATE_SYMBOLS[state]} [{unit if is_angle(state) else unit + '/s'}]"


def check_choice(what: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a value that is not among the allowed ones.

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


def set_angle_ticks(ax: Axes, low: float, high: float, *, degrees: bool, axis: str = "y") -> None:
    """Put ticks at round angles: multiples of pi for wide ranges in rad, of 15, 30 ... for degrees."""
    span = high - low
    most = 8.5 if axis == "y" else 4.5
    if degrees and span > 0.5:
        _set_step(ax, axis, _step(span, most, (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 45, 90, 180, 360)), None)
    elif not degrees and span > 0.75 * math.pi:
        step = _step(span / math.pi, most, [0.125 * 2**k for k in range(24)])
        _set_step(ax, axis, step * math.pi, FuncFormatter(pi_fraction))


def _step(span: float, most: float, steps: Sequence[float]) -> float:
    """Smallest step that gives at most so many intervals, or the largest one on offer."""
    return next((step for step in steps if span / step <= most), steps[-1])


def _set_step(ax: Axes, axis: str, step: float, formatter: Formatter | None) -> None:
    target = ax.yaxis if axis == "y" else ax.xaxis
    target.set_major_locator(MultipleLocator(step))
    if formatter is not None:
        target.set_major_formatter(formatter)


def pi_fraction(value: float, _position: int | None = None) -> str:
    """Write a multiple of pi/8 as a fraction of pi."""
    eighths = round(8.0 * value / math.pi)
    if eighths == 0:
        return "0"
    divisor = math.gcd(eighths, 8)
    numerator, denominator = abs(eighths) // divisor, 8 // divisor
    sign = "\N{MINUS SIGN}" if eighths < 0 else ""
    factor = "" if numerator == 1 else str(numerator)
    return f"{sign}{factor}π" + ("" if denominator == 1 else f"/{denominator}")


def parameter_label(coordinate: xr.DataArray) -> str:
    """Axis label of a parameter: what it is, and its unit."""
    if coordinate.name == "frequency":
        return "drive frequency [Hz]"
    name = str(coordinate.attrs.get("long_name", coordinate.name))
    unit = coordinate.attrs.get("units", "")
    return f"{name} [{unit}]" if unit else name


def edges(x: np.ndarray) -> np.ndarray:
    """Limits between neighbouring values of the parameter."""
    if x.size == 1:
        width = 0.05 * abs(float(x[0])) or 0.5
        return np.array([x[0] - width, x[0] + width])
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[1.5 * x[0] - 0.5 * x[1]], middle, [1.5 * x[-1] - 0.5 * x[-2]]])


def fill_columns(
    ax: Axes, edges: np.ndarray, low: np.ndarray, high: np.ndarray, looks: Mapping[str, Any], gid: str
) -> PolyCollection:
    """Fill columns from `low` to `high`: one rectangle for each run of equal columns."""
    levels = np.column_stack([low, high])
    starts = np.flatnonzero(np.r_[True, (np.diff(levels, axis=0) != 0).any(1)])
    ends = np.r_[starts[1:], len(levels)]
    kept = high[starts] > low[starts]
    corners = zip(edges[starts[kept]], edges[ends[kept]], *levels[starts[kept]].T, strict=True)
    boxes = [[(x0, y0), (x1, y0), (x1, y1), (x0, y1)] for x0, x1, y0, y1 in corners]
    area = PolyCollection(boxes, gid=gid, **looks)
    ax.add_collection(area, autolim=False)
    return area


def save_figure(fig: Figure, path: str | Path) -> Path:
    """Write a figure as PNG, PDF or SVG, by the suffix of the path.

    The file holds no time stamp and no random identifier: the same figure gives the same bytes with the
    same version of matplotlib. It is written only once it has been drawn completely.

    Parameters
    ----------
    fig
        The figure.
    path
        Where to write; the folder must exist. An existing file is replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ValueError
        If the suffix is none of .png, .pdf, .svg.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(
            f"cannot write a figure as {str(path)!r}: "
            f"the suffix {path.suffix!r} is not one of {', '.join(SUFFIXES)}"
        )
    buffer = io.BytesIO()
    options: dict[str, Any] = {
        "format": suffix[1:],
        "dpi": DPI if suffix == ".png" else VECTOR_DPI,
        "metadata": _METADATA[suffix],
        "facecolor": "white",
    }
    if suffix == ".svg":
        _save_svg(fig, buffer, options)
    else:
        fig.savefig(buffer, **options)
    path.write_bytes(buffer.getvalue())
    return path


def save_data(fig: DataFigure, path: str | Path) -> Path:
    """Write the data of a figure as NetCDF beside it: the same path with the suffix ``.nc``."""
    target = Path(path).with_suffix(".nc")
    fig.data.to_netcdf(target, engine="scipy", format="NETCDF3_64BIT")
    return target


def _save_svg(fig: Figure, buffer: io.BytesIO, options: dict[str, Any]) -> None:
    """Save with identifiers that do not change from run to run.

    matplotlib takes their salt from the shared settings alone; this one key is set while the lock is
    held, and all others are left as they are.
    """
    with _svg_lock:
        before = matplotlib.rcParams["svg.hashsalt"]
        matplotlib.rcParams["svg.hashsalt"] = "magpend"
        try:
            fig.savefig(buffer, **options)
        finally:
            matplotlib.rcParams["svg.hashsalt"] = before
