"""Define placeholders for the functions that a system does not have."""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline


@inline
def no_forcing(t: Any, c: Any) -> Any:
    """No explicit time dependence."""
    return 0.0 * t


@inline
def no_edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """No instant at which the forcing switches."""


@inline
def no_layers(y: Any, dy: Any, c: Any) -> Any:
    """No place at which the right-hand side changes quickly."""
    return ()
