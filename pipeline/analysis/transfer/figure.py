"""Draw the slow sets of a section map: their stationary densities, their cores and the committors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from pipeline.analysis.transfer.declaration import TransferFigureOptions, TransferOptions
from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import letter
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.ragged import N_POINTS, SAMPLE, SET, isel
from pipeline.results.run import OpenRun
from pipeline.results.selection import place


@style.drawn
def plot_transfer(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the slow sets of one parameter point in different colours.

    The left panel shows the stationary density within each set, with the core darkest; the right one the probability
    to reach the core of the set before the others. The plane is that of the first two states of the grid; of boxes in
    one place of it the one with the largest committor is drawn last. A grid of one state has curves.

    Parameters
    ----------
    ds
        From the analysis ``transfer``.
    at
        Value of each axis.

    Returns
    -------
    DataFigure
        Its `data` are the boxes.

    Raises
    ------
    ValueError
        If more than one parameter point is left, or no set was found.
    """
    part = isel(ds, {name: place(ds[name], value, rate_of(ds)) for name, value in (at or {}).items()})
    left = [str(d) for d in part["n_sets"].dims if part.sizes[d] > 1]
    if left:
        raise ValueError(f"sets are drawn at one parameter point; choose a value of {', '.join(left)} with at")
    part = part.isel({d: 0 for d in part["n_sets"].dims})
    if not part.sizes[SET]:
        raise ValueError("there is no set to draw: every path leaves the grid")
    own = np.repeat(np.arange(part.sizes[SET]), part[N_POINTS].values)
    names = [str(name) for name in part["axis"].values]
    data = part[["place", "density", "committor", "is_core"]].assign(set_of_box=(SAMPLE, own))
    fig = style.new_figure(3.7, data, frame)
    axes = fig.subplots(1, 2, sharex=True, sharey=len(names) > 1)
    draw = _draw_curves if len(names) == 1 else _draw_boxes
    draw(axes, part, own, names)
    handles = [style.dot(f"{letter(k)}, {_size(part, k)}", _colour(k), 6.0, marker="s") for k in range(part.sizes[SET])]
    text = style.join([labels.caption(part, with_start=False), "left: density; right: committor"])
    style.complete(fig, axes[0], text, handles)
    return fig


def _size(part: xr.Dataset, k: int) -> str:
    name = "share" if part["is_closed"][k] else "measure"
    return f"{name} {float(part[name][k]):.3g}"


def _colour(k: int) -> str:
    return style.PALETTE[k % len(style.PALETTE)]


def _shades(part: xr.Dataset, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how strong the colour of each box is in the left and in the right panel, between 0 and 1."""
    decades = 3.0  # range of the densities that are told apart, below the highest of a set
    density = part["density"].values
    top = np.array([density[own == k].max(initial=1e-300) for k in range(part.sizes[SET])])[own]
    with np.errstate(divide="ignore"):
        strong = np.clip(1.0 + np.log10(density / top) / decades, 0.0, 1.0)
    strong = np.where(part["is_core"].values > 0, 1.0, 0.75 * strong)
    return strong, part["committor"].values


def _draw_boxes(axes: np.ndarray, part: xr.Dataset, own: np.ndarray, names: list[str]) -> None:
    measures = [labels.state_measure(part, name) for name in names[:2]]
    width, places = part["width"].values[:2], part["place"].values[:, :2]
    low = places.min(axis=0) - 0.5 * width
    index = np.rint((places - low) / width - 0.5).astype(int)
    shape = tuple(index.max(axis=0) + 1)
    extent = [m.shown(end) for m, a, n, w in zip(measures, low, shape, width, strict=True) for end in (a, a + n * w)]
    order = np.argsort(part["committor"].values, kind="stable")
    colours = np.array([to_rgb(_colour(k)) for k in range(part.sizes[SET])])
    for ax, shade in zip(axes, _shades(part, own), strict=True):
        image = np.ones((*shape, 3))
        tint = 1.0 - (1.0 - colours[own]) * shade[:, None]
        image[index[order, 0], index[order, 1]] = tint[order]
        ax.imshow(
            image.transpose(1, 0, 2), origin="lower", extent=extent, aspect="auto", interpolation="nearest", gid="boxes"
        )
        style.style_axes(ax, inside=False, minor=False)
        style.label_axes(ax, measures[0].label, measures[1].label if ax is axes[0] else None)


def _draw_curves(axes: np.ndarray, part: xr.Dataset, own: np.ndarray, names: list[str]) -> None:
    measure = labels.state_measure(part, names[0])
    x, width = part["place"].values[:, 0], part["width"].values[:1]
    density = part["density"].values / width
    for ax, values in zip(axes, (density, part["committor"].values), strict=True):
        for k in range(part.sizes[SET]):
            _draw_steps(ax, measure.shown(x[own == k]), values[own == k], float(measure.shown(width)[0]), _colour(k))
        style.style_axes(ax)
        ax.set_ylim(bottom=0.0)
        style.label_axes(ax, measure.label, "density" if ax is axes[0] else "committor of the own set")


def _draw_steps(ax: Axes, x: np.ndarray, y: np.ndarray, width: float, colour: str) -> None:
    order = np.argsort(x)
    ax.bar(x[order], y[order], width=width, color=colour, linewidth=0.0, gid="boxes")


def draw(run: OpenRun, options: TransferFigureOptions) -> style.DataFigure:
    """Draw the figure ``transfer`` of a run."""
    at, notes = values_of(run, options)
    ds = run.derive("transfer", **options.part(TransferOptions))
    return noted(plot_transfer(ds, at=at, frame=frame_of(options)), notes)
