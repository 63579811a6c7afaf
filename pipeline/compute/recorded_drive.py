"""Integrate cells under a recorded drive."""

from __future__ import annotations

from typing import Any

from magpend_core import Sections
from pipeline.layout.cells import Inputs
from pipeline.specification.drive_files import RecordedDrive


def under_recording(drive: RecordedDrive, inputs: Inputs, **keywords: Any) -> Sections:
    """Integrate the cells of a sweep from the recording's start to the sections that are kept.

    Parameters
    ----------
    drive
        The recording.
    inputs
        Cells: branches of one point.
    keywords
        As for `magpend_core.run_branches`.
    """
    from magpend_core.recorded_drive import recorded_sections

    del keywords["stop_when_closed"]  # refused with the specification
    return recorded_sections(
        inputs.parameters[:, 0], drive.intervals, inputs.initial_states, ends=drive.section_ends, **keywords
    )
