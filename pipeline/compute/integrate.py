"""Integrate branches of a run: sections, and the products that go on from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magpend_core import Sections, Status
from magpend_core.engine.system import System
from pipeline.compute.continuation import walk
from pipeline.compute.recorded_drive import under_recording
from pipeline.layout.cells import Inputs
from pipeline.layout.schema import REST_STATE, base_variables
from pipeline.products.product import function_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.parsing import Spec


@dataclass(frozen=True)
class Job:
    """Cells that were integrated, for the products that go on from them.

    Attributes
    ----------
    spec : Spec
    inputs : Inputs
        What `run_branches` took.
    cells : Sections
        What it returned, with leading dims (branch, point).
    """

    spec: Spec
    inputs: Inputs
    cells: Sections

    @property
    def system(self) -> System:
        """What was integrated, by which method."""
        return replace(self.spec.model.system, method=self.spec.integration.method)


def integrate(spec: Spec, inputs: Inputs) -> dict[str, np.ndarray]:
    """Return all variables of some branches, with leading dims (branch, point)."""
    how = spec.model.system, spec.integration, watched_quantities(spec)
    cells = walk(inputs, *how) if spec.recorded is None else under_recording(spec.recorded, inputs, *how)
    own = {REST_STATE.name: rest_states(cells)} if spec.section is not None else {}
    values = {
        v.name: np.asarray(own.get(v.name, getattr(cells, v.name, None)), dtype=v.dtype)
        for v in base_variables(spec.model)
    }
    job = Job(spec, inputs, cells)
    for name, options in spec.products.items():
        values |= function_of(CELL_PRODUCTS[name].compute)(job, options)
    return values


def watched_quantities(spec: Spec) -> list[str] | None:
    """Return the names of the quantities that products watch while cells are integrated; None if there are none."""
    return [name for k, options in spec.products.items() for name in CELL_PRODUCTS[k].watches(options)] or None


def rest_states(cells: Sections) -> np.ndarray:
    """Return the last states of cells without a return to the section, NaN for all others."""
    is_left = cells.status == Status.NO_RETURN
    return np.where(is_left[..., None], cells.final_state, np.nan)


Integrate = Callable[[Spec, Inputs], dict[str, np.ndarray]]
"""From branches to all their variables, with leading dims (branch, point)."""
