"""Draw measured bifurcation diagrams beside or over computed ones, and recorded time series over computed ones."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from magpend_core.models.model import Model
from pipeline.layout.vocabulary import FREQUENCY_DIM, letter, model_of
from pipeline.layout.writing import write_atomically
from pipeline.plots import labels, palette, pixels, style
from pipeline.plots.bifurcation import Diagram, with_diagram
from pipeline.plots.figure import save_data, save_figure
from pipeline.plots.palette import Motions, motions_of
from pipeline.plots.style import WIDE, Frame
from pipeline.rig.measured.comparison import edges_table
from pipeline.rig.measured.computed import Computed
from pipeline.rig.measured.diagram import steps_table
from pipeline.store.local import make_folder

LAYOUTS = ("side", "over")
_MARKERS = {"up": "^", "down": "v", "none": "o"}
_LOOKS = {"up": (1.9, 0.0), "down": (3.8, pixels.TINT), "none": (1.9, 0.0)}
SIMULATED, UNMET = "simulated rig", "0.72"


@style.drawn
def plot_measured(
    measured: xr.Dataset,
    cube: xr.Dataset | None = None,
    *,
    state: str = "",
    degrees: bool = False,
    layout: str = "side",
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw measured section points over the drive frequency: alone, or beside or over a computed diagram.

    `cube` has one value on every axis but the frequency. With the layout ``side``, measured points are left and
    computed ones right, on the same axes; with ``over``, measured points are open triangles, which show the direction
    of the sweep. The data hold the measured points (dims ``step``, ``period_index``) and, under names that end in
    ``_diagram``, the computed ones. Raise `ValueError` for an unknown layout, or a state that was not measured.
    """
    style.check_choice("layout", layout, LAYOUTS)
    names = [str(n) for n in measured["state"].values]
    state = state or names[0]
    style.check_choice("state", state, names)
    measure = labels.state_measure(measured, state, degrees)
    values = measure.shown(measured["section"].sel(state=state).values, wrap=True)
    ranges = _ranges(measured, values, cube, frame)
    framed = style.Frame(frame.width, *ranges)
    diagram = None if cube is None else Diagram.of(cube, state=state, degrees=degrees, frame=framed)
    fig = style.new_figure(4.3, _data(measured, values, measure), framed)
    beside = diagram is not None and layout == "side"
    axes = [fig.add_subplot(1, 2 if beside else 1, 1)]
    if beside:
        axes.append(fig.add_subplot(1, 2, 2, sharex=axes[0], sharey=axes[0]))
    for ax in axes:
        _dress(ax, measured, measure, ranges)
    if beside:
        axes[1].set_ylabel("")
        axes[1].tick_params(labelleft=False)
        for ax, text in zip(axes, (_rig(measured), "computed"), strict=True):
            ax.text(
                0.045,
                0.955,
                text,
                transform=ax.transAxes,
                va="top",
                fontsize=fig.look.label,
                zorder=5.0,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5},
            )
    over = diagram is not None and layout == "over"
    _draw_steps(axes[0], measured, values, over)
    motions = motions_of(measured)
    style.complete(fig, axes[0], "", _handles(measured, motions, diagram, over))
    if diagram is not None:
        drawn = diagram.draw([pixels.Panel(axes[-1], diagram.layers)])
        fig.data = with_diagram(fig.data, drawn)
    return fig


def _rig(measured: xr.Dataset) -> str:
    return SIMULATED if int(measured.attrs.get("simulated", 0)) else "measured"


def _ranges(
    measured: xr.Dataset, values: np.ndarray, cube: xr.Dataset | None, frame: style.Frame
) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """Return the ranges of the frequency axis and the state axis, which is None if a computed diagram sets it."""
    own = measured["frequency"].values
    f = own if cube is None else np.concatenate([own, np.atleast_1d(cube[FREQUENCY_DIM].values)])
    margin = 0.02 * float(np.ptp(f)) or 0.02 * float(f[0])
    x = frame.xlim or (float(f.min()) - margin, float(f.max()) + margin)
    if frame.ylim:
        return x, frame.ylim
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return x, None if cube is not None else (low - 0.05 * (high - low), high + 0.05 * (high - low))


def _data(measured: xr.Dataset, values: np.ndarray, measure: labels.Measure) -> xr.Dataset:
    about = {"units": measure.unit, "long_name": f"{measure.name} at the rising edge"}
    kept = ["orbit_period", "confidence", "side", "frequency_error_hz"]
    data = measured[[n for n in kept if n in measured]].assign(value=(("step", "period_index"), values, about))
    return data.drop_vars(["state", "state_units"], errors="ignore").assign_attrs(title="measured diagram")


def _dress(ax: Axes, measured: xr.Dataset, measure: labels.Measure, ranges: Any) -> None:
    style.style_axes(ax)
    ax.set_xlim(*ranges[0])
    if ranges[1]:
        ax.set_ylim(*ranges[1])
    style.label_axes(ax, "drive frequency [Hz]", measure.label)


def _draw_steps(ax: Axes, measured: xr.Dataset, values: np.ndarray, over: bool) -> None:
    """Draw measured section points by sweep direction and class of motion, upward sweeps on top."""
    motions = motions_of(measured)
    codes = measured["side"].values if "side" in measured else np.zeros(measured.sizes["step"], int)
    f, ways = measured["frequency"].values, measured["direction"].values.astype(str)
    for way in ("down", "none", "up"):
        for code in np.unique(codes[ways == way]):
            chosen = (ways == way) & (codes == code)
            x = np.broadcast_to(f[chosen, None], values[chosen].shape)
            shown = np.isfinite(values[chosen])
            size, tint = _LOOKS[way]
            colour = style.tinted(motions.colours[int(code)], tint)
            look: dict[str, Any] = {"marker": "o", "markersize": size, "markeredgewidth": 0.0, "color": colour}
            if over:
                look = {
                    "marker": _MARKERS[way],
                    "markersize": 3.4,
                    "markeredgewidth": 0.5,
                    "markeredgecolor": "black",
                    "markerfacecolor": "none",
                }
            ax.plot(
                x[shown],
                values[chosen][shown],
                linestyle="none",
                rasterized=True,
                zorder=3.0,
                gid=f"measured:{way}:{motions.words[int(code)]}",
                **look,
            )


def _handles(measured: xr.Dataset, motions: Motions, diagram: Diagram | None, over: bool) -> list[Any]:
    ways = [w for w in ("up", "down") if w in measured["direction"].values]
    handles: list[Any] = list(diagram.handles(layers=not over)) if diagram is not None else []
    if diagram is None and "side" in measured:
        present = set(measured["side"].values.tolist())
        handles = [style.dot(motions.words[c], motions.colours[c]) for c in motions.drawn if c in present]
    if over:
        handles += [style.dot(f"{_rig(measured)}, {w}", "black", 4.0, face="none", marker=_MARKERS[w]) for w in ways]
    elif diagram is None or len(diagram.layers) < 2:
        handles += [style.dot(w, style.tinted("black", _LOOKS[w][1]), _LOOKS[w][0] + 1.5) for w in ways]
        if diagram is None and int(measured.attrs.get("simulated", 0)):
            handles.append(Line2D([], [], linestyle="none", label=SIMULATED))
    return handles


@style.drawn
def plot_comparison(
    compared: xr.Dataset, computed: Computed, *, state: str = "", degrees: bool = False, frame: style.Frame = style.WIDE
) -> style.DataFigure:
    """Draw measured points over the computed attractors, distances in noise floors, and periods and classes of rig and
    model.

    Top: the attractors, coloured if they are nearest at some step, with the measured sections as open triangles.
    Middle: the distance from the nearest attractor in units of the noise floor, in its colour; triangles show the
    direction of the sweep. Bottom: strips of the regimes of rig and model, coloured by side, with their periods (a
    cross: unclosed). Raise `ValueError` for a state that was not measured.
    """
    names = [str(n) for n in compared["state"].values]
    state = state or names[0]
    style.check_choice("state", state, names)
    measure = labels.state_measure(compared, state, degrees)
    met = _met(compared, computed)
    ways = [w for w in ("up", "down", "none") if w in compared["direction"].values]
    fig = style.new_figure(6.4 + 0.3 * len(ways), compared, frame)
    grid = fig.add_gridspec(3, 1, height_ratios=[1.0, 0.62, 0.17 * len(ways) + 0.08])
    top = fig.add_subplot(grid[0])
    middle, bottom = (fig.add_subplot(grid[k], sharex=top) for k in (1, 2))
    for ax in (top, middle, bottom):
        style.style_axes(ax, minor=ax is not bottom)
        ax.tick_params(labelbottom=ax is bottom)
    _draw_attractors(top, computed, measure, met)
    _draw_steps(top, compared, measure.shown(compared["section"].sel(state=state).values, wrap=True), True)
    _draw_distances(middle, compared, met)
    motions = motions_of(compared)
    _draw_regimes(bottom, compared, motions, ways)
    f = np.concatenate([compared["frequency"].values, computed.frequencies])
    style.limits(top, frame, (float(f.min()) - 0.01 * np.ptp(f), float(f.max()) + 0.01 * np.ptp(f)))
    labels.angle_ticks(top, measure)
    style.label_axes(top, y=measure.label)
    style.label_axes(middle, y="distance / noise floor")
    style.label_axes(bottom, "drive frequency [Hz]")
    fig.align_ylabels([top, middle])
    style.complete(fig, top, "", _comparison_handles(compared, met, motions, ways))
    return fig


@dataclass(frozen=True)
class _Met:
    """Attractors that were nearest to the measurement at some frequency step, with colours and names."""

    colours: dict[int, str]
    names: dict[int, str]
    others: bool


def _met(compared: xr.Dataset, computed: Computed) -> _Met:
    """Return the attractors that are nearest at some step; the most frequent of each class has its colour."""
    cast, motions = palette.cast_of(computed.attractors), motions_of(compared)
    winners, sides = compared["winner"].values, compared["computed_side"].values
    ids = [int(i) for i in np.unique(winners) if i >= 0]
    spare = sorted((c for c in palette.COLOURS if c not in motions.colours), key=lambda c: sum(to_rgb(c)))
    colours: dict[int, str] = {}
    for i in sorted(ids, key=lambda i: -int((winners == i).sum())):
        side = int(np.bincount(sides[winners == i].astype(np.int64)).argmax())
        own = motions.colours[side]
        free = bool(side) and own not in colours.values() and own != style.GREY
        colours[i] = own if free else spare[len(colours) % len(spare)]
    names = {i: cast.names[i] for i in ids}
    return _Met(colours, names, len(ids) < computed.attractors.sizes["attractor"])


def _draw_attractors(ax: Axes, computed: Computed, measure: labels.Measure, met: _Met) -> None:
    """Draw the section points of all attractors; an attractor that was never nearest to the measurement is grey."""
    found = computed.attractors
    points = found["attractor_points"].sel(state=measure.name).transpose(FREQUENCY_DIM, "attractor", "point")
    values = measure.shown(points.values, wrap=True)
    for i, number in enumerate(found["attractor"].values.tolist()):
        x = np.broadcast_to(computed.frequencies[:, None], values[:, i].shape)
        kept = np.isfinite(values[:, i])
        if kept.any():
            own = number in met.colours
            style.points(
                ax,
                x[kept],
                values[:, i][kept],
                1.6 if own else 1.2,
                met.colours.get(number, UNMET),
                zorder=2.0 if own else 1.8,
                rasterized=True,
                gid=f"points:{letter(number)}",
            )


def _draw_distances(ax: Axes, compared: xr.Dataset, met: _Met) -> None:
    ax.set_yscale("log")
    ax.axhline(1.0, color="0.5", linewidth=0.7, zorder=1.0)
    f, d = compared["frequency"].values, compared["distance_in_noise"].values
    ways, winners = compared["direction"].values.astype(str), compared["winner"].values
    for way in np.unique(ways):
        for number in np.unique(winners[winners >= 0]):
            chosen = (ways == way) & (winners == number)
            face = met.colours[int(number)] if way != "down" else "white"
            ax.plot(
                f[chosen],
                d[chosen],
                linestyle="none",
                marker=_MARKERS[way],
                markersize=4.0,
                zorder=2.0,
                markeredgewidth=0.8,
                markeredgecolor=met.colours[int(number)],
                markerfacecolor=face,
                gid=f"distance:{way}:{letter(int(number))}",
            )
    known = d[np.isfinite(d)]
    if known.size:
        ax.set_ylim(min(0.5, 0.7 * float(known.min())), max(10.0, 1.6 * float(known.max())))


def _draw_regimes(ax: Axes, compared: xr.Dataset, motions: Motions, ways: Sequence[str]) -> None:
    """Draw period and class of motion as coloured strips, for each sweep direction one for rig and model each."""
    rows: list[str] = []
    for way in ways:
        chosen = np.flatnonzero(compared["direction"].values == way)
        chosen = chosen[np.argsort(compared["frequency"].values[chosen], kind="stable")]
        for who, period, side in (("rig", "orbit_period", "side"), ("model", "computed_period", "computed_side")):
            place = -len(rows)
            rows.append(f"{who}, {way}" if way != "none" else who)
            sides = compared[side].values[chosen] if side in compared else np.zeros(chosen.size, int)
            _draw_strip(
                ax, compared["frequency"].values[chosen], compared[period].values[chosen], sides, place, motions
            )
    ax.set_yticks(-np.arange(len(rows)), rows)
    ax.tick_params(axis="y", which="both", length=0.0)
    ax.set_ylim(-len(rows) + 0.4, 0.6)


def _draw_strip(ax: Axes, f: np.ndarray, periods: np.ndarray, sides: np.ndarray, place: int, motions: Motions) -> None:
    edges = style.edges(f)
    size = style.look_of(ax).tick - 1.5
    whole = float(edges[-1] - edges[0])
    keys = list(zip(periods.tolist(), sides.tolist(), strict=True))
    for (period, side), run in itertools.groupby(range(f.size), key=lambda i: keys[i]):
        if period < 0:
            continue
        members = list(run)
        low, high = edges[members[0]], edges[members[-1] + 1]
        colour = style.tinted(motions.colours[side] if side else "0.5", 0.0 if period == 0 else 0.45)
        ax.add_patch(
            Rectangle(
                (low, place - 0.42),
                high - low,
                0.84,
                facecolor=colour,
                edgecolor="white",
                linewidth=0.4,
                gid=f"regime:{period}:{side}",
            )
        )
        if high - low > 0.012 * whole:
            text, ink = (str(period), "black") if period else ("×", "white")
            ax.text(0.5 * (low + high), place - 0.03, text, ha="center", va="center", fontsize=size, color=ink)


def _comparison_handles(compared: xr.Dataset, met: _Met, motions: Motions, ways: Sequence[str]) -> list[Any]:
    handles: list[Any] = [style.dot(name, met.colours[i]) for i, name in met.names.items()]
    handles += [style.dot("not met by the rig", UNMET)] if met.others else []
    handles += [
        style.dot(f"{_rig(compared)}{', ' + w if w != 'none' else ''}", "black", 4.0, face="none", marker=_MARKERS[w])
        for w in ways
    ]
    codes = {*compared["computed_side"].values.tolist()}
    codes |= set(compared["side"].values.tolist()) if "side" in compared else set()
    handles += [
        Patch(facecolor=style.tinted(motions.colours[c], 0.45), edgecolor="none", label=motions.words[c])
        for c in motions.drawn
        if c in codes and c
    ]
    return handles


# ---- time series -----------------------------------------------------------------------------------

RIG, MODEL = "0.15", style.VERMILLION
SUFFIX = "_computed"


@style.drawn
def plot_series(ds: xr.Dataset, *, degrees: bool = False, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw measured and computed time series from `pipeline.rig.measured.series.series_of`, and their phase portraits.

    Each state has a panel with the root mean square of the difference. Raise `ValueError` if degrees are asked for
    without an angle.
    """
    model = model_of(ds)
    labels.some_angle(model, degrees, "series")
    n, m = len(model.states), len(model.portraits)
    fig = style.new_figure(max(1.25 * n, 2.4 * m) + 0.7, ds, frame)
    outer = fig.add_gridspec(1, 2, width_ratios=[1.55, 1.0])
    left, right = outer[0].subgridspec(n, 1), outer[1].subgridspec(m, 1)
    measures = {s.name: labels.state_measure(ds, s.name, degrees and s.unit.startswith("rad")) for s in model.states}
    axes = [fig.add_subplot(left[i]) for i in range(n)]
    _draw_series(axes, ds, model, measures)
    for k, pair in enumerate(model.portraits):
        ax = fig.add_subplot(right[k])
        style.style_axes(ax)
        _draw_portrait(ax, ds, [measures[name] for name in pair])
    if frame.xlim:
        axes[-1].set_xlim(*style.check_range("xlim", frame.xlim))
    fig.align_ylabels(axes)
    who = "simulated rig" if int(ds.attrs.get("simulated", 0)) else "measured"
    handles = [
        Line2D([], [], color=RIG, linewidth=1.2, label=who),
        Line2D([], [], color=MODEL, linewidth=1.2, label="computed from the same state"),
    ]
    f, begin = float(ds.attrs["frequency_hz"]), float(ds.attrs["start_s"])
    text = f"$f$ = {f:.6g}\u00a0Hz, start at {begin:.3f}\u00a0s"
    style.complete(fig, axes[0], text, handles)
    return fig


def _draw_series(axes: list[Axes], ds: xr.Dataset, model: Model, measures: dict[str, labels.Measure]) -> None:
    time, rms = ds["time"].values, json.loads(str(ds.attrs["rms"]))
    for ax, s in zip(axes, model.states, strict=True):
        if ax is not axes[-1]:
            ax.sharex(axes[-1])
            ax.tick_params(labelbottom=False)
        style.style_axes(ax)
        m = measures[s.name]
        for name, look in _looks(s.name):
            ax.plot(time, m.shown(ds[name].values), gid=f"series:{name}", **look)
        ax.set_xlim(float(time[0]), float(time[-1]))
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.25 * (high - low))  # room for the words
        ax.text(
            0.99,
            0.93,
            f"rms {rms[s.name] * m.factor:.3g} {m.unit}",
            transform=ax.transAxes,
            ha="right",
            va="top",
            fontsize=style.look_of(ax).tick - 1.0,
        )
        style.label_axes(ax, y=m.label)
        labels.angle_ticks(ax, m, most=5.0)
    style.label_axes(axes[-1], x="time [s]")


def _draw_portrait(ax: Axes, ds: xr.Dataset, pair: list[labels.Measure]) -> None:
    x, y = pair
    for (name, look), (other, _) in zip(_looks(x.name), _looks(y.name), strict=True):
        first, second = x.shown(ds[name].values), y.shown(ds[other].values)
        if x.on_circle and np.ptp(ds[name].values) > 2 * np.pi:
            first, second = labels.on_circle(ds[name].values, second)
            first = first * x.factor
        ax.plot(first, second, gid=f"portrait:{name}", **look)
    labels.angle_ticks(ax, x, "x")
    style.label_axes(ax, x.label, y.label)


def _looks(name: str) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Return variable name and line style of a state, measured, then computed: thinner and on top."""
    return (
        (name, {"color": RIG, "linewidth": 1.3, "zorder": 2.0}),
        (name + SUFFIX, {"color": MODEL, "linewidth": 0.8, "zorder": 3.0}),
    )


# ---- files -----------------------------------------------------------------------------------------


def write_comparison(
    compared: xr.Dataset,
    computed: Computed,
    folder: Path,
    *,
    state: str = "",
    degrees: bool = False,
    frame: Frame = WIDE,
) -> list[Path]:
    """Write the figures and tables of a comparison into a folder, which is made if necessary; return their paths.

    They are ``comparison``, ``beside`` and ``over`` as ``.png`` with their data as ``.nc``, ``steps.csv`` and
    ``edges.csv``.
    """
    figures = {
        "comparison": plot_comparison(compared, computed, state=state, degrees=degrees, frame=frame),
        "beside": plot_measured(compared, computed.cube, state=state, degrees=degrees, frame=frame),
        "over": plot_measured(compared, computed.cube, state=state, degrees=degrees, layout="over", frame=frame),
    }
    make_folder(folder)
    written = []
    for name, figure in figures.items():
        figure.data = figure.data.assign_attrs(run=computed.title, cube_digest=computed.digest)
        written += [save_figure(figure, folder / f"{name}.png"), save_data(figure, folder / f"{name}.nc")]
    for name, table in (("steps", steps_table(compared)), ("edges", edges_table(compared))):
        written.append(folder / f"{name}.csv")
        write_atomically(written[-1], table.csv())
    return written
