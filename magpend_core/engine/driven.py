"""Replace the forcing of a system by a recorded drive: linear in time on each interval, set by two additional
parameters.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np

from magpend_core.engine.jit import inline
from magpend_core.engine.placeholders import no_edges, no_forcing
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System

LEVEL, SLOPE = "recorded_drive", "recorded_drive_slope"
"""Names of the parameters: the forcing at the interval's start, and its change per second."""


def _wrapped(source: str, module: str, **bindings: Any) -> Any:
    """Compile a function from source text. numba's cache treats it as part of `module` (see `jit.keeping`)."""
    scope: dict[str, Any] = {"__name__": module, **bindings}
    exec(source, scope)
    return inline(scope["function"])


@cache
def with_recorded_drive(system: System) -> System:
    """Return `system` with its forcing replaced by a recorded drive, which is linear in time on each interval.

    The forcing is ``recorded_drive + recorded_drive_slope * t`` at time `t` [s] since the interval's start,
    in the unit of the system's own forcing. So it can interpolate measured values linearly, or hold them constant.

    Parameters
    ----------
    system
        A system with forcing.

    Returns
    -------
    System
        System with two more parameters at the end: ``recorded_drive`` and ``recorded_drive_slope``.

    Raises
    ------
    ValueError
        If the system has no forcing.
    """
    if system.forcing is no_forcing:
        raise ValueError(f"{system.name} has no drive: its forcing cannot be a recording.")
    if system.forcing_is_time or system.timed_layers:
        raise ValueError(f"{system.name}: time enters by more than one number; a recording cannot take its place.")
    n, m, module = system.n_constants, len(system.parameter_names), system.rhs.__module__
    # the functions of the system expect the modes right after its own constants, without the two new ones
    own = f"c[:{n}]" if not system.n_modes else f"c[:{n}] + c[{n + 2}:]"
    bindings = {
        "_constants": system.constants,
        "_rhs": system.rhs,
        "_jacobian": system.jacobian,
        "_layers": system.layers,
        "_quantities": system.quantities,
        "_switches": system.switches,
        "_impacts": system.impacts,
        "_reset": system.reset,
    }

    def wrap(head: str, body: str) -> Any:
        return _wrapped(f"def function({head}):\n    {body}\n", module, **bindings)

    events = {
        name: wrap(head, f"return _{name}({head[:-1]}{own})")
        for name, head, function in (
            ("switches", "t, y, dy, c", system.switches),
            ("impacts", "t, y, dy, c", system.impacts),
            ("reset", "k, t, y, c", system.reset),
        )
        if function is not None
    }
    return dataclasses.replace(
        system,
        **events,
        name=f"{system.name}_recorded",
        parameter_names=(*system.parameter_names, LEVEL, SLOPE),
        n_constants=n + 2,
        constants=wrap(
            "frequency, p, out", f"_constants(frequency, p, out); out[{n}] = p[{m}]; out[{n + 1}] = p[{m + 1}]"
        ),
        forcing=wrap("t, c", f"return c[{n}] + c[{n + 1}] * t"),
        rhs=wrap("y, u, c", f"return _rhs(y, u, {own})"),
        jacobian=None if system.jacobian is None else wrap("y, u, c", f"return _jacobian(y, u, {own})"),
        layers=wrap("y, dy, c", f"return _layers(y, dy, {own})"),
        quantities=(
            None if system.quantities is None else wrap("t, y, dy, u, c", f"return _quantities(t, y, dy, u, {own})")
        ),
        n_edges=0,
        edges=no_edges,
        recorded_for=system,
    )


def drive_parameters(system: System, packed: np.ndarray) -> tuple[str, ...]:
    """Return the parameters that affect a system's forcing and nothing else, such as its amplitude.

    They have no effect once a recorded drive replaces the forcing. To find them, each parameter is changed in turn, in
    plain Python at a few instants and states; nothing is compiled.

    Parameters
    ----------
    system
        Any system.
    packed
        Values of its parameters, shape (n_parameters,), at which it can be evaluated.

    Returns
    -------
    tuple of str
        Names of the parameters; empty if a function of the system cannot run in plain Python.
    """
    constants, forcing, rhs = (plain(f) for f in (system.constants, system.forcing, system.rhs))
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (4, system.n_states))

    def values(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        c = np.full(system.n_constants, np.nan)
        constants(1.0, p, c)
        drive = np.array([float(forcing(t, tuple(c))) for t in np.linspace(0.03, 0.97, 11)])
        return drive, np.array([rhs(tuple(y), 0.7, tuple(c)) for y in states])

    found = []
    try:
        drive, rates = values(packed)
        for i, name in enumerate(system.parameter_names):
            changed = packed.copy()
            changed[i] += 0.01 + 0.01 * abs(changed[i])
            own_drive, own_rates = values(changed)
            if np.array_equal(own_rates, rates) and not np.array_equal(own_drive, drive):
                found.append(name)
    except NotImplementedError:
        return ()
    return tuple(found)
