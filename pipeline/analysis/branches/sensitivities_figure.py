"""Draw how far 1 % more of each parameter moves the bifurcations of a run, as bars by size (a tornado chart)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from pipeline.analysis.branches.declaration import SensitivityFigureOptions, SensitivityOptions
from pipeline.analysis.branches.kinds import LABELS, NAMES
from pipeline.analysis.branches.levels import bifurcations_at, levels_of_bifurcations
from pipeline.layout.vocabulary import parameter_name
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import words_of
from pipeline.results.tolerances import NO_INFLUENCE

LOOKS: dict[bool, dict[str, Any]] = {
    True: {"facecolor": style.ORANGE, "hatch": ""},
    False: {"facecolor": style.BLUE, "hatch": "////"},
}
"""Bars of parameters by which the value of a bifurcation grows, and shrinks."""

MOST_BARS = 10
"""Most bars of a panel, which are those of the largest moves."""


@style.drawn
def plot_sensitivities(ds: xr.Dataset, *, shown: int = 6, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw how far 1 % more of each parameter moves each bifurcation, in percent of its value.

    Parameters
    ----------
    ds
        From the analysis ``sensitivities``.
    shown
        Number of bifurcations that get a panel, by rising value.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Its `data` are the sensitivities. A panel has at most `MOST_BARS` bars.
    """
    name, unit = str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"])
    there = np.flatnonzero((np.abs(ds["elasticity"].values) > NO_INFLUENCE).any(axis=1))
    chosen = there[np.argsort(ds["value"].values[there], kind="stable")][:shown]
    levels = levels_of_bifurcations(ds)
    n_columns = min(1 if frame.compact else 2, max(len(chosen), 1))
    n_rows = -(-max(len(chosen), 1) // n_columns)
    counts = (np.abs(ds["elasticity"].values[chosen]) > NO_INFLUENCE).sum(axis=1)
    most = min(max([1, *counts]), MOST_BARS)
    height = 1.1 + n_rows * (0.8 + 0.2 * float(most))
    fig = style.new_figure(height, ds.assign_attrs(title="sensitivities of bifurcations"), frame)
    axes = fig.subplots(n_rows, n_columns, squeeze=False)
    for ax in axes.flat[len(chosen) :]:
        ax.set_visible(False)
    for ax, k in zip(axes.flat, chosen, strict=False):
        _draw_bars(ax, ds.isel(bifurcation=int(k)))
        style.limits(ax, frame)
        if frame.xlim is None:
            ax.margins(x=0.28)  # room for the numbers beside the bars
        kind = words_of(ds["kind"])[int(ds["kind"][k])]
        period = int(ds["orbit_period"][k])
        what = f"period {period}" if period else "equilibrium"
        value = f"{float(ds['value'][k]):.5g}{'' if unit in ('', '1') else f' {labels.raised(unit)}'}"
        text = f"{LABELS[kind]} {NAMES[kind]} at {value}, {what}"
        ax.set_title(style.join([text, *_level(ds, levels[k])]), loc="left", fontsize=fig.look.tick)
    if not len(chosen):
        axes.flat[0].set_visible(True)
        axes.flat[0].text(0.5, 0.5, "no bifurcation with elasticities", ha="center", va="center")
    symbol = labels.swept_label(name, "")
    fig.supxlabel(
        f"change of {symbol.removesuffix(' [Hz]')} at the bifurcation for 1 % more [%]", fontsize=fig.look.label
    )
    handles = [
        Patch(edgecolor="black", linewidth=0.6, label=t, **LOOKS[up]) for up, t in ((True, "grows"), (False, "shrinks"))
    ]
    style.legend_above(fig, handles, size=fig.look.tick)
    parts = [labels.caption(ds, with_start=False), *_left_out(ds, len(there), len(chosen))]
    parts += [f"the {MOST_BARS} largest moves of each"] if max(counts, default=0) > MOST_BARS else []
    if text := style.join(parts):
        size = fig.look.title
        fig.suptitle(style.folded(text, frame.width_in - 0.3, size), fontsize=size, x=0.01, ha="left")
    style.finish(fig)
    return fig


def _level(ds: xr.Dataset, level: Mapping[str, float]) -> list[str]:
    """Return the values of the parameters that tell one bifurcation from the others, with their units."""
    units = dict(zip(map(parameter_name, map(str, ds["parameter"].values)), map(str, ds["unit"].values), strict=True))
    shown = {name: "" if units[name] in ("", "1") else f" {labels.raised(units[name])}" for name in level}
    return [f"{name.removesuffix('_hz')} = {value:.5g}{shown[name]}" for name, value in level.items()]


def _left_out(ds: xr.Dataset, n_moving: int, n_shown: int) -> list[str]:
    """Return how many bifurcations have no panel, and why."""
    n_still = ds.sizes["bifurcation"] - n_moving
    found = [f"{n_shown} of {n_moving} bifurcations, the first by value (--shown)"] if n_shown < n_moving else []
    return found + ([f"{n_still} without elasticities left out"] if n_still else [])


def _draw_bars(ax: Axes, one: xr.Dataset) -> None:
    values = one["elasticity"].values
    there = np.flatnonzero(np.abs(values) > NO_INFLUENCE)
    order = there[np.argsort(np.abs(values[there]), kind="stable")][-MOST_BARS:]
    style.style_axes(ax, minor=False)
    for y, i in enumerate(order):
        rises = bool(values[i] > 0.0)
        ax.barh(y, values[i], height=0.62, edgecolor="black", linewidth=0.6, **LOOKS[rises])
        ax.annotate(
            f"{values[i]:+.2g}".replace("-", "\u2212"),
            (values[i], y),
            (3.0 if rises else -3.0, 0.0),
            textcoords="offset points",
            ha="left" if rises else "right",
            va="center",
            fontsize=style.figure_of(ax).look.tick,
        )
    ax.axvline(0.0, color="black", linewidth=0.6)
    names = [parameter_name(str(one["parameter"].values[i])) for i in order]
    ax.set_yticks(range(len(order)), names)
    ax.tick_params(axis="y", length=0)


def draw_sensitivities(run: OpenRun, options: SensitivityFigureOptions) -> style.DataFigure:
    """Draw the figure ``sensitivities`` of a run."""
    at, notes = values_of(run, options)
    found = bifurcations_at(run.derive("sensitivities", **options.part(SensitivityOptions)), at)
    return noted(plot_sensitivities(found, shown=options.shown, frame=frame_of(options)), notes)
