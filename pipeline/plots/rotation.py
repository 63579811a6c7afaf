"""Draw rotation numbers: a devil's staircase over one parameter, or colours in the plane of two."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.run import OpenRun
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import swept_parameters
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.selection import at_points
from pipeline.products.product import FigureOptions

NAMED = 5
"""Largest denominator of the steps p/q that a staircase names."""

LEAST_STEP = 0.01
"""Least length of a step that is named, in units of the axis."""

CLOSE = 1e-6
"""Largest distance of the rotation number of a closed orbit from p/q."""

UNKNOWN = "0.8"


@style.drawn
def plot_rotation(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the rotation numbers of a run's cells over one swept parameter, or in the plane of two.

    Parameters
    ----------
    ds
        Cube.
    at
        Values of swept parameters that are not drawn.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Over one parameter every cell has a dot, blue where it is locked to the drive (closed), and steps p/q with
        denominators up to `NAMED` have their names. Over two parameters the colour is the median over the cells
        of a point; points at which all cells are locked have white dots. Its `data` hold ``rotation`` and
        ``locked``, the share of the cells that are.

    Raises
    ------
    ValueError
        If there are no rotation numbers, or more than two swept parameters are left.
    """
    if "rotation" not in ds:
        raise ValueError("the cube has no rotation numbers; run it with [products] rotation = {} in its specification")
    part = at_points(ds, at)
    swept = [d for d in swept_parameters(part) if part.sizes[d] > 1]
    if len(swept) not in (1, 2):
        raise ValueError(
            f"rotation numbers are drawn over one or two swept parameters, and {len(swept)} are left "
            f"({', '.join(swept) or 'none'}); choose values of the others with at"
        )
    data = rotation_data(part, swept)
    fig = style.new_figure(4.4, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=len(swept) == 1)
    text = style.join([labels.caption(part, drop=swept), _about(part)])
    if len(swept) == 1:
        _draw_staircase(fig, ax, data, part[swept[0]])
    else:
        draw_map(fig, ax, data, swept)
    style.caption(ax, text)
    style.limits(ax, frame, *(style.span(part[d].values) for d in swept))
    style.finish(fig)
    return fig


def rotation_data(part: xr.Dataset, swept: list[str]) -> xr.Dataset:
    """Return the rotation numbers to draw, and which cells (over two parameters: which share of them) are
    phase-locked.
    """
    locked = (part["orbit_period"] > 0).where(part["rotation"].notnull())
    data = xr.Dataset({"rotation": part["rotation"], "locked": locked}).load()
    if len(swept) == 2:
        cells = [d for d in data["rotation"].dims if d not in swept]
        data = xr.Dataset({"rotation": data["rotation"].median(cells), "locked": data["locked"].mean(cells)})
        data = data.transpose(swept[1], swept[0])
    keep = {*data["rotation"].dims, *swept}
    data = data.drop_vars([c for c in data.coords if c not in keep])
    data["rotation"].attrs = {"units": "1", "long_name": "turns per drive period"}
    return data.assign_attrs(title="rotation numbers")


def _about(part: xr.Dataset) -> str:
    known, error = part["rotation"].notnull(), part["rotation_error"]
    size = (
        f"errors up to {float(error.max()):.1g}, half of them below {float(error.median()):.1g}" if known.any() else ""
    )
    missing = int((~known).sum())
    return style.join([size, f"{missing} of {known.size} cells have none" if missing else ""])


def _draw_staircase(fig: style.DataFigure, ax: Axes, data: xr.Dataset, axis: xr.DataArray) -> None:
    rotation = data["rotation"].transpose(axis.name, ...).values.reshape(axis.size, -1)
    locked = data["locked"].transpose(axis.name, ...).values.reshape(axis.size, -1) > 0
    x = np.broadcast_to(axis.values.astype(np.float64)[:, None], rotation.shape)
    for which, colour, name in ((~locked, "0.55", "not locked"), (locked, style.BLUE, "locked: closed orbits")):
        ax.plot(x[which], rotation[which], ".", color=colour, markersize=2.5, label=name, gid=name.split(":")[0])
    style.label_axes(ax, labels.parameter_label(axis), "rotation number [turns per drive period]")
    style.legend_above(fig, [style.dot("locked: closed orbits", style.BLUE), style.dot("not locked", "0.55")])
    for fraction, (low, high) in _steps(x[locked], rotation[locked], axis).items():
        ax.annotate(
            f"{fraction.numerator}/{fraction.denominator}",
            (0.5 * (low + high), float(fraction)),
            (0.0, 4.0),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=fig.look.tick,
            annotation_clip=True,
        )


def _steps(x: np.ndarray, rotation: np.ndarray, axis: xr.DataArray) -> dict[Fraction, tuple[float, float]]:
    """Return the parameter interval of each step p/q of a devil's staircase; short steps are left out."""
    whole = float(axis.max() - axis.min())
    found = {}
    for value in np.unique(np.round(rotation, 9)):
        fraction = Fraction(float(value)).limit_denominator(NAMED)
        if abs(float(fraction) - value) > CLOSE:
            continue
        here = x[np.abs(rotation - value) < CLOSE]
        if here.max() - here.min() >= LEAST_STEP * whole:
            found[fraction] = (float(here.min()), float(here.max()))
    return found


def draw_map(fig: style.DataFigure, ax: Axes, data: xr.Dataset, swept: list[str]) -> None:
    """Draw the rotation numbers as colours in the plane of two parameters, with white dots where all cells are
    locked.
    """
    grid, locked = data["rotation"].values, data["locked"].values
    x, y = (data[d].values.astype(np.float64) for d in swept)
    known = grid[np.isfinite(grid)]
    norm = Normalize(*((known.min(), known.max()) if known.size else (0.0, 1.0)))
    ax.set_facecolor(UNKNOWN)
    ax.pcolormesh(style.edges(x), style.edges(y), np.ma.masked_invalid(grid), norm=norm, rasterized=True, gid="map")
    j, i = np.nonzero(locked == 1.0)
    ax.plot(x[i], y[j], ".", color="white", markersize=1.2, gid="locked", rasterized=True)
    style.label_axes(ax, *(labels.parameter_label(data[d]) for d in swept))
    entries: list[Artist] = [style.dot("locked: closed orbits", "black", face="white", size=3.5)] if len(i) else []
    if not np.isfinite(grid).all():
        entries.append(Patch(facecolor=UNKNOWN, label="no rotation number"))
    if entries:
        style.legend_above(fig, entries)
    bar = fig.colorbar(ScalarMappable(norm), ax=ax, pad=0.015, aspect=32, ticks=MaxNLocator(7))
    style.style_bar(bar, "rotation number\n[turns per drive period]")


def draw(run: OpenRun, options: FigureOptions) -> style.DataFigure:
    """Draw the figure ``rotation`` of a run."""
    at, notes = values_of(run, options)
    return noted(plot_rotation(run.cube(), at=at, frame=frame_of(options)), notes)
