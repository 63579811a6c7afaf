"""Define the analysis ``escapes``: at which rate noisy cells leave a set, where they go, and how they get there."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy import stats

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.model import Model
from magpend_core.sizes import NOISE_PREFIX
from pipeline.analysis.noise.declaration import ESCAPES_COLUMNS, EscapeOptions
from pipeline.analysis.noise.exits import (
    Exits,
    PointCells,
    cells_at_points,
    coordinates_of,
    find_exits,
    find_passages,
    labels_of,
    point_dims,
)
from pipeline.layout.columns import on_points
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.products.product import Table
from pipeline.results.intervals import binomial_interval
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, at_point, number, points_of, unit_of, values, words_of

_IN_AND_OUT = ("inside", "outside")


_ESCAPE = (
    "n_cells",
    "n_left",
    "at_risk",
    "rate",
    "rate_low",
    "rate_high",
    "rate_halved",
    "left_share",
    "left_low",
    "left_high",
    "constant_p",
)


def needs_set(run: OpenRun, options: EscapeOptions) -> None:
    """Raise ValueError unless the options say which set cells leave, in states of the model."""
    model = run.model
    for name, given in (("low", options.low), ("high", options.high), ("centre", options.centre)):
        if unknown := [state for state in given if state not in model.state_names]:
            raise ValueError(f"{name}: {unknown[0]!r} is not a state; states: {', '.join(model.state_names)}.")
    box = bool(options.low or options.high)
    if box and options.radius is not None:
        raise ValueError("radius and low or high are given; cells leave a ball or a box: keep one.")
    if options.centre and options.radius is None:
        raise ValueError("centre is given without radius; add the radius of the ball.")
    if empty := [s for s in options.low if options.low[s] >= options.high.get(s, np.inf)]:
        raise ValueError(f"low and high of {empty[0]}: the box is empty; low must be below high.")
    if not box and options.radius is None and model.classifier is None:
        raise ValueError(
            f"{model.name} has no classifier of motions, so say which set cells leave: a box (low, high) or a ball "
            "(radius)."
        )
    if options.skip + 2 > run.spec.integration.n_keep:
        raise ValueError(
            f"skip = {options.skip} leaves less than two of {run.spec.integration.n_keep} sections; lower it."
        )


def escapes(run: OpenRun, options: EscapeOptions) -> xr.Dataset:
    """Compute rates of escape, exit places and last stretches at each parameter point.

    Returns
    -------
    Dataset
        The columns `ESCAPES_COLUMNS`. `finish_escapes` adds the fit of Kramers' law over a strength, see `KramersFit`.
        The ``interval`` at whose end exits are seen is a step for a box or a ball, and a period for a class of motion.
    """
    cube, model = run.cube(), run.model
    dims = point_dims(cube)
    words, has_region = _sets_of(model, options), _has_region(options)
    shape = tuple(cube.sizes[d] for d in dims)
    tables = _empty(shape, len(words), options.stretch, model)
    for cells in cells_at_points(cube):
        index = tuple(cells.at[d] for d in dims)
        if has_region:
            _fill(tables, (*index, 0), cells, find_passages(run, cells, options), 0, options, model)
            again = find_passages(run, cells, options, halves=True)
            tables["rate_halved"][(*index, 0)] = _rate(again, again.counted, options)[0]
            continue
        values = {FREQUENCY_DIM: _frequency(cube, cells), **cells.values}
        codes, n_transient = labels_of(model, cube)(cells.section, values), run.spec.integration.n_transient
        found = find_exits(codes, cells, options.skip, n_transient, 1.0 / values[FREQUENCY_DIM])
        for k in range(len(words)):
            _fill(tables, (*index, k), cells, found, k, options, model)
    ds = _dataset(tables, cube, dims, words, options, model)
    return ds.assign_attrs({**_attrs(cube), "confidence": options.confidence})


def finish_escapes(run: OpenRun, ds: xr.Dataset, options: EscapeOptions) -> xr.Dataset:
    """Drop the sets in which no cell of the run begins, and fit Kramers' law over all parameter points."""
    dims = [str(d) for d in ds["rate"].dims if d != "set"]
    begun = ds["n_cells"].sum(dims).values > 0
    # cells that begin outside a box or a ball are not counted
    kept = np.array([0]) if _has_region(options) else np.flatnonzero(begun)
    return _with_kramers(ds.isel(set=kept), dims, options)


def _has_region(options: EscapeOptions) -> bool:
    """Return whether cells leave a box or a ball."""
    return bool(options.low or options.high or options.radius is not None)


def _sets_of(model: Model, options: EscapeOptions) -> tuple[str, ...]:
    """Return the names of the sets: of a box or a ball its inside and outside, else the classes of motion."""
    if _has_region(options):
        return _IN_AND_OUT
    assert model.classifier is not None
    return model.classifier.words


def _frequency(cube: xr.Dataset, cells: PointCells) -> float:
    """Return the drive frequency at a point [Hz]."""
    return cells.values.get(FREQUENCY_DIM, float(cube[FREQUENCY_DIM].values.ravel()[0]))


def _attrs(cube: xr.Dataset) -> dict[str, Any]:
    kept = ("model", "parameters", "noise", "title", "source")
    return {name: cube.attrs[name] for name in kept if name in cube.attrs}


_NUMBERS = ("n_cells", "n_left", "at_risk")
_REALS = ("rate", "rate_low", "rate_high", "rate_halved", "left_share", "left_low", "left_high", "constant_p")


def _empty(shape: tuple[int, ...], n_sets: int, stretch: int, model: Model) -> dict[str, np.ndarray]:
    n = len(model.states)
    tables: dict[str, np.ndarray] = {name: np.zeros((*shape, n_sets), np.int64) for name in _NUMBERS}
    tables |= {name: np.full((*shape, n_sets), np.nan) for name in _REALS}
    tables["interval"] = np.full((*shape, n_sets), np.nan)
    tables["n_to"] = np.zeros((*shape, n_sets, n_sets), np.int64)
    tables |= {name: np.full((*shape, n_sets, n), np.nan) for name in ("exit_mean", "exit_std")}
    tables |= {name: np.full((*shape, n_sets, stretch + 1, n), np.nan) for name in ("path_mean", "path_std")}
    tables["path_n"] = np.zeros((*shape, n_sets, stretch + 1), np.int64)
    return tables


def _fill(
    tables: dict[str, np.ndarray],
    at: tuple[int, ...],
    cells: PointCells,
    found: Exits,
    code: int,
    options: EscapeOptions,
    model: Model,
) -> None:
    """Write the numbers of the cells that begin in one set at one parameter point."""
    own = found.counted & (found.begin == code)
    left = own & (found.first_out > 0)
    n, n_left, at_risk = int(own.sum()), int(left.sum()), int(found.at_risk[own].sum())
    tables["n_cells"][at], tables["n_left"][at], tables["at_risk"][at] = n, n_left, at_risk
    tables["interval"][at] = found.interval
    if not n:
        return
    for name, value in zip(_REALS[:3], _rate(found, own, options), strict=True):
        tables[name][at] = value
    low, high = binomial_interval(n_left, n, confidence=options.confidence, method="clopper-pearson")
    tables["left_share"][at], tables["left_low"][at], tables["left_high"][at] = n_left / n, low, high
    half = found.n_intervals // 2
    early = np.minimum(found.at_risk[own], half)
    n_early = int((found.at_risk[left] <= half).sum())
    tables["constant_p"][at] = constancy(n_early, n_left - n_early, int(early.sum()), at_risk - int(early.sum()))
    to, counts = np.unique(found.end[left], return_counts=True)
    for target, count in zip(to, counts, strict=True):
        if target >= 0:
            tables["n_to"][(*at, target)] = count
    place = found.place[left][np.isfinite(found.place[left]).all(axis=1)]
    if len(place):
        tables["exit_mean"][at], tables["exit_std"][at] = mean_and_spread(place, np.array(model.is_angle))
    _fill_paths(tables, at, cells.section[left], found.first_out[left] + options.skip, options.stretch, model)


def _rate(found: Exits, own: np.ndarray, options: EscapeOptions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rate of escape of some cells, and its interval [1/s]."""
    n_left, at_risk = int((own & (found.first_out > 0)).sum()), int(found.at_risk[own].sum())
    return rate_interval(np.array(n_left), np.array(at_risk), np.array(found.interval), options.confidence)


def _fill_paths(
    tables: dict[str, np.ndarray],
    at: tuple[int, ...],
    section: np.ndarray,
    first_out: np.ndarray,
    stretch: int,
    model: Model,
) -> None:
    """Write mean and spread of the sections before leaving, and of the first one after it."""
    circle = np.array(model.is_angle)
    for lag in range(stretch + 1):
        place = first_out - stretch + lag
        inside = (place >= 0) & (place < section.shape[1])
        points = section[inside, place[inside]]
        points = points[np.isfinite(points).all(axis=1)]
        tables["path_n"][(*at, lag)] = len(points)
        if len(points):
            mean, std = mean_and_spread(points, circle)
            tables["path_mean"][(*at, lag)], tables["path_std"][(*at, lag)] = mean, std


def mean_and_spread(points: np.ndarray, circle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of states, shape (n, state); of angles on the circle."""
    with np.errstate(invalid="ignore"):
        turned = np.angle(np.exp(1j * points).mean(axis=0))
        mean = np.where(circle, turned, points.mean(axis=0))
        apart = points - mean
        apart = np.where(circle, (apart + np.pi) % TWO_PI - np.pi, apart)
    return mean, np.sqrt((apart**2).mean(axis=0))


def _dataset(
    tables: dict[str, np.ndarray],
    cube: xr.Dataset,
    dims: list[str],
    words: tuple[str, ...],
    options: EscapeOptions,
    model: Model,
) -> xr.Dataset:
    coords = coordinates_of(cube, dims)
    coords |= {"set": np.arange(len(words)), "lag": np.arange(-options.stretch, 1), "state": list(model.state_names)}
    ds = xr.Dataset(on_points(ESCAPES_COLUMNS, tables, dims), coords=coords)
    ds["set"].attrs = {"flag_values": list(range(len(words))), "flag_meanings": " ".join(words)}
    return ds


_FIT = ("barrier", "barrier_low", "barrier_high", "log_factor", "n_fitted", "misfit_p")


def strength_dim(dims: list[str]) -> str | None:
    """Return the dim of a strength of the noise, if there is exactly one."""
    found = [d for d in dims if d.startswith(NOISE_PREFIX)]
    return found[0] if len(found) == 1 else None


def _with_kramers(ds: xr.Dataset, dims: list[str], options: EscapeOptions) -> xr.Dataset:
    """Add the fit of Kramers' law along the axis of a strength."""
    along = strength_dim(dims)
    if along is None:
        return ds
    others = [d for d in ds["rate"].dims if d != along]
    part = {name: ds[name].transpose(*others, along).values for name in ("n_left", "at_risk", "interval")}
    fits = np.full((len(_FIT), *part["n_left"].shape[:-1]), np.nan)
    for index in np.ndindex(*fits.shape[1:]):
        n, m, t = (part[name][index] for name in ("n_left", "at_risk", "interval"))
        fit: KramersFit = NO_FIT
        if np.isfinite(t).all():
            fit = fit_kramers(ds[along].values, n, m, t, options.confidence)
        fits[(slice(None), *index)] = fit
    return ds.assign({name: (others, value) for name, value in zip(_FIT, fits, strict=True)})


def rate_interval(
    n_events: np.ndarray, n_risked: np.ndarray, interval: np.ndarray, confidence: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a rate and its confidence interval from events that are seen at even instants, with censoring.

    `n_events` follow in `n_risked` intervals of time at whose begin a cell was still there. For a constant rate k
    the probability of an event in an interval is p = 1 - exp(-k T); the number of events is taken as Poisson's,
    with Garwood's exact interval (Biometrika 28, 437, 1936), which is conservative for the binomial number.

    Parameters
    ----------
    n_events, n_risked
        Numbers of events, and of intervals at risk, the censored ones included.
    interval
        Length T of an interval [s].
    confidence
        Two-sided level.

    Returns
    -------
    rate, low, high
        [1/s]; NaN without an interval at risk, a low end of 0 without events.
    """
    n, m, t = np.broadcast_arrays(np.asarray(n_events, float), np.asarray(n_risked, float), np.asarray(interval, float))
    tail = 0.5 * (1.0 - confidence)
    low = np.where(n > 0, stats.chi2.ppf(tail, np.maximum(2 * n, 1)) / 2, 0.0)
    high = stats.chi2.ppf(1.0 - tail, 2 * n + 2) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        rate, below, above = (-np.log1p(-np.minimum(x / m, 1.0)) / t for x in (n, low, high))
    known = m > 0
    return tuple(np.where(known, x, np.nan) for x in (rate, below, above))  # type: ignore[return-value]


def constancy(n_early: int, n_late: int, risked_early: int, risked_late: int) -> float:
    """Return the p-value of the hypothesis that the rate is the same early and late in the record; NaN without data."""
    if n_early + n_late == 0 or risked_early + risked_late == 0:
        return float("nan")
    share = risked_early / (risked_early + risked_late)
    return float(stats.binomtest(n_early, n_early + n_late, share).pvalue)


class KramersFit(NamedTuple):
    """Fit of Kramers' law, rate = factor exp(-slope/s**2), to rates over the noise's strength s.

    For dx = -U'(x) dt + s dW the slope is twice the height of the barrier of U.
    """

    slope: float
    low: float
    high: float
    log_factor: float  # of the rate in 1/s
    n_points: int
    misfit: float  # p-value of the deviance: small where the law does not hold


_NAN = float("nan")
NO_FIT = KramersFit(_NAN, _NAN, _NAN, _NAN, 0, _NAN)


def fit_kramers(
    strength: np.ndarray, n_events: np.ndarray, n_risked: np.ndarray, interval: np.ndarray, confidence: float
) -> KramersFit:
    """Fit Kramers' law by maximum likelihood, with the numbers of events as Poisson's.

    Parameters
    ----------
    strength
        Strengths of the noise; those that are 0 are left out.
    n_events, n_risked, interval, confidence
        See `rate_interval`; arrays over the strengths.

    Returns
    -------
    KramersFit
        `NO_FIT` unless three strengths have cells at risk and two of these have events. The interval of the slope
        is that of the likelihood's curvature.
    """
    events, least = 2, 3  # fewest points with an event, and fewest points, of a fit
    # most iterations, the change at which they end, and the longest step
    iterations, converged, longest = 100, 1e-12, 2.0
    strength, n, m = (np.asarray(x, np.float64) for x in (strength, n_events, n_risked))
    t = np.broadcast_to(np.asarray(interval, np.float64), n.shape)
    # where nearly every interval at risk has an event the rate is no rate any more
    use = (strength > 0) & (m > 0) & (n < 0.5 * m)
    if use.sum() < least or (n[use] > 0).sum() < events:
        return NO_FIT
    x, n = -1.0 / strength[use] ** 2, n[use]
    # -m log(1 - n/m) events of a constant rate over the whole time at risk
    exposure = m[use] * t[use] * np.where(n > 0, n / (-m[use] * np.log1p(-n / m[use]) + (n == 0)), 1.0)
    design = np.stack([np.ones_like(x), x], axis=1)
    some = n > 0
    line = np.polyfit(x[some], np.log(n[some] / exposure[some]), 1)
    beta = np.array([line[1], line[0]])
    for _ in range(iterations):
        mean = exposure * np.exp(np.clip(design @ beta, -700.0, 700.0))
        step = np.linalg.solve(design.T @ (mean[:, None] * design), design.T @ (n - mean))
        beta = beta + np.clip(step, -longest, longest)
        if np.abs(step).max() < converged * (1.0 + np.abs(beta).max()):
            break
    mean = exposure * np.exp(design @ beta)
    error = float(np.sqrt(np.linalg.inv(design.T @ (mean[:, None] * design))[1, 1]))
    z = float(stats.norm.ppf(0.5 + 0.5 * confidence))
    deviance = 2.0 * float(np.sum(np.where(some, n * np.log(np.where(some, n, 1.0) / mean), 0.0) - (n - mean)))
    misfit = float(stats.chi2.sf(deviance, len(n) - 2))
    slope = float(beta[1])
    return KramersFit(slope, slope - z * error, slope + z * error, float(beta[0]), len(n), misfit)


def escapes_table(ds: xr.Dataset) -> Table:
    """Return a row per parameter point and set: cells, cells that left, rate with interval, where they went."""
    dims = [str(d) for d in ds["rate"].dims if d != "set"]
    sets = words_of(ds["set"])
    targets = words_of(ds["set"])
    rows: list[Row] = []
    for at, where in points_of(ds, dims):
        for k in range(ds.sizes["set"]):
            one = ds.isel({**at, "set": k})
            row = {**where, "begins": sets[int(one["set"])], **values(one, *_ESCAPE)}
            row |= {f"to_{word}": int(n) for word, n in zip(targets, one["n_to"].values, strict=False)}
            row |= {f"exit_{s}": float(one["exit_mean"].sel(state=s)) for s in ds["state"].values.tolist()}
            rows.append(row)
    level = f"{100 * ds.attrs['confidence']:g} %"
    looked = "in every step" if np.isfinite(ds["rate_halved"]).any() else "at the sections"
    lines = [
        f"escapes, looked for {looked}, intervals of {level}",
        *aligned([_escape_words(ds, row, dims) for row in rows]),
    ]
    lines += [line for row in rows if (line := _uneven_line(ds, row, dims))]
    lines += _kramers_lines(ds, dims)
    return Table(rows, lines, "" if any(row["n_cells"] for row in rows) else "no cell begins in the set")


def _escape_words(ds: xr.Dataset, row: Row, dims: list[str]) -> Words:
    to = ", ".join(f"{n} {key[3:]}" for key, n in row.items() if key.startswith("to_") and n)
    mean = 1.0 / row["rate"] if 0.0 < row["rate"] < np.inf else np.nan
    interval = f"{number(row['rate_low'], '.3g')} to {number(row['rate_high'], '.3g')}"
    halved = {} if np.isnan(row["rate_halved"]) else {"halved steps": number(row["rate_halved"], ".4g")}
    return {
        **at_point(ds, row, dims),
        "begins": row["begins"],
        "cells": str(row["n_cells"]),
        "left": str(row["n_left"]),
        "to": to or "-",
        "rate [1/s]": number(row["rate"], ".4g"),
        "interval": interval,
        **halved,
        "mean time [s]": number(mean, ".4g"),
    }


def _uneven_line(ds: xr.Dataset, row: Row, dims: list[str]) -> str:
    """Return a warning if cells leave at another rate early in the record than late."""
    uneven = 0.01  # level below which a rate counts as changing along the record
    if not row["constant_p"] < uneven:
        return ""
    place = ", ".join(f"{d} {row[d]:g}{unit_of(ds, d)}" for d in dims)
    return (
        f"  warning: {place or 'here'}: the rate early in the record differs from that late in it "
        f"(p = {row['constant_p']:.1g}); raise n_transient or --skip, or the set holds more than one attractor"
    )


def _kramers_lines(ds: xr.Dataset, dims: list[str]) -> list[str]:
    """Return the lines on the fit of Kramers' law."""
    if "barrier" not in ds:
        return []
    along = strength_dim(dims)
    others = [d for d in dims if d != along]
    lines = []
    for at, where in points_of(ds, others):
        for k in range(ds.sizes["set"]):
            one = ds.isel({**at, "set": k})
            place = ", ".join(f"{d} {v:g}{unit_of(ds, d)}" for d, v in where.items())
            head = f"  {place + ': ' if place else ''}{words_of(ds['set'])[int(one['set'])]}: "
            if not np.isfinite(float(one["barrier"])):
                lines.append(f"{head}no fit of Kramers' law: three strengths are needed, two of them with escapes")
                continue
            value, low, high = (float(one[name]) for name in ("barrier", "barrier_low", "barrier_high"))
            lines.append(
                f"{head}rate = {np.exp(float(one['log_factor'])):.4g} /s exp(-{value:.4g}/{along}²), exponent "
                f"{low:.4g} to {high:.4g}, {int(one['n_fitted'])} strengths, misfit p = {float(one['misfit_p']):.2g}"
            )
    return lines
