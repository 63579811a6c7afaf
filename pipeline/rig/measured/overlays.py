"""Draw a recording and a computed trajectory from the same initial state: time series and phase portraits."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from magpend_core.models.model import Model
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style

RIG, MODEL = "0.15", style.VERMILLION
SUFFIX = "_computed"


@style.drawn
def plot_series(ds: xr.Dataset, *, degrees: bool = False, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw measured and computed time series from `pipeline.rig.measured.series.series_of`, and their phase portraits.

    Parameters
    ----------
    ds
        States and, with the suffix ``_computed``, those of the model, over ``time`` [s].
    degrees
        Whether to use degrees instead of radians.
    frame
        Width of the figure, and the range of time.

    Returns
    -------
    DataFigure
        A panel for each state with the root mean square of the difference, and one for each phase portrait.
        Its `data` are `ds`.

    Raises
    ------
    ValueError
        If degrees are asked for without an angle.
    """
    model = model_of(ds)
    labels.some_angle(model, degrees, "series")
    n, m = len(model.states), len(model.portraits)
    fig = style.new_figure(max(1.25 * n, 2.4 * m) + 0.7, ds, frame)
    outer = fig.add_gridspec(1, 2, width_ratios=[1.55, 1.0])
    left, right = outer[0].subgridspec(n, 1), outer[1].subgridspec(m, 1)
    measures = {s.name: labels.state_measure(ds, s.name, degrees and s.unit.startswith("rad")) for s in model.states}
    axes = [fig.add_subplot(left[i]) for i in range(n)]
    _draw_series(axes, ds, model, measures)
    for k, pair in enumerate(model.portraits):
        ax = fig.add_subplot(right[k])
        style.style_axes(ax)
        _draw_portrait(ax, ds, [measures[name] for name in pair])
    if frame.xlim:
        axes[-1].set_xlim(*style.check_range("xlim", frame.xlim))
    fig.align_ylabels(axes)
    who = "simulated rig" if int(ds.attrs.get("simulated", 0)) else "measured"
    handles = [
        Line2D([], [], color=RIG, linewidth=1.2, label=who),
        Line2D([], [], color=MODEL, linewidth=1.2, label="computed from the same state"),
    ]
    f, begin = float(ds.attrs["frequency_hz"]), float(ds.attrs["start_s"])
    text = f"$f$ = {f:.6g}\u00a0Hz, start at {begin:.3f}\u00a0s"
    style.complete(fig, axes[0], text, handles)
    return fig


def _draw_series(axes: list[Axes], ds: xr.Dataset, model: Model, measures: dict[str, labels.Measure]) -> None:
    time, rms = ds["time"].values, json.loads(str(ds.attrs["rms"]))
    for ax, s in zip(axes, model.states, strict=True):
        if ax is not axes[-1]:
            ax.sharex(axes[-1])
            ax.tick_params(labelbottom=False)
        style.style_axes(ax)
        m = measures[s.name]
        for name, look in _looks(s.name):
            ax.plot(time, m.shown(ds[name].values), gid=f"series:{name}", **look)
        ax.set_xlim(float(time[0]), float(time[-1]))
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.25 * (high - low))  # room for the words
        ax.text(
            0.99,
            0.93,
            f"rms {rms[s.name] * m.factor:.3g} {m.unit}",
            transform=ax.transAxes,
            ha="right",
            va="top",
            fontsize=style.look_of(ax).tick - 1.0,
        )
        style.label_axes(ax, y=m.label)
        labels.angle_ticks(ax, m, most=5.0)
    style.label_axes(axes[-1], x="time [s]")


def _draw_portrait(ax: Axes, ds: xr.Dataset, pair: list[labels.Measure]) -> None:
    x, y = pair
    for (name, look), (other, _) in zip(_looks(x.name), _looks(y.name), strict=True):
        first, second = x.shown(ds[name].values), y.shown(ds[other].values)
        if x.on_circle and np.ptp(ds[name].values) > 2 * np.pi:
            first, second = labels.on_circle(ds[name].values, second)
            first = first * x.factor
        ax.plot(first, second, gid=f"portrait:{name}", **look)
    labels.angle_ticks(ax, x, "x")
    style.label_axes(ax, x.label, y.label)


def _looks(name: str) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Return variable name and line style of a state, first measured, then computed. The computed line is thinner and
    on top.
    """
    return (
        (name, {"color": RIG, "linewidth": 1.3, "zorder": 2.0}),
        (name + SUFFIX, {"color": MODEL, "linewidth": 0.8, "zorder": 3.0}),
    )
