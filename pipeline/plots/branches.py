"""Branches of periodic orbits: over the brute-force diagram, their multipliers, curves of bifurcations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import AutoMinorLocator

from pipeline.plots import style
from pipeline.plots.bifurcation import plot_bifurcation

KINDS = ("fold", "period_doubling", "neimark_sacker", "branch_point")
_MARKERS = {"fold": "^", "period_doubling": "s", "neimark_sacker": "o", "branch_point": "D"}
_SHORT = {"fold": "F", "period_doubling": "PD", "neimark_sacker": "NS", "branch_point": "BP"}
_NAMES = {
    "fold": "fold", "period_doubling": "period doubling", "neimark_sacker": "Neimark-Sacker",
    "branch_point": "branch point",
}  # fmt: skip
_COLOURS = {"fold": style.BLUE, "period_doubling": style.VERMILLION, "neimark_sacker": style.GREEN}
_DASHES: dict[int, Any] = {1: "-", 2: (0, (6, 2)), 3: (0, (1, 1.2)), 4: (0, (5, 1.5, 1, 1.5))}
_LEFT = 1  # of pipeline.analysis.sides.Side
_STABLE: dict[str, Any] = {"color": "black", "linewidth": 1.3, "linestyle": "-", "zorder": 6.0}
_UNSTABLE: dict[str, Any] = {"color": "0.3", "linewidth": 0.7, "linestyle": (0, (4, 2)), "zorder": 5.0}


def plot_branches(
    ds: xr.Dataset,
    cube: xr.Dataset | None = None,
    *,
    state: str = "psi1",
    max_period: int | None = None,
    degrees: bool = False,
) -> Figure:
    """Draw section points of periodic orbits over the parameter: solid stable, dashed unstable.

    Bifurcations are marked; those at which a stable orbit is born or lost bear their name and period,
    such as PD1.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    cube
        Sweep or continuation over the same parameter, drawn below.
    state
        ``psi1``, ``psi2``, ``psi1_dot`` or ``psi2_dot``.
    max_period
        Longest period drawn; by default all.
    degrees
        Degrees instead of radians.

    Returns
    -------
    Figure
        7 in wide.

    Raises
    ------
    ValueError
        For an unknown state, and as `plot_bifurcation` for the cube.
    """
    style.check_choice("state", state, [str(name) for name in ds["state"].values])
    if cube is None:
        fig = style.new_figure(4.3)
        ax = fig.add_axes((0.095, 0.115, 0.88, 0.81))
        style.style_axes(ax)
        ax.set_ylabel(style.state_label(state, degrees), fontsize=style.LABEL_PT)
        ax.xaxis.set_minor_locator(AutoMinorLocator())
    else:
        fig = plot_bifurcation(cube, state=state, degrees=degrees)
        ax = fig.axes[0]
        _make_room(fig)
    limits = None if cube is None else (ax.get_xlim(), ax.get_ylim())
    chosen = [
        i for i in range(ds.sizes["branch"]) if max_period is None or int(ds["orbit_period"][i]) <= max_period
    ]
    factor = 180.0 / np.pi if degrees else 1.0
    for i in chosen:
        for x, y, stable in _pieces(ds, i, state):
            ax.plot(x, factor * y, **(_STABLE if stable else _UNSTABLE))
    _mark(ax, ds, chosen, state, factor)
    if limits is None:
        ax.set_xlabel(
            _label(str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"])), fontsize=style.LABEL_PT
        )
    else:
        ax.set_xlim(limits[0])
        ax.set_ylim(limits[1])
    _legend(ax, ds, chosen)
    style.style_text(fig)
    return fig


def _make_room(fig: Figure) -> None:
    """Lower the diagram's axes by a line of text, for a second legend."""
    for ax in fig.axes:
        box = ax.get_position()
        low, high = ((y - 0.115) * 0.94 + 0.115 for y in (box.y0, box.y1))
        ax.set_position((box.x0, low, box.width, high - low))


def _label(parameter: str, units: str) -> str:
    if parameter == "frequency_hz":
        return "drive frequency [Hz]"
    return f"{parameter} [{units}]" if units else parameter


def _pieces(ds: xr.Dataset, branch: int, state: str) -> Iterator[tuple[np.ndarray, np.ndarray, bool]]:
    """Polylines of one stability of a branch, one for each point of the orbit, cut where an angle wraps."""
    n = int(ds["n_points"][branch])
    period = int(ds["orbit_period"][branch])
    x = ds["parameter"].values[branch, :n]
    y = ds["section"].sel(state=state).values[branch, :n, :period]
    stable = ds["n_unstable"].values[branch, :n] == 0
    here = np.flatnonzero(ds["of_branch"].values == branch)
    own = ds.isel(bifurcation=here)
    after = own["after"].values
    # located points end one piece and begin the next
    x = np.insert(x, after + 1, own["value"].values)
    y = np.insert(y, after + 1, own["bifurcation_section"].sel(state=state).values[:, :period], axis=0)
    located = np.insert(np.zeros(n, bool), after + 1, True)
    stable = np.insert(stable, after + 1, False)
    is_solid = (stable[:-1] | located[:-1]) & (stable[1:] | located[1:]) & (stable[:-1] | stable[1:])
    edges = np.flatnonzero(np.diff(is_solid)) + 1
    for first, stop in zip([0, *edges], [*edges, len(is_solid)], strict=True):
        if stop <= first:
            continue
        solid = bool(is_solid[first])
        for k in range(period):
            values = y[first : stop + 1, k].copy()
            jumps = np.flatnonzero((np.abs(np.diff(values)) > np.pi) & style.is_angle(state)) + 1
            yield np.insert(x[first : stop + 1], jumps, np.nan), np.insert(values, jumps, np.nan), solid


def _mark(ax: Axes, ds: xr.Dataset, chosen: list[int], state: str, factor: float) -> None:
    """Put markers on bifurcations, and names where a stable orbit is born or lost."""
    names = []
    for k in range(ds.sizes["bifurcation"]):
        branch = int(ds["of_branch"][k])
        if branch not in chosen:
            continue
        kind, period = KINDS[int(ds["kind"][k])], int(ds["orbit_period"][branch])
        x = float(ds["value"][k])
        y = factor * ds["bifurcation_section"].sel(state=state).values[k, :period]
        stable = min(int(ds["n_unstable_before"][k]), int(ds["n_unstable_after"][k])) == 0
        ax.plot(
            np.full(period, x), y, linestyle="none", marker=_MARKERS[kind], markersize=4.5 if stable else 2.8,
            markerfacecolor="white" if stable else "0.75", markeredgecolor="black", markeredgewidth=0.7,
            zorder=8.0 if stable else 7.0,
        )  # fmt: skip
        if stable:
            # left orbits lie below right ones
            below = int(ds["bifurcation_side"][k]) == _LEFT
            names.append((period, x, float(y.min()), float(y.max()), below, f"{_SHORT[kind]}{period}"))
    _name(ax, sorted(names))


def _name(ax: Axes, names: list[tuple[int, float, float, float, bool, str]]) -> None:
    """Write names above or below their points, where no other name stands; short periods first."""
    ax.margins(y=0.08)
    ax.autoscale_view()
    taken: list[np.ndarray] = []
    for _, x, low, high, below, text in names:
        places = [(low, -4.5), (high, 4.5)] if below else [(high, 4.5), (low, -4.5)]
        for y, offset in [*places, *((y, 2.9 * o) for y, o in places)]:
            spot = ax.transData.transform((x, y)) * 72.0 / style.DPI + (0.0, 1.8 * offset)
            if all(abs(spot[0] - t[0]) > 17.0 or abs(spot[1] - t[1]) > 9.0 for t in taken):
                taken.append(spot)
                ax.annotate(
                    text, (x, y), (0, offset), textcoords="offset points", ha="center",
                    va="top" if offset < 0 else "bottom", fontsize=7.0, zorder=9.0,
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.4, "alpha": 0.75},
                )  # fmt: skip
                break


def _legend(ax: Axes, ds: xr.Dataset, chosen: list[int]) -> None:
    own = np.isin(ds["of_branch"].values, chosen)
    present = {KINDS[int(code)] for code in ds["kind"].values[own]}
    handles = [
        Line2D([], [], label="stable", **{k: v for k, v in _STABLE.items() if k != "zorder"}),
        Line2D([], [], label="unstable", **{k: v for k, v in _UNSTABLE.items() if k != "zorder"}),
        *(
            Line2D(
                [], [], linestyle="none", marker=_MARKERS[kind], markersize=4.5, markerfacecolor="white",
                markeredgecolor="black", markeredgewidth=0.7, label=f"{_SHORT[kind]} {_NAMES[kind]}",
            )
            for kind in KINDS
            if kind in present
        ),
    ]  # fmt: skip
    # above the axes on the left: the diagram's own legend is on the right
    legend = ax.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.01, 0.995), ncols=len(handles), frameon=False,
        fontsize=7.5, handletextpad=0.3, columnspacing=0.9, borderpad=0.2, handlelength=1.6,
    )  # fmt: skip
    legend.set_in_layout(False)


def plot_multipliers(ds: xr.Dataset, branch: int = 0) -> Figure:
    """Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches`.
    branch
        Which one.

    Returns
    -------
    Figure
        7 in wide; multipliers of modulus beyond 2 are left out, and their number is stated.

    Raises
    ------
    ValueError
        If there is no such branch.
    """
    if not 0 <= branch < ds.sizes["branch"]:
        raise ValueError(
            f"branch = {branch} is out of bounds: there are branches 0 to {ds.sizes['branch'] - 1}."
        )
    n = int(ds["n_points"][branch])
    z = (ds["multiplier_real"] + 1j * ds["multiplier_imag"]).values[branch, :n]
    x = np.repeat(ds["parameter"].values[branch, :n, None], z.shape[1], axis=1)
    fig = style.new_figure(4.8)
    ax = fig.add_axes((0.09, 0.11, 0.5623, 0.82))
    style.style_axes(ax)
    ax.add_patch(Circle((0.0, 0.0), 1.0, fill=False, edgecolor="0.5", linewidth=0.8))
    shown = np.abs(z) <= 2.0
    points = ax.scatter(
        z.real[shown], z.imag[shown], c=x[shown], s=6.0, cmap="cividis", linewidths=0.0, zorder=3
    )
    here = np.flatnonzero(ds["of_branch"].values == branch)
    critical = (ds["critical_real"] + 1j * ds["critical_imag"]).values[here]
    for k, mu in zip(here, critical, strict=True):
        kind = KINDS[int(ds["kind"][k])]
        for value in {mu, mu.conjugate()} if kind == "neimark_sacker" else {mu}:
            ax.plot(
                value.real, value.imag, marker=_MARKERS[kind], markersize=5.5, markerfacecolor="none",
                markeredgecolor=style.VERMILLION, markeredgewidth=1.0, linestyle="none", zorder=4,
            )  # fmt: skip
    _list_crossings(fig, ds, here, critical)
    reach = max(1.15, float(np.abs(np.stack([z.real[shown], z.imag[shown]])).max()) * 1.05)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    for axis in (ax.axhline, ax.axvline):
        axis(0.0, color="0.8", linewidth=0.5, zorder=0)
    ax.set_xlabel(r"Re $\mu$", fontsize=style.LABEL_PT)
    ax.set_ylabel(r"Im $\mu$", fontsize=style.LABEL_PT)
    missing = int((~shown).sum())
    title = f"branch {branch}, period {int(ds['orbit_period'][branch])}"
    ax.set_title(title + (f"; {missing} beyond |μ| = 2" if missing else ""), fontsize=style.LABEL_PT)
    box = ax.get_position()
    bar = fig.colorbar(points, cax=fig.add_axes((0.69, box.y0, 0.025, box.height)))
    bar.set_label(
        _label(str(ds.attrs["parameter"]), str(ds.attrs["parameter_units"])), fontsize=style.LABEL_PT
    )
    bar.ax.tick_params(labelsize=style.TICK_PT)
    style.style_text(fig)
    return fig


def _list_crossings(fig: Figure, ds: xr.Dataset, here: np.ndarray, critical: np.ndarray) -> None:
    """List the bifurcations of the branch on the right, tori with the angle of their multiplier."""
    handles = []
    for i in np.argsort(ds["value"].values[here], kind="stable"):
        kind = KINDS[int(ds["kind"][here[i]])]
        text = f"{_SHORT[kind]} {float(ds['value'][here[i]]):.4f}"
        if kind == "neimark_sacker":
            text += f", {np.degrees(np.angle(critical[i])):.0f}°"
        look: dict[str, Any] = {
            "marker": _MARKERS[kind],
            "markeredgecolor": style.VERMILLION,
            "markerfacecolor": "none",
        }
        handles.append(Line2D([], [], linestyle="none", markersize=5.0, label=text, **look))
    if handles:
        fig.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(0.815, 0.94), frameon=False, fontsize=7.5,
            handletextpad=0.2, borderpad=0.2,
        )  # fmt: skip


def plot_curves(ds: xr.Dataset) -> Figure:
    """Draw curves of bifurcations in the plane of two parameters.

    Parameters
    ----------
    ds
        From `pipeline.analysis.branches.curves_dataset`.

    Returns
    -------
    Figure
        7 in wide: colour for the kind, dashes for the period.
    """
    fig = style.new_figure(4.3)
    ax = fig.add_axes((0.095, 0.115, 0.88, 0.80))
    style.style_axes(ax)
    ax.xaxis.set_minor_locator(AutoMinorLocator())
    seen: dict[tuple[int, str], Line2D] = {}
    for i in range(ds.sizes["curve"]):
        n, period, kind = int(ds["n_points"][i]), int(ds["orbit_period"][i]), KINDS[int(ds["kind"][i])]
        (line,) = ax.plot(
            ds["first"].values[i, :n], ds["second"].values[i, :n], color=_COLOURS[kind],
            linestyle=_DASHES.get(period, _DASHES[4]), linewidth=1.2,
            label=f"{_NAMES[kind]}, period {period}",
        )  # fmt: skip
        seen.setdefault((period, kind), line)
    ax.set_xlabel(
        _label(str(ds.attrs["first_parameter"]), str(ds["first"].attrs["units"])), fontsize=style.LABEL_PT
    )
    ax.set_ylabel(
        _label(str(ds.attrs["second_parameter"]), str(ds["second"].attrs["units"])), fontsize=style.LABEL_PT
    )
    ax.legend(
        handles=[seen[key] for key in sorted(seen)], loc="lower left", bbox_to_anchor=(-0.01, 0.995), ncols=3,
        frameon=False, fontsize=7.5, handlelength=2.4, columnspacing=1.0, borderpad=0.2,
    )  # fmt: skip
    style.style_text(fig)
    return fig
