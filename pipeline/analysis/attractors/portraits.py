"""Integrate the motion on each attractor of one parameter point, to draw phase portraits."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.precision import limits_at, tolerances_at
from magpend_core.sections import run_branches
from magpend_core.trajectory import trajectory
from pipeline.analysis.attractors.jumps import with_jumps
from pipeline.layout.vocabulary import APERIODIC, EQUILIBRIUM, PERIODIC_ORBIT, frequency_of, parameters_of, told_by
from pipeline.results.ragged import dense
from pipeline.results.selection import choose, start_dims
from pipeline.results.tolerances import PORTRAIT_RTOL


def portraits(
    attractors: xr.Dataset,
    *,
    at: Mapping[str, float] | None = None,
    parameters: Parameters | None = None,
    n_samples: int = 256,
    n_periods: int = 20,
) -> xr.Dataset:
    """Integrate one trajectory on each attractor of a parameter point: one period of a periodic orbit, `n_periods`
    drive periods of any other set.

    Parameters
    ----------
    attractors
        Result of `pipeline.analysis.attractors.attractors.match`.
    at
        Value of each swept parameter; it must lie on its axis.
    parameters
        Parameters of the run, by default from the attributes. Swept parameters replace those of the same
        name.
    n_samples
        Samples per drive period, or per return.
    n_periods
        Drive periods or returns of a bounded set, from its first stored point on.

    Returns
    -------
    Dataset
        Dim ``attractor`` runs over the sets present at the point. ``orbit`` (attractor, sample, state) has
        the states at the instants ``time`` (attractor, sample) from a section on, `n_samples` per drive period or
        return, and more where a state jumps; angles are not wrapped, and samples beyond the end (for an
        equilibrium, after the first) are NaN. ``points``
        (attractor, sample, place, axis) has the moving points of the model's drawing, ``x`` to the right and
        ``y`` upwards, in the drawing's unit; ``fixed`` (fixed_place, axis) has the points that do not move.
        Both are absent if the model has no drawing. ``attractor_points``, ``share``, ``n_cells``,
        ``orbit_period``, ``kind``, ``stability`` and, if present, ``side`` are copied.

    Raises
    ------
    ValueError
        If an axis is left over, there is no frequency, or a number of samples or periods is below 1.
    ArithmeticError
        If a trajectory diverges.
    """
    if n_samples < 1 or n_periods < 1:
        raise ValueError(f"n_samples = {n_samples} and n_periods = {n_periods}: each must be 1 or more.")
    part = dense(
        choose(attractors, at, tuple(start_dims(attractors)), "portraits are those of one parameter point"), points=True
    )
    here = part.isel(attractor=np.flatnonzero(part["kind"].values > 0))
    values = {str(k): float(v) for k, v in here.coords.items() if not v.ndim and v.dtype.kind == "f"}
    base = parameters_of(attractors) if parameters is None else parameters
    base = base.replace(**{k: v for k, v in values.items() if k in base})
    step = _step(here, base, frequency_of(base.model, values), n_samples)
    orbits = [_orbit(here.isel(attractor=i), base, step, n_samples, n_periods) for i in range(here.sizes["attractor"])]
    return _dataset(here, orbits, base)


def _step(here: xr.Dataset, parameters: Parameters, frequency: float, n_samples: int) -> float:
    """Return the time between two samples [s]: a fraction of the drive period or of a typical return.

    Returns of a flow differ in length. All attractors share one step, from the shortest mean return of a
    closed orbit, or else from the mean return of the first set that does not close.
    """
    if np.isnan(frequency):
        raise ValueError("the dataset has no coordinate 'frequency' [Hz]; assign the drive frequency")
    if parameters.model.crossing is None:
        return 1.0 / (n_samples * frequency)
    per_return = (here["period_s"] / here["orbit_period"].where(here["orbit_period"] > 0)).values
    if np.isfinite(per_return).any():
        return float(np.nanmin(per_return)) / n_samples
    moving = np.isin(here["kind"].values, APERIODIC)
    starts = here["attractor_points"].transpose("attractor", "point", "state").values[moving, 0]
    if not len(starts):
        return 0.1 / (n_samples * frequency)
    return mean_return(starts[:1], parameters, frequency) / n_samples


def mean_return(starts: np.ndarray, parameters: Parameters, frequency: float) -> float:
    """Return the mean time between successive points on the Poincare section [s], over 16 returns."""
    result = run_branches(
        parameters.pack()[None, None],
        np.full((1, 1), frequency),
        starts,
        n_transient=0,
        n_keep=16,
        **limits_at(PORTRAIT_RTOL),
        system=parameters.model.system,
    )
    assert result.return_time is not None
    found = float(result.return_time.mean())
    return found if np.isfinite(found) else 0.1 / frequency


def _orbit(
    one: xr.Dataset, parameters: Parameters, step: float, n_samples: int, n_periods: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return instants and the states there."""
    start = one["attractor_points"].transpose("point", "state").values[0]
    kind, periods = int(one["kind"]), int(one["orbit_period"])
    n = n_samples * (periods if kind == PERIODIC_ORBIT else n_periods)
    if kind == EQUILIBRIUM:
        return np.zeros(1), np.asarray(start[None])
    if kind == PERIODIC_ORBIT and (parameters.model.crossing is not None or not periods):
        n = math.ceil(float(one["period_s"]) / step)
    flow = of_flow(parameters)

    def fly(_: list[int], times: list[np.ndarray]) -> list[np.ndarray]:
        return [trajectory(flow, 1.0 / (step * n_samples), start, times[0], **tolerances_at(PORTRAIT_RTOL))]

    times = [np.arange(n + 1) * step]
    (states,) = with_jumps(fly, times, flow.model.system.sizes)
    return times[0], states


def _dataset(here: xr.Dataset, orbits: list[tuple[np.ndarray, np.ndarray]], parameters: Parameters) -> xr.Dataset:
    length = max((len(times) for times, _ in orbits), default=0)
    instants = np.full((len(orbits), length), np.nan)
    table = np.full((len(orbits), length, len(parameters.model.states)), np.nan)
    for row, (times, states) in enumerate(orbits):
        instants[row, : len(times)], table[row, : len(times)] = times, states
    keep = ["attractor_points", "share", "n_cells", "orbit_period", "kind", "stability", "side"]
    result = here[[name for name in keep if name in here]].assign(
        orbit=(
            ("attractor", "sample", "state"),
            table,
            {"units": "see state_units", "long_name": "motion on the attractor"},
        )
    )
    about = {"units": "s", "long_name": "time"}
    result = result.assign_coords(time=(("attractor", "sample"), instants, about))
    result.attrs = {**told_by(here.attrs), "title": "portraits of attractors"}
    return _drawn(result, table, parameters)


def _drawn(result: xr.Dataset, table: np.ndarray, parameters: Parameters) -> xr.Dataset:
    """Add the moving points of the model's drawing on each attractor, if the model has a drawing."""
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
