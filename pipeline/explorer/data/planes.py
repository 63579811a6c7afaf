"""Label the initial states in a plane of two states by the attractor that each of them reaches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from pipeline.explorer.data.arrays import pack_arrays
from pipeline.explorer.data.colours import Category, Scheme, rgb, schemes
from pipeline.explorer.data.explored import ExploredRun
from pipeline.layout.vocabulary import DIVERGED, grid_dim, is_grid_dim
from pipeline.store.run import RunDirectory

NO_LABEL = -1
"""Label of a start that leads to nothing known."""

_DIVERGED = -2
"""Label of a start that diverges, as in `pipeline.results.outcomes`."""


@dataclass(frozen=True)
class Plane:
    """Plane of initial states: its two states, and the label of each initial state."""

    states: tuple[str, str]  # across and upwards
    fixed: Mapping[str, float]  # values of the other states, those that all starts share
    categories: list[Category]
    # ``basins`` where labels are attractors, ``starts`` where they say what the cells themselves tell; None where
    # there is no grid
    source: str | None = None
    u: np.ndarray = field(default_factory=lambda: np.empty(0))  # u, v: values of the states, ascending
    v: np.ndarray = field(default_factory=lambda: np.empty(0))
    label: np.ndarray = field(default_factory=lambda: np.empty((0, 0), np.int16))  # (v, u)
    starts: np.ndarray = field(default_factory=lambda: np.empty((0, 2)))  # (n, 2); starts that are no grid
    start_label: np.ndarray = field(default_factory=lambda: np.empty(0, np.int16))  # (n,)


def plane(run: RunDirectory, at: Mapping[str, int]) -> bytes:
    """Return the labelled plane of initial states at a parameter point, packed for the page."""
    found = plane_of(ExploredRun.open(run), at)
    arrays = {name: getattr(found, name) for name in ("u", "v", "label", "starts", "start_label")}
    attrs = {
        "states": list(found.states),
        "fixed": dict(found.fixed),
        "labels": [c.describe() for c in found.categories],
        "source": found.source,
    }
    return pack_arrays(arrays, attrs)


def plane_of(run: ExploredRun, at: Mapping[str, int]) -> Plane:
    """Read the labelled plane of initial states at a parameter point; the arguments are those of `plane`.

    For a grid of more than two states the first two are shown, at the middle of the others' ranges.
    """
    place = run.place(at)
    scheme = _scheme(run)
    dims = [d for d in run.start_dims if is_grid_dim(d) and run.cube().sizes[d] > 1]
    if len(dims) >= 2:
        return _of_grid(run, place, scheme, dims)
    return _of_starts(run, place, scheme)


def _scheme(run: ExploredRun) -> Scheme:
    known = {s.name: s for s in schemes(run)}
    return next(known[name] for name in ("attractor", "motion", "status") if name in known)


def _of_grid(run: ExploredRun, place: Mapping[str, int], scheme: Scheme, dims: list[str]) -> Plane:
    cube = run.cube()
    middle = {d: cube.sizes[d] // 2 for d in dims[2:]}
    rest = {d: 0 for d in run.start_dims if d not in dims}
    part = _part(run, scheme, {**place, **middle, **rest})
    across, upwards = dims[:2]
    label = _labels(part, scheme).transpose(upwards, across)
    u, v = (np.asarray(part[d].values, np.float64) for d in (across, upwards))
    columns, rows = np.argsort(u, kind="stable"), np.argsort(v, kind="stable")
    states, origin = (_state_of(run, across), _state_of(run, upwards)), run.origins(place)
    u, v = u + origin[states[0]], v + origin[states[1]]
    return Plane(
        states,
        _fixed(run, part, states, origin),
        _categories(scheme, label.values),
        "basins" if scheme.name == "attractor" else "starts",
        u[columns],
        v[rows],
        label.values[np.ix_(rows, columns)],
    )


def _of_starts(run: ExploredRun, place: Mapping[str, int], scheme: Scheme) -> Plane:
    """Return the plane of initial states if these form no grid, with one label for each."""
    from pipeline.explorer.data.view import planes

    pairs = planes(run)
    names = run.model.state_names
    states = pairs[0] if pairs else (names[0], names[-1])
    part = _part(run, scheme, place)
    label = _labels(part, scheme)
    origin = run.origins(place)
    columns = [_spread(part, grid_dim(name), label) + origin[name] for name in states]
    shown, starts = label.values.ravel(), np.stack(columns, axis=1)
    return Plane(
        states, _fixed(run, part, states, origin), _categories(scheme, shown), starts=starts, start_label=shown
    )


def _part(run: ExploredRun, scheme: Scheme, index: Mapping[str, int]) -> xr.Dataset:
    """Read the status and the colour code of the cells at a parameter point."""
    cube = run.cube()
    names = [n for n in cube.data_vars if n in {"status", *scheme.needs}]
    numbered = cube[names].assign_coords(
        {f"_{d}": (d, np.arange(n)) for d, n in zip(run.plan.dims, run.plan.shape, strict=True)}
    )
    # slices of one, so that codes find every dim; dropped afterwards
    kept = numbered.isel({d: slice(i, i + 1) for d, i in index.items()}).load()
    codes = scheme.codes(kept)
    status = kept["status"]
    codes = xr.zeros_like(status, dtype=np.int32) + codes.drop_vars(list(kept.coords), errors="ignore")
    found = kept.drop_vars([n for n in names if n != "status"]).assign(_code=codes)
    return found.isel(dict.fromkeys(index, 0))


def _labels(part: xr.Dataset, scheme: Scheme) -> xr.DataArray:
    codes = part["_code"].values
    told = np.where(codes < 0, NO_LABEL, codes)
    if scheme.name != "status":
        told = np.where(part["status"].values == DIVERGED, _DIVERGED, told)
    return part["status"].copy(data=told.astype(np.int16))


def _categories(scheme: Scheme, labels: np.ndarray) -> list[Category]:
    present = set(np.unique(labels).tolist())
    found = [c for c in scheme.categories if c.number in present]
    if _DIVERGED in present:
        found.append(Category(_DIVERGED, "diverged", rgb("black")))
    return found


def _state_of(run: ExploredRun, dim: str) -> str:
    return next(s.name for s in run.model.states if grid_dim(s.name) == dim)


def _fixed(
    run: ExploredRun, part: xr.Dataset, states: tuple[str, str], origin: Mapping[str, float]
) -> dict[str, float]:
    """Return the other states, outside the plane, that have the same value in all initial states, by name."""
    found = {}
    for state in run.model.states:
        values = np.unique(np.asarray(part.coords[grid_dim(state.name)].values, np.float64))
        if state.name not in states and values.size == 1:
            found[state.name] = float(values[0]) + origin[state.name]
    return found


def _spread(part: xr.Dataset, name: str, like: xr.DataArray) -> np.ndarray:
    """Return a coordinate of the initial states as one value per cell."""
    coordinate = part.coords[name]
    values = xr.DataArray(coordinate.values.astype(np.float64), dims=coordinate.dims)
    plain = xr.DataArray(np.zeros(like.shape), dims=like.dims)
    return np.asarray((plain + values).transpose(*like.dims).values.ravel())
