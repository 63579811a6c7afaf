"""Integrate branches (chains of cells), and compute the products of their cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from magpend_core import Sections, Status
from pipeline.layout.schema import REST_STATE, base_variables
from pipeline.motion.steady import Inputs
from pipeline.products.product import function_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.spec import Spec


@dataclass(frozen=True)
class Job:
    """Integrated cells with their specification and inputs, from which products are computed.

    Attributes
    ----------
    inputs : Inputs
        What `run_branches` took.
    cells : Sections
        Result of the integration, with leading dims (branch, point).
    """

    spec: Spec
    inputs: Inputs
    cells: Sections


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
