"""Compute at which rate noisy cells leave a set, where they go, and the stretch of sections before."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models.model import Model
from magpend_core.sizes import NOISE_PREFIX
from pipeline.analysis.intervals import binomial_interval
from pipeline.analysis.noise.cells import PointCells, cells_at_points, coordinates_of, point_dims
from pipeline.analysis.noise.exits import Exits, find_exits, labels_of
from pipeline.analysis.noise.passages import find_passages
from pipeline.analysis.noise.rates import NO_FIT, KramersFit, constancy, fit_kramers, rate_interval
from pipeline.analysis.run import OpenRun
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.products.noise import EscapeOptions

_IN_AND_OUT = ("inside", "outside")


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
        Over the parameter points, and over ``set`` (in which cells begin): ``n_cells``, ``n_left``, ``n_to`` (by
        the set they go to), ``at_risk`` [intervals], ``rate``, ``rate_low``, ``rate_high`` and, of a box or a
        ball, ``rate_halved`` with halved steps [1/s], ``left_share`` with its interval, ``constant_p``,
        ``exit_mean`` and ``exit_std`` of each state; ``path_mean`` and ``path_std`` by section before leaving.
        `finish_escapes` adds, over a strength, ``barrier`` and so on, see `rates.KramersFit`. The ``interval`` at
        whose end exits are seen is a step for a box or a ball, and a period for a class of motion.
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


def finish_escapes(ds: xr.Dataset, options: EscapeOptions) -> xr.Dataset:
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
    own: dict[str, tuple[str, ...]] = {
        "n_to": ("to",),
        "exit_mean": ("state",),
        "exit_std": ("state",),
        "path_n": ("lag",),
    }
    own |= {"path_mean": ("lag", "state"), "path_std": ("lag", "state")}
    units = {"interval": "s", **{name: "1/s" for name in _REALS if name.startswith("rate")}}
    variables = {
        name: ((*dims, "set", *own.get(name, ())), value, {"units": units.get(name, "1")})
        for name, value in tables.items()
    }
    coords = coordinates_of(cube, dims)
    coords |= {"set": np.arange(len(words)), "lag": np.arange(-options.stretch, 1), "state": list(model.state_names)}
    ds = xr.Dataset(variables, coords=coords)
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
