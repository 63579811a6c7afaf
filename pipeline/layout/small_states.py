"""Find states that a run could not resolve: on one side of 0 for ever, and for a while far below the run's `atol`.

A population whose rate vanishes with it can fall to 1e-27 and grow again. How long that takes depends on its logarithm,
while errors of the run are up to `atol`: below it the state has no digits, and the run's periods are wrong although its
cells close. So some cells are integrated again for a while, with the logarithm of such states.

The search can miss states of cells that were not drawn, of models that are not text, and those that come back later
than `MOST_PERIODS` after the last section. States that stay small (a population that dies out) are no fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import rates_of
from magpend_core.status import Status
from pipeline.layout.vocabulary import frequency_of, split_dims

if TYPE_CHECKING:
    import xarray as xr

DRAWN = 8
"""Most parameter points of which a cell is integrated, and drawn states at which rates are evaluated."""

MOST_PERIODS, MOST_RATES = 4, 20_000
"""Returns or drive periods for which a cell is integrated, and most evaluations of its rates."""


def small_states(parameters: Parameters, cube: Callable[[], xr.Dataset]) -> list[str]:
    """Return a warning for each state of a run that falls below the run's `atol` and comes back.

    The cube is opened only where the model has a state that can.
    """
    model = parameters.model
    whole = model.flow
    if not isinstance(whole, TextModel) or not whole.clock.is_continuous or model.disturbance is not None:
        return []
    values = dict(parameters.items())
    logs = one_sided(whole, values)
    ds = cube() if logs.any() else None
    if ds is None or "atol" not in ds.attrs or "section" not in ds:
        return []
    atol = float(ds.attrs["atol"]) * np.array([state.size for state in whole.states])
    dims, starts = split_dims(ds["status"])
    shape = tuple(ds.sizes[d] for d in dims)
    least = np.full(len(whole.states), np.inf)
    for k in np.unique(np.linspace(0, math.prod(shape) - 1, DRAWN).astype(int)):
        place = dict(zip(dims, np.unravel_index(k, shape), strict=True))
        found = _least(ds.isel(place), starts, model, values, logs, atol)
        least = np.fmin(least, found)
    return [
        f"warning: {name} falls to {least[i]:.2g}, below its atol of {atol[i]:.2g}, and comes back: it has no digits "
        f"there, and periods may be wrong; give an atol below {least[i]:.0e}, or take log({name}) as a state"
        for i, name in enumerate(whole.state_names)
        if np.isfinite(least[i])
    ]


def one_sided(model: TextModel, values: Mapping[str, float]) -> np.ndarray:
    """Return which states can never change their sign: their rates vanish with them, whatever the others are."""
    rng = np.random.default_rng(0)
    scales = np.array(model.scales)[:, None]
    found = np.zeros(len(model.states), bool)
    for i, state in enumerate(model.states):
        moved = any(state.name in impact.set for impact in model.definition.impacts)
        if state.on_circle or moved:
            continue
        y = scales * rng.uniform(0.1, 2.0, (len(model.states), DRAWN))
        y[i] = 0.0
        rate = np.broadcast_to(_rates(model, values, 1.0, rng.random(DRAWN), y)[i], (DRAWN,))
        found[i] = bool((rate == 0.0).all())
    return found


def _rates(model: TextModel, values: Mapping[str, float], frequency: float, t: Any, y: np.ndarray) -> list[Any]:
    known: dict[str, Any] = {"pi": np.pi, "f": frequency, "t": t, "phase": t * frequency - np.floor(t * frequency)}
    known |= {**values, **dict(zip(model.state_names, y, strict=True))}
    with np.errstate(all="ignore"):
        return list(rates_of(model.definition, known).values())


def _least(
    cells: xr.Dataset,
    starts: tuple[str, ...],
    model: Any,
    values: Mapping[str, float],
    logs: np.ndarray,
    atol: np.ndarray,
) -> np.ndarray:
    """Return the least size of each state on the way of one cell of a parameter point; infinite for states that do not
    fall below their `atol`, or do not come back.
    """
    none = np.full(len(atol), np.inf)
    status = cells["status"].transpose(*starts).values
    good = np.argwhere(np.isin(status, (Status.PERIODIC, Status.BOUNDED)))
    if not len(good):
        return none
    cell = cells.isel(dict(zip(starts, good[0], strict=True)))
    values = {**values, **{str(k): float(v) for k, v in cell.coords.items() if k in values and v.ndim == 0}}
    frequency = frequency_of(model.flow, {str(k): v for k, v in cell.coords.items()})
    frequency = frequency if np.isfinite(frequency) else 1.0
    period = float(cell["return_time"].values[-1]) if "return_time" in cell else 1.0 / frequency
    path = _path(model.flow, values, frequency, cell["section"].values[-1], MOST_PERIODS * period, logs)
    for i in np.flatnonzero(logs):
        if len(path) and path[:, i].min() < atol[i]:
            lowest = int(path[:, i].argmin())
            if path[lowest:, i].max() > atol[i]:
                none[i] = path[lowest, i]
    return none


def _path(
    model: TextModel, values: Mapping[str, float], frequency: float, start: np.ndarray, seconds: float, logs: np.ndarray
) -> np.ndarray:
    """Return the sizes of the states along a trajectory (step, state), integrated with logarithms of some states; empty
    if a state is 0 or the trajectory takes too many steps.
    """
    from scipy.integrate import LSODA

    rtol = 1e-4  # of the logarithms: only the order of magnitude counts
    if not np.isfinite(start).all() or (start[logs] == 0.0).any() or not np.isfinite(seconds):
        return np.zeros((0, len(start)))
    sign = np.sign(start)

    def states(u: np.ndarray) -> np.ndarray:
        return np.where(logs, sign * np.exp(np.clip(np.where(logs, u, 0.0), -700.0, 700.0)), u)

    def slopes(t: float, u: np.ndarray) -> np.ndarray:
        y = states(u)
        rates = np.array([float(rate) for rate in _rates(model, values, frequency, t, y)])
        return np.where(logs, rates / np.where(logs, y, 1.0), rates)

    first = np.where(logs, np.log(np.abs(np.where(logs, start, 1.0))), start)
    solver = LSODA(slopes, 0.0, first, seconds, rtol=rtol, atol=rtol * np.where(logs, 1.0, model.scales))
    path = [np.abs(states(first))]
    while solver.status == "running" and solver.nfev < MOST_RATES:
        if solver.step() is not None:
            break
        path.append(np.abs(states(solver.y)))
    return np.array(path)
