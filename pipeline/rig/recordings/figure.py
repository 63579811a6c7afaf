"""Draw the measured quantities of a recording over time with the faults found in it, and measure its spectrum."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pipeline.analysis.spectrum.estimate import spectrum_of
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.rig.edges import edges_of
from pipeline.rig.recordings.channels import findings_of
from pipeline.rig.recordings.mapping import DRIVE
from pipeline.specification.problems import SpecError

MOST_DOTS = 6000
"""Most samples of a line that are drawn singly; of more, the minima and maxima by column."""

LINES = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE)
MARKS = {
    "gap": "0.7",
    "dead-band": style.ORANGE,
    "saturated": style.VERMILLION,
    "missing": style.PURPLE,
    "wrap": "0.25",
    "start": style.GREEN,
    "leap": style.BLUE,
}
"""Colour by kind of finding; other kinds concern a whole recording and stand in the caption."""

INSTANTS = ("wrap", "start", "leap")
"""Kinds of findings at one time; they are drawn as lines, not as shaded stretches."""

SHADE = 0.4


@style.drawn
def plot_recording(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the measured quantities of a recording over time, and mark the faults found in it.

    Parameters
    ----------
    ds
        Recording from `read_recording` or `smooth`.
    frame
        Width of the figure, and the range of time [s].

    Returns
    -------
    DataFigure
        A panel for each unit and one for the drive. Findings are coloured stretches in their channels'
        panels; ends of pieces are thin lines. Its `data` are `ds`.
    """
    rows = _rows(ds)
    fig = style.new_figure(1.0 + 1.45 * len(rows), ds, frame)
    grid = fig.subplots(len(rows), 1, sharex=True, squeeze=False)
    axes: list[Axes] = list(grid[:, 0])
    time = ds["time"].values
    span = frame.xlim or (float(time[0]), float(time[-1]))
    for ax, names in zip(axes, rows, strict=True):
        style.style_axes(ax)
        for colour, name in zip(LINES, names, strict=False):
            _draw(ax, ds, name, span, colour)
        style.label_axes(ax, None, _label(ds, names))
        ax.set_xlim(*style.check_range("xlim", span))
    kinds = _mark(axes, rows, ds, span)
    style.label_axes(axes[-1], labels.with_unit("time", "s"), None)
    fig.align_ylabels(axes)
    handles = [*_line_handles(ds, rows), *map(_mark_handle, kinds)]
    style.complete(fig, axes[0], _caption(ds), handles)
    return fig


def _rows(ds: xr.Dataset) -> list[tuple[str, ...]]:
    units: dict[str, tuple[str, ...]] = {}
    for name in map(str, ds.data_vars):
        if name != DRIVE:
            unit = str(ds[name].attrs.get("units", ""))
            units[unit] = (*units.get(unit, ()), name)
    return [*units.values(), *([(DRIVE,)] if DRIVE in ds else [])]


def _symbol(ds: xr.Dataset, name: str) -> str:
    model = model_of(ds)
    symbols = {s.name: s.symbol for s in model.states} | {q.name: q.symbol for q in model.quantities}
    symbol = symbols.get(name, "")
    return f"${symbol}$" if symbol else name


def _label(ds: xr.Dataset, names: Sequence[str]) -> str:
    text = ", ".join(_symbol(ds, name) for name in names)
    return labels.with_unit(text, str(ds[names[0]].attrs.get("units", "")))


def _draw(ax: Axes, ds: xr.Dataset, name: str, span: tuple[float, float], colour: str) -> None:
    time, values, piece = ds["time"].values, ds[name].values, ds["piece"].values
    inside = (time >= span[0]) & (time <= span[1])
    time, values, piece = time[inside], values[inside].astype(np.float64), piece[inside]
    cuts = np.flatnonzero(np.diff(piece)) + 1
    if len(time) > MOST_DOTS:
        time, values = _envelope(time, values)
    elif cuts.size:
        time = np.insert(time, cuts, time[cuts])
        values = np.insert(values, cuts, np.nan)
    ax.plot(time, values, color=colour, linewidth=0.8, gid=f"recording-{name}")


def _envelope(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return minimum and maximum of each block of samples, in the order of time; NaN without finite samples."""
    n = len(time) // (MOST_DOTS // 2) + 1
    whole = len(time) // n * n
    blocks = values[:whole].reshape(-1, n)
    known = np.isfinite(blocks).any(axis=1)
    low = np.where(np.isfinite(blocks), blocks, np.inf).argmin(axis=1)
    high = np.where(np.isfinite(blocks), blocks, -np.inf).argmax(axis=1)
    rows = np.arange(len(blocks))
    pair = np.sort(np.column_stack([low, high]), axis=1) + n * rows[:, None]
    picked = values[pair]
    picked[~known] = np.nan
    return (np.append(time[pair].ravel(), time[whole:]), np.append(picked.ravel(), values[whole:]))


def _mark(axes: Sequence[Axes], rows: Sequence[Sequence[str]], ds: xr.Dataset, span: tuple[float, float]) -> list[str]:
    """Shade the times of the faults and draw the ends of pieces; return the kinds of faults that are marked."""
    share = 0.003  # least width of a mark, relative to the width of the axes
    least = share * (span[1] - span[0])
    kinds: dict[str, None] = {}
    for f in findings_of(ds):
        if f.kind not in MARKS or np.isnan(f.start_s) or f.end_s < span[0] or f.start_s > span[1]:
            continue
        kinds[f.kind] = None
        colour, middle = MARKS[f.kind], 0.5 * (f.start_s + f.end_s)
        half = 0.5 * max(f.end_s - f.start_s, least)
        for ax in (a for a, names in zip(axes, rows, strict=True) if f.channel in ("", *names)):
            if f.kind in INSTANTS:
                ax.axvline(middle, color=colour, linewidth=0.9, linestyle=(0, (2, 2)), zorder=1)
            else:
                ax.axvspan(middle - half, middle + half, color=colour, alpha=SHADE, linewidth=0.0, zorder=0)
    time, piece = ds["time"].values, ds["piece"].values
    for i in np.flatnonzero(np.diff(piece)):
        for ax in axes:
            ax.axvline(0.5 * (time[i] + time[i + 1]), color="0.8", linewidth=0.5, zorder=0.5)
    return list(kinds)


def _mark_handle(kind: str) -> Any:
    if kind in INSTANTS:
        return Line2D([], [], color=MARKS[kind], linewidth=1.2, linestyle=(0, (2, 2)), label=kind)
    return Patch(color=MARKS[kind], alpha=SHADE, linewidth=0.0, label=kind)


def _line_handles(ds: xr.Dataset, rows: Sequence[Sequence[str]]) -> list[Any]:
    return [
        Line2D([], [], color=colour, linewidth=1.2, label=_symbol(ds, name))
        for names in rows
        if len(names) > 1
        for colour, name in zip(LINES, names, strict=False)
    ]


def _caption(ds: xr.Dataset) -> str:
    n_pieces = len(np.unique(ds["piece"].values))
    parts = [
        Path(str(ds.attrs.get("file", ""))).name,
        f"{float(ds.attrs['sampling_rate_hz']):.6g} Hz",
        f"{n_pieces} pieces" if n_pieces > 1 else "",
        "simulated" if ds.attrs.get("simulated") else "",
    ]
    others = sorted({f.kind for f in findings_of(ds) if f.kind not in MARKS or np.isnan(f.start_s)})
    return style.join([*parts, f"also found: {', '.join(others)}" if others else ""])


def spectrum_of_recording(ds: xr.Dataset, channel: str = "", **settings: Any) -> xr.Dataset:
    """Return the spectrum of a recording, with orders if the edges of its drive have a frequency.

    Parameters
    ----------
    ds
        Recording from `read_recording` or `smooth`.
    channel, settings
        See `magpend.spectrum_of`.
    """
    drive_hz = None
    if DRIVE in ds:
        with contextlib.suppress(SpecError):  # not periodic, or not switched: then there are no orders
            drive_hz = edges_of(ds).frequency().frequency_hz
    found = spectrum_of(ds, channel, drive_hz=drive_hz, **settings)
    return found.assign_attrs(file=str(ds.attrs.get("file", "")))
