"""Draw the edges of Arnold tongues p/q in the plane of two parameters."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from pipeline.analysis.run import OpenRun
from pipeline.layout.conventions import shown_unit
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import fixed_of, swept_parameters
from pipeline.plots.curve_lines import take_room
from pipeline.plots.figure import frame_of
from pipeline.plots.rotation import draw_map, rotation_data
from pipeline.plots.selection import at_points
from pipeline.products.figures import TongueFigureOptions
from pipeline.products.tongues import TongueOptions

_COLOURS = (style.VERMILLION, style.BLUE, style.GREEN, style.PURPLE, "black")
"""Colours of the edges over a blank plane, by denominator; later denominators share the last."""


@style.drawn
def plot_tongues(
    ds: xr.Dataset, cube: xr.Dataset | None = None, *, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the edges of Arnold tongues in the plane of two parameters, each with its name p/q.

    Parameters
    ----------
    ds
        Result of the analysis ``tongues``.
    cube
        Cube with rotation numbers over both parameters, drawn as a map below; None if there is none.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Edges are black over a map; else their colour tells the denominator. Its `data` are the curves, with the
        map's numbers.
    """
    first, second = str(ds.attrs["first_parameter"]), str(ds.attrs["second_parameter"])
    stored = ds.drop_vars([k for k, v in ds.variables.items() if v.dtype == object])
    stored = stored.assign_attrs(title="Arnold tongues")
    data = rotation_data(cube, [first, second]) if cube is not None else None
    fig = style.new_figure(4.4, stored if data is None else stored.merge(data), frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=data is None)
    if data is not None:
        draw_map(fig, ax, data, [first, second])
    low, high = ax.get_xlim(), ax.get_ylim()
    _draw_edges(ax, ds, data is not None)
    if data is not None:
        ax.set_xlim(low)
        ax.set_ylim(high)
    style.label_axes(
        ax,
        labels.swept_label(first, shown_unit(ds["first"].attrs)),
        labels.swept_label(second, shown_unit(ds["second"].attrs)),
    )
    if data is None:
        _explain(fig, ds)
    n_found = int((ds["n_branches"] > 0).sum())
    style.caption(
        ax,
        style.join(
            [
                f"{n_found} of {ds.sizes['tongue']} tongues with denominators up to {ds.attrs['max_denominator']}",
                f"searched at {second} = {ds.attrs['row']:g}",
                labels.caption(ds, with_start=False),
            ]
        ),
    )
    style.limits(ax, frame)
    _name_tongues(fig, ax, ds)
    style.finish(fig)
    return fig


def _colour(denominator: int) -> str:
    return _COLOURS[min(denominator, len(_COLOURS)) - 1]


def _draw_edges(ax: Axes, ds: xr.Dataset, over_map: bool) -> None:
    halo = [withStroke(linewidth=2.0, foreground="white")]
    for i in range(ds.sizes["curve"]):
        n, p, q = (int(ds[name][i]) for name in ("n_points", "numerator", "denominator"))
        ax.plot(
            ds["first"].values[i, :n],
            ds["second"].values[i, :n],
            color="black" if over_map else _colour(q),
            linewidth=0.9,
            path_effects=halo if over_map else None,
            gid=f"tongue:{p}/{q}",
        )


def _name_tongues(fig: style.DataFigure, ax: Axes, ds: xr.Dataset) -> None:
    """Write the name p/q of each tongue at the highest point of its edges, if there is room."""
    halo = [withStroke(linewidth=2.0, foreground="white")]
    taken: list[np.ndarray] = []
    (left, right), (bottom, ceiling) = ax.get_xlim(), ax.get_ylim()
    order = np.lexsort((ds["numerator"].values, ds["denominator"].values))
    tops: dict[tuple[int, int], np.ndarray] = {}
    for i in order:
        p, q = int(ds["numerator"][i]), int(ds["denominator"][i])
        points = np.column_stack([ds["first"].values[i], ds["second"].values[i]])
        inside = (points - [left, bottom]) / [right - left, ceiling - bottom]
        inside = inside[((inside >= 0.0) & (inside <= 1.0)).all(axis=1)]
        if q and len(inside) and inside[:, 1].max() > tops.get((p, q), np.zeros(2))[1]:
            tops[p, q] = inside[int(np.argmax(inside[:, 1]))]
    for (p, q), top in tops.items():
        at = np.minimum(top, [1.0, 0.955])
        if not take_room(ax, (left + at[0] * (right - left), bottom + at[1] * (ceiling - bottom)), taken):
            continue
        ax.annotate(
            f"{p}/{q}",
            at,
            (0.0, 1.5),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=fig.look.tick,
            path_effects=halo,
            zorder=7,
        )


def _explain(fig: style.DataFigure, ds: xr.Dataset) -> None:
    present = sorted({int(q) for q in ds["denominator"].values if q})
    names = [f"denominator {q}" if q < len(_COLOURS) else f"denominator {len(_COLOURS)} or more" for q in present]
    colours = dict(zip(names, map(_colour, present), strict=True))
    style.legend_above(fig, [style.dot(name, colour) for name, colour in colours.items()])


def draw(run: OpenRun, options: TongueFigureOptions) -> style.DataFigure:
    """Draw the figure ``tongues`` of a run, over its rotation numbers if the run sweeps both parameters."""
    found = run.derive("tongues", **options.part(TongueOptions))
    plane = {str(found.attrs[f"{role}_parameter"]) for role in ("first", "second")}
    cube = run.cube()
    fixed = fixed_of(at_points(cube, options.at).squeeze())
    found = found.assign_coords({name: value for name, value in fixed.items() if name not in plane})
    swept = [d for d in swept_parameters(cube) if cube.sizes[d] > 1]
    return plot_tongues(found, cube if set(swept) == plane else None, frame=frame_of(options))
