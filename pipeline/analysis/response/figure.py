"""Draw frequency responses: amplitude and phase along a parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pipeline.analysis.branches.analysis import fixed_of, isolas_of
from pipeline.analysis.branches.completeness import cut_words
from pipeline.analysis.branches.figure import STABLE, UNSTABLE, stretches, with_located
from pipeline.analysis.branches.kinds import KINDS, LABELS, MARKERS, NAMES
from pipeline.analysis.branches.levels import at_levels
from pipeline.analysis.response.declaration import ResponseFigureOptions, ResponseOptions
from pipeline.layout.vocabulary import axis_name, model_of
from pipeline.plots import labels, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.plots.labels import Measure
from pipeline.plots.measured import draw_points, points_of, with_points
from pipeline.results.run import OpenRun
from pipeline.specification.problems import SpecError

_ARROW: dict[str, Any] = {"arrowstyle": "->", "linewidth": 0.7, "shrinkA": 3.0, "shrinkB": 0.0, "mutation_scale": 7.0}


@style.drawn
def plot_response(
    ds: xr.Dataset,
    *,
    channel: str = "",
    harmonic: int = 0,
    points: xr.Dataset | None = None,
    degrees: bool = False,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the amplitude along a parameter, and below it the phase of a driven system: stable solid, unstable dashed.

    Each value of a further swept parameter, such as the level of the force, has its colour. All bifurcations are
    marked. Arrows lead from the end of a stable orbit to the amplitude of the orbit on which a trajectory lands.
    Isolas are named.

    Parameters
    ----------
    ds
        From the analysis ``response``.
    channel
        State or quantity; by default the first state.
    harmonic
        Harmonic whose amplitude is drawn; 0 draws half of peak to peak, and the phase of the first harmonic.
    points
        Measured points from `read_points`: ``amplitude`` and perhaps ``phase`` [rad] over the parameter. Points at
        a level that was computed have its colour, others are black, or open over black curves.
    degrees
        Degrees for phases, and for a channel that is an angle.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Its `data` are the response; measured points are ``measured_parameter``, ``measured_amplitude``,
        ``measured_phase``.

    Raises
    ------
    ValueError
        If there is no such channel or harmonic.
    """
    channel = channel or str(ds["channel"].values[0])
    style.check_choice("channel", channel, [str(c) for c in ds["channel"].values])
    if harmonic > ds.sizes["harmonic"]:
        raise ValueError(f"harmonic {harmonic} was not computed; it must be at most {ds.sizes['harmonic']}")
    turns = str(ds["unit"].sel(channel=channel).values).startswith("rad")
    measure = labels.quantity_measure(ds, channel, degrees and turns)
    has_phase = model_of(ds).clock.has_drive
    fig = style.new_figure(
        5.2 if has_phase else 4.0, with_points(style.storable(ds, "frequency response"), points), frame
    )
    ratios = [2, 1] if has_phase else [1]
    axes = fig.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    levels = levels_of(ds)
    chosen = [amplitude_of(ds, channel, harmonic), _phase(ds, channel, max(harmonic, 1))][: len(axes)]
    phase = Measure("phase", "lag", "deg" if degrees else "rad", 180.0 / np.pi if degrees else 1.0, True)
    for ax, (of_points, of_bifurcations), shown in zip(axes, chosen, (measure, phase), strict=False):
        style.style_axes(ax)
        for i in range(ds.sizes["branch"]):
            draw_branch(ax, ds, i, of_points, of_bifurcations, shown, levels)
    if not harmonic:
        _draw_jumps(axes[0], ds, channel, measure, levels)
    _name_isolas(axes[0], ds, measure.shown(chosen[0][0].values))
    drawn: list[dict[str, Any]] = []
    for ax, column, shown in zip(axes, ("amplitude", "phase"), (measure, phase), strict=False):
        drawn = drawn if points is None else draw_points(ax, points, column, shown, levels)
    name = str(ds.attrs["parameter"])
    what = "amplitude" if not harmonic else f"harmonic {harmonic}"
    style.label_axes(axes[-1], labels.swept_label(name, ds.attrs["parameter_units"]), "")
    axes[0].set_ylabel(labels.with_unit(f"{what} of {measure.symbol}", measure.unit))
    style.limits(axes[0], frame)
    if has_phase:
        axes[1].set_ylabel(labels.with_unit(f"lag of harmonic {max(harmonic, 1)}", phase.unit))
        labels.angle_ticks(axes[1], phase, most=4.5)
    style.caption(axes[0], style.join([labels.caption(ds, with_start=False), *_one_level(ds, levels), cut_words(ds)]))
    style.legend_above(fig, _handles(ds, levels, drawn), size=fig.look.tick)
    style.finish(fig)
    return fig


def levels_of(ds: xr.Dataset) -> dict[tuple[tuple[str, float], ...], str]:
    """Return the colour of each combination of fixed parameters: black if there is one."""
    found = sorted({tuple(fixed_of(ds, i).items()) for i in range(ds.sizes["branch"])})
    if len(found) <= 1:
        return dict.fromkeys(found, "black")
    return {level: style.PALETTE[k % len(style.PALETTE)] for k, level in enumerate(found)}


def _one_level(ds: xr.Dataset, levels: Mapping[Any, str]) -> list[str]:
    """Return the fixed parameters of all branches for the caption, if they are the same; else the legend has them."""
    told = next(iter(levels), ()) if len(levels) == 1 else ()
    return [f"{name} = {value:g}" for name, value in told if axis_name(name) not in ds.coords]


def amplitude_of(ds: xr.Dataset, channel: str, harmonic: int) -> tuple[xr.DataArray, xr.DataArray]:
    """Return half of peak to peak (harmonic 0), or the amplitude of a harmonic, at the points and bifurcations."""
    where: dict[str, Any] = {"channel": channel, **({"harmonic": harmonic} if harmonic else {})}
    name = "harmonic_amplitude" if harmonic else "amplitude"
    return ds[name].sel(where), ds[f"bifurcation_{name}"].sel(where)


def _phase(ds: xr.Dataset, channel: str, harmonic: int) -> tuple[xr.DataArray, xr.DataArray]:
    where: Any = {"channel": channel, "harmonic": harmonic}
    return ds["phase"].sel(where), ds["bifurcation_phase"].sel(where)


def draw_branch(
    ax: Axes,
    ds: xr.Dataset,
    branch: int,
    of_points: xr.DataArray,
    of_bifurcations: xr.DataArray,
    measure: Measure,
    levels: Mapping[Any, str],
) -> None:
    """Draw a measure along a branch, solid where stable, with marks at its bifurcations."""
    x = with_located(ds, branch, ds["parameter"], ds["value"])
    y = measure.shown(with_located(ds, branch, of_points, of_bifurcations))
    colour = levels[tuple(fixed_of(ds, branch).items())]
    for first, stop, solid in stretches(ds, branch):
        piece = y[first:stop]
        jumps = np.flatnonzero((np.abs(np.diff(piece)) > measure.half_turn) & measure.on_circle) + 1
        look = {**(STABLE if solid else UNSTABLE), "color": colour}
        ax.plot(np.insert(x[first:stop], jumps, np.nan), np.insert(piece, jumps, np.nan), **look)
    for k in np.flatnonzero(ds["of_branch"].values == branch):
        stable = min(int(ds["n_unstable_before"][k]), int(ds["n_unstable_after"][k])) == 0
        ax.plot(
            float(ds["value"][k]),
            measure.shown(of_bifurcations.values[k]),
            linestyle="none",
            marker=MARKERS[KINDS[int(ds["kind"][k])]],
            markersize=4.5 if stable else 2.8,
            markerfacecolor="white" if stable else "0.75",
            markeredgecolor=colour,
            markeredgewidth=0.7,
            zorder=8.0,
        )


def _draw_jumps(ax: Axes, ds: xr.Dataset, channel: str, measure: Measure, levels: Mapping[Any, str]) -> None:
    """Draw arrows from where a stable orbit ends to the amplitude of the orbit on which a trajectory lands."""
    to = measure.shown(ds["jump_amplitude"].sel(channel=channel).values)
    ends = ds.isel(bifurcation=ds["jump_bifurcation"])
    before = measure.shown(ends["bifurcation_amplitude"].sel(channel=channel).values)
    for k in np.flatnonzero(np.isfinite(to)):
        x, colour = float(ends["value"][k]), levels[tuple(fixed_of(ds, int(ends["of_branch"][k])).items())]
        ax.annotate("", (x, to[k]), (x, before[k]), arrowprops={**_ARROW, "color": colour}, zorder=7.0)


def _name_isolas(ax: Axes, ds: xr.Dataset, amplitude: np.ndarray) -> None:
    """Write ``isola`` above each branch that is one."""
    isolas = isolas_of(ds)
    if isolas:
        ax.margins(y=0.1)  # room for the name of the highest one
    for i in isolas:
        highest = int(np.nanargmax(amplitude[i]))
        at = float(ds["parameter"].values[i, highest]), amplitude[i, highest]
        ax.annotate(
            "isola", at, (0.0, 4.0), textcoords="offset points", ha="center", va="bottom",
            fontsize=style.look_of(ax).tick, zorder=9.0, path_effects=style.halo(1.5),
        )  # fmt: skip


def _handles(ds: xr.Dataset, levels: Mapping[Any, str], points: list[dict[str, Any]]) -> list[Line2D]:
    lines = [{**STABLE, "label": "stable"}, {**UNSTABLE, "label": "unstable"}]
    if len(levels) > 1:
        lines += [{"color": c, "label": ", ".join(f"{n} = {v:g}" for n, v in level)} for level, c in levels.items()]
    kinds = [KINDS[k] for k in sorted({int(k) for k in ds["kind"].values})]
    mark = {"linestyle": "none", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": "black"}
    lines += [{**mark, "marker": MARKERS[k], "label": f"{LABELS[k]} {NAMES[k]}"} for k in kinds]
    return style.handles([*lines, *points])


def draw(run: OpenRun, options: ResponseFigureOptions) -> style.DataFigure:
    """Draw the figure ``response`` of a run."""
    if options.harmonic > options.harmonics:
        raise SpecError(f"--harmonic {options.harmonic}: only {options.harmonics} are computed; raise --harmonics.")
    at, notes = values_of(run, options)
    points = points_of(run, options.points, options.parameter)
    found = at_levels(run.derive("response", **options.part(ResponseOptions)), at)
    chosen: dict[str, Any] = {name: getattr(options, name) for name in ("channel", "harmonic", "degrees")}
    return noted(plot_response(found, points=points, frame=frame_of(options), **chosen), notes)
