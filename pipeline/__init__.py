"""Run parameter sweeps and continuations of dynamical systems: from a specification to the run's result cube and its
figures.

`open_run` opens a run directory. It is imported at its first use, so that the
command line answers quickly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.store.run import open_run

__all__ = ["open_run"]


def __getattr__(name: str) -> Any:
    if name == "open_run":
        from pipeline.store.run import open_run

        return open_run
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
