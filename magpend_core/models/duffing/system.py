"""Define the Duffing oscillator's equations as a system that the engine integrates; `models` describes it."""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.system import System, positions
from magpend_core.engine.vecmath import TWO_PI, cos
from magpend_core.models.duffing.models import PARAMETERS, QUANTITIES, STATES

AT = positions(tuple(p.name for p in PARAMETERS))
C = positions(("damping", "linear", "cubic", "amplitude", "omega"))


@inline
def _constants(frequency: Any, p: Any, out: Any) -> None:
    out[C.damping] = p[AT.damping]
    out[C.linear] = p[AT.linear]
    out[C.cubic] = p[AT.cubic]
    out[C.amplitude] = p[AT.amplitude]
    out[C.omega] = TWO_PI * frequency


@inline
def _forcing(t: Any, c: Any) -> Any:
    return c[C.amplitude] * cos(c[C.omega] * t)


@inline
def _rhs(y: Any, u: Any, c: Any) -> Any:
    x, v = y
    return v, u - c[C.damping] * v - x * (c[C.linear] + c[C.cubic] * (x * x))


@inline
def _jacobian(y: Any, u: Any, c: Any) -> Any:
    x, _ = y
    zero = 0.0 * x
    return zero, zero + 1.0, -(c[C.linear] + 3.0 * c[C.cubic] * (x * x)), zero - c[C.damping]


@inline
def _quantities(t: Any, y: Any, dy: Any, u: Any, c: Any) -> Any:
    x, v = y
    xx = x * x
    energy = 0.5 * (v * v) + 0.5 * c[C.linear] * xx + 0.25 * c[C.cubic] * (xx * xx)
    return energy, u * v, c[C.damping] * (v * v), u


@inline
def _no_edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """Set no forcing edges: the drive is smooth."""


@inline
def _no_layers(y: Any, dy: Any, c: Any) -> Any:
    return ()


DUFFING = System(
    name="duffing",
    state_names=tuple(s.name for s in STATES),
    is_angle=tuple(s.on_circle for s in STATES),
    scales=tuple(s.scale for s in STATES),
    parameter_names=tuple(p.name for p in PARAMETERS),
    n_constants=len(C),
    constants=_constants,
    forcing=_forcing,
    rhs=_rhs,
    n_edges=0,
    edges=_no_edges,
    layers=_no_layers,
    has_layers=False,
    jacobian=_jacobian,
    escape=tuple(s.escape for s in STATES),
    quantity_names=tuple(q.name for q in QUANTITIES),
    quantities=_quantities,
)
