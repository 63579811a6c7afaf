"""Draw the largest Lyapunov exponent as colours in the plane of two swept parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pipeline.analysis.chaos.lyapunov import check_exponents
from pipeline.plots import labels, style
from pipeline.plots.bifurcation import swept_parameters
from pipeline.plots.exponents import UNITS, exponent_values, left_out, rate_unit
from pipeline.plots.selection import at_points

_NO_EXPONENT = "0.8"
_SHOWN = 0.98
"""Share of the points whose exponents the scale holds, so that a few do not pale all others."""


@style.drawn
def plot_lyapunov_map(
    ds: xr.Dataset, *, per: str = "s", at: Mapping[str, float] | None = None, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the largest Lyapunov exponent as colours in the plane of two swept parameters.

    Parameters
    ----------
    ds
        Cube with the product ``lyapunov`` over two swept parameters.
    per
        ``s``: per unit time [1/s]; ``period``: per drive period or return.
    at
        Values of further swept parameters.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Each point shows the largest exponent among its cells, so chaos shows wherever one of the
        coexisting attractors is chaotic. White is 0; equal distances from 0 have the same depth of colour
        on both sides. A point is grey where no cell has an exponent. The line above says how many cells
        have none, and why. Its `data` hold ``exponent_value`` and
        ``chaotic_share``, the share of cells whose exponent is positive.

    Raises
    ------
    ValueError
        If there are no exponents, if an option is unknown, or if not exactly two parameters are left.
    """
    style.check_choice("unit (per)", per, UNITS)
    check_exponents(ds)
    part = at_points(ds, at)
    swept = swept_pair(part, "draw a diagram with plot_lyapunov")
    values = exponent_values(part, per, spectrum=False)
    largest = values["exponent_value"].isel(exponent=0, drop=True)
    cells = [d for d in largest.dims if d not in swept]
    data = xr.Dataset(
        {
            "exponent_value": largest.max(cells, keep_attrs=True).transpose(swept[1], swept[0]),
            "chaotic_share": (largest > 0).mean(cells).transpose(swept[1], swept[0]),
        },
        attrs={"title": "largest Lyapunov exponent, maximum over the cells of each point"},
    )
    fig = style.new_figure(4.4, data, frame)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=False)
    _draw_map(fig, ax, data, part, swept)
    style.caption(ax, style.join([labels.caption(part, drop=swept), left_out(part)]))
    style.limits(ax, frame, *(style.span(part[d].values) for d in swept))
    style.finish(fig)
    return fig


def swept_pair(part: xr.Dataset, instead: str) -> list[str]:
    """Return the names of the two swept parameters of a result cube; raise ValueError if there are not two.

    `instead` says what to do if there are fewer.
    """
    swept = [d for d in swept_parameters(part) if part.sizes[d] > 1]
    if len(swept) != 2:
        raise ValueError(
            f"a map is drawn over two swept parameters, and {len(swept)} are left ({', '.join(swept) or 'none'}); "
            + ("choose values of the others with --at" if len(swept) > 2 else instead)
        )
    return swept


def _draw_map(fig: style.DataFigure, ax: Axes, data: xr.Dataset, part: xr.Dataset, swept: list[str]) -> None:
    grid = data["exponent_value"].values
    x, y = (style.edges(part[d].values.astype(np.float64)) for d in swept)
    norm, extend = _scale(grid)
    ax.set_facecolor(_NO_EXPONENT)
    image = ax.pcolormesh(x, y, np.ma.masked_invalid(grid), cmap="PuOr_r", norm=norm, rasterized=True)
    image.set_gid("map")
    style.label_axes(ax, *(labels.parameter_label(part[d]) for d in swept))
    if not np.isfinite(grid).all():
        style.legend_above(fig, [Patch(facecolor=_NO_EXPONENT, label="no cell has an exponent")])
    bar = fig.colorbar(ScalarMappable(norm, "PuOr_r"), ax=ax, extend=extend, pad=0.015, aspect=32, ticks=MaxNLocator(7))
    text = f"largest exponent [{rate_unit(data)}]\nmaximum over the cells of each point"
    style.style_bar(bar, text)


def _scale(grid: np.ndarray) -> tuple[Normalize, str]:
    """Return a colour scale that is symmetric about 0, and a word for the ends at which values lie outside it."""
    known = grid[np.isfinite(grid)]
    most = float(np.abs(known).max(initial=0.0))
    half = float(np.quantile(np.abs(known), _SHOWN)) if known.size else 1.0
    half = half if half > 0.0 else most or 1.0
    if most <= 1.5 * half:
        half = most or 1.0
    ends = (bool((known < -half).any()), bool((known > half).any()))
    return Normalize(-half, half), {
        (False, False): "neither",
        (True, False): "min",
        (False, True): "max",
        (True, True): "both",
    }[ends]
