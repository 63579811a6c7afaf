"""The full motion on each attractor of one parameter point: what phase portraits are drawn from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.parameters import Parameters
from magpend_core.trajectory import trajectory
from pipeline.analysis.attractors.attractors import parameters_of
from pipeline.analysis.selection import choose, start_dims
from pipeline.layout.vocabulary import CLOSED_ORBIT

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
        Dim ``attractor`` runs over those present at the point. ``orbit`` (attractor, sample, state): states
        [rad, rad/s], angles not wrapped, every 1 / (`n_samples` f) from a section on, NaN beyond the end;
        ``magnet`` (attractor, sample, axis): place of the moving magnet [m] from the upper joint, ``x`` to
        the right, ``y`` upwards; ``attractor_points``, ``share``, ``n_cells``, ``orbit_period``, ``kind`` and
        ``side`` as given; the attribute ``fixed_magnet_y`` [m], on the vertical through the joint.

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
    frequency = values.get("frequency")
    if frequency is None:
        raise ValueError("the dataset has no coordinate 'frequency' [Hz]; assign the drive frequency")
    base = parameters_of(attractors) if parameters is None else parameters
    names = base.as_dict()
    base = base.replace(**{k: v for k, v in values.items() if k in names})
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


def magnet_path(orbit: np.ndarray, parameters: Parameters) -> np.ndarray:
    """Place of the moving magnet (..., 2) [m]: right of and above the upper joint, from states (..., 4)."""
    names = parameters.as_dict()
    lengths = np.array([names["l1"], names["l2"]])
    angles = orbit[..., :2]
    return np.stack([np.sin(angles) @ lengths, -(np.cos(angles) @ lengths)], axis=-1)


def _dataset(
    here: xr.Dataset, orbits: list[np.ndarray], parameters: Parameters, frequency: float, n_samples: int
) -> xr.Dataset:
    length = max((len(o) for o in orbits), default=0)
    table = np.full((len(orbits), length, 4), np.nan)
    for row, orbit in zip(table, orbits, strict=True):
        row[: len(orbit)] = orbit
    units: dict[str, Any] = {"units": "rad, rad, rad/s, rad/s", "long_name": "motion on the attractor"}
    path = {"units": "m", "long_name": "moving magnet, from the upper joint"}
    keep = ["attractor_points", "share", "n_cells", "orbit_period", "kind", "side"]
    result = here[keep].assign(
        orbit=(("attractor", "sample", "state"), table, units),
        magnet=(("attractor", "sample", "axis"), magnet_path(table, parameters), path),
    )
    result.attrs = {"fixed_magnet_y": -parameters.as_dict()["h"], "title": "portraits of attractors"}
    return result.assign_coords(
        time=("sample", np.arange(length) / (n_samples * frequency), {"units": "s", "long_name": "time"}),
        axis=["x", "y"],
    )
