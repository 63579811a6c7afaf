"""Draw backbone curves over the frequency: phase resonance over the response of a run, and normal modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D

from pipeline.analysis.branches.completeness import cut_words
from pipeline.analysis.branches.figure import UNSTABLE
from pipeline.analysis.branches.levels import at_levels, refuse_at
from pipeline.analysis.response.declaration import BackboneFigureOptions, BackboneOptions
from pipeline.analysis.response.figure import amplitude_of, draw_branch, levels_of
from pipeline.layout.vocabulary import FREQUENCY_DIM, parameter_name
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.run import OpenRun
from pipeline.results.tabular import plain

LOOKS: dict[str, dict[str, Any]] = {
    "phase_resonance": {"color": "black", "linewidth": 1.8, "zorder": 9.5},
    "normal_mode": {"color": "0.7", "linewidth": 3.6, "zorder": 4.0},
}
"""Lines by kind: a mode is a broad band below, so that phase resonance on it is seen."""

DASHES = {"phase_resonance": (0, (3, 1.5)), "normal_mode": (0, (1.0, 0.6))}
"""Dashes by kind, in units of the line's width, where unstable."""

DIMS = ("branch", "point", "channel")


@style.drawn
def plot_backbone(
    ds: xr.Dataset, response: xr.Dataset | None = None, *, degrees: bool = False, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw the amplitude along backbone curves over the frequency: stable solid, unstable dashed.

    Parameters
    ----------
    ds
        From the analysis ``backbone``.
    response
        From the analysis ``response`` along the frequency, drawn below; each level of the force has its colour.
    degrees
        Degrees for a channel that is an angle.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Its `data` are the curves; names with the suffix ``_response`` are those of the response.
    """
    channel = str(ds.attrs["of_channel"])
    turns = str(ds["unit"].sel(channel=channel).values).startswith("rad")
    measure = labels.quantity_measure(ds, channel, degrees and turns)
    fig = style.new_figure(4.2, _stored(ds, response), frame)
    ax = fig.add_subplot()
    style.style_axes(ax)
    levels = {} if response is None else dict(zip(levels_of(response), cycle(style.PALETTE), strict=False))
    if response is not None:
        for i in range(response.sizes["branch"]):
            draw_branch(ax, response, i, *amplitude_of(response, channel, 0), measure, levels)
    kinds = ds["kind"].attrs["flag_meanings"].split()
    for i in range(ds.sizes["curve"]):
        n = int(ds["n_points"][i])
        x, y = ds["parameter"].values[i, :n], measure.shown(ds["amplitude"].sel(channel=channel).values[i, :n])
        solid = ds["n_unstable"].values[i, :n] == 0
        kind = kinds[int(ds["kind"][i])]
        for stable in (True, False):
            # a step between a stable and an unstable orbit is drawn as unstable
            steps = solid[:-1] & solid[1:] if stable else ~(solid[:-1] & solid[1:])
            shown = np.append(steps, False) | np.insert(steps, 0, False)
            line = {**LOOKS[kind], "linestyle": "-" if stable else DASHES[kind]}
            ax.plot(np.where(shown, x, np.nan), np.where(shown, y, np.nan), **line)
    name = labels.with_unit(f"amplitude of {measure.symbol}", measure.unit)
    swept = labels.swept_label(ds.attrs["parameter"], ds.attrs["parameter_units"])
    style.label_axes(ax, swept if levels else "frequency [Hz]", name)
    style.limits(ax, frame)
    caption = style.join([labels.caption(ds, with_start=False), cut_words(ds)])
    style.complete(fig, ax, caption, _handles(ds, kinds, levels))
    return fig


def _stored(ds: xr.Dataset, response: xr.Dataset | None) -> xr.Dataset:
    found = ds.assign_attrs(title="backbone curves")
    if response is not None:
        own = {name: response[name] for name in ("parameter", "amplitude", "n_unstable", "n_points")}
        kept = xr.Dataset(own).drop_vars(("channel", "unit")).drop_dims("harmonic", errors="ignore")
        kept = kept.rename({d: f"{d}_response" for d in DIMS})
        found = found.assign({f"{name}_response": v for name, v in kept.items()})
    return found


def _handles(ds: xr.Dataset, kinds: Sequence[str], levels: Mapping[Any, str]) -> list[Line2D]:
    lines = [{**LOOKS[kinds[k]], "label": plain(kinds[k])} for k in sorted(set(ds["kind"].values.tolist()))]
    for level, colour in levels.items():
        where = ", ".join(f"{name} = {value:g}" for name, value in level)
        lines.append({"color": colour, "label": f"response, {where}" if where else "response"})
    lines.append({**UNSTABLE, "label": "unstable"})
    return style.handles(lines)


def draw_backbone(run: OpenRun, options: BackboneFigureOptions) -> style.DataFigure:
    """Draw the figure ``backbone`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("backbone", **options.part(BackboneOptions))
    if not found.attrs["force"]:
        refuse_at(at, "the figure backbone", "normal modes of the free motion have no level of a force")
    response = None
    if found.attrs["force"]:
        response = at_levels(run.derive("response", parameter=parameter_name(FREQUENCY_DIM)), at)
    return noted(plot_backbone(found, response, degrees=options.degrees, frame=frame_of(options)), notes)
