"""What a model says at given states and times: rates, their Jacobian, named quantities."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from magpend_core.engine.checks import check_system
from magpend_core.engine.jit import inline, is_covered, kernel, specialise
from magpend_core.engine.simd import WIDTH, load, load_rows, store_rows
from magpend_core.engine.system import System
from magpend_core.models.parameters import Parameters
from magpend_core.validation import check_frequency, check_states


def _rates(t: Any, y: Any, c: Any) -> Any:
    return rhs(y, forcing(t, c), c)


def _slopes(t: Any, y: Any, c: Any) -> Any:
    return rhs_jacobian(y, forcing(t, c), c)


def _named(t: Any, y: Any, c: Any) -> Any:
    u = forcing(t, c)
    return quantities(t, y, rhs(y, u, c), u, c)


def _evaluate(t: Any, states: Any, frequency: float, p: Any, out: Any) -> None:
    """Fill `out` (n, n_out) with the bound function at `t` (n,) and `states` (n, N)."""
    c = np.empty(NC)
    constants(frequency, p, c)
    rows = np.empty(NC * WIDTH)
    for i in range(NC):
        for lane in range(WIDTH):
            rows[i * WIDTH + lane] = c[i]
    time = np.zeros(WIDTH)
    y = np.zeros(N * WIDTH)
    values = np.zeros(out.shape[1] * WIDTH)
    n = len(t)
    for first in range(0, n, WIDTH):
        for lane in range(WIDTH):
            source = min(first + lane, n - 1)
            time[lane] = t[source]
            for i in range(N):
                y[i * WIDTH + lane] = states[source, i]
        store_rows(values, 0, quantity(load(time, 0), load_rows(y, 0, N), load_rows(rows, 0, NC)))
        for lane in range(min(WIDTH, n - first)):
            for i in range(out.shape[1]):
                out[first + lane, i] = values[i * WIDTH + lane]


def _forced(t: Any, y: Any, c: Any) -> Any:
    return (0.0 * y[0] + forcing(t, c),)


_KINDS = {"rates": _rates, "jacobian": _slopes, "quantities": _named, "forcing": _forced}


@cache
def _evaluator(system: System, kind: str) -> Any:
    bindings: dict[str, Any] = {
        "N": system.n_states,
        "NC": system.n_constants,
        "rhs": system.rhs,
        "forcing": system.forcing,
        "rhs_jacobian": system.jacobian,
        "constants": system.constants,
        "quantities": system.quantities,
    }
    label = f"{system.label}_{kind}"
    bindings["quantity"] = inline(specialise(_KINDS[kind], label, **bindings))
    return kernel(specialise(_evaluate, label, **bindings), is_covered(*system.functions))


def _at(kind: str, n_out: int, t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Evaluate; the result has the leading shape of `state` and one last dim."""
    system = parameters.model.system
    frequency = check_frequency(frequency_hz, ndim=0)
    states = check_states(state, tuple(range(1, np.ndim(state) + 1)), system.n_states)
    leading = states.shape[:-1]
    many = states.reshape(-1, system.n_states)
    times = np.broadcast_to(np.asarray(t, np.float64), leading).reshape(-1)
    # one period is as good as another, and short times keep the drive's phase exact
    local = np.ascontiguousarray(np.mod(times, 1.0 / float(frequency)))
    packed = parameters.pack()
    check_system(system, packed[None], frequency[None], many, jacobian=kind == "jacobian")
    out = np.empty((len(many), n_out))
    _evaluator(system, kind)(local, many, float(frequency), packed, out)
    return out.reshape((*leading, n_out))


def evaluate_packed(
    system: System,
    t: np.ndarray,
    states: np.ndarray,
    packed: np.ndarray,
    frequency_hz: float,
    out: np.ndarray,
) -> None:
    """Fill `out` with all quantities of a system, for callers that have checked what they give.

    Parameters
    ----------
    system
        Whose quantities they are.
    t
        Times since the start of the drive's period [s], within it; shape (n,).
    states
        Shape (n, n_states).
    packed
        Parameters, shape (n_parameters,).
    frequency_hz
        Drive frequency [Hz].
    out
        Shape (n, len(system.quantity_names)).
    """
    times, rows = np.ascontiguousarray(t, np.float64), np.ascontiguousarray(states, np.float64)
    _evaluator(system, "quantities")(times, rows, float(frequency_hz), packed, out)


def rates(t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Time derivatives of the states.

    Parameters
    ----------
    t
        Time since a section [s], a number or one per state.
    state
        Shape (..., n_states), in the model's units.
    parameters
        See `Model.load`.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    ndarray
        The shape of `state`, its units per second.

    Raises
    ------
    ValueError
        If a state is not finite or has the wrong shape, or the frequency is not positive.
    """
    return _at("rates", parameters.model.system.n_states, t, state, parameters, frequency_hz)


def drive_level(t: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Forcing at given times, in the unit of the model's own.

    Parameters
    ----------
    t
        Times since a section [s], shape (n,).
    parameters
        See `Model.load`.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    ndarray
        Shape (n,).

    Raises
    ------
    ValueError
        If the frequency is not positive.
    """
    at_rest = np.zeros((*np.shape(t), parameters.model.system.n_states))
    return _at("forcing", 1, t, at_rest, parameters, frequency_hz)[..., 0]


def jacobian(t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Analytic Jacobian of `rates`: entry [i, j] is the derivative of the rate of state i by state j.

    Parameters
    ----------
    t, state, parameters, frequency_hz
        As for `rates`.

    Returns
    -------
    ndarray
        Shape (..., n_states, n_states).

    Raises
    ------
    ValueError
        As for `rates`.
    """
    n = parameters.model.system.n_states
    flat = _at("jacobian", n * n, t, state, parameters, frequency_hz)
    return flat.reshape((*flat.shape[:-1], n, n))


def evaluate(
    names: Sequence[str], t: Any, state: Any, parameters: Parameters, frequency_hz: float
) -> np.ndarray:
    """Named quantities of the model, such as an energy or a torque.

    Parameters
    ----------
    names
        Among ``parameters.model.quantities``.
    t, state, parameters, frequency_hz
        As for `rates`.

    Returns
    -------
    ndarray
        Shape (..., len(names)), in the quantities' units.

    Raises
    ------
    ParameterError
        If a name is unknown, with the nearest ones.
    ValueError
        As for `rates`.
    """
    model = parameters.model
    known = model.system.quantity_names
    columns = [known.index(model.quantity(name).name) for name in names]
    if not columns:
        return np.empty((*np.shape(state)[:-1], 0))
    return _at("quantities", len(known), t, state, parameters, frequency_hz)[..., columns]
