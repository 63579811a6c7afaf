"""The full motion on each attractor of one parameter point: what phase portraits are drawn from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from magpend_core.models.parameters import Parameters
from magpend_core.trajectory import trajectory
from pipeline.analysis.selection import choose, start_dims
from pipeline.layout.vocabulary import CLOSED_ORBIT, FREQUENCY_DIM, parameters_of

RTOL = 1e-9


def portraits(
    attractors: xr.Dataset,
    *,
    at: Mapping[str, float] | None = None,
    parameters: Parameters | None = None,
    n_samples: int = 256,
    n_periods: int = 20,
) -> xr.Dataset:
    """Integrate each attractor of a parameter point: one period of a closed orbit, some of a bounded set.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match`.
    at
        Values of the swept parameters; the nearest ones are taken.
    parameters
        What was integrated; by default as the attributes say. Swept parameters replace those of the same
        name.
    n_samples
        Samples per drive period.
    n_periods
        Drive periods of a bounded set, from its first stored point on.

    Returns
    -------
    Dataset
        Dim ``attractor`` runs over those present at the point. ``orbit`` (attractor, sample, state): states,
        angles not wrapped, every 1 / (`n_samples` f) from a section on, NaN beyond the end; ``points``
        (attractor, sample, place, axis): the moving points of the model's drawing, ``x`` to the right, ``y``
        upwards, in its unit, and ``fixed`` (fixed_place, axis), those that do not move, both absent if the
        model has no drawing; ``attractor_points``, ``share``, ``n_cells``, ``orbit_period``, ``kind`` and, if
        there, ``side`` as given.

    Raises
    ------
    ValueError
        If an axis is left over, there is no frequency, or a number of samples or periods is below 1.
    ArithmeticError
        If a trajectory diverges.
    """
    if n_samples < 1 or n_periods < 1:
        raise ValueError(f"n_samples = {n_samples} and n_periods = {n_periods}: each must be 1 or more.")
    part = choose(attractors, at, tuple(start_dims(attractors)), "portraits are those of one parameter point")
    here = part.isel(attractor=np.flatnonzero(part["kind"].values > 0))
    values = {str(k): float(v) for k, v in here.coords.items() if not v.ndim and v.dtype.kind == "f"}
    frequency = values.get(FREQUENCY_DIM)
    if frequency is None:
        raise ValueError("the dataset has no coordinate 'frequency' [Hz]; assign the drive frequency")
    base = parameters_of(attractors) if parameters is None else parameters
    base = base.replace(**{k: v for k, v in values.items() if k in base})
    orbits = [
        _orbit(here.isel(attractor=i), base, frequency, n_samples, n_periods)
        for i in range(here.sizes["attractor"])
    ]
    return _dataset(here, orbits, base, frequency, n_samples)


def _orbit(
    one: xr.Dataset, parameters: Parameters, frequency: float, n_samples: int, n_periods: int
) -> np.ndarray:
    closed = int(one["kind"]) == CLOSED_ORBIT
    periods = int(one["orbit_period"]) if closed else n_periods
    times = np.arange(periods * n_samples + 1) / (n_samples * frequency)
    start = one["attractor_points"].transpose("point", "state").values[0]
    return trajectory(parameters, frequency, start, times, rtol=RTOL, atol=RTOL)


def _dataset(
    here: xr.Dataset, orbits: list[np.ndarray], parameters: Parameters, frequency: float, n_samples: int
) -> xr.Dataset:
    length = max((len(o) for o in orbits), default=0)
    table = np.full((len(orbits), length, len(parameters.model.states)), np.nan)
    for row, orbit in zip(table, orbits, strict=True):
        row[: len(orbit)] = orbit
    keep = ["attractor_points", "share", "n_cells", "orbit_period", "kind", "side"]
    result = here[[name for name in keep if name in here]].assign(
        orbit=(("attractor", "sample", "state"), table,
               {"units": "see state_units", "long_name": "motion on the attractor"}),
    )  # fmt: skip
    time = np.arange(length) / (n_samples * frequency)
    result = result.assign_coords(time=("sample", time, {"units": "s", "long_name": "time"}))
    result.attrs = {
        **{name: here.attrs[name] for name in ("model", "parameters") if name in here.attrs},
        "title": "portraits of attractors",
    }
    return _drawn(result, table, parameters)


def _drawn(result: xr.Dataset, table: np.ndarray, parameters: Parameters) -> xr.Dataset:
    """With the places of the model's points."""
    drawing = parameters.model.drawing
    if drawing is None:
        return result
    moving, fixed = drawing.points(table, parameters), drawing.fixed(parameters)
    about = {"units": drawing.unit, "long_name": "place, to the right and upwards"}
    places = np.stack([moving[name] for name in moving], axis=-2)
    result = result.assign(points=(("attractor", "sample", "place", "axis"), places, about))
    result = result.assign_coords(place=list(moving), axis=["x", "y"])
    if fixed:
        still = np.stack([np.asarray(fixed[name], np.float64) for name in fixed])
        result = result.assign(fixed=(("fixed_place", "axis"), still, about))
        result = result.assign_coords(fixed_place=list(fixed))
    return result
