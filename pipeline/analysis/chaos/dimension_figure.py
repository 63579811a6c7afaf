"""Draw the correlation sum from which a correlation dimension is fitted."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.analysis.chaos.declaration import DimensionFigureOptions, DimensionOptions
from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.ragged import SET, dims_of, is_ragged
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points


@style.drawn
def plot_dimension(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the correlation sum of an attractor over the radius, with the fitted line and the local slope.

    Parameters
    ----------
    ds
        Result of `pipeline.analysis.chaos.dimensions.correlation_dimension` for one set of points, or of
        `pipeline.analysis.chaos.analysis.section_dimension` for one parameter point. In the latter
        case the attractor with the most cells is drawn, among those with a dimension.
    frame
        Width of the figure; ranges of the radius and the correlation sum.

    Returns
    -------
    DataFigure
        Its `data` hold ``correlation_sum`` and ``local_slope`` over ``radius``, and the numbers of the fit.

    Raises
    ------
    ValueError
        If there is more than one set, or nothing to draw.
    """
    dims = dims_of(ds) if is_ragged(ds) else ds["correlation_dimension"].dims
    several = [str(d) for d in dims if ds.sizes[d] > 1]
    if several:
        raise ValueError(f"a correlation sum is drawn of one set, and {', '.join(several)} has several")
    ds = _of_one_attractor(ds)
    data = _correlation(ds)
    fig = style.new_figure(5.2, data, frame)
    grid = fig.add_gridspec(2, 1, height_ratios=[1.5, 1.0])
    top = fig.add_subplot(grid[0])
    bottom = fig.add_subplot(grid[1], sharex=top)
    for ax in (top, bottom):
        style.style_axes(ax, minor=False)
    radius = data["radius"].values
    top.loglog(
        radius,
        data["correlation_sum"].values,
        linestyle="none",
        marker="o",
        markersize=3,
        color="black",
        gid="correlation_sum",
    )
    bottom.semilogx(
        radius, data["local_slope"].values, "o-", markersize=3, linewidth=0.7, color="black", gid="local_slope"
    )
    _draw_fit(top, bottom, data)
    value, error = (float(data[f"correlation_dimension{end}"]) for end in ("", "_stderr"))
    text = f"$D_2$ = {value:.2f} ± {error:.2f}" if np.isfinite(value) else "no range to fit"
    top.text(
        0.03,
        0.94,
        f"{text}\n{int(data['n_points'])} points",
        transform=top.transAxes,
        va="top",
        fontsize=fig.look.label,
    )
    style.caption(top, data.attrs["place"])
    top.tick_params(labelbottom=False)
    style.label_axes(top, y="correlation sum C(r)")
    style.label_axes(bottom, f"scaled radius r ({_scales(ds)})", "local slope")
    steep = data["local_slope"].values
    bottom.set_ylim(0.0, 1.15 * max(float(np.nanmax(steep, initial=1.0)), 1.0))
    style.limits(top, frame)
    fig.align_ylabels([top, bottom])
    style.finish(fig)
    return fig


def _of_one_attractor(ds: xr.Dataset) -> xr.Dataset:
    """Select the attractor with the most cells, among those that have a correlation sum."""
    if not is_ragged(ds):
        return ds
    cells = np.where(ds["n_points"].values > 0, ds["n_cells"].values, 0)
    if not cells.max(initial=0):
        raise ValueError("there is no correlation sum to draw: no attractor at this point is without a period")
    return ds.isel({SET: int(cells.argmax())})


def _scales(ds: xr.Dataset) -> str:
    model = model_of(ds)
    units = {s.unit: s.scale for s in model.states}
    return "1 for " + ", ".join(f"{scale:g}" + (f" {unit}" if unit != "1" else "") for unit, scale in units.items())


def _draw_fit(top: Axes, bottom: Axes, data: xr.Dataset) -> None:
    fit = tuple(float(data[name]) for name in ("fit_low", "fit_high"))
    if not np.isfinite(fit).all():
        return
    value, error = (float(data[f"correlation_dimension{end}"]) for end in ("", "_stderr"))
    radius, share = data["radius"].values, data["correlation_sum"].values
    bottom.text(
        np.sqrt(fit[0] * fit[1]),
        0.06,
        "fit",
        transform=bottom.get_xaxis_transform(),
        ha="center",
        fontsize=style.look_of(bottom).legend,
    )
    inside = (radius >= fit[0] * (1 - 1e-9)) & (radius <= fit[1] * (1 + 1e-9)) & (share > 0)
    height = np.exp(np.log(share[inside]).mean() + value * (np.log(radius) - np.log(radius[inside]).mean()))
    near = (radius > fit[0] / 3) & (radius < fit[1] * 3)
    top.plot(radius[near], height[near], color=style.VERMILLION, linewidth=1.0, zorder=1.5, gid="fit")
    for ax in (top, bottom):
        ax.axvspan(*fit, color=style.ORANGE, alpha=0.25, linewidth=0, zorder=0.5, gid="fit_range")
    bottom.axhspan(value - error, value + error, color=style.VERMILLION, alpha=0.25, linewidth=0)
    bottom.axhline(value, color=style.VERMILLION, linewidth=1.0, zorder=1.5)


def _correlation(ds: xr.Dataset) -> xr.Dataset:
    """Return the correlation sum over the radius, and its local slope, as the data of the figure."""
    dims = [str(d) for d in ds["correlation_dimension"].dims]
    one = ds.isel(dict.fromkeys(dims, 0))
    x, y = one["log_radius"].values, one["log_correlation_sum"].values
    there = np.isfinite(x) & np.isfinite(y)
    if there.sum() < 3:
        raise ValueError("there is no correlation sum to draw: all points are one")
    x, y = x[there], y[there]
    numbers = ("correlation_dimension", "correlation_dimension_stderr", "fit_low", "fit_high", "n_points")
    return xr.Dataset(
        {
            "correlation_sum": ("radius", np.exp(y), {"units": "1", "long_name": "share of pairs closer"}),
            "local_slope": ("radius", np.gradient(y, x), {"units": "1", "long_name": "local slope"}),
            **{name: ((), one[name].values, one[name].attrs) for name in numbers},
        },
        coords={"radius": ("radius", np.exp(x), {"units": "1", "long_name": "scaled radius"})},
        attrs={"title": "correlation sum", "place": labels.caption(ds, with_start=False)},
    )


def draw(run: OpenRun, options: DimensionFigureOptions) -> style.DataFigure:
    """Draw the figure ``dimension`` of a run."""
    cube = run.cube()
    at, notes = values_of(run, options)
    select_points(cube, at, purpose="a correlation sum is drawn of one parameter point")
    found = run.derive("dimension", **{**options.part(DimensionOptions), "at": at})
    return noted(plot_dimension(found, frame=frame_of(options)), notes)
