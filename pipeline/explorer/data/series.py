"""Compute the time series of an orbit or a start, with the model's quantities and drawing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magpend_core import evaluate, trajectory
from magpend_core.models.model import Model, Parameters
from magpend_core.models.sectioned import of_flow

SAMPLES = 128
"""Instants per drive period or return."""


def drawn_points(model: Model, parameters: Mapping[str, float], states: np.ndarray) -> np.ndarray | None:
    """Return positions of the drawing's moving points, shape (n, n_points, 2), or None without a drawing.

    They are in the order in which `Drawing.points` names them.
    """
    if model.drawing is None:
        return None
    places = model.drawing.points(states, parameters)
    return np.stack([np.broadcast_to(p, (len(states), 2)) for p in places.values()], axis=1).astype(float)


def fixed_points(model: Model, parameters: Mapping[str, float]) -> dict[str, list[float]]:
    """Return the positions of the drawing's fixed points, by name."""
    if model.drawing is None:
        return {}
    return {name: [float(x) for x in place] for name, place in model.drawing.fixed(parameters).items()}


def series(
    parameters: Parameters,
    clock_hz: float,
    state: np.ndarray,
    times: np.ndarray,
    *,
    rtol: float,
    atol: float,
    with_quantities: bool = True,
) -> dict[str, np.ndarray]:
    """Integrate the states over time from a section point, and compute the quantities and the drawing's points.

    Parameters
    ----------
    parameters
        Parameters of the model, with or without its Poincare section.
    clock_hz
        Drive frequency [Hz]; for a flow any frequency, which affects only the limit on steps.
    state
        At time 0, shape (n_states,).
    times
        Rising [s], shape (n,).
    rtol, atol
        Tolerances.
    with_quantities
        Whether the model's quantities are wanted.

    Returns
    -------
    dict
        ``time`` (n,), ``states`` (n, n_states) with angles that run on, ``quantities`` (n, n_quantities), and
        ``drawing`` (n, n_points, 2) if the model has one.

    Raises
    ------
    ArithmeticError
        If the trajectory ends before the last time.
    """
    own = of_flow(parameters)
    states = trajectory(own, clock_hz, state, times, rtol=rtol, atol=atol)
    found = {"time": np.asarray(times, np.float64), "states": states}
    if with_quantities:
        names = [q.name for q in own.model.quantities]
        found["quantities"] = evaluate(names, times, states, own, clock_hz)
    drawing = drawn_points(own.model, own, states)
    if drawing is not None:
        found["drawing"] = drawing
    return found


def orbit_series(
    parameters: Parameters,
    clock_hz: float,
    state: np.ndarray,
    n_periods: int,
    seconds: float,
    *,
    rtol: float = 1e-9,
    atol: float = 1e-9,
) -> dict[str, np.ndarray]:
    """Return `series` over the periods of an orbit, both ends included; `seconds` is their total time."""
    n = max(1, min(n_periods * SAMPLES, 65_536))
    times = seconds * np.arange(n + 1) / n
    return series(parameters, clock_hz, state, times, rtol=rtol, atol=atol)
