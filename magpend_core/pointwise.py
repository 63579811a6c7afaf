"""Evaluate a model at given states and times: rates, their Jacobian, named quantities."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, wraps
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.checks import check_system
from magpend_core.engine.crossing import slopes_of
from magpend_core.engine.events import event_bindings
from magpend_core.engine.jacobians import places_of, whole_jacobian
from magpend_core.engine.jit import bound_part, entry, keeping
from magpend_core.engine.modes import mode_bindings
from magpend_core.engine.simd import WIDTH, load, load_rows, store_rows, take
from magpend_core.engine.system import System
from magpend_core.engine.threads import share
from magpend_core.models.model import Parameters
from magpend_core.validation import check_frequency, check_states, check_times

WORTH = 128
"""An evaluation is so short beside an integration that fewer rows than a group's lanes times this are not shared."""


def _rates(t: Any, y: Any, c: Any) -> Any:
    return rhs(y, forcing(t, c), c)


def _slopes(t: Any, y: Any, c: Any) -> Any:
    return rhs_jacobian(y, forcing(t, c), c)


def _named(t: Any, y: Any, c: Any) -> Any:
    u = forcing(t, c)
    return quantities(t, y, rhs(y, u, c), u, c)


def _surfaces(t: Any, y: Any, c: Any) -> Any:
    return event_values(t, y, rhs(y, forcing(t, c), c), c, 0.0 * t)


def _section(t: Any, y: Any, c: Any) -> Any:
    return section_slopes(t, y, c)


def _set_modes(t: float, y: Any, rows: Any, lane: int, edge_times: Any) -> None:
    """Set the modes of the switches of a SIMD lane from the signs of the event functions; no switch slides."""
    for k in range(N_OWN, NC):
        rows[k * WIDTH + lane] = 1.0
    if HAS_SWITCHES:
        values = event_values(t, lane_states(y, lane), lane_states(y, lane), lane_constants(rows, lane), 0.0)
        for k in range(N_SWITCHES):
            rows[(N_OWN + k) * WIDTH + lane] = -1.0 if values[2 * k] < 0.0 else 1.0
    if HAS_SEGMENTS:
        passed = 0.0
        for i in range(NE):
            passed += edge_times[i] <= t
        rows[(NC - 1) * WIDTH + lane] = passed


class _Desk(NamedTuple):
    """Work arrays of `_evaluate`, most with `WIDTH` SIMD lanes per row."""

    c: Any  # constants
    rows: Any  # constants and modes
    time: Any  # s
    y: Any  # states
    values: Any  # of the bound function
    edge_table: Any  # (3, n_edges), see `lanes.Work`
    queue: Any  # int64 (1,), the next group of times: shared by all threads


def _desk_for(system: System, n_out: int, queue: np.ndarray) -> _Desk:
    n_rows = system.n_constants + system.n_modes
    return _Desk(
        np.empty(system.n_constants),
        np.ones(n_rows * WIDTH),
        np.zeros(WIDTH),
        np.zeros(system.n_states * WIDTH),
        np.zeros(n_out * WIDTH),
        np.zeros((3, max(system.n_edges, 1))),
        queue,
    )


def _evaluate(desk: _Desk, t: Any, states: Any, frequency: float, p: Any, out: Any) -> None:
    """Evaluate the rates, Jacobian or quantities (fixed at compilation) at times (n,) and states (n, N); write them to
    `out`.
    """
    c, rows, time, y, values, edge_table, queue = desk
    constants(frequency, p, c)
    for i in range(N_OWN):
        for lane in range(WIDTH):
            rows[i * WIDTH + lane] = c[i]
    n = len(t)
    edges(frequency, p, edge_table[0], edge_table[1], edge_table[2])
    first = take(queue) * WIDTH
    while first < n:
        for lane in range(WIDTH):
            source = first + lane if first + lane < n else n - 1
            time[lane] = t[source]
            for i in range(N):
                y[i * WIDTH + lane] = states[source, i]
            if HAS_MODES:
                _set_modes(time[lane], y, rows, lane, edge_table[0])
        store_rows(values, 0, quantity(load(time, 0), load_rows(y, 0, N), load_rows(rows, 0, NC)))
        for lane in range(WIDTH if n - first > WIDTH else n - first):
            for i in range(out.shape[1]):
                out[first + lane, i] = values[i * WIDTH + lane]
        first = take(queue) * WIDTH


def _forced(t: Any, y: Any, c: Any) -> Any:
    return (0.0 * y[0] + forcing(t, c),)


_KINDS = {
    "rates": _rates,
    "jacobian": _slopes,
    "quantities": _named,
    "forcing": _forced,
    "surfaces": _surfaces,
    "section": _section,
}


@cache
def _evaluator(system: System, kind: str) -> Any:
    bindings: dict[str, Any] = {
        "N": system.n_states,
        "NC": system.n_constants + system.n_modes,
        "N_OWN": system.n_constants,
        "NE": system.n_edges,
        "HAS_MODES": system.n_modes > 0,
        "edges": system.edges,
        **event_bindings(system),
        **mode_bindings(system),
        "rhs": system.rhs,
        "forcing": system.forcing,
        "rhs_jacobian": system.jacobian,
        "constants": system.constants,
        "quantities": system.quantities,
        **({} if system.surface is None else {"section_slopes": slopes_of(system)}),
    }
    label = f"{system.label}_{kind}"
    bindings["_set_modes"] = bound_part(_set_modes, bindings, True)
    bindings["quantity"] = bound_part(_KINDS[kind], bindings, True)
    compiled = entry(_evaluate, label, bindings, keeping(*system.functions))

    @wraps(compiled)
    def evaluator(t: Any, states: Any, frequency: float, p: Any, out: Any) -> None:
        def run(queue: np.ndarray, n_lanes: int) -> None:
            compiled(_desk_for(system, out.shape[1], queue), t, states, frequency, p, out)

        share(run, len(t) // WORTH, WIDTH)

    return evaluator


def _at(kind: str, n_out: int, t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Evaluate rates, Jacobian, quantities or forcing (`kind`) at states (..., n_states); return shape (..., n_out)."""
    system = parameters.model.system
    frequency = check_frequency(frequency_hz, ndim=0)
    states = check_states(state, tuple(range(1, np.ndim(state) + 1)), system.n_states)
    leading = states.shape[:-1]
    many = states.reshape(-1, system.n_states)
    times = check_times(t, leading).reshape(-1)
    # one period is as good as another, and short times keep the drive's phase exact
    local = np.ascontiguousarray(np.mod(times, 1.0 / float(frequency)))
    packed = parameters.pack()
    check_system(system, packed[None], frequency[None], many, jacobian=kind == "jacobian")
    out = np.empty((len(many), n_out))
    _evaluator(system, kind)(local, many, float(frequency), packed, out)
    return out.reshape((*leading, n_out))


def evaluate_packed(
    system: System, t: np.ndarray, states: np.ndarray, packed: np.ndarray, frequency_hz: float, out: np.ndarray
) -> None:
    """Fill `out` with all quantities of a system; the caller has checked the arguments.

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


def surfaces_at(
    system: System, t: np.ndarray, states: np.ndarray, packed: np.ndarray, frequency_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the functions whose zeros are the surfaces of switches and impacts, and their rates. Nothing is checked.

    Parameters
    ----------
    system, t, states, packed, frequency_hz
        As for `evaluate_packed`.

    Returns
    -------
    values, rates : ndarray, (n, surface)
        The switches come first. No switch slides and no state rests on the surface of an impact.
    """
    out = np.empty((len(t), 2 * system.n_events))
    times, rows = np.ascontiguousarray(t, np.float64), np.ascontiguousarray(states, np.float64)
    _evaluator(system, "surfaces")(times, rows, float(frequency_hz), packed, out)
    n = system.n_switches + system.n_impacts
    return out[:, : 2 * n : 2], out[:, 1 : 2 * n : 2]


def rates_at(system: System, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
    """Return the rates of an autonomous system at many states, for one parameter vector. Nothing is checked.

    Parameters
    ----------
    system
        Without a drive.
    states
        Shape (n, n_states).
    packed
        Parameters, shape (n_parameters,).

    Returns
    -------
    ndarray, (n, n_states)
    """
    return _flow_at("rates", system.n_states, system, states, packed)


def jacobian_at(system: System, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
    """Return the Jacobians of the rates of an autonomous system at many states, shape (n, n_states, n_states). Nothing
    is checked.
    """
    return whole_jacobian(system, _flow_at("jacobian", len(places_of(system)), system, states, packed))


def _flow_at(kind: str, n_out: int, system: System, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
    rows, parameters = np.ascontiguousarray(states, np.float64), np.ascontiguousarray(packed, np.float64)
    out = np.empty((len(rows), n_out))
    if len(rows):
        _evaluator(system, kind)(np.zeros(len(rows)), rows, 1.0, parameters, out)
    return out


def rates_packed(system: System, states: np.ndarray, packed: np.ndarray, frequency_hz: np.ndarray) -> np.ndarray:
    """Return the rates of an autonomous system at many states, each with its own parameters. Nothing is checked.

    Parameters
    ----------
    system
        Without a drive: the time is 0.
    states
        Shape (n, n_states); rows that are not finite give NaN.
    packed
        Parameters, shape (n, n_parameters).
    frequency_hz
        Shape (n,) [Hz].

    Returns
    -------
    ndarray, (n, n_states)
    """
    found = np.full(states.shape, np.nan)
    evaluator, known = _evaluator(system, "rates"), np.flatnonzero(np.isfinite(states).all(axis=1))
    changes = (packed[known[1:]] != packed[known[:-1]]).any(axis=1) | (np.diff(frequency_hz[known]) != 0.0)
    for rows in np.split(known, 1 + np.flatnonzero(changes)) if len(known) else ():  # neighbours with equal parameters
        out = np.empty((len(rows), system.n_states))
        parameters = np.ascontiguousarray(packed[rows[0]])
        evaluator(np.zeros(len(rows)), states[rows], float(frequency_hz[rows[0]]), parameters, out)
        found[rows] = out
    return found


def surface_packed(system: System, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
    """Return the `surface` of a system at many states, each with its own parameters, and its derivatives by the states.
    Nothing is checked.

    Parameters
    ----------
    system
        With a surface.
    states
        Shape (n, n_states); rows that are not finite give NaN.
    packed
        Parameters, shape (n, n_parameters), or (n_parameters,) of all.

    Returns
    -------
    ndarray, (n, 1 + n_states)
    """
    packed = np.broadcast_to(packed, (len(states), np.shape(packed)[-1]))
    found = np.full((len(states), 1 + system.n_states), np.nan)
    rows = np.flatnonzero(np.isfinite(states).all(axis=1))
    if len(rows):
        sets, which = np.unique(packed[rows], axis=0, return_inverse=True)
        for k, one in enumerate(sets):
            own = rows[which.ravel() == k]
            found[own] = _flow_at("section", found.shape[1], system, states[own], one)
    return found


def rates(t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Return the time derivatives of the states.

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
        If a time or a state is not finite or has the wrong shape, or the frequency is not positive.
    """
    return _at("rates", parameters.model.system.n_states, t, state, parameters, frequency_hz)


def drive_level(t: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Return the model's forcing at given times, in its unit.

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
        If a time is not finite, or the frequency is not positive.
    """
    at_rest = np.zeros((*np.shape(t), parameters.model.system.n_states))
    return _at("forcing", 1, t, at_rest, parameters, frequency_hz)[..., 0]


def jacobian(t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Return the Jacobian of `rates`: entry [i, j] is the derivative of rate i by state j.

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
    system = parameters.model.system
    n_entries = len(places_of(system))
    return whole_jacobian(system, _at("jacobian", n_entries, t, state, parameters, frequency_hz))


def evaluate(names: Sequence[str], t: Any, state: Any, parameters: Parameters, frequency_hz: float) -> np.ndarray:
    """Return named quantities of the model, for example an energy or a torque.

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
