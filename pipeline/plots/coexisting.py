"""Draw the section points of all coexisting attractors over the swept parameter, with one colour per attractor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from pipeline.analysis.outcomes import left_out
from pipeline.analysis.ragged import dense
from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import choose, start_dims
from pipeline.layout.vocabulary import ATTRACTS, STABILITIES, letter
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.fractions import swept_parameter
from pipeline.products.product import StateOptions

_LEAST_PT, _GROWTH_PT = 1.1, 5.0
_UP_PT, _DOWN_PT, _TINT = 1.5, 4.2, 0.55
_SPAN: dict[str, Any] = {"facecolor": "0.9", "edgecolor": "none", "linewidth": 0.0}


@style.drawn
def plot_coexisting(
    attractors: xr.Dataset,
    *,
    state: str = "",
    at: Mapping[str, float] | None = None,
    degrees: bool = False,
    hysteresis: xr.Dataset | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the section points of all attractors of a run over the swept parameter.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` over one parameter or more.
    state
        Name of the state drawn; by default the model's first.
    at
        Values of the other swept parameters.
    degrees
        Degrees instead of radians.
    hysteresis
        Result of `pipeline.analysis.attractors.matching.hysteresis.hysteresis`; its loops are shaded.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        In a sweep the area of each point grows with the attractor's basin fraction, divided among its points.
        In a continuation in both directions small dark points belong to the upward continuation, large light
        points to the downward one. A set that does not close is drawn by its stored points. Where a set does
        not attract, its points are small and grey.
        Its `data` hold ``value`` and the variables that set the look
        of each point: ``stability`` and ``share``, or ``present`` for each direction.

    Raises
    ------
    ValueError
        If the state is unknown, or not exactly one swept parameter is left.
    """
    measure = labels.state_measure(attractors, state, degrees)
    parameter = swept_parameter(attractors, at, "attractors")
    keep = (parameter, *start_dims(attractors))
    part = dense(choose(attractors, at, keep, f"attractors are drawn over {parameter}"), points=True)
    cast = palette.cast_of(attractors, part)
    data = _points(part, parameter, measure)
    loops = _loops(hysteresis, part, parameter) if hysteresis is not None else []
    both = "direction" in data.dims
    fig, ax = palette.new_panel(data, _entries(data, cast, both, bool(loops)), frame)
    style.style_axes(ax)
    for low, high in loops:
        ax.axvspan(low, high, gid="loop", zorder=0.5, **_SPAN)
    for number in sorted(range(len(cast.names)), key=lambda i: float(data["share"].isel(attractor=i).sum())):
        (_draw_directions if both else _draw_weighted)(ax, data.isel(attractor=number), parameter, cast)
    _draw_others(ax, data, parameter)
    ax.margins(y=0.05)
    style.limits(ax, frame, style.span(data[parameter].values))
    labels.angle_ticks(ax, measure)
    style.label_axes(ax, labels.parameter_label(data[parameter]), measure.label)
    style.complete(fig, ax, style.join([labels.caption(part, drop=[parameter]), left_out(part)]))
    return fig


def _points(part: xr.Dataset, parameter: str, measure: labels.Measure) -> xr.Dataset:
    """Return the section points to draw, with the basin fraction and the stability of each attractor."""
    values = part["attractor_points"].sel(state=measure.name, drop=True)
    values = values.transpose(parameter, "attractor", "point")
    shown = values.copy(data=measure.shown(values.values, wrap=True))
    data = xr.Dataset(
        {
            "value": shown.assign_attrs(units=measure.unit, long_name=f"{measure.name} at the section"),
            "share": part["share"].transpose(parameter, "attractor"),
            "stability": part["stability"].transpose(parameter, "attractor"),
        }
    )
    if "branch" in part["attractor_id"].dims and "direction" in part.coords:
        words = part["direction"].values.astype(str)
        names = [d for d in ("up", "down") if d in words]
        cells = part["attractor_id"].transpose(parameter, "branch").values
        ids = part["attractor"].values
        present = [(cells[:, words == d, None] == ids).any(axis=1) for d in names]
        data["present"] = (
            (parameter, "direction", "attractor"),
            np.stack(present, axis=1).astype(np.int8),
            {"units": "1", "long_name": "whether a branch of the direction is on it"},
        )
        data = data.assign_coords(direction=names)
    data = data.drop_vars([k for k in data.coords if data[k].dtype == object])
    data.attrs = {"title": "coexisting attractors"}
    return data


def _loops(found: xr.Dataset, part: xr.Dataset, parameter: str) -> list[tuple[float, float]]:
    """Return the parameter limits of the hysteresis loops at the chosen values of the other parameters."""
    axis = part[parameter].values.astype(np.float64)
    edges = style.edges(axis)
    here = np.ones(found.sizes["loop"], bool)
    for name in found.data_vars:
        other = str(name).removeprefix("loop_at_")
        if other != name and other in part.coords:
            here &= np.isclose(found[name].values, float(part[other]))
    limits = []
    for a, b in zip(found["loop_from"].values[here], found["loop_to"].values[here], strict=True):
        first, last = (int(np.abs(axis - x).argmin()) for x in (a, b))
        limits.append((float(edges[first]), float(edges[last + 1])))
    return limits


def _spread(one: xr.Dataset, parameter: str, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the chosen points of an attractor as arrays: parameter value, drawn value, index of the parameter
    value.
    """
    values = one["value"].transpose(parameter, "point").values
    row, column = np.nonzero(np.isfinite(values) & chosen[:, None])
    return one[parameter].values[row].astype(np.float64), values[row, column], row


def _draw_weighted(ax: Axes, one: xr.Dataset, parameter: str, cast: palette.Cast) -> None:
    share = one["share"].values
    x, y, row = _spread(one, parameter, share > 0)
    number = int(one["attractor"])
    size = _diameter(share[row] / np.bincount(row)[row]) ** 2 if row.size else 1.0
    ax.scatter(x, y, s=size, c=cast.colours[number], linewidths=0.0, rasterized=True, gid=f"points:{letter(number)}")


def _draw_others(ax: Axes, data: xr.Dataset, parameter: str) -> None:
    """Draw the section points of sets that do not attract, in a grey for each kind of stability."""
    for code, grey in palette.GREY_OF.items():
        chosen = (data["stability"].values == code)[..., None] & np.isfinite(data["value"].values)
        row, *_ = np.nonzero(chosen)
        if row.size:
            x, y = data[parameter].values[row].astype(np.float64), data["value"].values[chosen]
            style.points(ax, x, y, _UP_PT, grey, zorder=1.5, rasterized=True, gid=f"points:{_word(code)}")


def _word(stability: int) -> str:
    return STABILITIES[stability].replace("_", " ")


def _diameter(share: Any) -> Any:
    return np.sqrt(_LEAST_PT**2 + _GROWTH_PT**2 * np.asarray(share))


def _draw_directions(ax: Axes, one: xr.Dataset, parameter: str, cast: palette.Cast) -> None:
    """Draw an attractor's points for both directions of continuation: small dark ones over large light ones."""
    number = int(one["attractor"])
    for word in one["direction"].values[::-1]:
        chosen = (one["present"].sel(direction=word).values > 0) & (one["stability"].values == ATTRACTS)
        x, y, _ = _spread(one, parameter, chosen)
        up = word == "up"
        size, colour = _UP_PT if up else _DOWN_PT, style.tinted(cast.colours[number], 0.0 if up else _TINT)
        gid = f"points:{word}:{letter(number)}"
        style.points(ax, x, y, size, colour, zorder=2.2 if up else 2.0, rasterized=True, gid=gid)


def _entries(data: xr.Dataset, cast: palette.Cast, both: bool, loops: bool) -> list[palette.Entry]:
    total = data["share"].values.sum(axis=0)
    ranked = [i for i in cast.order if i in cast.main and total[i] > 0]
    met = {int(code) for code in np.unique(data["stability"].values)}
    entries: list[palette.Entry] = [(cast.names[i], cast.colours[i]) for i in ranked]
    rest = sum(total[i] > 0 for i in cast.names if i not in cast.main)
    if rest:
        entries.append((f"{rest} others", palette.OTHERS))
    entries += [(_word(code), grey) for code, grey in palette.GREY_OF.items() if code in met]
    if both:
        entries += [style.dot("up", "0.0", _UP_PT), style.dot("down", style.tinted("0.0", _TINT), _DOWN_PT)]
    else:
        sizes = ((1.0, "basin fraction per point 1"), (0.1, "0.1"), (0.0, "below 0.01"))
        entries += [style.dot(text, "0.3", float(_diameter(share))) for share, text in sizes]
    if loops:
        entries.append(Patch(label="up and down differ", **_SPAN))
    return entries


def draw(run: OpenRun, options: StateOptions) -> style.DataFigure:
    """Draw the figure ``attractors`` of a run, with hysteresis loops if it was continued in both directions."""
    at, notes = values_of(run, options)
    found = run.derive("attractors")
    both = "direction" in found.coords and {"up", "down"} == set(found["direction"].values.astype(str).tolist())
    loops = run.derive("hysteresis") if both else None
    figure = plot_coexisting(
        found, state=options.state, at=at, degrees=options.degrees, hysteresis=loops, frame=frame_of(options)
    )
    return noted(figure, notes)
