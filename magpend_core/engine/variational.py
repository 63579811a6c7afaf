"""Extend a system by its variational equations, which integrate tangent vectors beside the trajectory.

`with_tangents` is for derivatives by the initial state, `with_parameter_tangent` for those by parameters as well.

The engine integrates the extended system like any other: first the states of the system, then the tangent vectors one
after the other, each with the analytic Jacobian along the trajectory. Only the system's own states enter the error
control, so the trajectory has the same steps and the same bits as without tangent vectors.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from typing import Any

from magpend_core.engine.jacobians import rows_of_entries
from magpend_core.engine.jit import inline
from magpend_core.engine.simd import absolute, maximum
from magpend_core.engine.system import System
from magpend_core.engine.tangents import DIVERGENCE, divergence_of, order_of
from magpend_core.engine.vecmath import log
from magpend_core.sizes import WRITTEN_OUT, too_many_states


def _first(n: int) -> str:
    return ", ".join(f"y[{i}]" for i in range(n))


def _products(system: System, n_vectors: int) -> list[str]:
    """Return source code for the components of J v, for each tangent vector v in turn."""
    n, found = system.n_states, []
    for k in range(n_vectors):
        for row in rows_of_entries(system):
            first, second = order_of(row)[:1], order_of(row)[1:2]
            # of two products the left one is fused (see `fusing`); so the product to be rounded goes to the right
            columns = [*second, *first, *order_of(row)[2:]]
            terms = [f"jacobian[{row[j]}] * y[{n * (1 + k) + j}]" for j in columns]
            found.append(" + ".join(terms) or "0.0 * y[0]")
    return found


def _compile(source: str, name: str, wrapped: Callable[..., Any], bindings: dict[str, Any]) -> Any:
    """Compile a function from source text. numba's cache treats it as part of the module of `wrapped`.

    See `jit.keeping` for the reason. The function calls `wrapped`.
    """
    scope: dict[str, Any] = {"__name__": wrapped.__module__, **bindings}
    exec(source, scope)
    return inline(scope[name])


@cache
def with_tangents(system: System, n_vectors: int, divergence: bool = False, written_out: bool | None = None) -> System:
    """Return `system` extended by `n_vectors` tangent vectors.

    A small system gets a right-hand side with the products of Jacobian and vectors written out. With a large
    one the engine loops over the vectors (see `tangents`): both give the same bits.

    Parameters
    ----------
    system
        System to linearise; must have a `jacobian`.
    n_vectors
        Number of tangent vectors, 1 to ``system.n_states``.
    divergence
        Whether one more state, the last, integrates the trace of the Jacobian: the logarithm of the
        factor by which the flow changes volumes. Of a map it is that of the last iteration.
    written_out
        Whether the products are written out; by default up to `sizes.WRITTEN_OUT` states.

    Returns
    -------
    System
        With n_states (1 + n_vectors) states, and one more for the divergence.

    Raises
    ------
    ValueError
        If `n_vectors` is out of bounds, or the system has more than `sizes.MAX_STATES` states.
    """
    n = system.n_states
    problem = too_many_states(system.name, n)
    if problem is not None:
        raise ValueError(problem)
    if not 1 <= n_vectors <= n:
        raise ValueError(f"n_vectors = {n_vectors} is out of bounds: it must be between 1 and {n}.")
    if written_out is None:
        written_out = n <= WRITTEN_OUT
    entries = n * n_vectors + divergence
    return dataclasses.replace(
        system,
        name=f"{system.name}_tangents{n_vectors}" + ("_divergence" if divergence else ""),
        state_names=(
            *system.state_names,
            *(f"d{s}_{k}" for k in range(n_vectors) for s in system.state_names),
            *[DIVERGENCE] * divergence,
        ),
        is_angle=(*system.is_angle, *[False] * entries),
        units=(*system.units, *[1.0] * entries),
        scales=(*system.scales, *[1.0] * entries),
        sizes=(*system.sizes * (1 + n_vectors), *[1.0] * divergence),
        escape=(*system.escape, *[math.inf] * entries),
        n_controlled=system.controlled,
        quantity_names=(),
        quantities=None,
        tangents_of=system,
        **(_extended_functions(system, n_vectors, divergence) if written_out else {"n_known": n}),
    )


def _extended_functions(system: System, n_vectors: int, divergence: bool) -> dict[str, Any]:
    """Return the functions of the system extended by its variational equations, with the Jacobian products written
    out.
    """
    n = system.n_states
    bindings = {"_rhs": system.rhs, "_jacobian": system.jacobian, "_layers": system.layers}
    if system.is_map:
        bindings |= {"absolute": absolute, "log": log, "maximum": maximum}
    parts = [f"dy[{i}]" for i in range(n)] + _products(system, n_vectors)
    if divergence:
        parts.append(divergence_of(system, "jacobian"))
    rhs = _compile(
        f"def rhs(y, u, c):\n"
        f"    base = ({_first(n)},)\n"
        f"    jacobian = _jacobian(base, u, c)\n"
        f"    dy = _rhs(base, u, c)\n"
        f"    return ({', '.join(parts)})\n",
        "rhs",
        system.rhs,
        bindings,
    )
    behind = [n * (1 + n_vectors) + divergence] if system.timed_layers else []  # index of the time
    rates = ", ".join(f"dy[{i}]" for i in (*range(n), *behind))
    layers = _compile(
        f"def layers(y, dy, c):\n    return _layers(({_first(n)},), ({rates},), c)\n", "layers", system.layers, bindings
    )
    events = {
        name: _compile(
            f"def {name}(t, y, dy, c):\n    return _{name}(t, ({_first(n)},), ({rates},), c)\n",
            name,
            function,
            {f"_{name}": function},
        )
        for name, function in (("switches", system.switches), ("impacts", system.impacts))
        if function is not None
    }
    return {"rhs": rhs, "layers": layers, **events}


PLUS, MINUS, PER_STEP = "_plus", "_minus", "per_step"
"""Suffixes of the increased and the decreased parameters, and the name of the parameter 1/(their difference)."""


@cache
def with_parameter_tangent(system: System) -> System:
    """Extend a system by one tangent vector: the derivative of the trajectory with respect to a parameter.

    The vector v obeys v' = J v + (f(c_plus) - f(c_minus)) per_step. The Jacobian J is analytic; the direct effect of
    the parameters on the right-hand side f and on the forcing is a central difference at each stage. For a derivative
    by the initial state, set all three sets of parameters equal, and let the vector begin as the change of the state.

    Parameters
    ----------
    system
        System to linearise; must have a `jacobian`.

    Returns
    -------
    System
        System with 2 n_states states. Its parameters are those of `system`, then a copy with the suffix ``_plus``, a
        copy with ``_minus``, and ``per_step``.

    Raises
    ------
    ValueError
        If the system has switches, impacts or segments, of which the parameters' effect is not followed.
    """
    if system.n_modes or system.n_events:
        raise ValueError(
            f"{system.name} has switches, impacts or segments: tangent vectors of parameters do not go "
            "through them; let the fit take its slopes as differences of trajectories."
        )
    n, m, nc = system.n_states, len(system.parameter_names), system.n_constants
    bindings = {
        "_rhs": system.rhs,
        "_jacobian": system.jacobian,
        "_layers": system.layers,
        "_edges": system.edges,
        "_forcing": system.forcing,
        "_constants": system.constants,
    }
    home = system.rhs

    def compiled(head: str, *lines: str) -> Any:
        return _compile(f"def function({head}):\n    " + "\n    ".join(lines) + "\n", "function", home, bindings)

    blocks = [f"_constants(frequency, p[{k * m}:{(k + 1) * m}], out[{k * nc}:{(k + 1) * nc}])" for k in range(3)]
    sets = [f"c{k} = c[{k * nc}:{(k + 1) * nc}]" for k in range(3)]
    changes = ", ".join(
        f"{product} + (f1[{i}] - f2[{i}]) * c[{3 * nc}]" for i, product in enumerate(_products(system, 1))
    )
    own_rates = f"dy[:{n}]" + (f" + (dy[{2 * n}],)" if system.timed_layers else "")
    own = ", ".join(f"f0[{i}]" for i in range(n))
    return dataclasses.replace(
        system,
        name=f"{system.name}_parameter_tangent",
        state_names=(*system.state_names, *(f"d{s}" for s in system.state_names)),
        parameter_names=(*(f"{name}{end}" for end in ("", PLUS, MINUS) for name in system.parameter_names), PER_STEP),
        n_constants=3 * nc + 1,
        is_angle=(*system.is_angle, *[False] * n),
        units=(*system.units, *[1.0] * n),
        scales=(*system.scales, *[1.0] * n),
        sizes=(*system.sizes, *[1.0] * n),
        escape=(*system.escape, *[math.inf] * n),
        n_controlled=system.controlled,
        constants=compiled("frequency, p, out", *blocks, f"out[{3 * nc}] = p[{3 * m}]"),
        # `forcing` returns the time, since `rhs` needs three values of the forcing, one for each set of parameters
        forcing=compiled("t, c", "return 1.0 * t"),
        rhs=compiled(
            "y, t, c",
            *sets,
            f"base = ({_first(n)},)",
            *(f"u{k} = _forcing(t, c{k})" for k in range(3)),
            *(f"f{k} = _rhs(base, u{k}, c{k})" for k in range(3)),
            "jacobian = _jacobian(base, u0, c0)",
            f"return ({own}, {changes})",
        ),
        layers=compiled("y, dy, c", f"return _layers(y[:{n}], {own_rates}, c[:{nc}])"),
        edges=compiled("frequency, p, at, widths, jumps", f"_edges(frequency, p[:{m}], at, widths, jumps)"),
        jacobian=None,
        quantity_names=(),
        quantities=None,
        tangents_of=system,
    )
