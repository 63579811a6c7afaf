"""Evaluate the rates of an autonomous system and their Jacobian in numpy, at states with parameters of their own each.

Nothing is compiled: the functions of the system run as plain Python, on arrays. For a few dozen states this costs less
than a call of compiled code for each vector of parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from magpend_core.engine import vecmath
from magpend_core.engine.jacobians import whole_jacobian
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System

SUBSTITUTES: dict[Callable[..., Any], Callable[..., Any]] = {
    vecmath.exp: np.exp,
    vecmath.expm1: np.expm1,
    vecmath.log: np.log,
    vecmath.power: np.power,
    vecmath.sincos: lambda x: (np.sin(x), np.cos(x)),
    vecmath.sin: np.sin,
    vecmath.cos: np.cos,
    vecmath.tan: np.tan,
    vecmath.sinh: np.sinh,
    vecmath.cosh: np.cosh,
    vecmath.tanh: np.tanh,
    vecmath.atan: np.arctan,
    vecmath.atan2: np.arctan2,
    vecmath.asin: np.arcsin,
    vecmath.acos: np.arccos,
}
"""Functions of numpy in place of the engine's functions of SIMD vectors."""


@cache
def _functions(system: System) -> tuple[Callable[..., Any], ...]:
    wanted = system.constants, system.forcing, system.rhs, system.jacobian, system.switches
    return tuple(plain(function, SUBSTITUTES) if function is not None else None for function in wanted)  # type: ignore[misc]


def plain_rates(system: System, states: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates of an autonomous system, and their Jacobians. Nothing is checked.

    Parameters
    ----------
    system
        Without a drive, with a Jacobian.
    states
        Shape (n, n_states).
    packed
        Parameters of each state, shape (n, n_parameters).

    Returns
    -------
    rates : ndarray, (n, n_states)
    jacobians : ndarray, (n, n_states, n_states)
    """
    constants, forcing, rhs, jacobian, switches = _functions(system)
    own = np.ones((len(states), system.n_constants + system.n_modes))
    y = tuple(states.T)
    with np.errstate(all="ignore"):
        for row, parameters in zip(own, packed, strict=True):
            constants(1.0, parameters, row)
        c = own.T
        if switches is not None:
            for k, (value, _) in enumerate(switches(0.0, y, y, c)):
                c[system.n_constants + k] = np.where(value < 0.0, -1.0, 1.0)
        u = forcing(0.0, c)
        rates, entries = (_columns(of(y, u, c), len(states)) for of in (rhs, jacobian))
    return rates, whole_jacobian(system, entries)


def _columns(found: tuple[Any, ...], n: int) -> np.ndarray:
    """Return arrays of length n, or single numbers, as columns."""
    columns = np.empty((n, len(found)))
    for k, one in enumerate(found):
        columns[:, k] = one
    return columns
