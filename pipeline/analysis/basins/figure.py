"""Draw planes of initial states: basins of attraction, edge states, stable and unstable manifolds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, LogNorm, to_rgb
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from pipeline.analysis.basins.declaration import BasinFigureOptions
from pipeline.layout.vocabulary import INFERRED, PERIODIC_ORBIT, grid_dim, model_of
from pipeline.plots import labels, palette, style
from pipeline.plots.figure import frame_of, noted, values_of
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.results.selection import choose, start_dims

_DARKEST = 0.62
_OTHERS = -1
_FIRST_GREY = -2


@style.drawn
def plot_basins(
    attractors: xr.Dataset,
    *,
    at: Mapping[str, float] | None = None,
    degrees: bool = False,
    n_periods: xr.DataArray | None = None,
    frame: style.Frame = style.WIDE,
) -> style.DataFigure:
    """Draw the basins of attraction in a plane of initial states, with one colour per attractor.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match` for a sweep over a grid of initial states.
    at
        Values of all other axes, for example ``{"frequency": 2.2}`` [units of the axis].
    degrees
        Degrees instead of radians.
    n_periods
        Drive periods or returns that each cell of the same cube took. If given, cells that took longer to
        close are darker, on a logarithmic scale from the 1st to the 99th percentile. Inferred cells were not
        integrated and keep the plain colour.
    frame
        Width of the figure and ranges of its axes.

    Returns
    -------
    DataFigure
        Cells that end on no attractor are grey, with the reason. The legend gives each basin's share of the cells
        drawn that end on attractors or diverge, as the table of basins does, and the number of the others. Its `data`
        hold ``attractor_id``, ``status`` and ``outcome`` of the cells drawn, and ``n_periods`` if drawn.

    Raises
    ------
    ValueError
        If the cells are not on a grid of two initial states or more, or an axis is left
        without a value in `at`.
    """
    axes = _axes(attractors, at)
    part = dense(choose(attractors, at, axes, f"an image of basins has the axes {' and '.join(axes)}"))
    data = part[["attractor_id", "status"]].transpose(*reversed(axes))
    data["outcome"] = outcomes(part).transpose(*reversed(axes)).assign_attrs(units="1", long_name="outcome")
    if n_periods is not None:
        times = choose(n_periods.to_dataset(name="attractor_id"), at, axes, "an image has two axes")
        data["n_periods"] = times["attractor_id"].transpose(*reversed(axes))
    cast = palette.cast_of(attractors, part)
    codes, counts = _codes(data, part, axes, cast)
    fig, ax = palette.new_panel(_stored(data, part, cast), _entries(cast, counts), frame, 4.7)
    scale = _scale(data, part)
    ax.imshow(
        _painted(codes, data, part, cast, scale),
        origin="lower",
        extent=_extent(data, attractors, axes, degrees),
        aspect="equal" if _is_square(data, attractors, axes) and not (frame.xlim or frame.ylim) else "auto",
        interpolation="nearest",
        gid="basins",
    )
    style.limits(ax, frame)
    _dress(ax, attractors, axes, degrees)
    if scale is not None:
        _draw_scale(fig, ax, scale, model_of(attractors).clock.periods)
    style.complete(fig, ax, labels.caption(part, drop=axes))
    _write_letters(ax, codes, cast)
    return fig


def _write_letters(ax: Axes, codes: np.ndarray, cast: palette.Cast) -> None:
    left, right, bottom, top = ax.get_images()[0].get_extent()
    row, column = (
        np.clip(((np.arange(400) + 0.5) / 400 * (b - a) + a - low) / (high - low) * n, 0, n - 1).astype(int)
        for (a, b), low, high, n in (
            (ax.get_ylim(), bottom, top, codes.shape[0]),
            (ax.get_xlim(), left, right, codes.shape[1]),
        )
    )
    palette.write_letters(ax, codes[np.ix_(row, column)], cast.main)


def _axes(attractors: xr.Dataset, at: Mapping[str, float] | None) -> tuple[str, str]:
    """Return the dims of the image's horizontal and vertical axis; ValueError unless two are left."""
    dims = start_dims(attractors)
    grid = [grid_dim(name) for name in model_of(attractors).state_names if grid_dim(name) in dims]
    if len(grid) < 2:
        have = ", ".join(start_dims(attractors)) or "none"
        raise ValueError(
            f"an image of basins needs a grid over two initial states, and the initial states lie along: "
            f'{have}; run a sweep with initial_conditions kind = "grid"'
        )
    left = [d for d in grid if d not in (at or {})]
    long = [d for d in left if attractors.sizes[d] > 1]
    chosen = long if len(long) >= 2 else left
    if len(chosen) != 2:
        raise ValueError(
            f"an image of basins has two axes, and {len(chosen)} of the initial states are left: "
            f"{', '.join(chosen) or 'none'}; choose values of the others of {', '.join(grid)}, "
            f"such as {grid[-1]}={float(attractors[grid[-1]].values[0]):g}"
        )
    return chosen[0], chosen[1]


def _codes(
    data: xr.Dataset, part: xr.Dataset, axes: tuple[str, str], cast: palette.Cast
) -> tuple[np.ndarray, dict[int, int]]:
    """Return the code of each cell (an attractor id, or a negative code), and the number of cells of each code."""
    ids, dims = np.maximum(data["outcome"].values, -1), part["attractor_id"].dims
    table = np.full(len(cast.names) + 1, _OTHERS, np.int32)
    table[list(cast.main)] = cast.main
    codes = table[ids]
    others = palette.other_cells(part)
    for k, name in enumerate(palette.GREYS):
        if name in others:
            which = xr.DataArray(others[name], dims=dims).transpose(*reversed(axes))
            codes[which.values] = _FIRST_GREY - k
    found, counts = np.unique(codes, return_counts=True)
    return codes, dict(zip(found.tolist(), counts.tolist(), strict=True))


def _colour_table(cast: palette.Cast) -> np.ndarray:
    """Return RGB by code, shape (codes, 3): attractor ids first; negative codes count from the end."""
    greys = list(reversed(palette.GREYS.values()))
    colours = [*(cast.colours[i] for i in range(len(cast.names))), *greys, palette.OTHERS]
    return np.array([to_rgb(c) for c in colours], dtype=np.float32)


def _painted(
    codes: np.ndarray, data: xr.Dataset, part: xr.Dataset, cast: palette.Cast, scale: LogNorm | None
) -> np.ndarray:
    table = np.round(255.0 * _colour_table(cast)).astype(np.uint8)
    picture = table[codes]
    if scale is not None:
        decided = _timed(data, part)
        dark = np.clip(scale(data["n_periods"].values[decided].astype(np.float32)), 0.0, 1.0)
        factor = (1.0 - _DARKEST * np.asarray(dark, np.float32))[:, None]
        picture[decided] = np.round(picture[decided] * factor).astype(np.uint8)
    return np.asarray(picture)


def _timed(data: xr.Dataset, part: xr.Dataset) -> np.ndarray:
    """Return which cells have a known convergence time: those that were integrated and ended on a periodic orbit."""
    closed = np.append(part["kind"].values == PERIODIC_ORBIT, False)
    ids = np.maximum(data["outcome"].values, -1)
    return np.asarray(closed[ids] & (data["status"].values != INFERRED))


def _scale(data: xr.Dataset, part: xr.Dataset) -> LogNorm | None:
    if "n_periods" not in data:
        return None
    times = data["n_periods"].values[_timed(data, part)]
    if not times.size:
        return None
    low, high = (max(float(x), 1.0) for x in np.percentile(times, [1.0, 99.0]))
    return LogNorm(low, high if high > low else low + 1.0)


def _extent(
    data: xr.Dataset, attractors: xr.Dataset, axes: tuple[str, str], degrees: bool
) -> tuple[float, float, float, float]:
    x, y = (
        labels.start_measure(attractors, d, degrees).shown(style.edges(data[d].values.astype(np.float64))) for d in axes
    )
    return float(x[0]), float(x[-1]), float(y[0]), float(y[-1])


def _is_square(data: xr.Dataset, attractors: xr.Dataset, axes: tuple[str, str]) -> bool:
    left, right, bottom, top = _extent(data, attractors, axes, False)
    units = {labels.start_measure(attractors, d).unit for d in axes}
    return len(units) == 1 and bool(np.isclose(right - left, top - bottom, rtol=0.02))


def _dress(ax: Axes, attractors: xr.Dataset, axes: tuple[str, str], degrees: bool) -> None:
    labels.some_angle(model_of(attractors), degrees, "initial states")
    x, y = (labels.start_measure(attractors, name, degrees) for name in axes)
    style.label_axes(ax, x.label, y.label)
    labels.angle_ticks(ax, x, "x")
    labels.angle_ticks(ax, y, "y")


def _entries(cast: palette.Cast, counts: Mapping[int, int]) -> list[tuple[str, str]]:
    total = sum(counts.values())
    own = [i for i in cast.order if i in counts]
    entries = [(f"{cast.names[i]}, {palette.percent(counts[i] / total)}", cast.colours[i]) for i in own]
    if _OTHERS in counts:
        n = len(cast.names) - len(cast.main)
        entries.append((f"{n} others, {palette.percent(counts[_OTHERS] / total)}", palette.OTHERS))
    for k, name in enumerate(palette.GREYS):
        if (code := _FIRST_GREY - k) in counts:
            entries.append((f"{name}, {palette.percent(counts[code] / total)}", palette.GREYS[name]))
    return entries


def _draw_scale(fig: style.DataFigure, ax: Axes, scale: LogNorm, periods: str) -> None:
    ramp = LinearSegmentedColormap.from_list("time", [(0.85,) * 3, (0.85 * (1.0 - _DARKEST),) * 3])
    bar = fig.colorbar(ScalarMappable(scale, ramp), ax=ax, orientation="horizontal", shrink=0.6, aspect=24, pad=0.02)
    bar.ax.set_gid("time")
    style.style_bar(bar, f"{periods} to converge")
    bar.ax.xaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 3.0, 5.0, 7.0), numticks=12))
    bar.ax.xaxis.set_major_formatter(ScalarFormatter())
    bar.ax.xaxis.set_minor_locator(NullLocator())


def _stored(data: xr.Dataset, part: xr.Dataset, cast: palette.Cast) -> xr.Dataset:
    stored = data.reset_coords(drop=True).assign(share=part["share"].variable)
    stored = stored.assign_coords(attractor=part["attractor"].variable, name=("attractor", list(cast.names.values())))
    scalars = {k: v for k, v in part.coords.items() if v.ndim == 0 and v.dtype.kind == "f"}
    stored = stored.assign_coords(scalars)
    stored.attrs = {"title": "basins of attraction"}
    return stored


def draw_basins(run: OpenRun, options: BasinFigureOptions) -> style.DataFigure:
    """Draw the figure ``basins`` of a run."""
    at, notes = values_of(run, options)
    found = run.derive("attractors")
    times = run.cube()["n_periods"] if options.shade else None
    figure = plot_basins(found, at=at, degrees=options.degrees, n_periods=times, frame=frame_of(options))
    return noted(figure, notes)
