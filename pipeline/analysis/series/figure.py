"""Draw what a time series says of its dynamics, in six panels."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.analysis.series.declaration import SeriesFigureOptions, SeriesOptions
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import counted


@style.drawn
def plot_series(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw a series' delay portrait, return map, divergence of neighbours, correlation sums, recurrences and spectrum.

    Parameters
    ----------
    ds
        From `magpend.series_of`.
    frame
        Width of the figure.

    Returns
    -------
    DataFigure
        Panels without data say so. Its `data` are `ds`.
    """
    fig = style.new_figure(4.9, ds, frame)
    axes = fig.subplots(2, 3).ravel()
    panels = (_portrait, _return_map, _divergence, _slopes, _recurrences, _spectrum)
    for ax, panel in zip(axes, panels, strict=True):
        style.style_axes(ax)
        panel(ax, ds)
    of_a_cell = "model" in ds.attrs
    title = style.join([*([labels.caption(ds)] if of_a_cell else []), f"{ds.attrs['channel']}: {ds.attrs['motion']}"])
    fig.suptitle(style.folded(title, frame.width_in - 0.6, fig.look.title), x=0.01, ha="left", fontsize=fig.look.title)
    style.finish(fig)
    return fig


def draw_series(run: OpenRun, options: SeriesFigureOptions) -> style.DataFigure:
    """Draw the figure ``series`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("series", **{**options.part(SeriesOptions), "at": at})
    return noted(plot_series(found, frame=frame_of(options)), notes)


def _told(ds: xr.Dataset, name: str, form: str) -> str:
    """Return a result with half of its interval for a title; why it is not decided is in the table."""
    if name not in ds["quantity"].values:
        return ""
    one = ds.sel(quantity=name)
    if str(one["reason"].item()):
        return "not decided"
    unit = str(one["unit"].item())
    text = f"{float(one['value']):{form}} ± {0.5 * float(one['high'] - one['low']):.1g}"
    return text if unit == "1" else f"{text} {unit}"


def _title(ax: Axes, text: str) -> None:
    ax.set_title(text, loc="left", fontsize=style.look_of(ax).legend)


def _portrait(ax: Axes, ds: xr.Dataset) -> None:
    name, unit = str(ds.attrs["channel"]), str(ds.attrs["unit"])
    now, later = ds["vector"].values.T
    ax.plot(now, later, color=style.BLUE, linewidth=0.4, gid="portrait")
    shown = labels.with_unit(name, "" if unit == "1" else unit)
    style.label_axes(ax, shown, f"{name}, one delay later")
    _title(ax, f"delay {_told(ds, 'delay', '.3g')}")


def _return_map(ax: Axes, ds: xr.Dataset) -> None:
    style.points(ax, ds["maximum"].values, ds["next_maximum"].values, 2.4, style.BLUE, gid="returns")
    style.label_axes(ax, "maximum", "next maximum")
    _title(ax, f"period {_told(ds, 'period', '.4g')}")


def _divergence(ax: Axes, ds: xr.Dataset) -> None:
    if ds.sizes["elapsed"]:
        ax.plot(ds["elapsed"], ds["divergence"], color="black", linewidth=0.9, gid="divergence")
        ax.plot(ds["elapsed"], ds["fit_line"], color=style.VERMILLION, linewidth=1.6, gid="fit")
    else:
        style.write(ax, "too few samples")
    style.label_axes(ax, labels.with_unit("time", "s"), "mean log distance")
    _title(ax, f"exponent {_told(ds, 'exponent', '.2g')}")


def _slopes(ax: Axes, ds: xr.Dataset) -> None:
    radius = ds["radius"].values
    for k, colour in zip(range(ds.sizes["embedding"]), style.colours(), strict=False):
        one = ds.isel(embedding=k)
        share = one["correlation_sum"].values
        # over an octave, as four radii are in one, where there are pairs to count
        there = share[:-4] > 1e-6
        slope = np.log2(share[4:][there] / share[:-4][there])
        middle = np.sqrt(radius[4:] * radius[:-4])[there]
        ax.plot(
            middle, slope, color=colour, linewidth=0.9, label=counted(int(one["embedding"]), "delay"), gid=f"slope-{k}"
        )
    if np.isfinite(float(ds["fit_low"])):
        ax.axvspan(float(ds["fit_low"]), float(ds["fit_high"]), color="0.9", linewidth=0.0, zorder=0)
    ax.set_xscale("log")
    ax.set_ylim(0.0, float(ds["embedding"].max()) + 1.5)
    ax.legend(fontsize=style.look_of(ax).legend, frameon=False)
    style.label_axes(ax, "radius [standard deviations]", "slope")
    _title(ax, f"dimension {_told(ds, 'correlation_dimension', '.3g')}")


def _recurrences(ax: Axes, ds: xr.Dataset) -> None:
    most = 600  # rows of the recurrence matrix that are drawn
    if "recurrent" in ds:
        stride = -(-ds.sizes["row"] // most)
        end = float(ds["row"][-1])
        image = ds["recurrent"].values[::stride, ::stride]
        ax.imshow(image, cmap="Greys", origin="lower", extent=(0.0, end, 0.0, end), aspect="auto", interpolation="none")
    else:
        style.write(ax, "too few samples")
    style.label_axes(ax, labels.with_unit("time", "s"), labels.with_unit("time", "s"))
    _title(ax, f"determinism {_told(ds, 'determinism', '.3f')}")


def _spectrum(ax: Axes, ds: xr.Dataset) -> None:
    frequency, power = ds["frequency_hz"].values[1:], ds["power"].values[1:]
    ax.plot(frequency, power, color="black", linewidth=0.7, gid="power")
    there = power > 1e-9 * power.max()
    ax.set_yscale("log")
    ax.set_ylim(1e-9 * power.max(), 3.0 * power.max())
    ax.set_xlim(0.0, float(frequency[there].max()))
    style.label_axes(ax, labels.with_unit("frequency", "Hz"), "density")
