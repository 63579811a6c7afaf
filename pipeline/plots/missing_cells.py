"""Show the share of cells without points in a strip below a diagram, and say why a diagram is empty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from pipeline.plots import style
from pipeline.plots.points import Survey

# Greys instead of hatching: some readers of SVG paint its patterns black.
LOOKS: dict[str, dict[str, Any]] = {
    "pending": {"facecolor": "0.92", "edgecolor": "0.6", "linewidth": 0.4},
    "diverged": {"facecolor": "0.0", "edgecolor": "0.0", "linewidth": 0.8},
    "failed": {"facecolor": "0.28", "edgecolor": "0.28", "linewidth": 0.8},
    "not reached": {"facecolor": "0.62", "edgecolor": "0.62", "linewidth": 0.8},
    "no return": {"facecolor": "0.8", "edgecolor": "0.3", "linewidth": 0.6},
    "chatter": {"facecolor": "0.45", "edgecolor": "0.1", "linewidth": 0.6},
    "without exponent": {"facecolor": "1.0", "edgecolor": "0.3", "linewidth": 0.6},
}


def draw_absent(ax: Axes, strip: Axes, x: np.ndarray, survey: Survey, layers: Sequence[int]) -> None:
    """Draw in a strip the share of cells that have no point in the diagram, and shade parameter values where no cell
    has one.

    Parameters
    ----------
    ax, strip
        Axes of the diagram, and of the strip below it.
    x
        Values of the parameter.
    survey
        Result of `pipeline.plots.points.survey`; it counts the cells along the parameter.
    layers
        Indices of the layers (directions) that the axes show.
    """
    edges = style.edges(x)
    cells = survey.cells[list(layers)].sum(0)
    floor = np.zeros(cells.size)
    for name, counts in survey.absent.items():
        share = counts[list(layers)].sum(0) / np.maximum(cells, 1)
        if share.any():
            style.fill_columns(strip, edges, floor, floor + share, LOOKS[name], f"absent:{name}")
            floor = floor + share
    strip.set_ylim(0.0, 1.0)
    strip.set_yticks([0.5], ["absent"])
    strip.tick_params(axis="y", which="both", right=False, left=False)
    strip.tick_params(axis="x", which="both", top=False)
    shade_blank(ax, x, survey, layers)


def shade_blank(ax: Axes, x: np.ndarray, survey: Survey, layers: Sequence[int]) -> None:
    """Shade a diagram at the parameter values where no cell has a point."""
    shown = list(layers)
    absent = sum((counts[shown].sum(0) for counts in survey.absent.values()), np.zeros(x.size, np.int64))
    blank = (absent >= np.maximum(survey.cells[shown].sum(0), 1)).astype(float)
    if blank.any():
        looks = {"facecolor": "0.955", "linewidth": 0.0, "zorder": 1.5}
        area = style.fill_columns(ax, style.edges(x), np.zeros(blank.size), blank, looks, "blank")
        area.set_transform(ax.get_xaxis_transform())


def absent_handles(survey: Survey) -> list[Patch]:
    """Return legend entries for the cells that have no point in the diagram: their number for each reason."""
    total = int(survey.cells.sum())
    return [
        Patch(label=f"{name}: {int(counts.sum())} of {total} cells", **LOOKS[name])
        for name, counts in survey.absent.items()
        if counts.any()
    ]


def say_empty(ax: Axes, survey: Survey, shown: str = "") -> None:
    """Write into empty axes why there is nothing to draw."""
    n_cells = int(survey.cells.sum())
    absent = {name: int(counts.sum()) for name, counts in survey.absent.items() if counts.any()}
    text = f"nothing to draw: of {n_cells} cells, " + style.join(f"{n} {name}" for name, n in absent.items())
    if not n_cells:
        text = "nothing to draw: the cube has no cells"
    elif absent.get("pending", 0) == n_cells:
        text = f"nothing to draw yet: all {n_cells} cells are pending"
    elif sum(absent.values()) < n_cells:
        text = f"nothing to draw: no point lies {shown or 'here'}"
    size = style.look_of(ax).label
    width = 0.8 * style.figure_of(ax).frame.width_in
    ax.text(
        0.5,
        0.5,
        style.folded(text, width, size),
        transform=ax.transAxes,
        ha="center",
        va="center",
        fontsize=size,
        zorder=3,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 5.0},
    )
