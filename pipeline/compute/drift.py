"""Integrate cells whose parameters move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from magpend_core import Sections
from magpend_core.engine.system import System
from pipeline.layout.cells import Inputs
from pipeline.specification.tables import Integration

if TYPE_CHECKING:
    from magpend_core.models.drift.sections import Drift


def while_drifting(
    drift: Drift, inputs: Inputs, system: System, integration: Integration, quantities: Sequence[str] | None
) -> Sections:
    """Integrate the cells of a sweep while their parameters move, and return their last section points.

    Parameters
    ----------
    drift
        How the parameters move.
    inputs
        Cells: branches of one point.
    system
        What is integrated.
    integration
        The table ``[integration]``; the specification refuses early stops.
    quantities
        Names of the quantities to watch.
    """
    from magpend_core.models.drift.sections import drifting_sections

    return drifting_sections(
        replace(system, method=integration.method),
        drift,
        inputs.parameters[:, 0],
        inputs.frequency_hz[:, 0],
        inputs.initial_states,
        n_transient=integration.n_transient,
        n_keep=integration.n_keep,
        rtol=integration.rtol,
        atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period,
        closure_tolerance=integration.closure_tolerance,
        max_orbit_period=integration.max_orbit_period,
        quantities=quantities,
    )
