"""Draw measured points over the curves of a figure, in the colours of their levels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from pipeline.layout.own_words import rate_of
from pipeline.layout.vocabulary import axis_name, split_dims
from pipeline.plots import labels, style
from pipeline.plots.labels import Measure
from pipeline.results.points import POINT, level_name, read_points
from pipeline.results.run import OpenRun
from pipeline.results.tolerances import SAME_LEVEL

Level = tuple[tuple[str, float], ...]
"""Values of further swept parameters, by name."""
Levels = Mapping[Level, str]
"""Colour of the curves at each level."""

_LOOK: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 3.0,
    "markerfacecolor": "black",
    "markeredgecolor": "white",
    "markeredgewidth": 0.4,
    "zorder": 9.0,
}


def points_of(run: OpenRun, path: str, along: str, **columns: Any) -> xr.Dataset | None:
    """Read the measured points of a figure of a run over an axis; None without a file.

    Its `columns` are those of `read_points`. Further swept parameters of the run are levels.
    """
    if not path:
        return None
    cube = run.cube()
    others = [d for d in split_dims(cube["status"])[0] if d != axis_name(along)]
    return read_points(path, run.model, along, others=others, rate=rate_of(cube), **columns)


def columns_of(measure: Measure) -> dict[str, Any]:
    """Return the columns of `points_of` for a diagram of one state or quantity, in its own unit."""
    turns = measure.unit.startswith("rad")
    return {"needed": (measure.name,), "known": (), "angles": (measure.name,) if turns else ()}


def by_level(points: xr.Dataset, levels: Levels) -> Iterator[tuple[np.ndarray, dict[str, Any]]]:
    """Yield the points of the levels of each colour with their look, and at last those of no level of the curves.

    Points without a level belong to the curves if these have one colour. Those of no level are open then, else black.
    """
    colours, has_level = list(dict.fromkeys(levels.values())), False
    rest = np.ones(points.sizes[POINT], bool)
    for colour in colours:
        own, text = np.zeros_like(rest), ""
        for level in (level for level, its in levels.items() if its == colour):
            told = {name: level_name(points, name) for name, _ in level}
            values = {name: value for name, value in level if told[name]}
            has_level |= bool(values)
            if not values and len(colours) > 1:
                continue
            near = [
                np.isclose(points[told[name]].values, value, rtol=SAME_LEVEL, atol=0.0)
                for name, value in values.items()
            ]
            own |= rest & np.all([rest, *near], axis=0)
            text = "".join(f", {name} = {value:g}" for name, value in values.items()) if len(colours) > 1 else ""
        if own.any():
            rest &= ~own
            yield own, {**_LOOK, "markerfacecolor": colour, "label": f"measured{text}"}
    if rest.any():
        own_look = {"markerfacecolor": "white", "markeredgecolor": colours[0], "markeredgewidth": 0.8}
        look = {**_LOOK, **(own_look if len(colours) == 1 else {})}
        yield rest, {**look, "label": "measured at other levels" if has_level else "measured"}


def draw_points(
    ax: Axes, points: xr.Dataset, column: str, measure: Measure, levels: Levels, **look: Any
) -> list[dict[str, Any]]:
    """Draw a column of measured points in the colours of their levels; return their legend entries."""
    looks = [(own, {**one, **look}) for own, one in by_level(points, levels)]
    for own, one in looks:
        if column in points:
            ax.plot(points["parameter"].values[own], measure.shown(points[column].values[own]), **one)
    return [one for _, one in looks]


def draw_sections(ax: Axes, points: xr.Dataset, measure: Measure, levels: Iterable[Level]) -> list[Any]:
    """Draw measured values of what a diagram shows, angles from -pi to pi, and widen the axes to hold them.

    Points at the levels of the diagram are filled, others are open. Return their legend entries.
    """
    values = points[measure.name]
    if measure.on_circle:
        values = values.where(np.abs(values) <= np.pi, labels.wrapped(values.values))
    shown = points.assign({measure.name: values})
    own = dict.fromkeys(levels, style.VERMILLION)
    entries = draw_points(ax, shown, measure.name, measure, own, markersize=4.5, gid="measured")
    style.hold(ax, [points["parameter"].values], [measure.shown(values.values)])
    labels.angle_ticks(ax, measure)
    return style.handles([{k: v for k, v in entry.items() if k != "gid"} for entry in entries])


def with_points(data: xr.Dataset, points: xr.Dataset | None) -> xr.Dataset:
    """Add measured points to the data of a figure, under names that begin with ``measured_``."""
    return data if points is None else data.assign({f"measured_{name}": v for name, v in points.variables.items()})
