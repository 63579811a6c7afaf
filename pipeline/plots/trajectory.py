"""Time series and phase portraits of one trajectory."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import AutoMinorLocator

from pipeline.plots import style

_COLOURS = {"1": style.BLUE, "2": style.VERMILLION}
_STATES = ("psi1", "psi2", "psi1_dot", "psi2_dot")


def plot_trajectory(ds: xr.Dataset) -> Figure:
    """Draw the time series of a trajectory, and a phase portrait of each link.

    Parameters
    ----------
    ds
        `psi1`, `psi2` [rad] and `psi1_dot`, `psi2_dot` [rad/s] over `time` [s], with steps that are short
        against a turn; `torque` [N m] of the drive is drawn if it is there. The stroboscopic section is
        marked at the coordinate or variable `section_times` [s] or, without it, at the whole periods of
        the attribute `frequency_hz`; without either, it is not marked.

    Returns
    -------
    Figure
        7 in wide. The portrait of a link that turns over is drawn on the circle, from -pi to pi.

    Raises
    ------
    ValueError
        If a state is missing, or there are no two points of time.
    """
    _check(ds)
    time = np.asarray(ds["time"].values, dtype=np.float64)
    series = {name: np.asarray(ds[name].values, dtype=np.float64) for name in _STATES}
    for name in ("psi1", "psi2"):
        series[name] = np.unwrap(series[name])
    strobe = _section_times(ds, time)
    fig = style.new_figure(4.6)
    rows = 3 if "torque" in ds else 2
    grid = fig.add_gridspec(
        1, 2, width_ratios=[1.35, 1.0], left=0.085, right=0.985, bottom=0.1, top=0.93, wspace=0.24
    )
    left = grid[0].subgridspec(rows, 1, hspace=0.07, height_ratios=[1.0, 1.0, 0.5][:rows])
    right = grid[1].subgridspec(2, 1, hspace=0.32)
    _draw_series([fig.add_subplot(left[i]) for i in range(rows)], ds, time, series)
    for i, link in enumerate("12"):
        _draw_portrait(fig.add_subplot(right[i]), link, time, series, strobe)
    _legend(fig, bool(strobe.size))
    style.style_text(fig)
    return fig


def _check(ds: xr.Dataset) -> None:
    missing = [name for name in (*_STATES, "time") if name not in ds]
    if missing:
        raise ValueError(f"a trajectory needs {', '.join((*_STATES, 'time'))}; missing: {', '.join(missing)}")
    if ds.sizes["time"] < 2:
        raise ValueError(
            f"a trajectory needs at least two points of time, and this one has {ds.sizes['time']}"
        )


def _section_times(ds: xr.Dataset, time: np.ndarray) -> np.ndarray:
    """Instants of the stroboscopic section within the time series [s]."""
    if "section_times" in ds:
        times = np.asarray(ds["section_times"].values, dtype=np.float64)
    elif "frequency_hz" in ds.attrs:
        frequency = float(ds.attrs["frequency_hz"])
        slack = 1e-9 * (abs(time[0]) + abs(time[-1])) * frequency
        first, last = math.ceil(time[0] * frequency - slack), math.floor(time[-1] * frequency + slack)
        times = np.clip(np.arange(first, last + 1) / frequency, time[0], time[-1])
    else:
        return np.zeros(0)
    inside = (times >= time[0]) & (times <= time[-1])
    return np.asarray(times[inside])


def _draw_series(axes: list[Axes], ds: xr.Dataset, time: np.ndarray, series: dict[str, np.ndarray]) -> None:
    for ax, suffix, label in zip(axes, ("", "_dot"), ("angle [rad]", "rate [rad/s]"), strict=False):
        for link, colour in _COLOURS.items():
            ax.plot(
                time,
                series[f"psi{link}{suffix}"],
                color=colour,
                linewidth=0.8,
                gid=f"series:psi{link}{suffix}",
            )
        ax.set_ylabel(label, fontsize=style.LABEL_PT)
    if "torque" in ds:
        torque = np.asarray(ds["torque"].values, dtype=np.float64)
        axes[-1].plot(time, torque, color="0.2", linewidth=0.8, gid="series:torque")
        axes[-1].set_ylabel("torque [N m]", fontsize=style.LABEL_PT)
    for ax in axes:
        style.style_axes(ax)
        ax.set_xlim(float(time[0]), float(time[-1]))
        ax.margins(y=0.08)
        ax.xaxis.set_minor_locator(AutoMinorLocator())
        ax.yaxis.set_minor_locator(AutoMinorLocator(2))
        ax.tick_params(labelbottom=ax is axes[-1])
    low, high = axes[0].get_ylim()
    style.set_angle_ticks(axes[0], low, high, degrees=False)
    axes[-1].set_xlabel("time [s]", fontsize=style.LABEL_PT)
    axes[0].figure.align_ylabels(axes)


def _draw_portrait(
    ax: Axes, link: str, time: np.ndarray, series: dict[str, np.ndarray], strobe: np.ndarray
) -> None:
    angle, rate = series[f"psi{link}"], series[f"psi{link}_dot"]
    points = np.interp(strobe, time, angle), np.interp(strobe, time, rate)
    turns = bool(np.ptp(angle) >= 2.0 * math.pi)
    line = on_circle(angle, rate) if turns else (angle, rate)
    ax.plot(*line, color=_COLOURS[link], linewidth=0.7, gid=f"portrait:psi{link}")
    if strobe.size:
        ax.plot(
            wrapped(points[0]) if turns else points[0], points[1],
            linestyle="none", marker="o", markersize=3.6, color="black",
            markeredgecolor="white", markeredgewidth=0.5, gid=f"section:psi{link}", zorder=3,
        )  # fmt: skip
    if turns:
        ax.set_xlim(-math.pi, math.pi)
    style.style_axes(ax)
    ax.margins(0.06)
    low, high = ax.get_xlim()
    style.set_angle_ticks(ax, low, high, degrees=False, axis="x")
    ax.set_xlabel(style.state_label(f"psi{link}"), fontsize=style.LABEL_PT, labelpad=2.0)
    ax.set_ylabel(style.state_label(f"psi{link}_dot"), fontsize=style.LABEL_PT, labelpad=2.0)
    ax.xaxis.set_minor_locator(AutoMinorLocator(2))
    ax.yaxis.set_minor_locator(AutoMinorLocator(2))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Bring angles to [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def on_circle(angle: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wrap the angle and break the line where it leaves one edge and enters at the other."""
    folded = wrapped(angle)
    jumps = np.flatnonzero(np.abs(np.diff(folded)) > math.pi) + 1
    return np.insert(folded, jumps, np.nan), np.insert(rate, jumps, np.nan)


def _legend(fig: Figure, with_section: bool) -> None:
    handles = [
        Line2D([], [], color=colour, linewidth=1.2, label=f"link {link}") for link, colour in _COLOURS.items()
    ]
    if with_section:
        handles.append(
            Line2D(
                [],
                [],
                linestyle="none",
                marker="o",
                markersize=3.6,
                color="black",
                label="once per drive period",
            )
        )
    fig.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(0.99, 0.93), ncols=3, frameon=False,
        fontsize=style.LEGEND_PT, borderpad=0.2, handlelength=1.6, columnspacing=1.2,
    )  # fmt: skip
