"""Draw the genealogy of attractors: the range of each one over a parameter as a bar, with its events."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from pipeline.analysis.events.declaration import EventOptions, GenealogyOptions
from pipeline.analysis.events.kinds import EVENTS, RANGE_END, UNDECIDED
from pipeline.layout.vocabulary import letter
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import plain, words_of

_ROW_IN = 0.34
"""Height of the row of an attractor [in]."""

_LETTER = 0.012
"""Width of a letter, as a share of the panel's: names of shorter bars are left out."""

_HALO = [withStroke(linewidth=1.8, foreground="white")]
"""White outline of texts over bars and arrows."""

_OPEN: dict[str, Any] = {"color": "0.45", "linewidth": 1.2, "linestyle": (0, (1, 1.2))}
_JOIN: dict[str, Any] = {"arrowstyle": "->", "linewidth": 0.6, "color": "0.35", "shrinkA": 5.0, "shrinkB": 4.0}
_MARK: dict[str, Any] = {"markersize": 5.0, "markerfacecolor": "white", "markeredgecolor": "black", "zorder": 8.0}


@style.drawn
def plot_genealogy(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the range of each attractor as a bar, one row for each, and mark the events at its ends.

    Marks name the bifurcations (LP, PD, ...). An arrow leads to the attractor on which most cells go on. A dotted
    line is the interval in which an end is not decided. A bar bears its period; where it is too short, the period
    stands in brackets beside the letter.

    Parameters
    ----------
    ds
        From the analysis ``events``.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Its `data` are the events without their texts.

    Raises
    ------
    ValueError
        If there is no attractor.
    """
    if not ds.sizes["stretch"]:
        raise ValueError("there is no attractor to draw: no cell of the run ends on one")
    texts = [name for name, variable in ds.variables.items() if variable.dtype.kind in "OUT"]
    ids = sorted(set(ds["stretch_attractor"].values.tolist()))
    rows = {number: len(ids) - 1 - k for k, number in enumerate(ids)}
    stored = ds.drop_vars(texts).assign_attrs(title="genealogy of attractors")
    fig = style.new_figure(max(1.3 + _ROW_IN * len(ids), 2.4), stored, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, minor=False)
    named = _draw_bars(ax, ds, rows)
    _draw_events(ax, ds, rows)
    ax.set_yticks(list(rows.values()), [letter(i) if i in named else _with_periods(ds, i) for i in rows])
    ax.tick_params(axis="y", length=0.0)
    ax.set_ylim(-0.6, len(ids) - 0.35)
    ax.margins(x=0.02)
    style.limits(ax, frame)
    style.label_axes(ax, labels.swept_label(str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"])), "attractor")
    style.caption(ax, labels.caption(ds, with_start=False))
    style.legend_above(fig, _handles(ds), size=fig.look.tick)
    style.finish(fig)
    return fig


def _with_periods(ds: xr.Dataset, number: int) -> str:
    """Return the letter of an attractor with its periods in brackets, if it has some."""
    periods = set(ds["stretch_period"].values[ds["stretch_attractor"].values == number].tolist()) - {0}
    return f"{letter(number)} ({', '.join(map(str, sorted(periods)))})" if periods else letter(number)


def _draw_bars(ax: Axes, ds: xr.Dataset, rows: dict[int, int]) -> set[int]:
    """Draw the bars. Return the ids of the attractors with a bar that is long enough for its name."""
    kinds, names = words_of(ds["stretch_set"]), []
    for k in range(ds.sizes["stretch"]):
        number, period = int(ds["stretch_attractor"][k]), int(ds["stretch_period"][k])
        low, high = float(ds["stretch_low"][k]), float(ds["stretch_high"][k])
        colour = style.PALETTE[list(rows).index(number) % len(style.PALETTE)]
        ax.plot(
            [low, high], [rows[number]] * 2, color=colour, linewidth=5.0, solid_capstyle="butt", zorder=3.0,
            alpha=1.0 if period else 0.6, gid=f"stretch:{k}",
        )  # fmt: skip
        if low == high:
            ax.plot(low, rows[number], linestyle="none", marker="s", markersize=5.0, color=colour, zorder=3.0)
        text = f"period {period}" if period else plain(kinds[int(ds["stretch_set"][k])])
        middle = 0.5 * (low + high)
        names.append((high - low, middle, text, number))
    named = set()
    width = np.ptp([x for k in ("low", "high") for x in ds[f"stretch_{k}"].values])
    for length, middle, text, number in names:
        if length > _LETTER * len(text) * width:
            named.add(number)
            ax.annotate(
                text, (middle, rows[number]), (0.0, -4.5), textcoords="offset points", ha="center", va="top",
                fontsize=style.look_of(ax).tick, zorder=9.0, path_effects=_HALO,
            )  # fmt: skip
    return named


def _draw_events(ax: Axes, ds: xr.Dataset, rows: dict[int, int]) -> None:
    kinds = words_of(ds["what"])
    taken: dict[int, list[float]] = {row: [] for row in rows.values()}
    width = np.ptp([x for k in ("low", "high") for x in ds[f"stretch_{k}"].values])
    for k in range(ds.sizes["event"]):
        what, row = kinds[int(ds["what"][k])], rows[int(ds["attractor"][k])]
        seen, beyond, x = (float(ds[name][k]) for name in ("seen", "beyond", "value"))
        if what == UNDECIDED:
            ax.plot([seen, beyond], [row, row], zorder=2.0, **_OPEN)
        if not np.isfinite(x) or what == RANGE_END:
            continue
        kind = EVENTS[what]
        label = kind.mark or kind.label
        ax.plot(x, row, linestyle="none", marker=kind.marker, **_MARK)
        if all(abs(x - other) > 3.0 * _LETTER * width for other in taken[row]):
            taken[row].append(x)
        else:
            label = ""
        ax.annotate(
            label, (x, row), (0.0, 5.0), textcoords="offset points", ha="center", va="bottom",
            fontsize=style.look_of(ax).tick, zorder=9.0, path_effects=_HALO,
        )  # fmt: skip
        to = int(ds["to_attractor"][k, 0])
        if int(ds["period_after"][k]) < 0 and to in rows and rows[to] != row:
            ax.annotate("", (x, rows[to]), (x, row), arrowprops=_JOIN, zorder=4.0)


def _handles(ds: xr.Dataset) -> list[Any]:
    kinds = words_of(ds["what"])
    present = {kinds[code] for code in ds["what"].values.tolist()}
    handles = [
        Line2D([], [], linestyle="none", marker=kind.marker, label=f"{kind.label} {kind.text}".lstrip(), **_MARK)
        for kind in EVENTS.values()
        if kind.name in present and kind.marker
    ]
    if UNDECIDED in present:
        handles.append(Line2D([], [], label="not decided", **_OPEN))
    return handles


def draw(run: OpenRun, options: GenealogyOptions) -> style.DataFigure:
    """Draw the figure ``genealogy`` of a run."""
    return plot_genealogy(run.derive("events", **options.part(EventOptions)), frame=frame_of(options))
