"""Draw the figures of an identification: measured and computed values, residuals, profile likelihoods, correlations."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy import stats
from scipy.interpolate import PchipInterpolator

from pipeline.layout.vocabulary import model_of
from pipeline.plots import labels, style
from pipeline.plots.figure import save_data, save_figure
from pipeline.rig.identify.statistics import LEVEL, pooled_autocorrelation
from pipeline.rig.measured.branch_figure import plot_branch

# ---- data of the residuals -------------------------------------------------------------------------


@dataclass(frozen=True)
class Series:
    """Piece in a dataset of residuals: its indices, its range of samples, and the size of its residuals."""

    # index of the recording, and of the piece in it
    recording: int
    number: int
    held_out: bool
    samples: tuple[int, int]  # first sample, and one past the last
    worst: float  # mean square of its residuals, each channel relative to its mean square over all pieces

    def of(self, ds: xr.Dataset) -> xr.Dataset:
        """Return the samples of this piece from the dataset of residuals."""
        return ds.isel(sample=slice(*self.samples))


def pieces_in(ds: xr.Dataset) -> list[Series]:
    """Return the pieces of a dataset of residuals in their order, each with its range of samples."""
    keys = np.stack([ds[name].values for name in ("held_out", "recording", "piece")])
    cuts = np.flatnonzero((np.diff(keys, axis=1) != 0).any(axis=0)) + 1
    bounds = [0, *cuts.tolist(), keys.shape[1]]
    channels = str(ds.attrs["channels"]).split()
    squares = np.stack([ds[f"{c}_residual"].values ** 2 for c in channels])
    squares = squares / np.nanmean(squares, axis=1, keepdims=True)
    return [
        Series(int(keys[1, a]), int(keys[2, a]), bool(keys[0, a]), (a, b), float(np.nanmean(squares[:, a:b])))
        for a, b in itertools.pairwise(bounds)
    ]


def per_piece(ds: xr.Dataset, channel: str) -> xr.Dataset:
    """Return the rms of a channel's residuals by piece, in the order of recordings and pieces."""
    pieces = sorted(pieces_in(ds), key=lambda s: (s.recording, s.number))
    residual = ds[f"{channel}_residual"].values
    rms = [float(np.sqrt(np.nanmean(residual[slice(*s.samples)] ** 2))) for s in pieces]
    return xr.Dataset(
        {"rms": ("number", np.array(rms))},
        coords={
            "piece": ("number", [s.number for s in pieces]),
            "recording": ("number", [s.recording for s in pieces]),
            "held_out": ("number", [int(s.held_out) for s in pieces]),
        },
    )


def rate_of(ds: xr.Dataset, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a channel's computed rates of change and its residuals at the same times, over all fitted pieces.

    Computed values have no noise, so the rates are differences of neighbours.
    """
    rates, left = [], []
    for series in pieces_in(ds):
        if series.held_out:
            continue
        own = series.of(ds)
        residual = own[f"{channel}_residual"].values
        computed = own[f"{channel}_measured"].values - residual
        rates.append(np.gradient(computed, own["time"].values))
        left.append(residual)
    rate, residual = np.concatenate(rates), np.concatenate(left)
    known = np.isfinite(rate) & np.isfinite(residual)
    return rate[known], residual[known]


def residual_views(ds: xr.Dataset, channels: list[str]) -> xr.Dataset:
    """Return what the residual plots show: autocorrelation, mean against the rate, density, rms by piece."""
    longest, n_bins = 1 / 3, 30  # longest lag of the autocorrelation in lengths of the shortest piece; bins of the rate
    fitted = [s.of(ds) for s in pieces_in(ds) if not s.held_out]
    step = float(np.median(np.diff(fitted[0]["time"].values)))
    most = max(2, int(longest * min(p.sizes["sample"] for p in fitted)))
    views = xr.Dataset(coords={"lag": ("lag", step * np.arange(most + 1), {"units": "s"})})
    for channel in channels:
        parts = [p[f"{channel}_residual"].values for p in fitted]
        unit = str(ds[f"{channel}_residual"].attrs.get("units", ""))
        n = sum(int(np.isfinite(r).sum()) for r in parts)
        band = float(stats.norm.ppf(0.5 + LEVEL / 2) / np.sqrt(n))
        rho = pooled_autocorrelation(parts, most)
        views[f"{channel}_autocorrelation"] = ("lag", rho, {"band": band, "units": "1"})
        rate, residual = rate_of(ds, channel)
        order = np.argsort(rate, kind="stable")
        bins = np.array_split(order, min(n_bins, max(1, len(order) // 5)))
        dim = f"{channel}_bin"
        views[f"{channel}_rate"] = (dim, np.array([rate[b].mean() for b in bins]), {"units": f"{unit}/s"})
        views[f"{channel}_mean"] = (dim, np.array([residual[b].mean() for b in bins]), {"units": unit})
        width = float(residual.std())
        density, edges = np.histogram(residual, bins=61, range=(-4 * width, 4 * width), density=True)
        views[f"{channel}_edges"] = (f"{channel}_edge", edges, {"units": unit})
        views[f"{channel}_density"] = (f"{channel}_box", density, {"width": width})
        rms = per_piece(ds, channel)["rms"].values
        views[f"{channel}_rms"] = ("piece_number", rms, {"units": unit})
    return views


# ---- figures ---------------------------------------------------------------------------------------


MILLI = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "rad/s": ("mrad/s", 1e3)}
"""Unit and factor in which residuals are drawn, by unit."""

SQUARE = style.Frame(width=131.0)
"""Frame of a matrix."""

FITTED, HELD = style.BLUE, style.VERMILLION


def draw_all(
    folder: Path,
    residuals: xr.Dataset,
    result: Mapping[str, Any],
    branches: Sequence[tuple[xr.Dataset, xr.Dataset, np.ndarray]] = (),
) -> list[str]:
    """Draw all figures of an identification into a folder, each with the data that it shows; return the names of the
    files.

    `branches` has for each table of measured orbits the judged orbits, the computed branches and the amplitudes of
    their orbits.
    """
    drawings: dict[str, Callable[[], style.DataFigure]] = {}
    if residuals.sizes["sample"]:
        drawings |= {"fit": lambda: plot_fit(residuals), "residuals": lambda: plot_residuals(residuals)}
    if len(result["names"]) > 1:
        drawings["correlations"] = lambda: plot_correlations(residuals.attrs, result)
    drawings |= {f"branch-{i}": partial(plot_branch, *one) for i, one in enumerate(branches) if "orbit" in one[0].sizes}
    if result["profiles"]:
        drawings["profiles"] = lambda: plot_profiles(residuals.attrs, result)
    files = []
    for name, draw in drawings.items():
        figure = draw()
        for path in (save_figure(figure, folder / f"{name}.png"), save_data(figure, folder / f"{name}.png")):
            files.append(path.name)
    return files


def _title(attrs: Mapping[Any, Any], what: str) -> str:
    simulated = "simulated recording" if attrs.get("simulated") else ""
    return style.join([str(attrs.get("title", "")), what, simulated])


def _finish(fig: style.DataFigure) -> None:
    if fig.data.attrs.get("simulated"):
        fig.text(0.012, 0.992, "simulated recording", ha="left", va="top", fontsize=fig.look.legend)
    style.finish(fig)


def _symbol(ds: xr.Dataset, channel: str) -> str:
    return labels.state_measure(ds, channel).symbol


def _milli(ds: xr.Dataset, channel: str) -> tuple[str, float]:
    unit = str(ds[f"{channel}_residual"].attrs.get("units", ""))
    return MILLI.get(unit, (unit, 1.0))


@style.drawn
def plot_fit(ds: xr.Dataset) -> style.DataFigure:
    """Draw the first piece, the worst fit, a held-out piece and the last: measured, computed, and residuals."""
    chosen = _chosen(pieces_in(ds))
    channels = str(ds.attrs["channels"]).split()
    part = xr.concat([s.of(ds) for s in chosen], "sample", join="override", combine_attrs="override")
    fig = style.new_figure(1.0 + 2.3 * len(channels), part.assign_attrs(title=_title(ds.attrs, "fit")), style.WIDE)
    grid = fig.add_gridspec(2 * len(channels), len(chosen), height_ratios=[1.7, 1.0] * len(channels))
    axes = [[fig.add_subplot(grid[row, k]) for k in range(len(chosen))] for row in range(2 * len(channels))]
    for k, series in enumerate(chosen):
        own = series.of(ds)
        for c, channel in enumerate(channels):
            _draw_piece(axes[2 * c][k], axes[2 * c + 1][k], own, channel)
        style.label_axes(axes[-1][k], "time [s]")
        held = ", held out" if series.held_out else ""
        where = f"recording {series.recording}, " if len({s.recording for s in chosen}) > 1 else ""
        axes[0][k].set_title(f"{where}piece {series.number}{held}", fontsize=fig.look.legend, pad=3.0)
    for c, channel in enumerate(channels):
        unit, _ = _milli(ds, channel)
        own_unit = str(ds[f"{channel}_measured"].attrs.get("units", ""))
        style.label_axes(axes[2 * c][0], y=labels.with_unit(_symbol(ds, channel), own_unit))
        axes[2 * c + 1][0].set_ylabel(f"residual [{unit}]", fontsize=fig.look.tick, labelpad=3.5)
        _share_range(axes[2 * c])
        _share_range(axes[2 * c + 1])
    fig.align_ylabels([row[0] for row in axes])
    dots = {"linestyle": "none", "marker": "o", "markersize": 3.0}
    style.legend_above(
        fig,
        [
            Line2D([], [], color="0.65", label="measured", **dots),  # type: ignore[arg-type]
            Line2D([], [], color=FITTED, linewidth=1.2, label="computed"),
        ],
    )
    _finish(fig)
    return fig


def _chosen(pieces: list[Series]) -> list[Series]:
    most = 4  # pieces that are drawn over the data
    fitted = [s for s in pieces if not s.held_out]
    held = [s for s in pieces if s.held_out]
    worst = max(fitted, key=lambda s: s.worst)
    wanted = [fitted[0], worst, *held[:1], fitted[-1]]
    if len(held) > 1 or not held:
        wanted.insert(2, fitted[len(fitted) // 2])
    found = list(dict.fromkeys(wanted))[:most]
    return sorted(found, key=lambda s: (s.recording, s.number))


def _draw_piece(above: Axes, below: Axes, own: xr.Dataset, channel: str) -> None:
    time = own["time"].values
    measured, left = own[f"{channel}_measured"].values, own[f"{channel}_residual"].values
    step = max(1, len(time) // 300)
    style.points(above, time[::step], measured[::step], 1.6, "0.65")
    above.plot(time, measured - left, color=FITTED, linewidth=0.8)
    below.axhline(0.0, color="0.7", linewidth=0.5)
    below.plot(time, _milli(own, channel)[1] * left, color="0.15", linewidth=0.5)
    for ax in (above, below):
        style.style_axes(ax, minor=False)
        style.few_ticks(ax, 3, 4)
        ax.set_xlim(float(time[0]), float(time[-1]))
    above.tick_params(labelbottom=False)


def _share_range(row: list[Axes]) -> None:
    low, high = min(ax.get_ylim()[0] for ax in row), max(ax.get_ylim()[1] for ax in row)
    for ax in row:
        ax.set_ylim(low, high)
    for ax in row[1:]:
        ax.tick_params(labelleft=False)


@style.drawn
def plot_residuals(ds: xr.Dataset) -> style.DataFigure:
    """Draw the residuals of each channel: autocorrelation, rms by piece, residuals against the rate, and histogram.

    Wrong friction shows in the third row: the mean residual then depends on the rate. Except in the second row, only
    fitted pieces count.
    """
    n_views = 4  # autocorrelation, by piece, against the rate, histogram
    channels = str(ds.attrs["channels"]).split()
    views = residual_views(ds, channels)
    title = _title(ds.attrs, "residuals")
    fig = style.new_figure(8.2, views.assign_attrs({**ds.attrs, "title": title}), style.WIDE)
    grid = fig.add_gridspec(n_views, len(channels))
    for c, channel in enumerate(channels):
        column = [fig.add_subplot(grid[row, c]) for row in range(n_views)]
        for ax in column:
            style.style_axes(ax, minor=False)
        unit, factor = _milli(ds, channel)
        column[0].set_title(f"residuals of {_symbol(ds, channel)}", fontsize=fig.look.label, pad=4.0)
        _draw_autocorrelation(column[0], views, channel)
        _draw_pieces(column[1], ds, channel, factor)
        _draw_against_rate(column[2], ds, views, channel, factor)
        _draw_histogram(column[3], views, channel, factor)
        style.label_axes(column[0], "lag [s]", "autocorrelation")
        style.label_axes(column[1], "piece", f"rms [{unit}]")
        style.label_axes(column[2], _rate_label(ds, channel), f"residual [{unit}]")
        style.label_axes(column[3], f"residual [{unit}]", f"density [1/{unit}]")
        fig.align_ylabels(column)
    handles = [Patch(color="0.85", label="95 % band of white residuals"), Patch(color=FITTED, label="fitted")]
    if bool((ds["held_out"] == 1).any()):
        handles.append(Patch(color=HELD, label="held out"))
    more = [
        Line2D([], [], color=style.ORANGE, marker="o", markersize=3.0, label="mean in bins of the rate"),
        Line2D([], [], color="black", linestyle="--", linewidth=0.9, label="Gaussian of the same width"),
    ]
    style.legend_above(fig, [*handles, *more], size=fig.look.tick)
    _finish(fig)
    return fig


def _rate_label(ds: xr.Dataset, channel: str) -> str:
    model = model_of(ds)
    rate = model.state(channel).rate
    if rate:
        return labels.state_measure(ds, rate).label
    return labels.with_unit(f"rate of {_symbol(ds, channel)}", f"{model.state(channel).unit}/s")


def _draw_autocorrelation(ax: Axes, views: xr.Dataset, channel: str) -> None:
    lag, rho = views["lag"].values, views[f"{channel}_autocorrelation"].values
    band = float(views[f"{channel}_autocorrelation"].attrs["band"])
    ax.axhspan(-band, band, color="0.85", linewidth=0.0)
    ax.plot(lag, rho, color=FITTED, linewidth=0.9)
    ax.set_xlim(0.0, float(lag[-1]))
    ax.set_ylim(min(-0.3, float(np.nanmin(rho)) - 0.05), 1.05)


def _draw_pieces(ax: Axes, ds: xr.Dataset, channel: str, factor: float) -> None:
    rms = per_piece(ds, channel)
    held = rms["held_out"].values == 1
    for which, colour in ((~held, FITTED), (held, HELD)):
        if which.any():
            ax.bar(np.flatnonzero(which), factor * rms["rms"].values[which], color=colour, width=0.8)
    numbers = rms["piece"].values
    step = max(1, math.ceil(len(numbers) / 12))
    ax.set_xticks(range(0, len(numbers), step), [str(n) for n in numbers[::step]])
    ax.set_xlim(-0.7, len(numbers) - 0.3)


def _draw_against_rate(ax: Axes, ds: xr.Dataset, views: xr.Dataset, channel: str, factor: float) -> None:
    most = 3000  # residuals that are drawn against the rate; the means in bins use all residuals
    rate, left = rate_of(ds, channel)
    step = max(1, len(rate) // most)
    style.points(ax, rate[::step], factor * left[::step], 1.5, "0.72", marker=".", rasterized=True)
    ax.axhline(0.0, color="0.5", linewidth=0.5)
    ax.plot(
        views[f"{channel}_rate"],
        factor * views[f"{channel}_mean"],
        color=style.ORANGE,
        marker="o",
        markersize=2.2,
        linewidth=1.0,
    )
    reach = 3.5 * factor * float(np.nanstd(left))
    ax.set_ylim(-reach, reach)


def _draw_histogram(ax: Axes, views: xr.Dataset, channel: str, factor: float) -> None:
    edges = factor * views[f"{channel}_edges"].values
    density = views[f"{channel}_density"].values / factor
    ax.stairs(density, edges, color=FITTED, fill=True, alpha=0.55)
    width = factor * float(views[f"{channel}_density"].attrs["width"])
    x = np.linspace(edges[0], edges[-1], 200)
    ax.plot(
        x,
        np.exp(-0.5 * (x / width) ** 2) / (math.sqrt(2 * math.pi) * width),
        color="black",
        linestyle="--",
        linewidth=0.9,
    )
    ax.set_xlim(edges[0], edges[-1])
    ax.set_ylim(0.0, None)


@style.drawn
def plot_profiles(attrs: Mapping[Any, Any], result: Mapping[str, Any]) -> style.DataFigure:
    """Draw the profile likelihood of each unknown, with the parabola that its standard error predicts."""
    names = [name for name in result["names"] if name in result["profiles"]]
    n_columns = min(4, len(names))
    n_rows = math.ceil(len(names) / n_columns)
    data: dict[str, Any] = {}
    for name in names:
        p = result["profiles"][name]
        for key in ("values", "growth"):
            values = np.array([np.nan if v is None else v for v in p[key]], np.float64)
            data[f"{name}_{key}"] = (f"{name}_point", values)
    title = _title(attrs, "profiles")
    fig = style.new_figure(0.7 + 1.75 * n_rows, xr.Dataset(data, attrs={**attrs, "title": title}), style.WIDE)
    critical = float(result["covariance"]["critical"])
    for k, name in enumerate(names):
        ax = fig.add_subplot(n_rows, n_columns, k + 1)
        style.style_axes(ax, minor=False)
        _draw_profile(ax, fig.data, name, result["estimates"][name], critical)
        if k % n_columns == 0:
            style.label_axes(ax, y="growth of the criterion")
    style.legend_above(
        fig,
        [
            Line2D([], [], color=FITTED, marker="o", markersize=3.0, label="profile"),
            Line2D([], [], color="black", linestyle="--", linewidth=0.9, label="by the standard error"),
            Line2D([], [], color="0.5", linewidth=0.9, linestyle=":", label="95 % threshold"),
        ],
        size=fig.look.tick,
    )
    _finish(fig)
    return fig


def _draw_profile(ax: Axes, data: xr.Dataset, name: str, estimate: Mapping[str, Any], critical: float) -> None:
    x, growth = data[f"{name}_values"].values, data[f"{name}_growth"].values
    centre = float(estimate["value"])
    scale, exponent = _engineering(float(np.nanmax(np.abs(x))))
    top = 1.6 * critical**2
    ax.axhline(critical**2, color="0.5", linewidth=0.9, linestyle=":")
    if estimate["error"]:
        error = float(estimate["error"])
        fine = np.linspace(x[0], x[-1], 200)
        ax.plot(fine * scale, ((fine - centre) / error) ** 2, color="black", linestyle="--", linewidth=0.9)
    known = np.isfinite(growth)
    ax.plot(x * scale, growth, color=FITTED, marker="o", markersize=2.6, linestyle="none")
    if known.sum() > 1:
        root = PchipInterpolator(x[known], np.sign(x[known] - centre) * np.sqrt(np.maximum(growth[known], 0)))
        fine = np.linspace(x[known][0], x[known][-1], 200)
        ax.plot(fine * scale, root(fine) ** 2, color=FITTED, linewidth=1.0)
    ax.set_ylim(min(0.0, float(np.nanmin(growth))) - 0.03 * top, top)
    style.few_ticks(ax, 3, 4)
    unit = str(estimate["unit"])
    power = rf"$10^{{{exponent}}}$ " if exponent else ""
    shown = f"{power}{labels.raised(unit)}".strip() if unit != "1" else power.strip()
    style.label_axes(ax, f"{name} [{shown}]" if shown else name)


def _engineering(size: float) -> tuple[float, int]:
    """Return the factor that scales a number to 1 to 1000, and the exponent that it removes (a multiple of 3)."""
    if not size > 0 or 1e-2 <= size < 1e4:
        return 1.0, 0
    exponent = 3 * math.floor(math.log10(size) / 3)
    return 10.0**-exponent, exponent


@style.drawn
def plot_correlations(attrs: Mapping[Any, Any], result: Mapping[str, Any]) -> style.DataFigure:
    """Draw the correlation matrix of the estimates; entries of parameters that the data do not determine stay empty."""
    names = list(result["names"])
    matrix = np.array([[_nan(result["correlations"][a][b]) for b in names] for a in names], np.float64)
    data = xr.Dataset(
        {"correlation": (("row", "column"), matrix, {"units": "1"})},
        coords={"row": names, "column": names},
        attrs={**attrs, "title": _title(attrs, "correlations")},
    )
    n = len(names)
    fig = style.new_figure(min(1.4 + 0.42 * n, 7.2), data, SQUARE)
    ax = fig.add_subplot()
    style.style_axes(ax, inside=False, minor=False)
    image = ax.imshow(matrix, cmap="PuOr", vmin=-1.0, vmax=1.0)
    ax.set_xticks(range(n), names, rotation=90 if n > 6 else 0)
    ax.set_yticks(range(n), names)
    ax.tick_params(length=0.0)
    for i in range(n):
        for j in range(n):
            value = matrix[i, j]
            shown = f"{value:.2f}".replace("-", "\N{MINUS SIGN}")
            text = "" if np.isnan(value) else shown if i != j else "1"
            strong = abs(value) > 0.7
            ax.text(
                j, i, text, ha="center", va="center", fontsize=fig.look.tick - 1.5, color="white" if strong else "black"
            )
    ax.set_title(" ", fontsize=fig.look.legend)
    style.style_bar(fig.colorbar(image, ax=ax, pad=0.02, aspect=28), "correlation of the estimates")
    _finish(fig)
    return fig


def _nan(value: float | None) -> float:
    return math.nan if value is None else value
