"""Integrate branches (chains of cells), continue them in a new task, and compute the products of their cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from magpend_core import Sections, Status
from pipeline.layout.schema import REST_STATE, base_variables
from pipeline.motion.steady import Inputs
from pipeline.products.product import function_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.spec import Spec


@dataclass(frozen=True)
class Job:
    """Integrated cells with their specification and inputs, from which products are computed."""

    spec: Spec
    inputs: Inputs  # what `run_branches` took
    cells: Sections  # result of the integration, with leading dims (branch, point)


def integrate(spec: Spec, inputs: Inputs) -> dict[str, np.ndarray]:
    """Integrate branches, compute their products, and return all variables with the leading dims (branch, point)."""
    cells, own = spec.motion.integrate(inputs, watched_quantities(spec))
    if spec.section is not None:
        own[REST_STATE.name] = rest_states(cells)
    values = {
        v.name: np.asarray(own.get(v.name, getattr(cells, v.name, None)), dtype=v.dtype)
        for v in base_variables(spec.model)
    }
    job = Job(spec, inputs, cells)
    for name, options in spec.products.items():
        values |= function_of(CELL_PRODUCTS[name].compute)(job, options)
    return values


def watched_quantities(spec: Spec) -> list[str] | None:
    """Return the names of the quantities that products record during the integration; None if there are none."""
    return [name for k, options in spec.products.items() for name in CELL_PRODUCTS[k].watches(options)] or None


def rest_states(cells: Sections) -> np.ndarray:
    """Return the final states of trajectories that never returned to the Poincare section; NaN for all others."""
    is_left = cells.status == Status.NO_RETURN
    return np.where(is_left[..., None], cells.final_state, np.nan)


Integrate = Callable[[Spec, Inputs], dict[str, np.ndarray]]
"""From branches to all their variables, with leading dims (branch, point)."""


WALKED = ("section", "rest_state", "status", "step_size")
"""Variables that say where a branch was left; the last kept section is the state at the cell's end."""


def going_on(inputs: Inputs, before: Mapping[str, np.ndarray]) -> Inputs:
    """Replace the initial states of branches by the states in which the preceding task ended.

    `before` has the variables `WALKED` of the cell before each branch's first one, in the order of the branches: any
    leading dims, a point of the path among them, then the variable's own.
    """
    n_branches, n_states = inputs.initial_states.shape
    section = before["section"]
    states = section.reshape(n_branches, -1, n_states)[:, -1]
    if "rest_state" in before:  # a branch goes on from where it did not come back to the section
        is_left = before["status"].reshape(n_branches, 1) == Status.NO_RETURN
        states = np.where(is_left, before["rest_state"].reshape(n_branches, n_states), states)
    return replace(inputs, initial_states=states, step_size=before["step_size"].reshape(n_branches))
