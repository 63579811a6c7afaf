"""Draw the sections of a run over a parameter that moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps, rcParams
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_hex

from pipeline.analysis.tipping.declaration import DriftFigureOptions
from pipeline.analysis.tipping.delay import moving_parameter
from pipeline.layout.cells import at_section
from pipeline.layout.vocabulary import model_of, split_dims
from pipeline.plots import labels, style
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.results.run import OpenRun

BELOW = "0.72"
MOST_VECTOR_DOTS = 200_000
"""Most dots of a vector file that are not pixels."""


@style.drawn
def plot_drift(
    ds: xr.Dataset,
    parameter: str,
    *,
    below: xr.Dataset | None = None,
    state: str = "",
    at: Mapping[str, float] | None = None,
    degrees: bool = False,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the section points of all cells over the value that a moving parameter has there.

    `below` is a cube that sweeps the parameter at constant values; its sections are drawn grey below. `at` leaves at
    most one swept axis, which gives the colours. The figure's `data` hold ``value``, the state, and the parameter's
    values over cells and sections. Raise ValueError if several axes are left, or `below` does not sweep the parameter.
    """
    part = at_points(ds, at)
    dims, _ = split_dims(part["status"])
    swept = [d for d in dims if part.sizes[d] > 1]
    if len(swept) > 1:
        axes = " and ".join(swept)
        raise ValueError(
            f"the colours show one swept number, and {axes} are left; choose a value, such as --at {swept[0]}=..."
        )
    measure = labels.state_measure(part, state or model_of(part).section_states[0], degrees)
    x, y = _points(part, parameter, measure)
    data = xr.Dataset({"value": y, at_section(parameter): x}).load()
    fig = style.new_figure(4.6, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    handles = []
    if below is not None:
        _draw_below(ax, below, parameter, measure, at)
        handles.append(style.dot("constant parameter", BELOW))
    colours = _colours(part, swept)
    _draw_cells(ax, data, parameter, swept, colours)
    style.label_axes(ax, _label(part, parameter), measure.label)
    style.limits(ax, frame)
    labels.angle_ticks(ax, measure)
    if swept:
        axis = part[swept[0]]
        norm = Normalize(float(axis.min()), float(axis.max()))
        bar = fig.colorbar(ScalarMappable(norm, _ramp()), ax=ax, pad=0.015, aspect=32)
        style.style_bar(bar, labels.parameter_label(axis))
    style.complete(fig, ax, labels.caption(part, drop=[at_section(parameter)]), handles)
    return fig


def _points(part: xr.Dataset, parameter: str, measure: labels.Measure) -> tuple[xr.DataArray, xr.DataArray]:
    """Return the parameter's values and those of the state, over cells and sections; without dims of size 1."""
    section = part["section"].sel(state=measure.name, drop=True)
    y = section.copy(data=measure.shown(section.values))
    y.attrs = {"units": measure.unit, "long_name": measure.name}
    x = part[at_section(parameter)].broadcast_like(section).transpose(*section.dims)
    x = x.reset_coords(drop=True).drop_vars(at_section(parameter), errors="ignore")
    return x, y.drop_vars(at_section(parameter))


def _ramp() -> ListedColormap:
    """Return the colours from the least to the largest value, without the lightest, which would be faint on white."""
    darkest, lightest = 0.0, 0.85
    return ListedColormap(colormaps[rcParams["image.cmap"]](np.linspace(darkest, lightest, 256)))


def _colours(part: xr.Dataset, swept: list[str]) -> list[str]:
    """Return the colour of each value of the swept parameter."""
    if not swept:
        return [style.BLUE]
    values = part[swept[0]].values.astype(float)
    return [to_hex(colour) for colour in _ramp()((values - values.min()) / np.ptp(values))]


def _draw_cells(ax: Axes, data: xr.Dataset, parameter: str, swept: list[str], colours: list[str]) -> None:
    """Draw the sections of all cells, a colour for each value of the swept number."""
    order = [*swept, ...]
    x, y = (data[name].transpose(*order).values.reshape(len(colours), -1) for name in (at_section(parameter), "value"))
    for k, colour in enumerate(colours):
        ax.plot(x[k], y[k], ".", markersize=2.2, color=colour, zorder=3, rasterized=x.size > MOST_VECTOR_DOTS)


def _draw_below(
    ax: Axes, below: xr.Dataset, parameter: str, measure: labels.Measure, at: Mapping[str, float] | None
) -> None:
    """Draw the sections of a run with constant parameters, grey."""
    if parameter not in below["status"].dims:
        raise ValueError(f"the run below does not sweep {parameter}; give one with [axes] {parameter} = {{...}}")
    section = below["section"].sel(state=measure.name).transpose(parameter, ...).values
    section = section.reshape(below.sizes[parameter], -1)
    x = np.repeat(below[parameter].values[:, None], section.shape[1], axis=1)
    ax.plot(x, measure.shown(section), ".", color=BELOW, markersize=1.6, zorder=1, rasterized=x.size > MOST_VECTOR_DOTS)


def _label(part: xr.Dataset, parameter: str) -> str:
    one = model_of(part).parameter(parameter)
    name = f"${one.symbol}$" if one.symbol else one.meaning or one.name
    return labels.with_unit(f"{name} at the section", one.unit)


def draw(run: OpenRun, options: DriftFigureOptions) -> style.DataFigure:
    """Draw the figure ``drift`` of a run."""
    cube = run.cube()
    at, notes = values_of(run, options)
    below = run.of(options.over).cube() if options.over else None
    moving = moving_parameter(getattr(model_of(cube), "ramps", ()), options.moving)
    look: dict[str, Any] = {"state": options.state, "degrees": options.degrees, "frame": frame_of(options)}
    return noted(plot_drift(cube, moving, below=below, at=at, **look), notes)
