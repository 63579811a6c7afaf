"""Draw 95 % bands about computed orbits, and 95 % intervals of bifurcations, into a diagram."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from pipeline.analysis.draws import LEAST_SHARE, interval_of, stretches
from pipeline.plots import style
from pipeline.plots.labels import Measure

SHADE: dict[str, Any] = {"color": style.BLUE, "alpha": 0.3, "linewidth": 0.0, "zorder": 2.0}
BAR: dict[str, Any] = {"color": style.BLUE, "linewidth": 2.2, "solid_capstyle": "butt", "zorder": 7.5}


def draw_bands(ax: Axes, bands: xr.Dataset, measure: Measure, max_period: int | None = None) -> list[Any]:
    """Shade the bands about the section points of orbits, and draw the intervals of bifurcations as horizontal bars.

    A bar goes through the first section point of its bifurcation. Bifurcations at which no stable orbit begins or ends
    have none, and neither have those that fewer than half of the draws have.

    Parameters
    ----------
    ax
        Axes with final limits.
    bands
        From the analysis ``bands``.
    measure
        Vertical axis: a state.
    max_period
        Longest period of the drawn orbits; by default all.

    Returns
    -------
    list
        Handles for the legend.
    """
    edges: list[float] = []
    levels = bands["section_level"].sel(state=measure.name).values
    low, high = levels[0], levels[-1]
    for _, _, chosen in stretches(bands):
        period = int(np.isfinite(low[chosen]).any(axis=0).sum())
        if max_period is not None and period > max_period:
            continue
        x = bands["parameter_value"].values[chosen]
        for phase in range(period):
            below, above = (measure.shown(edge[chosen, phase]) for edge in (low, high))
            ax.fill_between(x, below, above, **SHADE, gid="band")
            edges += [np.nanmin(low[chosen, phase]), np.nanmax(high[chosen, phase])]
    if edges and style.figure_of(ax).frame.ylim is None and not measure.on_circle:
        _make_room(ax, measure.shown(np.array(edges)))
    bars = _draw_bars(ax, bands, measure, max_period)
    handles: list[Any] = [Patch(label="95 % of the orbits", **{**SHADE, "zorder": None})] if edges else []
    if bars:
        handles.append(Line2D([], [], label="95 % of bifurcations", color=BAR["color"], linewidth=BAR["linewidth"]))
    return handles


def _make_room(ax: Axes, heights: np.ndarray) -> None:
    """Widen the vertical axis so that it shows all heights."""
    bottom, top = ax.get_ylim()
    room = 0.03 * (top - bottom)
    ax.set_ylim(min(bottom, float(heights.min()) - room), max(top, float(heights.max()) + room))


def _draw_bars(ax: Axes, bands: xr.Dataset, measure: Measure, max_period: int | None) -> int:
    """Draw the bars of the bifurcations; return their number."""
    n = 0
    for k in range(bands.sizes["bifurcation"]):
        one = bands.isel(bifurcation=k)
        low, _, high, n_known = interval_of(one["bifurcation_value"].values)
        too_long = max_period is not None and int(one["orbit_period"]) > max_period
        if too_long or not bool(one["is_border"]) or n_known < LEAST_SHARE * bands.sizes["draw"]:
            continue
        y = measure.shown(one["bifurcation_section"].sel(state=measure.name).values)[0]
        ax.plot([low, high], [y, y], scalex=False, scaley=False, gid="interval", **BAR)
        n += 1
    return n


def with_bands(data: xr.Dataset, bands: xr.Dataset) -> xr.Dataset:
    """Add the drawn bands to the data of a figure, under names that end in ``_bands``."""
    plain = bands.drop_vars([k for k, v in bands.variables.items() if v.dtype == object or k == "state"])
    plain = plain.assign({k: v.astype(np.int8) for k, v in plain.data_vars.items() if v.dtype == bool})
    renamed = plain.rename({str(n): f"{n}_bands" for n in (*plain.variables, *plain.dims) if n != "state"})
    return data.merge(renamed).assign_attrs(data.attrs)
