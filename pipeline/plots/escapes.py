"""Draw rates of escape of noisy cells, and the last stretch of sections before they leave."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.noise.escapes import strength_dim
from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import place
from pipeline.analysis.tabular import words_of
from pipeline.layout.conventions import shown_unit
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.products.figures import EscapeFigureOptions
from pipeline.products.noise import EscapeOptions
from pipeline.specification.problems import unknown_name

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")


@style.drawn
def plot_rates(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw rates of escape with their intervals over the one swept parameter that is left.

    Parameters
    ----------
    ds
        Result of the analysis ``escapes``.
    at
        Values of the axes that are not drawn.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        With a logarithmic axis of rates. Over the strength σ of a noise the other axis is 1/σ², on which
        Kramers' law is a line; an open marker is the upper end of the interval where no cell left.

    Raises
    ------
    ValueError
        If not exactly one swept parameter is left.
    """
    part = _at(ds, at)
    dims = [str(d) for d in part["rate"].dims if d != "set"]
    if len(dims) != 1:
        raise ValueError(
            f"rates are drawn over one axis, and {len(dims)} are left ({', '.join(dims) or 'none'}); choose values "
            "of the others with at, or draw --show=paths"
        )
    along, kramers = dims[0], dims[0] == strength_dim(dims)
    axis = part[along]
    fig = style.new_figure(4.2, part[["rate", "rate_low", "rate_high", "n_cells", "n_left"]], frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    handles = []
    for k, word in enumerate(words_of(part["set"])[int(i)] for i in part["set"].values):
        one, colour = part.isel(set=k), COLOURS[k % len(COLOURS)]
        x = 1.0 / axis.values**2 if kramers else axis.values
        _draw_points(ax, x, one, colour, MARKERS[k % len(MARKERS)])
        name = word.replace("_", " ")
        if kramers and np.isfinite(float(one["barrier"])):
            grid = np.linspace(x[np.isfinite(x)].min(), x[np.isfinite(x)].max(), 200)
            ax.plot(grid, np.exp(float(one["log_factor"]) - float(one["barrier"]) * grid), color=colour, lw=1.0)
            b, low, high = (float(one[n]) for n in ("barrier", "barrier_low", "barrier_high"))
            name += f": exp(\N{MINUS SIGN}{b:.3g}/σ²), {low:.3g} to {high:.3g}"
        handles.append(style.dot(name, colour, marker=MARKERS[k % len(MARKERS)]))
    ax.set_yscale("log")
    unit = shown_unit(axis.attrs)
    below = f"1/σ², σ = {along}" + ("" if unit == "1" else f" [{unit}]")
    style.label_axes(ax, below if kramers else labels.parameter_label(axis), "rate of escape [1/s]")
    style.limits(ax, frame)
    level = f"intervals of {100 * ds.attrs['confidence']:g} %"
    style.complete(fig, ax, style.join([labels.caption(part, drop=dims, with_start=False), level]), handles)
    return fig


def _draw_points(ax: Axes, x: np.ndarray, one: xr.Dataset, colour: str, marker: str) -> None:
    rate, low, high = (one[name].values for name in ("rate", "rate_low", "rate_high"))
    seen = (rate > 0) & np.isfinite(rate) & np.isfinite(x)
    apart = np.stack([rate - low, high - rate])[:, seen]
    ax.errorbar(x[seen], rate[seen], apart, fmt=marker, color=colour, ms=4.5, lw=0.9, capsize=2.0, gid="rate")
    none = (rate == 0) & np.isfinite(high) & np.isfinite(x)
    ax.plot(x[none], high[none], marker, mfc="white", color=colour, ms=4.5, gid="bound")


@style.drawn
def plot_paths(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw mean and spread of the sections before cells leave, a panel for each state.

    Parameters
    ----------
    ds, at, frame
        See `plot_rates`; all axes must have a value.

    Returns
    -------
    DataFigure
        Lines are means, bands one standard deviation on either side; the set in which cells begin has a colour.
    """
    part = _at(ds, at)
    dims = [str(d) for d in part["rate"].dims if d != "set"]
    if dims:
        raise ValueError(f"paths are drawn at one parameter point; choose a value of {dims[0]} with at")
    states = [str(s) for s in part["state"].values]
    data = part[["path_mean", "path_std", "path_n"]]
    fig = style.new_figure(1.4 + 1.5 * len(states), data, frame)
    axes = np.atleast_1d(fig.subplots(len(states), 1, sharex=True))
    handles = []
    for k, word in enumerate(words_of(part["set"])[int(i)] for i in part["set"].values):
        one, colour = part.isel(set=k), COLOURS[k % len(COLOURS)]
        handles.append(style.dot(f"{word.replace('_', ' ')}: {int(one['n_left'])} cells left", colour))
        for ax, state in zip(axes, states, strict=True):
            mean, std = (one[name].sel(state=state).values for name in ("path_mean", "path_std"))
            lag = one["lag"].values
            ax.fill_between(lag, mean - std, mean + std, color=style.tinted(colour, 0.7), lw=0.0)
            ax.plot(lag, mean, color=colour, lw=1.2, marker=".", ms=3.0)
    for ax, state in zip(axes, states, strict=True):
        style.style_axes(ax)
        style.label_axes(ax, None, labels.state_measure(ds, state).label)
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    style.label_axes(axes[-1], "sections before the first one outside")
    text = style.join([labels.caption(part, with_start=False), "mean and standard deviation"])
    style.complete(fig, axes[0], text, handles)
    return fig


def _at(ds: xr.Dataset, at: Mapping[str, float] | None) -> xr.Dataset:
    """Select values of axes; axes of one value are selected, too."""
    dims = [str(d) for d in ds["rate"].dims if d != "set"]
    for name, value in (at or {}).items():
        if name not in dims:
            raise ValueError(unknown_name("axis", name, dims))
        ds = ds.isel({name: place(ds[name], value)})
    return ds.isel({d: 0 for d in dims if d in ds.dims and ds.sizes[d] == 1})


def draw(run: OpenRun, options: EscapeFigureOptions) -> style.DataFigure:
    """Draw the figure ``escapes`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("escapes", **options.part(EscapeOptions))
    plot = plot_paths if options.show == "paths" else plot_rates
    return noted(plot(ds, at=at, frame=frame_of(options)), notes)
