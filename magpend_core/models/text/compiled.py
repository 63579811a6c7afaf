"""Compile the equations of a model given as text into a system for the engine."""

from __future__ import annotations

import hashlib
import math
from typing import Any

from magpend_core.engine import simd, vecmath
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.expressions.writer import SIMD, VECMATH
from magpend_core.models.text import runtime
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.derive import Derived
from magpend_core.models.text.generate import Source
from magpend_core.models.text.layers import FADING

_MODULE = __name__  # a module that later processes find, as the compile cache must


def system_of(definition: Definition, derived: Derived, source: Source) -> System:
    """Return the system that the engine integrates, compiled from a model's generated source.

    Parameters
    ----------
    definition
        What the text says.
    derived, source
        What follows from it; the digest of the source names the compiled code.
    """
    functions = _compiled(source.text)
    states, forcing = definition.states, derived.forcing
    digest = hashlib.sha256(source.text.encode()).hexdigest()[:16]
    n_switches, n_impacts = len(derived.switches), len(derived.impacts)
    return System(
        name=f"{definition.name.replace('-', '_')}_{digest}",
        state_names=tuple(s.name for s in states),
        parameter_names=tuple(p.name for p in definition.parameters),
        n_constants=source.n_constants,
        constants=functions["constants"],
        forcing=None if forcing is None else functions["forcing"],  # type: ignore[arg-type]
        forcing_is_time=forcing is not None and forcing.op == "time",
        rhs=functions["rhs"],
        is_map=definition.is_map,
        jacobian=functions["jacobian"] if derived.jacobian else None,
        jacobian_entries=source.jacobian_entries,
        is_angle=tuple(s.on_circle for s in states),
        units=tuple(s.scale for s in states),
        scales=tuple(s.measure for s in states),
        farthest=max(s.farthest for s in states),
        sizes=tuple(s.size for s in states),
        escape=tuple(s.escape for s in states),
        n_edges=source.n_edges,
        edges=functions.get("edges"),  # type: ignore[arg-type]
        layers=functions["layers"] if derived.layers else None,  # type: ignore[arg-type]
        has_layers=bool(derived.layers),
        timed_layers=derived.timed_layers,
        has_poles=True,  # what is bad input was refused before: see `domains`
        layers_fade=all(layer.steep.form in FADING for layer in derived.layers),
        n_modes=source.n_modes,
        n_switches=n_switches,
        switches=functions["switches"] if n_switches else None,
        slides=derived.sliding.slides,
        has_segments=bool(derived.instants),
        n_impacts=n_impacts,
        impacts=functions["impacts"] if n_impacts else None,
        impact_directions=tuple(i.direction for i in derived.impacts),
        sticks=derived.sticks,
        reset=functions["reset"] if n_impacts else None,
        surface=functions["surface"] if derived.surface else None,
        surface_unit=definition.surface_unit,
        quantity_names=tuple(definition.quantities),
        quantities=functions["quantities"] if definition.quantities else None,
    )


def _compiled(source: str) -> dict[str, Any]:
    """Execute generated source and return its compiled functions. The source can only do arithmetic."""
    scope: dict[str, Any] = {"__name__": _MODULE, "math_inf": math.inf}
    for name in (*SIMD, *VECMATH):
        scope[name] = getattr(simd if name in SIMD else vecmath, name)
    for name in ("rank", "set_times", "within"):
        scope[name] = getattr(runtime, name)
    known = set(scope)
    exec(source, scope)
    # each calls those before it alone
    for name in [name for name in scope if name not in known and not name.startswith("__")]:
        scope[name] = inline(scope[name])
    return scope
