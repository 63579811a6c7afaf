"""A system under a recorded drive: its forcing is a line in each interval, given by two more parameters."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

from magpend_core.engine.absent import no_edges, no_forcing
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System

LEVEL, SLOPE = "recorded_drive", "recorded_drive_slope"
"""Names of the parameters: the forcing at the interval's start, and its change per second."""


def _wrapped(source: str, module: str, **bindings: Any) -> Any:
    """Compile a one-function source; it passes for a function of `module` (see `jit.is_covered`)."""
    scope: dict[str, Any] = {"__name__": module, **bindings}
    exec(source, scope)
    return inline(scope["function"])


@cache
def with_recorded_drive(system: System) -> System:
    """Return `system` with a forcing that is a recording instead of its own.

    The forcing is ``recorded_drive + recorded_drive_slope * t`` at time `t` [s] since the interval's start,
    in the unit of the system's own forcing; so measured values are joined by lines, or held between switches.

    Parameters
    ----------
    system
        Any system; one without forcing has nothing that a drive could act on.

    Returns
    -------
    System
        With two parameters more, the last ones.

    Raises
    ------
    ValueError
        If the system has no forcing.
    """
    if system.forcing is no_forcing:
        raise ValueError(f"{system.name} has no drive: its forcing cannot be a recording.")
    n, m, module = system.n_constants, len(system.parameter_names), system.rhs.__module__
    own = f"c[:{n}]"
    bindings = {
        "_constants": system.constants, "_rhs": system.rhs, "_jacobian": system.jacobian,
        "_layers": system.layers, "_quantities": system.quantities,
    }  # fmt: skip

    def wrap(head: str, body: str) -> Any:
        return _wrapped(f"def function({head}):\n    {body}\n", module, **bindings)

    return dataclasses.replace(
        system,
        name=f"{system.name}_recorded",
        parameter_names=(*system.parameter_names, LEVEL, SLOPE),
        n_constants=n + 2,
        constants=wrap(
            "frequency, p, out",
            f"_constants(frequency, p, out); out[{n}] = p[{m}]; out[{n + 1}] = p[{m + 1}]",
        ),
        forcing=wrap("t, c", f"return c[{n}] + c[{n + 1}] * t"),
        rhs=wrap("y, u, c", f"return _rhs(y, u, {own})"),
        jacobian=None if system.jacobian is None else wrap("y, u, c", f"return _jacobian(y, u, {own})"),
        layers=wrap("y, dy, c", f"return _layers(y, dy, {own})"),
        quantities=(
            None
            if system.quantities is None
            else wrap("t, y, dy, u, c", f"return _quantities(t, y, dy, u, {own})")
        ),
        n_edges=0,
        edges=no_edges,
        recorded_for=system,
    )
