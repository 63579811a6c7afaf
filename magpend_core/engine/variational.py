"""Tangent vectors beside a trajectory: the system extended by its variational equations.

The engine integrates the extended system like any other: the states of the system, then the tangent
vectors one after the other, each driven by the analytic Jacobian along the trajectory. Only the
system's own states enter the error control, so that the trajectory is, step by step, the one that it
is without tangents.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.system import System


def _first(n: int) -> str:
    return ", ".join(f"y[{i}]" for i in range(n))


def _products(n: int, n_vectors: int) -> str:
    """Source of J v for each tangent vector v, entry by entry."""
    return ", ".join(
        " + ".join(f"jacobian[{i * n + j}] * y[{n * (1 + k) + j}]" for j in range(n))
        for k in range(n_vectors)
        for i in range(n)
    )


def _compile(source: str, name: str, wrapped: Callable[..., Any], bindings: dict[str, Any]) -> Any:
    """Compile a one-function source; numba cannot build a tuple of given length in a loop.

    It passes for a function of the module of `wrapped`, which it calls (see `jit.is_covered`).
    """
    scope: dict[str, Any] = {"__name__": wrapped.__module__, **bindings}
    exec(source, scope)
    return inline(scope[name])


@cache
def with_tangents(system: System, n_vectors: int, divergence: bool = False) -> System:
    """Return `system` extended by `n_vectors` tangent vectors.

    Parameters
    ----------
    system
        What is linearised; needs its `jacobian`.
    n_vectors
        1 to ``system.n_states``.
    divergence
        Whether one more state, the last, integrates the trace of the Jacobian: the logarithm of the
        factor by which the flow changes volumes.

    Returns
    -------
    System
        With n_states (1 + n_vectors) states, and one more for the divergence.

    Raises
    ------
    ValueError
        If `n_vectors` is out of bounds.
    """
    n = system.n_states
    if not 1 <= n_vectors <= n:
        raise ValueError(f"n_vectors = {n_vectors} is out of bounds: it must be between 1 and {n}.")
    bindings = {"_rhs": system.rhs, "_jacobian": system.jacobian, "_layers": system.layers}
    trace = ", " + " + ".join(f"jacobian[{i * n + i}]" for i in range(n)) if divergence else ""
    rhs = _compile(
        f"def rhs(y, u, c):\n"
        f"    base = ({_first(n)},)\n"
        f"    jacobian = _jacobian(base, u, c)\n"
        f"    dy = _rhs(base, u, c)\n"
        f"    return ({', '.join(f'dy[{i}]' for i in range(n))}, {_products(n, n_vectors)}{trace})\n",
        "rhs",
        system.rhs,
        bindings,
    )
    rates = ", ".join(f"dy[{i}]" for i in range(n))
    layers = _compile(
        f"def layers(y, dy, c):\n    return _layers(({_first(n)},), ({rates},), c)\n",
        "layers",
        system.layers,
        bindings,
    )
    entries = n * n_vectors + divergence
    return dataclasses.replace(
        system,
        name=f"{system.name}_tangents{n_vectors}" + ("_divergence" if divergence else ""),
        state_names=(
            *system.state_names,
            *(f"d{s}_{k}" for k in range(n_vectors) for s in system.state_names),
            *["divergence"] * divergence,
        ),
        is_angle=(*system.is_angle, *[False] * entries),
        scales=(*system.scales, *[1.0] * entries),
        escape=(*system.escape, *[math.inf] * entries),
        n_controlled=system.controlled,
        rhs=rhs,
        layers=layers,
        quantity_names=(),
        quantities=None,
        tangents_of=system,
    )
