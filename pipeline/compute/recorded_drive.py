"""Integrate cells under a recorded drive."""

from __future__ import annotations

from collections.abc import Sequence

from magpend_core import Sections
from magpend_core.engine.system import System
from pipeline.layout.cells import Inputs
from pipeline.specification.drive_files import RecordedDrive
from pipeline.specification.tables import Integration


def under_recording(
    drive: RecordedDrive, inputs: Inputs, system: System, integration: Integration, quantities: Sequence[str] | None
) -> Sections:
    """Integrate the cells of a sweep from the recording's start, and return their last section points.

    Parameters
    ----------
    drive
        The recording.
    inputs
        Cells: branches of one point.
    system
        System of equations to integrate.
    integration
        The table ``[integration]``; the specification refuses another method and early stops.
    quantities
        Names of the quantities to watch.
    """
    from magpend_core.recorded_drive import recorded_sections

    return recorded_sections(
        inputs.parameters[:, 0],
        drive.intervals,
        inputs.initial_states,
        ends=drive.section_ends,
        n_transient=integration.n_transient,
        n_keep=integration.n_keep,
        rtol=integration.rtol,
        atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period,
        closure_tolerance=integration.closure_tolerance,
        max_orbit_period=integration.max_orbit_period,
        system=system,
        quantities=quantities,
    )
