"""Draw the section points of one parameter point in the plane of two states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.layout.vocabulary import model_of, split_dims
from pipeline.plots import labels, palette, pixels, style
from pipeline.plots.bifurcation import absent_handles, fixed_of, say_empty
from pipeline.plots.figure import at_points, frame_of, noted, values_of
from pipeline.plots.palette import Motions
from pipeline.plots.points import View, make_view, survey
from pipeline.products.diagrams import SectionOptions
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dense, dims_of, isel
from pipeline.results.run import OpenRun
from pipeline.results.selection import place, select_points

_MOST_PT, _LEAST_PT = 1.7, 0.45


@style.drawn
def plot_section(
    ds: xr.Dataset,
    attractors: xr.Dataset | None = None,
    *,
    states: tuple[str, str] | None = None,
    at: Mapping[str, float] | None = None,
    degrees: bool = False,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the section points of all cells at one parameter point, in the plane of two states.

    Parameters
    ----------
    ds
        Cube of a sweep or a continuation, as `pipeline.open_run` gives it.
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` of the same cube: each has its colour.
        Without it the colours are those of the kinds of motion.
    states
        Names of the states to the right and upwards; by default the first that a portrait shows.
    at
        Values of the swept parameters.
    degrees
        Degrees for angles and their rates.
    frame
        Width of the figure; `xlim` and `ylim` choose a part, whose points are counted anew.

    Returns
    -------
    DataFigure
        Up to `pixels.MARKER_LIMIT` points are markers, more are counted on pixels. Its `data` hold the
        points, as `pipeline.plots.pixels.draw_points` says; ``x`` and ``y`` are the states.

    Raises
    ------
    ValueError
        For an unknown state, if more than one parameter point is left, or degrees are asked for without
        an angle.
    """
    part = _one_point(ds, at)
    measures = _measures(part, states, degrees)
    view = _view(part, measures, attractors)
    found = survey(view, xlim=frame.xlim, ylim=frame.ylim)
    fig = style.new_figure(4.8, xr.Dataset(), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    style.limits(ax, frame, *(_range(r, m) for r, m in zip((found.x, found.y), measures, strict=True)))
    for axis, m in zip("xy", measures, strict=True):
        labels.angle_ticks(ax, m, axis, 8.0)
    style.label_axes(ax, measures[0].label, measures[1].label)
    if found.empty:
        say_empty(ax, found, "in these ranges")
    handles = [*_handles(view, {code for _, code in found.classes}), *absent_handles(found)]
    style.complete(fig, ax, labels.caption(part), handles)
    diameter = float(np.clip(260.0 / np.sqrt(max(view.n_points, 1)), _LEAST_PT, _MOST_PT))
    data = pixels.draw_points([pixels.Panel(ax, (0,))], view, diameter)
    for axis, m in zip("xy", measures, strict=True):
        data[axis].attrs = {"units": m.unit, "long_name": m.name}
    fig.data = data.assign_coords(fixed_of(part)).assign_attrs(title=model_of(part).clock.section)
    return fig


def _measures(part: xr.Dataset, states: tuple[str, str] | None, degrees: bool) -> list[labels.Measure]:
    model = model_of(part)
    names = states or section_pair(model)
    for name in names:
        style.check_choice("state", name, model.state_names)
    turns = [degrees and model.state(name).unit.startswith("rad") for name in names]
    if degrees and not any(turns):
        raise ValueError(f"neither {names[0]} nor {names[1]} is an angle; draw them without degrees")
    return [labels.state_measure(part, n, turn) for n, turn in zip(names, turns, strict=True)]


def section_pair(model: Model, first: str = "") -> tuple[str, str]:
    """Choose the two states to draw, if possible a pair for which the model has a phase portrait."""
    states = model.section_states
    pairs = [p for p in model.portraits if set(p) <= set(states) and p[0] == (first or p[0])]
    if pairs:
        return pairs[0]
    first = first or states[0]
    others = [name for name in states if name != first] or [n for n in model.state_names if n != first]
    return first, (others or [first])[0]


def _view(part: xr.Dataset, measures: list[labels.Measure], attractors: xr.Dataset | None) -> View:
    def coordinates(block: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
        section = block["section"].transpose(*block["status"].dims, "period_index", "state")
        x, y = (m.shown(section.sel(state=m.name).values) for m in measures)
        return x, y

    view = replace(make_view(part, ("section",), coordinates), layers=("",))
    return view if attractors is None else _by_attractor(view, part, attractors)


def _one_point(ds: xr.Dataset, at: Mapping[str, float] | None) -> xr.Dataset:
    part = at_points(ds, at)
    dims, _ = split_dims(part["status"])
    part = select_points(part, None, purpose="a section is drawn of one parameter point")
    return part.isel(dict.fromkeys(dims, 0))


def _range(found: tuple[float, float], measure: labels.Measure) -> tuple[float, float]:
    low, high = found
    if not low <= high:
        return (-measure.half_turn, measure.half_turn) if measure.on_circle else (-1.0, 1.0)
    margin = max(0.04 * (high - low), 1e-9 * max(abs(low), abs(high)), 1e-12)
    return low - margin, high + margin


def _handles(view: View, found: set[int]) -> list[Any]:
    motions = view.motions
    return [style.dot(motions.words[c], motions.colours[c]) for c in motions.drawn if c in found and motions.told]


def _by_attractor(view: View, part: xr.Dataset, attractors: xr.Dataset) -> View:
    """Colour each point by the attractor of its cell, or by the grey for the reason why the cell has none."""
    at = {dim: place(attractors[dim], float(part[dim])) for dim in dims_of(attractors)}
    chosen = dense(isel(attractors, at))
    cast = palette.cast_of(attractors, chosen)
    ids, greys = sorted(cast.names), list(palette.GREYS)
    motions = Motions(
        (*greys, *(cast.names[i] for i in ids)),
        (*palette.GREYS.values(), *(cast.colours[i] for i in ids)),
        (*(i + len(greys) for i in cast.order), *range(len(greys))),
    )
    codes = outcomes(chosen).transpose(*split_dims(chosen["status"])[1]).astype(np.int32) + len(greys)
    for name, which in palette.other_cells(chosen).items():
        codes = codes.where(~which, greys.index(name))
    marked = part.assign_coords(_kind=(codes.dims, codes.values))
    return replace(view, ds=marked, motions=motions)


def draw(run: OpenRun, options: SectionOptions) -> style.DataFigure:
    """Draw the figure ``section`` of a run."""
    cube = run.cube()
    at, notes = values_of(run, options)
    found = run.derive("attractors") if options.colour == "attractor" else None
    model = model_of(cube)
    first, second = options.state, options.against or section_pair(model, options.state)[1]
    figure = plot_section(cube, found, states=(first, second), at=at, degrees=options.degrees, frame=frame_of(options))
    return noted(figure, notes)
