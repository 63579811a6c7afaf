"""Find the rates of a system's equations that bound the step of an explicit method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from magpend_core.engine.jacobians import whole_jacobian
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System

_NEWTON_STEPS = 4
_DIFFERENCE = 1e-6


def fastest_contraction(system: System, parameters: np.ndarray, frequency_hz: np.ndarray, states: np.ndarray) -> float:
    """Return the largest rate at which the linearised equations contract, at given states and in the layers nearby.

    A layer is where the right-hand side changes quickly (see `System.layers`); each state is also moved to the
    middle of each layer, where it contracts fastest. Everything is evaluated in plain Python.

    Parameters
    ----------
    system
        With a Jacobian.
    parameters
        Packed, shape (cell, n_parameters).
    frequency_hz
        Shape (cell,) [Hz].
    states
        Shape (cell, n_states).

    Returns
    -------
    float
        Largest negative real part of an eigenvalue of the Jacobian [1/s], with a plus sign; 0 if none is
        negative or the system has no Jacobian.
    """
    if system.jacobian is None:
        return 0.0
    fastest = 0.0
    for y, c in _with_constants(system, parameters, frequency_hz, states):
        for state in (y, *_in_layers(system, y, c)):
            fastest = max(fastest, -float(np.linalg.eigvals(_jacobian(system, state, c)).real.min()))
    return fastest


def spectral_radii(system: System, parameters: np.ndarray, frequency_hz: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the spectral radius of the Jacobian at given states [1/s], in plain Python; 0 where a state is no number.

    Parameters
    ----------
    system
        With a Jacobian.
    parameters, frequency_hz, states
        As for `fastest_contraction`.

    Returns
    -------
    ndarray, (cell,)
    """
    found = []
    for y, c in _with_constants(system, parameters, frequency_hz, states):
        matrix = _jacobian(system, y, c)
        found.append(np.abs(np.linalg.eigvals(matrix)).max() if np.isfinite(matrix).all() else 0.0)
    return np.array(found)


def _with_constants(
    system: System, parameters: np.ndarray, frequency_hz: np.ndarray, states: np.ndarray
) -> Iterator[tuple[np.ndarray, tuple[Any, ...]]]:
    """Yield each state with the constants of its cell."""
    constants = plain(system.constants)
    for p, hz, y in zip(parameters, frequency_hz, states, strict=True):
        c = np.zeros(system.n_constants + system.n_modes)
        constants(float(hz), p, c)
        yield y, tuple(c)


def _jacobian(system: System, y: np.ndarray, c: tuple[Any, ...]) -> np.ndarray:
    u = plain(system.forcing)(0.0, c)
    assert system.jacobian is not None
    return whole_jacobian(system, np.array(plain(system.jacobian)(tuple(y), u, c), np.float64))


def _in_layers(system: System, y: np.ndarray, c: tuple[Any, ...]) -> list[np.ndarray]:
    """Return the state moved to the middle of each layer, by Newton's method along the layer's gradient."""
    if not system.has_layers:
        return []
    layers, rhs, u = plain(system.layers), plain(system.rhs), plain(system.forcing)(0.0, c)

    def layer(state: np.ndarray, k: int) -> tuple[float, float]:
        rates = tuple(rhs(tuple(state), u, c)) + ((0.0,) if system.timed_layers else ())
        value, _, half_width, _ = layers(tuple(state), rates, c)[k]
        return float(value), float(half_width)

    rates = tuple(rhs(tuple(y), u, c)) + ((0.0,) if system.timed_layers else ())
    found, steps = [], _DIFFERENCE * np.eye(len(y)) * np.array(system.units)
    for k in range(len(layers(tuple(y), rates, c))):
        state = y.astype(np.float64).copy()
        for _ in range(_NEWTON_STEPS):
            value = layer(state, k)[0]
            slope = np.array([(layer(state + s, k)[0] - layer(state - s, k)[0]) / (2.0 * s.sum()) for s in steps])
            if not slope @ slope > 0.0:
                break
            state -= slope * value / (slope @ slope)
        value, half_width = layer(state, k)
        if abs(value) < half_width:
            found.append(state)
    return found
