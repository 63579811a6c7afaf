"""Draw escapes from a set and the density of section points, of runs with noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.noise.declaration import DensityFigureOptions, DensityOptions, EscapeFigureOptions, EscapeOptions
from pipeline.analysis.noise.escapes import strength_dim
from pipeline.layout.conventions import shown_unit
from pipeline.layout.own_words import rate_of
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.selection import place
from pipeline.results.tabular import words_of
from pipeline.specification.problems import unknown_name

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)
MARKERS = ("o", "s", "^", "D", "v", "P")


@style.drawn
def plot_rates(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw rates of escape with their intervals over the one swept parameter that is left.

    The axis of rates is logarithmic. Over the strength σ of a noise the other axis is 1/σ², on which Kramers' law is a
    line; an open marker is the upper end of the interval where no cell left. Raise ValueError if not exactly one swept
    parameter is left.
    """
    part = _at(ds, "rate", at)
    dims = _axes(part, "rate")
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
    """Draw mean and spread of the sections before cells leave, at one parameter point, a panel for each state.

    Lines are means, bands one standard deviation on either side; the set in which cells begin has a colour.
    """
    part = _at(ds, "rate", at)
    dims = _axes(part, "rate")
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


def _axes(ds: xr.Dataset, name: str) -> list[str]:
    return [str(d) for d in ds[name].dims if d != "set"]


def _at(ds: xr.Dataset, of: str, at: Mapping[str, float] | None) -> xr.Dataset:
    """Select values of the axes of a variable; axes of one value are selected, too."""
    dims = _axes(ds, of)
    for name, value in (at or {}).items():
        if name not in dims:
            raise ValueError(unknown_name("axis", name, dims))
        ds = ds.isel({name: place(ds[name], value, rate_of(ds))})
    return ds.isel({d: 0 for d in dims if d in ds.dims and ds.sizes[d] == 1})


def draw_escapes(run: OpenRun, options: EscapeFigureOptions) -> style.DataFigure:
    """Draw the figure ``escapes`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("escapes", **options.part(EscapeOptions))
    plot = plot_paths if options.show == "paths" else plot_rates
    return noted(plot(ds, at=at, frame=frame_of(options)), notes)


@style.drawn
def plot_density(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the density of a state at the sections; raise ValueError if more than one axis is left.

    Over an axis: the density by colour with its peaks as dots, and the number of peaks in a panel below. At one point:
    the histogram, the smoothed density as a line, its peaks as dots.
    """
    part = _at(ds, "n_peaks", at)
    left = _axes(part, "n_peaks")
    if len(left) > 1:
        raise ValueError(f"a density is drawn over one axis, and {', '.join(left)} are left; choose values with at")
    return _over(part, left[0], frame) if left else _at_one_point(part, frame)


def _text(part: xr.Dataset, drop: list[str]) -> str:
    kernel = f"peaks with at least {100 * part.attrs['prominence']:g} % of the highest above their valleys"
    return style.join([labels.caption(part, drop=drop, with_start=False), kernel])


def _over(part: xr.Dataset, along: str, frame: style.Frame) -> style.DataFigure:
    gamma = 0.5  # exponent of the colour scale: the square root shows what is rare, too
    fig = style.new_figure(5.2, part[["density", "smoothed", "peak", "n_peaks", "bandwidth"]], frame)
    ax, below = fig.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    measure = labels.state_measure(part, str(part.attrs["density_of"]))
    x, y = (part[d].values.astype(np.float64) for d in (along, "value"))
    shown = part["smoothed"].transpose("value", along).values / measure.factor
    top = float(np.nanmax(shown)) if np.isfinite(shown).any() else 1.0
    norm = PowerNorm(gamma, 0.0, top)
    ax.pcolormesh(style.edges(x), style.edges(measure.shown(y)), shown, norm=norm, rasterized=True, gid="density")
    peaks = measure.shown(part["peak"].transpose(along, "rank").values)
    ax.plot(
        np.broadcast_to(x[:, None], peaks.shape).ravel(), peaks.ravel(), "o", ms=3.2, mfc="white", mec="black", mew=0.6
    )
    below.plot(x, part["n_peaks"].values, "o-", color=style.BLUE, ms=3.0, lw=0.9, drawstyle="steps-mid")
    below.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    below.set_ylim(0.0, float(part["n_peaks"].max()) + 1.0)
    for one in (ax, below):
        style.style_axes(one, inside=one is below, minor=False)
    style.label_axes(ax, None, measure.label)
    style.label_axes(below, labels.parameter_label(part[along]), "peaks")
    style.limits(ax, frame, style.span(x))
    bar = fig.colorbar(ScalarMappable(norm), ax=ax, pad=0.015, aspect=26)
    style.style_bar(bar, "density")
    handles = [style.dot("peaks", "black", 4.0, face="white")]
    style.complete(fig, ax, _text(part, [along]), handles)
    return fig


def _at_one_point(part: xr.Dataset, frame: style.Frame) -> style.DataFigure:
    fig = style.new_figure(3.6, part[["density", "smoothed", "peak"]], frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    measure = labels.state_measure(part, str(part.attrs["density_of"]))
    x = measure.shown(part["value"].values)
    ax.stairs(
        part["density"].values / measure.factor,
        style.edges(x),
        fill=True,
        color=style.tinted(style.SKY, 0.4),
        gid="histogram",
    )
    smoothed = part["smoothed"].values / measure.factor
    ax.plot(x, smoothed, color=style.BLUE, lw=1.2, gid="smoothed")
    peaks = measure.shown(part["peak"].values)
    peaks = peaks[np.isfinite(peaks)]
    ax.plot(peaks, np.interp(peaks, x, smoothed), "o", ms=4.5, mfc="white", mec="black", mew=0.7)
    unit = "" if measure.unit in ("", "1") else f" [1/({measure.unit})]"
    style.label_axes(ax, measure.label, f"density{unit}")
    ax.set_ylim(bottom=0.0)
    style.limits(ax, frame, style.span(x))
    style.complete(fig, ax, _text(part, []), [style.dot("peaks", "black", 4.0, face="white")])
    return fig


def draw_density(run: OpenRun, options: DensityFigureOptions) -> style.DataFigure:
    """Draw the figure ``density`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("density", **options.part(DensityOptions))
    return noted(plot_density(ds, at=at, frame=frame_of(options)), notes)
