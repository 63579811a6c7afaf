"""Draw the density of noisy section points, at one parameter point or over an axis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import place
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.products.figures import DensityFigureOptions
from pipeline.products.noise import DensityOptions
from pipeline.specification.problems import unknown_name

_GAMMA = 0.5
"""Exponent of the colour scale: the square root shows what is rare, too."""


@style.drawn
def plot_density(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the density of a state at the sections.

    Parameters
    ----------
    ds
        Result of the analysis ``density``.
    at
        Values of the axes that are not drawn.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Over an axis: the density by colour with its peaks as dots, and the number of peaks in a panel below.
        At one point: the histogram, the smoothed density as a line, its peaks as dots.

    Raises
    ------
    ValueError
        If more than one axis is left.
    """
    dims = [str(d) for d in ds["n_peaks"].dims]
    for name, value in (at or {}).items():
        if name not in dims:
            raise ValueError(unknown_name("axis", name, dims))
        ds = ds.isel({name: place(ds[name], value)})
    part = ds.isel({d: 0 for d in dims if d in ds.dims and ds.sizes[d] == 1})
    left = [str(d) for d in part["n_peaks"].dims]
    if len(left) > 1:
        raise ValueError(f"a density is drawn over one axis, and {', '.join(left)} are left; choose values with at")
    return _over(part, left[0], frame) if left else _at_one_point(part, frame)


def _text(part: xr.Dataset, drop: list[str]) -> str:
    kernel = f"peaks with at least {100 * part.attrs['prominence']:g} % of the highest above their valleys"
    return style.join([labels.caption(part, drop=drop, with_start=False), kernel])


def _over(part: xr.Dataset, along: str, frame: style.Frame) -> style.DataFigure:
    fig = style.new_figure(5.2, part[["density", "smoothed", "peak", "n_peaks", "bandwidth"]], frame)
    ax, below = fig.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    measure = labels.state_measure(part, str(part.attrs["density_of"]))
    x, y = (part[d].values.astype(np.float64) for d in (along, "value"))
    shown = part["smoothed"].transpose("value", along).values / measure.factor
    top = float(np.nanmax(shown)) if np.isfinite(shown).any() else 1.0
    norm = PowerNorm(_GAMMA, 0.0, top)
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


def draw(run: OpenRun, options: DensityFigureOptions) -> style.DataFigure:
    """Draw the figure ``density`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("density", **options.part(DensityOptions))
    return noted(plot_density(ds, at=at, frame=frame_of(options)), notes)
