"""Draw a fit of torque curves, after Figs. 6 to 9 of Wojna et al., J. Sound Vib. 430 (2018).

Fig. 6: torque curves, each with a fitted bump. Fig. 7: parameters of the bumps over the locked angle. Fig. 8:
the fitted torque over both angles. Fig. 9: the fit and point dipoles against the readings. Each function
takes an Outcome and returns a figure with its data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.plots import style
from pipeline.plots.figure import save_data, save_figure, with_provenance
from pipeline.rig.magnet.fitting import Outcome
from pipeline.rig.magnet.measurement import SAME_ANGLE
from pipeline.store.provenance import provenance, versions

FINE = 241
"""Points of a computed curve."""


COLOURS = (style.BLUE, style.SKY, style.GREEN, style.ORANGE, style.VERMILLION)
MARKERS = ("o", "s", "D", "^", "v")
SIDE_COLOURS = (style.VERMILLION, style.BLUE)
"""Colours of the right and the left side."""

_ANGLE, _LOCKED = (f"${laws.SYMBOLS[name]}$ [deg]" for name in (laws.ANGLE, laws.LOCKED))
_TORQUE = f"${laws.SYMBOLS['torque']}$ [N m]"
_FIT, _BUMP = "fit (Eq. 19)", "bump (Eq. 17)"
_NAMES = {"fit": _FIT, "dipoles": "point dipoles (Eq. 16)"}
_MODELS: dict[str, tuple[str, Any, str]] = {"fit": ("black", "-", "o"), "dipoles": (style.VERMILLION, (0, (4, 2)), "x")}
"""Colour, dash and marker by model."""


@style.drawn
def draw_curves(outcome: Outcome, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the measured torque curves of some locked angles, each with its fitted bump (as Fig. 6 of Wojna et al.
    2018).

    Filled points are right of the fixed magnet, open ones left of it.
    """
    n_shown = 5  # locked angles whose curves are drawn
    m, shown = outcome.measured, _spread(outcome, n_shown)
    drawn = [fit for fit in outcome.curves if _place(shown, fit.curve.locked) is not None]
    fine = np.array([_fine(m.angle[fit.curve.rows]) for fit in drawn])
    bumps = np.array([laws.bump(at, *fit.values.values()) for at, fit in zip(fine, drawn, strict=True)])
    rows = np.concatenate([fit.curve.rows for fit in drawn])
    data = _readings(outcome, rows).assign(
        fine_angle=(("curve", "fine"), np.degrees(fine), {"units": "deg"}),
        bump=(("curve", "fine"), bumps, {"units": "N m", "long_name": _BUMP}),
        curve_locked=("curve", [np.degrees(fit.curve.locked) for fit in drawn], {"units": "deg"}),
        curve_side=("curve", [fit.curve.side for fit in drawn], {"meaning": "0 right, 1 left"}),
    )
    figure = style.new_figure(3.9, data, frame)
    ax = _axes(figure, _ANGLE, _TORQUE)
    for at, bump, fit in zip(fine, bumps, drawn, strict=True):
        place = _place(shown, fit.curve.locked) or 0
        ax.plot(np.degrees(at), bump, color=COLOURS[place], linewidth=1.0)
        _points(ax, m.angle[fit.curve.rows], m.torque[fit.curve.rows], place, fit.curve.side)
    handles: list[Any] = [style.dot(_degrees(v), COLOURS[i], 4.0, marker=MARKERS[i]) for i, v in enumerate(shown)]
    handles[0].set_label(f"${laws.SYMBOLS[laws.LOCKED]}$ = {handles[0].get_label()}")
    handles += [
        style.dot("right", "0.3", 4.0),
        style.dot("left", "0.3", 4.0, face="white"),
        Line2D([], [], color="0.3", linewidth=1.0, label=_BUMP),
    ]
    ax.axhline(0.0, color="0.75", linewidth=0.7, zorder=0)
    return _done(figure, ax, outcome, handles)


@style.drawn
def draw_numbers(outcome: Outcome, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw height, position and width of the fitted bumps against the locked angle, with the laws fitted to these
    values (as Fig. 7 of Wojna et al. 2018).

    Bars are standard errors. Full lines are the laws through the points; dashed lines are the joint fit's.
    """
    fine = _fine(outcome.measured.locked)
    figure = style.new_figure(3.1, _numbers(outcome, fine), frame)
    grid = figure.subplots(1, 3)
    looks = (
        (laws.HEIGHT, "$|A|$ [N m]", 1.0),
        (laws.POSITION, "$b$ [deg]", 180.0 / np.pi),
        (laws.WIDTH, "$c$ [deg]", 180.0 / np.pi),
    )
    for ax, (name, label, factor) in zip(grid, looks, strict=True):
        style.style_axes(ax)
        style.label_axes(ax, _LOCKED, label)
        for side, colour in enumerate(SIDE_COLOURS):
            own = figure.data.sel(curve=figure.data["curve_side"] == side)
            sign = -1.0 if name == laws.HEIGHT and side else 1.0
            ax.errorbar(
                own["curve_locked"],
                sign * factor * own[name],
                factor * own[f"{name}_error"],
                fmt=MARKERS[side],
                color=colour,
                markersize=3.2,
                linewidth=0.7,
                markeredgewidth=0.7,
                markerfacecolor=colour if side == 0 else "white",
            )
            for kind, dash in (("law", "-"), ("joint", (0, (4, 2)))):
                values = sign * factor * figure.data[f"{name}_{kind}"][side]
                ax.plot(figure.data["fine_locked"], values, color=colour, linewidth=0.9, linestyle=dash)
    grid[0].set_ylim(bottom=0.0)
    handles: list[Any] = [
        style.dot("right", SIDE_COLOURS[0], 4.0),
        style.dot("left", SIDE_COLOURS[1], 4.0, face="white", marker=MARKERS[1]),
        Line2D([], [], color="0.3", linewidth=0.9, label="laws through the points"),
        Line2D([], [], color="0.3", linewidth=0.9, linestyle=(0, (4, 2)), label="joint fit"),
    ]
    style.caption(grid[0], "")
    return _done(figure, grid[0], outcome, handles, short=True)


@style.drawn
def draw_map(outcome: Outcome, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the fitted torque over both angles, with its zeros and the readings (as Fig. 8 of Wojna et al. 2018)."""
    edge = 0.03  # margin of a map beyond the readings [rad]
    m, values = outcome.measured, outcome.joint.values
    angle, locked = (np.linspace(a.min() - edge, a.max() + edge, FINE) for a in (m.angle, m.locked))
    torque = laws.magnet_moment(angle, locked[:, None], values)
    data = _readings(outcome, np.arange(len(m.torque))).assign(
        torque_map=(("fine_locked", "fine_angle"), torque, {"units": "N m", "long_name": _FIT}),
        fine_angle=("fine_angle", np.degrees(angle), {"units": "deg"}),
        fine_locked=("fine_locked", np.degrees(locked), {"units": "deg"}),
        transition=("fine_locked", np.degrees(np.polyval(laws.transition(values), locked)), {"units": "deg"}),
    )
    figure = style.new_figure(4.0, data, frame)
    ax = _axes(figure, _ANGLE, _LOCKED, inside=False)
    top = float(np.abs(torque).max())
    image = ax.pcolormesh(
        data["fine_angle"], data["fine_locked"], torque, cmap="RdBu_r", vmin=-top, vmax=top, rasterized=True
    )
    ax.scatter(data["angle"], data["locked"], s=1.2, color="0.25", linewidths=0.0)
    ax.plot(data["transition"], data["fine_locked"], color="black", linewidth=1.1)
    ax.set_xlim(*np.degrees(angle[[0, -1]]))
    ax.set_ylim(*np.degrees(locked[[0, -1]]))
    bar = figure.colorbar(image, ax=ax, pad=0.02)
    style.style_bar(bar, f"{_TORQUE}, {_FIT}")
    handles = [Line2D([], [], color="black", linewidth=1.1, label="transition"), style.dot("readings", "0.25", 2.5)]
    return _done(figure, ax, outcome, handles)


@style.drawn
def draw_comparison(outcome: Outcome, frame: style.Frame = style.WIDE) -> style.DataFigure:
    """Draw the joint fit and point dipoles against the readings (as Fig. 9 of Wojna et al. 2018)."""
    n_shown = 3  # locked angles whose curves are drawn
    shown = _spread(outcome, n_shown)
    figure = style.new_figure(4.4, _comparison(outcome, shown), frame)
    grid = figure.subplots(2, len(shown), sharex="col", sharey="row", height_ratios=[1.5, 1.0], squeeze=False)
    data = figure.data
    for column, locked in enumerate(shown):
        upper, lower = grid[:, column]
        own = data.isel(reading=np.abs(data["locked"].values - np.degrees(locked)) < np.degrees(SAME_ANGLE))
        for name, (colour, dash, marker) in _MODELS.items():
            upper.plot(data["fine_angle"][column], data[name][column], color=colour, linewidth=1.0, linestyle=dash)
            lower.plot(
                own["angle"],
                own[f"left_by_{name}"],
                linestyle="none",
                marker=marker,
                markersize=2.6,
                color=colour,
                markeredgewidth=0.7,
            )
        upper.plot(own["angle"], own["torque"], linestyle="none", marker="o", markersize=2.8, color=style.BLUE)
        text = f"${laws.SYMBOLS[laws.LOCKED]}$ = {_degrees(locked)}"
        upper.set_title(text, fontsize=figure.look.legend)
        for ax in (upper, lower):
            style.style_axes(ax)
            ax.axhline(0.0, color="0.75", linewidth=0.7, zorder=0)
        style.label_axes(lower, x=_ANGLE)
    style.label_axes(grid[0, 0], y=_TORQUE)
    style.label_axes(grid[1, 0], y="left over [N m]")
    r2 = {"fit": f"{outcome.joint.quality.r2:.4f}", "dipoles": f"{outcome.dipoles.quality.r2:.3f}"}
    handles: list[Any] = [style.dot("readings", style.BLUE, 4.0)]
    for name, (colour, dash, marker) in _MODELS.items():
        label = f"{_NAMES[name]}, $R^2$ = {r2[name]}"
        handles.append(
            Line2D([], [], color=colour, linewidth=1.0, linestyle=dash, marker=marker, markersize=3, label=label)
        )
    return _done(figure, grid[0, 0], outcome, handles, short=True)


FIGURES: dict[str, Callable[..., style.DataFigure]] = {
    "fig6": draw_curves,
    "fig7": draw_numbers,
    "fig8": draw_map,
    "fig9": draw_comparison,
}
"""Functions that draw, by the name of the file."""


def write_figures(outcome: Outcome, folder: Path) -> list[Path]:
    """Draw all figures of a torque fit, and write them with their data into an existing folder."""
    written = []
    for name, draw in FIGURES.items():
        figure = draw(outcome)
        m = outcome.measured
        origin = {"figure": name, "file": m.header.file, "sha256": m.digest, "model": m.header.model}
        figure.data = with_provenance(figure.data, {**origin, "versions": versions(), **provenance()})
        written += [save_figure(figure, folder / f"{name}.png"), save_data(figure, folder / f"{name}.png")]
    return written


# ---- parts ---------------------------------------------------------------------------------------


def _spread(outcome: Outcome, n: int) -> list[float]:
    every = sorted(fit.curve.locked for fit in outcome.curves)
    angles = [a for a, b in zip(every, [*every[1:], np.inf], strict=True) if b - a > SAME_ANGLE]
    return [angles[i] for i in np.unique(np.linspace(0, len(angles) - 1, n).round().astype(int))]


def _place(shown: Sequence[float], locked: float) -> int | None:
    near = np.flatnonzero(np.abs(np.array(shown) - locked) < SAME_ANGLE)
    return int(near[0]) if near.size else None


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.4g}°".replace("-", "\N{MINUS SIGN}")


def _fine(angles: np.ndarray) -> np.ndarray:
    return np.linspace(float(angles.min()), float(angles.max()), FINE)


def _readings(outcome: Outcome, rows: np.ndarray) -> xr.Dataset:
    m = outcome.measured
    variables = {
        "angle": (np.degrees(m.angle), "deg", laws.ANGLE),
        "locked": (np.degrees(m.locked), "deg", laws.LOCKED),
        "side": (m.side, "1", "0 right, 1 left"),
        "torque": (m.torque, "N m", "torque of the magnets, corrected"),
        "left_by_fit": (outcome.joint.residuals, "N m", "torque less the joint fit's"),
        "left_by_dipoles": (outcome.dipoles.residuals, "N m", "torque less the point dipoles'"),
    }
    return xr.Dataset(
        {
            name: ("reading", values[rows], {"units": unit, "long_name": text})
            for name, (values, unit, text) in variables.items()
        },
        attrs={"title": m.label, "synthetic": int(m.header.synthetic)},
    )


def _numbers(outcome: Outcome, fine: np.ndarray) -> xr.Dataset:
    """Return height, position and width of the bumps, and their laws over the locked angle."""
    curves = outcome.curves
    variables: dict[str, Any] = {
        "curve_locked": ("curve", [np.degrees(f.curve.locked) for f in curves], {"units": "deg"}),
        "curve_side": ("curve", [f.curve.side for f in curves], {"meaning": "0 right, 1 left"}),
        "fine_locked": ("fine", np.degrees(fine), {"units": "deg"}),
    }
    for name, unit in ((laws.HEIGHT, "N m"), (laws.POSITION, "rad"), (laws.WIDTH, "rad")):
        variables[name] = ("curve", [f.values[name] for f in curves], {"units": unit})
        variables[f"{name}_error"] = ("curve", [f.errors[name] for f in curves], {"units": unit})
    for kind, values in (("law", outcome.laws.values), ("joint", outcome.joint.values)):
        both = [_laws_at(fine, values, i) for i in (1, 2)]
        for name in both[0]:
            variables[f"{name}_{kind}"] = (("side", "fine"), [one[name] for one in both])
    m = outcome.measured
    return xr.Dataset(variables, attrs={"title": m.label, "synthetic": int(m.header.synthetic)})


def _laws_at(locked: np.ndarray, values: dict[str, float], i: int) -> dict[str, np.ndarray]:
    return {
        laws.HEIGHT: laws.bump(locked, values[f"alpha{i}"], values[f"beta{i}"], values[f"gamma{i}"]),
        laws.POSITION: values[f"p{i}"] * locked + values[f"r{i}"],
        laws.WIDTH: np.full_like(locked, values[f"c{i}"]),
    }


def _comparison(outcome: Outcome, shown: Sequence[float]) -> xr.Dataset:
    """Return readings at some locked angles, with the torques of the fit and of dipoles on a fine grid."""
    m = outcome.measured
    own = [np.flatnonzero(np.abs(m.locked - locked) < SAME_ANGLE) for locked in shown]
    fine = np.array([_fine(m.angle[rows]) for rows in own])
    at = np.array(shown)[:, None]
    known = {**m.parameters, **outcome.dipoles.values}
    return _readings(outcome, np.concatenate(own)).assign(
        fine_angle=(("shown", "fine"), np.degrees(fine), {"units": "deg"}),
        shown_locked=("shown", np.degrees(shown), {"units": "deg"}),
        fit=(("shown", "fine"), laws.magnet_moment(fine, at, outcome.joint.values), {"units": "N m"}),
        dipoles=(("shown", "fine"), laws.dipole_moment(fine, at, known), {"units": "N m"}),
    )


def _axes(figure: style.DataFigure, x: str, y: str, *, inside: bool = True) -> Axes:
    ax = figure.add_subplot()
    style.style_axes(ax, inside=inside)
    style.label_axes(ax, x, y)
    return ax


def _points(ax: Axes, angle: np.ndarray, torque: np.ndarray, place: int, side: int) -> None:
    ax.plot(
        np.degrees(angle),
        torque,
        linestyle="none",
        marker=MARKERS[place],
        markersize=3.2,
        color=COLOURS[place],
        markerfacecolor=COLOURS[place] if side == 0 else "white",
        markeredgewidth=0.7,
    )


def _done(
    figure: style.DataFigure, ax: Axes, outcome: Outcome, handles: list[Any], *, short: bool = False
) -> style.DataFigure:
    text = outcome.measured.label
    if short:
        figure.suptitle(
            style.folded(text, figure.frame.width_in - 0.6, figure.look.legend),
            fontsize=figure.look.legend,
            x=0.01,
            ha="left",
        )
        style.legend_below(figure, handles)
        style.finish(figure)
    else:
        style.caption(ax, text)
        style.legend_below(figure, handles)
        style.finish(figure)
    return figure
