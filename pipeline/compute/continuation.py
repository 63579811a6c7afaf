"""Continue branches bit for bit from where another task ended them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from magpend_core import Sections, Status, run_branches
from magpend_core.engine.system import System
from pipeline.layout.cells import Inputs
from pipeline.specification.tables import Integration

WALKED = ("section", "rest_state", "status", "step_size")
"""Variables that say where a branch was left; the last kept section is the state at the cell's end."""


def going_on(inputs: Inputs, before: Mapping[str, np.ndarray]) -> Inputs:
    """Return the inputs with branches that start where the task before ended them.

    Parameters
    ----------
    inputs
        Branches as if they began here.
    before
        Variables `WALKED` of the cell before each branch's first one, in the order of the branches: any
        leading dims, a point of the path among them, then the variable's own.
    """
    n_branches, n_states = inputs.initial_states.shape
    section = before["section"]
    states = section.reshape(n_branches, -1, n_states)[:, -1]
    if "rest_state" in before:  # a branch goes on from where it did not come back to the section
        is_left = before["status"].reshape(n_branches, 1) == Status.NO_RETURN
        states = np.where(is_left, before["rest_state"].reshape(n_branches, n_states), states)
    return replace(inputs, initial_states=states, step_size=before["step_size"].reshape(n_branches))


def walk(inputs: Inputs, system: System, integration: Integration, quantities: Sequence[str] | None) -> Sections:
    """Integrate branches by `magpend_core.run_branches`; those that ended before are marked as unreached.

    Parameters
    ----------
    inputs
        The branches.
    system
        What is integrated.
    integration
        The table ``[integration]``.
    quantities
        Names of the quantities to watch.
    """
    alive = np.ones(len(inputs.initial_states), bool) if inputs.step_size is None else np.isfinite(inputs.step_size)
    some = inputs.take(alive)
    cells = run_branches(
        some.parameters,
        some.frequency_hz,
        some.initial_states,
        n_transient=integration.n_transient,
        n_keep=integration.n_keep,
        rtol=integration.rtol,
        atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period,
        stop_when_closed=integration.stop_when_closed,
        closure_tolerance=integration.closure_tolerance,
        max_orbit_period=integration.max_orbit_period,
        step_size=some.step_size,
        system=replace(system, method=integration.method),
        quantities=quantities,
    )
    if alive.all():
        return cells
    found: dict[str, Any] = {f.name: getattr(cells, f.name) for f in fields(cells)}
    return Sections(**{name: _spread(name, array, alive) for name, array in found.items()})


def _spread(name: str, found: Any, alive: np.ndarray) -> Any:
    """Spread the results of living branches over all branches, with fill values for the others."""
    if found is None:
        return None
    fill = int(Status.UNREACHED) if name == "status" else np.nan if found.dtype.kind == "f" else 0
    whole = np.full((len(alive), *found.shape[1:]), fill, found.dtype)
    whole[alive] = found
    return whole
