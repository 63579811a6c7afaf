"""Describe white noise on chosen equations of a system, and add its strengths to the system's parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.random_numbers import MAX_SOURCES
from magpend_core.engine.system import System
from magpend_core.sizes import NOISE_PREFIX, REALIZATION

ITO, STRATONOVICH = "ito", "stratonovich"


@dataclasses.dataclass(frozen=True)
class Noise:
    """White noise: independent Wiener processes on some equations of a system, dx_i = f_i dt + b_i(x) dW_i.

    The strength b_i is the parameter ``noise_<state>``, times entry i of `factors` if that is given. Then b_i
    may depend on x_i and on the states that have no noise, and not on other noisy states: that would need double
    integrals of two Wiener processes.

    Attributes
    ----------
    states : tuple of int
        Numbers of the states whose equations have noise, rising.
    factors : callable or None
        ``factors(y, c)``: a tuple with a number per noisy state, compiled like the system's functions, `c` its
        constants. None: additive noise.
    depends_on_own : tuple of bool
        For each noisy state whether its factor changes with this state; empty for none. Only then do the two
        interpretations differ.
    interpretation : str
        `ITO` or `STRATONOVICH`.
    """

    states: tuple[int, ...]
    factors: Callable[..., Any] | None = None
    depends_on_own: tuple[bool, ...] = ()
    interpretation: str = ITO

    @property
    def own(self) -> tuple[bool, ...]:
        """For each noisy state whether its factor depends on this state."""
        return self.depends_on_own or (False,) * len(self.states)

    @property
    def label(self) -> str:
        """Part of the compiled code's name."""
        marks = "".join("o" if own else "x" for own in self.own)
        return f"{'_'.join(map(str, self.states))}_{marks}_{self.interpretation[0]}"


def noise_parameters(system: System, noise: Noise) -> tuple[str, ...]:
    """Return the names of the parameters that noise adds to a system: the strengths, then the realization."""
    return (*(NOISE_PREFIX + system.state_names[i] for i in noise.states), REALIZATION)


def obstacles(system: System, noise: Noise) -> list[str]:
    """Return sentences on why a system cannot have this noise; empty if it can."""
    found = []
    if system.n_events:
        found.append(
            f"{system.name} has impacts, switches or a section by crossing: a noisy state crosses a surface "
            "infinitely often; replace them by steep smooth functions, or drop the noise."
        )
    elif system.n_modes:
        found.append(
            f"{system.name} has a drive that jumps within the period, and the steps of a noisy run are equal; "
            "replace the jump by a steep smooth function."
        )
    if not 0 < len(noise.states) <= MAX_SOURCES:
        found.append(f"noise acts on {len(noise.states)} equations; give 1 to {MAX_SOURCES}.")
    return found


@cache
def with_strengths(system: System, noise: Noise) -> System:
    """Return `system` with the strengths of the noise and the realization as its last parameters.

    Its right-hand side is unchanged; the strengths, ``c[n_constants - len(noise.states):]``, are for
    `noisy.strengths_of`.

    Raises
    ------
    ValueError
        If the system cannot have noise, see `obstacles`.
    """
    if found := obstacles(system, noise):
        raise ValueError(" ".join(found))
    n, m, k = system.n_constants, len(system.parameter_names), len(noise.states)
    own = f"c[:{n}]"
    bound = {
        "_constants": system.constants,
        "_rhs": system.rhs,
        "_forcing": system.forcing,
        "_jacobian": system.jacobian,
        "_layers": system.layers,
        "_quantities": system.quantities,
    }

    def wrap(head: str, body: str) -> Any:
        scope: dict[str, Any] = {"__name__": system.rhs.__module__, **bound}
        exec(f"def function({head}):\n    {body}\n", scope)
        return inline(scope["function"])

    copied = "; ".join(f"out[{n + i}] = p[{m + i}]" for i in range(k))
    return dataclasses.replace(
        system,
        name=f"{system.name}_noise_{'_'.join(map(str, noise.states))}",
        parameter_names=(*system.parameter_names, *noise_parameters(system, noise)),
        n_constants=n + k,
        constants=wrap("frequency, p, out", f"_constants(frequency, p, out); {copied}"),
        forcing=wrap("t, c", f"return _forcing(t, {own})"),
        rhs=wrap("y, u, c", f"return _rhs(y, u, {own})"),
        jacobian=None if system.jacobian is None else wrap("y, u, c", f"return _jacobian(y, u, {own})"),
        layers=wrap("y, dy, c", f"return _layers(y, dy, {own})"),
        quantities=None
        if system.quantities is None
        else wrap("t, y, dy, u, c", f"return _quantities(t, y, dy, u, {own})"),
    )
