"""Draw bifurcation curves over panels that show a parameter plane, and mark their points of codimension two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from pipeline.plots import style
from pipeline.plots.branches import KINDS, NAMES

DASHES: tuple[Any, ...] = ("-", (0, (6, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)), (0, (8, 1.5, 1, 1.5, 1, 1.5)))
"""Line styles that can be told apart."""

_ON_MAP = dict(zip(KINDS[:3], DASHES[:3], strict=True))
_STYLE_NAMES = dict(zip(KINDS[:3], ("solid:", "dashed:", "dotted:"), strict=True))

POINT_NAMES = {
    "cusp": "CP",
    "generalised_doubling": "GPD",
    "chenciner": "CH",
    "r1": "R1",
    "r2": "R2",
    "r3": "R3",
    "r4": "R4",
    "fold_flip": "LPPD",
    "fold_neimark_sacker": "LPNS",
    "doubling_neimark_sacker": "PDNS",
    "double_neimark_sacker": "NSNS",
}
"""Short names of points of codimension two, as MatContM writes them."""


ROOM = (0.045, 0.045)
"""Room that a short name takes, in units of the axes."""


def take_room(ax: Axes, at: tuple[float, float], taken: list[np.ndarray]) -> bool:
    """Reserve the place of a short name on axes. Return False if it would overlap a name already placed."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    here = np.array([(at[0] - left) / (right - left), (at[1] - bottom) / (top - bottom)])
    if any((np.abs(here - other) < ROOM).all() for other in taken):
        return False
    taken.append(here)
    return True


def draw_over(fig: style.DataFigure, axes: Sequence[Axes], ds: xr.Dataset, x: str) -> None:
    """Draw bifurcation curves in black over panels that show a parameter plane, whose horizontal axis is `x`.

    Points of codimension two have their names if there is one panel; several are too small.
    """
    along, across = ("first", "second") if str(ds.attrs["first_parameter"]) == x else ("second", "first")
    halo = [withStroke(linewidth=2.2, foreground="white")]
    for ax in axes:
        low, high = ax.get_xlim(), ax.get_ylim()
        for i in range(ds.sizes["curve"]):
            n, kind = int(ds["n_points"][i]), KINDS[int(ds["kind"][i])]
            ax.plot(
                ds[along].values[i, :n],
                ds[across].values[i, :n],
                color="black",
                linewidth=1.0 if len(axes) == 1 else 0.7,
                linestyle=_ON_MAP[kind],
                path_effects=halo if len(axes) == 1 else None,
                gid=f"curve:{i}",
                zorder=4.0,
            )
        ax.set_xlim(low)
        ax.set_ylim(high)
        mark_points(ax, ds, along, across, fig.look.tick, named=len(axes) == 1)


def line_note(ds: xr.Dataset) -> str:
    """Return a text on which line style stands for which kind of bifurcation."""
    present = {KINDS[int(kind)] for kind in ds["kind"].values}
    return ", ".join(f"{_STYLE_NAMES[kind]} {NAMES[kind]}" for kind in _ON_MAP if kind in present)


def mark_points(ax: Axes, ds: xr.Dataset, along: str, across: str, size: float, named: bool = True) -> None:
    """Mark points of codimension two by dots and, if `named`, by short names such as CP (cusp) and R1.

    A name that would lie over another one is left out.
    """
    names = str(ds["special_kind"].attrs["flag_meanings"]).split()
    halo = [withStroke(linewidth=2.0, foreground="white")]
    taken: list[np.ndarray] = []
    for k in range(ds.sizes["special"]):
        at = float(ds[f"special_{along}"][k]), float(ds[f"special_{across}"][k])
        ax.plot(*at, marker="o", markersize=3.2, color="black", markeredgecolor="white", markeredgewidth=0.5, zorder=6)
        if not (named and take_room(ax, at, taken)):
            continue
        ax.annotate(
            POINT_NAMES[names[int(ds["special_kind"][k])]],
            at,
            (3.0, 3.0),
            textcoords="offset points",
            fontsize=size,
            path_effects=halo,
            annotation_clip=True,
            zorder=7,
        )
