"""Define placeholders for the functions that a system does not have."""

from __future__ import annotations

from typing import Any

from magpend_core.engine.jit import inline


@inline
def no_forcing(t: Any, c: Any) -> Any:
    """Return 0: the system has no forcing that depends on time explicitly."""
    return 0.0 * t


@inline
def no_edges(frequency: Any, p: Any, times: Any, half_widths: Any, jumps: Any) -> None:
    """Set no forcing edges: the forcing of this system never switches."""


@inline
def no_layers(y: Any, dy: Any, c: Any) -> Any:
    """Return no boundary layers: the right-hand side of this system has no region in which it changes quickly."""
    return ()
