"""Draw bifurcation curves in the plane of two parameters, alone or over a regime map of this plane."""

from __future__ import annotations

import xarray as xr
from matplotlib.lines import Line2D

from pipeline.analysis.run import OpenRun
from pipeline.layout.conventions import shown_unit
from pipeline.plots import labels, style
from pipeline.plots.branches import KINDS, NAMES
from pipeline.plots.curve_lines import DASHES, mark_points
from pipeline.plots.figure import frame_of
from pipeline.plots.regimes import plot_regimes
from pipeline.products.branches import CurveOptions
from pipeline.products.figures import CurveFigureOptions

_COLOURS = dict(zip(KINDS[:4], (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE), strict=True))


@style.drawn
def plot_curves(ds: xr.Dataset, *, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw bifurcation curves and points of codimension two in the plane of two parameters.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches.curves_dataset`.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        The colour shows the kind, the dashes show the period. Points of codimension two have a dot and their
        short name. Its `data` are the curves.
    """
    stored = ds.drop_vars([k for k, v in ds.variables.items() if v.dtype == object])
    fig = style.new_figure(4.4, stored.assign_attrs(title="curves of bifurcations"), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    periods = sorted({int(p) for p in ds["orbit_period"].values})
    seen: dict[tuple[int, str], Line2D] = {}
    for i in range(ds.sizes["curve"]):
        n, period, kind = int(ds["n_points"][i]), int(ds["orbit_period"][i]), KINDS[int(ds["kind"][i])]
        (line,) = ax.plot(
            ds["first"].values[i, :n],
            ds["second"].values[i, :n],
            color=_COLOURS[kind],
            linestyle=DASHES[periods.index(period) % len(DASHES)],
            linewidth=1.2,
            label=f"{NAMES[kind]}, period {period}",
        )
        seen.setdefault((period, kind), line)
    style.label_axes(
        ax,
        labels.swept_label(str(ds.attrs["first_parameter"]), shown_unit(ds["first"].attrs)),
        labels.swept_label(str(ds.attrs["second_parameter"]), shown_unit(ds["second"].attrs)),
    )
    style.limits(ax, frame)
    mark_points(ax, ds, "first", "second", fig.look.tick)
    style.caption(ax, labels.caption(ds, with_start=False))
    style.legend_above(fig, [seen[key] for key in sorted(seen)], size=fig.look.tick)
    style.finish(fig)
    return fig


def draw(run: OpenRun, options: CurveFigureOptions) -> style.DataFigure:
    """Draw the figure ``curves`` of a run, alone or over the regime map of another run."""
    found = run.derive("curves", **options.part(CurveOptions))
    if not options.over:
        return plot_curves(found, frame=frame_of(options))
    below = run.of(options.over).derive("attractors")
    return plot_regimes(below, show=options.show, curves=found, frame=frame_of(options))
