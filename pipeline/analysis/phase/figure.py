"""Draw phase responses of limit cycles, and isochrones around them."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from pipeline.analysis.phase.declaration import IsochroneOptions, PhaseFigureOptions, PhaseOptions
from pipeline.layout.vocabulary import letter
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun


@style.drawn
def plot_phase(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw phase responses over the phase, a panel for each state and one for the kick.

    Parameters
    ----------
    ds
        From `pipeline.analysis.phase.analysis.phase`.
    frame
        Width of the figure and ranges of its axes.

    Raises
    ------
    ValueError
        If no cycle has a response.
    """
    if not np.isfinite(ds["response"].values).any():
        raise ValueError("no cycle has a phase response; magpend analyse phase says why.")
    names = [str(name) for name in ds["state"].values]
    panels = len(names) + ("shift" in ds)
    fig = style.new_figure(1.2 + 1.6 * panels, ds, frame)
    axes = fig.subplots(panels, 1, sharex=True, squeeze=False)[:, 0]
    colours = style.colours()
    for ax in axes:
        style.style_axes(ax)
        ax.axhline(0.0, color="0.6", linewidth=0.6)
    phase = np.append(ds["cycle_phase"].values, 1.0)
    for i in range(ds.sizes["cycle"]):
        one, colour = ds.isel(cycle=i), colours[i % len(colours)]
        for k, ax in enumerate(axes[: len(names)]):
            values = one["response"].values[:, k]
            ax.plot(phase, np.append(values, values[0]), color=colour, linewidth=1.2, gid=f"response:{i}:{names[k]}")
        if "shift" in ds:
            style.points(axes[-1], phase[:-1], one["shift"].values, 2.5, colour, gid=f"shift:{i}")
    for k, ax in enumerate(axes[: len(names)]):
        measure, unit = labels.state_measure(ds, names[k]), str(ds["unit"].values[k])
        style.label_axes(ax, None, labels.with_unit(f"response to {measure.symbol}", unit if unit != "1" else ""))
    if "shift" in ds:
        style.label_axes(axes[-1], None, f"shift [periods] by {ds.attrs['kick']}")
    style.label_axes(axes[-1], "phase [periods]")
    style.limits(axes[-1], frame, (0.0, 1.0))
    fig.align_ylabels(axes)
    style.caption(axes[0], labels.caption(ds.isel(cycle=0) if ds.sizes["cycle"] == 1 else ds, with_start=False))
    if ds.sizes["cycle"] > 1:
        looks = [{"color": colours[i % len(colours)], "label": _name(ds, i)} for i in range(ds.sizes["cycle"])]
        style.legend_above(fig, style.handles(looks))
    style.finish(fig)
    return fig


def _name(ds: xr.Dataset, i: int) -> str:
    at = [f"{name} {float(ds[name][i]):.4g}" for name in str(ds.attrs["axes"]).split() if name in ds.coords]
    return ", ".join([*at, letter(int(ds["attractor"][i]))])


def draw_phase(run: OpenRun, options: PhaseFigureOptions) -> style.DataFigure:
    """Draw the figure ``phase`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("phase", **{**options.part(PhaseOptions), "at": at})
    return noted(plot_phase(ds, frame=frame_of(options)), notes)


@style.drawn
def plot_isochrones(ds: xr.Dataset, *, lines: int = 20, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the phases of states around a limit cycle as colours, with isochrones and the cycle.

    Parameters
    ----------
    ds
        From `pipeline.analysis.phase.analysis.phase` with a grid; its first cycle is drawn.
    lines
        Number of isochrones, at even phases.
    frame
        Width of the figure and ranges of its axes.
    """
    one = ds.isel(cycle=0)
    names = [str(name) for name in ds["state"].values]
    x, y, phase = one["x_state"].values, one["y_state"].values, one["asymptotic_phase"].values
    fig = style.new_figure(4.6, one, frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    normal, colours = Normalize(0.0, 1.0), colormaps["twilight"]
    ax.pcolormesh(x, y, phase, cmap=colours, norm=normal, rasterized=True, zorder=0.5)
    for level in np.arange(lines) / lines:
        # the phase relative to the level, without its jump by one period
        relative = (phase - level + 0.5) % 1.0 - 0.5
        ax.contour(x, y, np.where(np.abs(relative) < 0.25, relative, np.nan), [0.0], colors="black", linewidths=0.7)
    orbit = one["orbit"].values
    ax.plot(*np.vstack([orbit, orbit[:1]]).T, color="white", linewidth=3.0)
    ax.plot(*np.vstack([orbit, orbit[:1]]).T, color=style.VERMILLION, linewidth=1.6, gid="cycle")
    style.label_axes(ax, *(labels.state_measure(ds, name).label for name in names))
    style.style_bar(fig.colorbar(ScalarMappable(normal, colours), ax=ax), "phase [periods]")
    style.caption(ax, labels.caption(one, with_start=False))
    style.limits(ax, frame)
    style.finish(fig)
    return fig


def draw_isochrones(run: OpenRun, options: IsochroneOptions) -> style.DataFigure:
    """Draw the figure ``isochrones`` of a run, of the first of its limit cycles."""
    at, notes = values_of(run, options)
    ds = run.derive("phase", **{**options.part(PhaseOptions), "at": at})
    return noted(plot_isochrones(ds, lines=options.lines, frame=frame_of(options)), notes)
