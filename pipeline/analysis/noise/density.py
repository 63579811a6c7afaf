"""Estimate the density of noisy section points, its moments, and the number of its peaks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.status import Status
from pipeline.analysis.noise.declaration import DENSITY_COLUMNS, DensityOptions
from pipeline.analysis.noise.escapes import mean_and_spread
from pipeline.analysis.noise.exits import PointCells, cells_at_points, coordinates_of, point_dims
from pipeline.layout.columns import on_points
from pipeline.layout.vocabulary import model_of
from pipeline.products.product import Table
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, at_point, number, points_of, values

MOST_PEAKS = 16
"""Most peaks whose places are kept."""


class Peaks(NamedTuple):
    """Peaks of a smoothed density: bandwidth, density on the bins' centres, places from the highest on."""

    bandwidth: float
    smoothed: np.ndarray
    places: np.ndarray


def effective_number(values: np.ndarray) -> float:
    """Return the number of independent points with the same standard error of the mean.

    The cells are independent; within a cell the autocorrelation is summed up to its first negative value.

    Parameters
    ----------
    values
        Shape (cell, section).
    """
    n_cells, n = values.shape
    apart = values - values.mean()
    variance = float((apart**2).mean())
    if n < 2 or variance == 0.0:
        return float(values.size)
    padded = np.fft.rfft(apart, 2 * n, axis=1)
    lagged = np.fft.irfft(np.abs(padded) ** 2, 2 * n, axis=1)[:, :n].sum(axis=0) / (n_cells * np.arange(n, 0, -1))
    rho = lagged / variance
    stop = int(np.argmax(rho < 0.0)) if (rho < 0.0).any() else n
    return float(values.size) / max(1.0 + 2.0 * float(rho[1:stop].sum()), 1.0)


def silverman_bandwidth(values: np.ndarray, n_effective: float) -> float:
    """Return the bandwidth of a Gaussian kernel by Silverman's rule: 0.9 min(s, IQR/1.34) n**(-1/5).

    Silverman, Density Estimation for Statistics and Data Analysis, 1986, eq. (3.31); with the effective number of
    points, since successive sections of a cell depend on each other.
    """
    q1, q3 = np.percentile(values, [25.0, 75.0])
    spreads = [s for s in (float(values.std()), float(q3 - q1) / 1.34) if s > 0.0]
    return float(0.9 * min(spreads, default=0.0) * n_effective**-0.2)


def find_density_peaks(
    density: np.ndarray, width: float, bandwidth: float, prominence: float, on_circle: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth a histogram by a Gaussian kernel; return it and the bins of its peaks, from the highest on.

    Parameters
    ----------
    density
        On even bins of the width `width`.
    bandwidth
        Of the kernel; at least half a bin is used.
    prominence
        Least height of a peak above the higher of its valleys, as a share of the highest peak.
    on_circle
        Whether the last bin and the first are neighbours.
    """
    sigma = max(bandwidth / width, 0.5)
    smoothed = gaussian_filter1d(density, sigma, mode="wrap" if on_circle else "constant", truncate=6.0)
    n = len(smoothed)
    # a peak at the end of the range has a valley beyond it
    around = np.concatenate([smoothed] * 3) if on_circle else np.concatenate([[0.0], smoothed, [0.0]])
    found, _ = find_peaks(around, prominence=prominence * smoothed.max() if smoothed.max() > 0 else None)
    bins = np.unique(found[(found >= n) & (found < 2 * n)] - n) if on_circle else found - 1
    return smoothed, bins[np.argsort(-smoothed[bins], kind="stable")]


def density(run: OpenRun, options: DensityOptions) -> xr.Dataset:
    """Compute the density of a state's section points at each parameter point, moments and peaks.

    Returns
    -------
    Dataset
        The columns `DENSITY_COLUMNS`.
    """
    cube, model = run.cube(), model_of(run.cube())
    state = options.state or model.state_names[0]
    if state not in model.state_names:
        raise ValueError(f"state {state!r} is not one of {', '.join(model.state_names)}")
    number = model.state_names.index(state)
    on_circle = model.is_angle[number]
    edges = _edges(cube, options, number, on_circle)
    dims = point_dims(cube)
    shape = tuple(cube.sizes[d] for d in dims)
    tables = _empty(shape, options.bins, len(model.states))
    for cells in cells_at_points(cube):
        _fill(tables, tuple(cells.at[d] for d in dims), cells, options, number, edges, np.array(model.is_angle))
    coords = coordinates_of(cube, dims) | {
        "value": 0.5 * (edges[1:] + edges[:-1]),
        "state": list(model.state_names),
        "other_state": list(model.state_names),
    }
    ds = xr.Dataset(on_points(DENSITY_COLUMNS, tables, dims), coords=coords)
    ds["value"].attrs["long_name"] = model.state(state).meaning
    kept = ("model", "parameters", "noise", "title", "source")
    about = {name: cube.attrs[name] for name in kept if name in cube.attrs}
    return ds.assign_attrs({**about, "density_of": state, "prominence": options.prominence})


def _points(cells: PointCells, skip: int) -> np.ndarray:
    """Return the counted section points of the cells that did not diverge, shape (cell, section, state)."""
    return np.asarray(cells.section[cells.status == Status.BOUNDED, skip:])


def _edges(cube: xr.Dataset, options: DensityOptions, number: int, on_circle: bool) -> np.ndarray:
    """Return the edges of the bins, the same for all parameter points."""
    beyond = 0.05  # margin of the histogram on either side, as a share of the range of all points
    if options.skip >= cube.sizes["period_index"]:
        raise ValueError(f"skip = {options.skip} leaves none of {cube.sizes['period_index']} sections; lower it")
    if on_circle:
        return np.linspace(-np.pi, np.pi, options.bins + 1)
    low, high = np.inf, -np.inf
    for cells in cells_at_points(cube):
        values = _points(cells, options.skip)[..., number]
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    if not np.isfinite(low):
        raise ValueError("no cell has section points")
    margin = beyond * (high - low) or 0.5
    return np.linspace(low - margin, high + margin, options.bins + 1)


def _empty(shape: tuple[int, ...], n_bins: int, n_states: int) -> dict[str, np.ndarray]:
    reals = ("n_effective", "bandwidth", "variance", "skewness", "kurtosis")
    tables: dict[str, np.ndarray] = {name: np.full(shape, np.nan) for name in reals}
    tables |= {name: np.zeros(shape, np.int64) for name in ("n_points", "n_peaks")}
    tables |= {name: np.full((*shape, n_bins), np.nan) for name in ("density", "smoothed")}
    tables["peak"] = np.full((*shape, MOST_PEAKS), np.nan)
    tables["mean"] = np.full((*shape, n_states), np.nan)
    tables["covariance"] = np.full((*shape, n_states, n_states), np.nan)
    return tables


def _fill(
    tables: dict[str, Any],
    at: tuple[int, ...],
    cells: PointCells,
    options: DensityOptions,
    number: int,
    edges: np.ndarray,
    circle: np.ndarray,
) -> None:
    """Write the density, the moments and the peaks of one parameter point."""
    points = _points(cells, options.skip)
    flat = points.reshape(-1, points.shape[-1])
    tables["n_points"][at] = len(flat)
    if not len(flat):
        return
    mean, spread = mean_and_spread(flat, circle)
    apart = flat - mean
    apart = np.where(circle, (apart + np.pi) % TWO_PI - np.pi, apart)
    tables["mean"][at], tables["covariance"][at] = mean, apart.T @ apart / len(flat)
    own = apart[:, number]
    variance = float(spread[number] ** 2)
    tables["variance"][at] = variance
    if variance > 0.0:
        tables["skewness"][at] = (own**3).mean() / variance**1.5
        tables["kurtosis"][at] = (own**4).mean() / variance**2 - 3.0
    n_effective = effective_number(own.reshape(points.shape[:2]))
    bandwidth = options.bandwidth * silverman_bandwidth(own, n_effective)
    counts, _ = np.histogram(flat[:, number], edges)
    width = float(edges[1] - edges[0])
    share = counts / (len(flat) * width)
    smoothed, bins = find_density_peaks(share, width, bandwidth, options.prominence, bool(circle[number]))
    tables["density"][at], tables["smoothed"][at] = share, smoothed
    tables["n_effective"][at], tables["bandwidth"][at], tables["n_peaks"][at] = n_effective, bandwidth, len(bins)
    places = 0.5 * (edges[bins] + edges[bins + 1])[:MOST_PEAKS]
    tables["peak"][(*at, slice(0, len(places)))] = places


_DENSITY = ("n_points", "n_effective", "variance", "skewness", "kurtosis", "bandwidth", "n_peaks")


def density_table(ds: xr.Dataset) -> Table:
    """Return a row per parameter point: points, moments, bandwidth, number and places of the peaks."""
    dims = [str(d) for d in ds["n_peaks"].dims]
    state = str(ds.attrs["density_of"])
    rows: list[Row] = []
    for at, where in points_of(ds, dims):
        one = ds.isel(at)
        row = {**where, "state": state, "mean": float(one["mean"].sel(state=state)), **values(one, *_DENSITY)}
        rows.append(row | {"peaks": [float(x) for x in one["peak"].values if np.isfinite(x)]})
    rule = "Silverman's rule with the effective number of points"
    lines = [f"density of {state} at the sections; bandwidth by {rule}"]
    lines += aligned([_density_words(ds, row, dims) for row in rows])
    for row in rows:
        row["peaks"] = " ".join(f"{x:.6g}" for x in row["peaks"])
    return Table(rows, lines)


def _density_words(ds: xr.Dataset, row: Row, dims: list[str]) -> Words:
    return {
        **at_point(ds, row, dims),
        "points": str(row["n_points"]),
        "independent": number(row["n_effective"], ".0f"),
        "mean": number(row["mean"], ".4g"),
        "variance": number(row["variance"], ".4g"),
        "skewness": number(row["skewness"], ".2f"),
        "kurtosis": number(row["kurtosis"], ".2f"),
        "bandwidth": number(row["bandwidth"], ".2g"),
        "peaks": f"{row['n_peaks']}: {', '.join(f'{x:.3g}' for x in sorted(row['peaks']))}",
    }
