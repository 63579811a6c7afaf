"""Integrate branches (chains of cells), and compute the products of their cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from magpend_core import Sections, Status, run_branches
from magpend_core.engine.system import System
from pipeline.compute.drift import while_drifting
from pipeline.compute.noise import under_noise
from pipeline.compute.recorded_drive import under_recording
from pipeline.layout.cells import Inputs
from pipeline.layout.schema import REST_STATE, STRONG_ERROR, base_variables
from pipeline.products.product import function_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.parsing import Spec
from pipeline.specification.tables import Integration


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

    @property
    def system(self) -> System:
        """System of the run's model, with the integration method of the run."""
        return replace(self.spec.model.system, method=self.spec.integration.method)


def integrate(spec: Spec, inputs: Inputs) -> dict[str, np.ndarray]:
    """Integrate branches, compute their products, and return all variables with the leading dims (branch, point)."""
    own: dict[str, np.ndarray] = {}
    how = spec.model.system, spec.integration, watched_quantities(spec)
    if spec.noise is not None:
        cells, own[STRONG_ERROR.name] = under_noise(spec, inputs)
    elif spec.drift:
        cells = while_drifting(spec.motion, inputs, *how)
    else:
        cells = walk(inputs, *how) if spec.recorded is None else under_recording(spec.recorded, inputs, *how)
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


def walk(inputs: Inputs, system: System, integration: Integration, quantities: Sequence[str] | None) -> Sections:
    """Integrate branches point by point. Branches that failed in the preceding task get the status UNREACHED.

    Parameters
    ----------
    inputs
        The branches.
    system
        System of equations to integrate.
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
    """Copy results of the integrated branches into arrays of all branches, with fill values for the other branches."""
    if found is None:
        return None
    fill = int(Status.UNREACHED) if name == "status" else np.nan if found.dtype.kind == "f" else 0
    whole = np.full((len(alive), *found.shape[1:]), fill, found.dtype)
    whole[alive] = found
    return whole


def watched_quantities(spec: Spec) -> list[str] | None:
    """Return the names of the quantities that products record during the integration; None if there are none."""
    return [name for k, options in spec.products.items() for name in CELL_PRODUCTS[k].watches(options)] or None


def rest_states(cells: Sections) -> np.ndarray:
    """Return the final states of trajectories that never returned to the Poincare section; NaN for all others."""
    is_left = cells.status == Status.NO_RETURN
    return np.where(is_left[..., None], cells.final_state, np.nan)


Integrate = Callable[[Spec, Inputs], dict[str, np.ndarray]]
"""From branches to all their variables, with leading dims (branch, point)."""
