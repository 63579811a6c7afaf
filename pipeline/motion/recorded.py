"""Integrate cells under a drive that was recorded in an experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pipeline.motion.steady import Inputs, Steady, Values
from pipeline.specification.recorded_drive import TORQUE, RecordedDrive

if TYPE_CHECKING:
    from magpend_core.sections import Sections

MICROSECONDS_PER_INTERVAL = 0.9
"""Additional time per trajectory for each interval of a recorded torque."""


@dataclass(frozen=True)
class Recorded(Steady):
    """Motion under a recorded drive, from its start to its end."""

    drive: RecordedDrive

    kind: ClassVar[str] = "recorded"
    has_quantities: ClassVar[bool] = False  # the drive is another one at each section

    @property
    def frequency_meaning(self) -> str:
        return "mean frequency of the recorded drive"

    @property
    def obstacle(self) -> str:
        return f"its drive is the recording {self.drive.file}, which ends"

    @property
    def needed(self) -> str:
        return f"a run at a fixed frequency (frequency_hz = {self.drive.frequency_hz:.6g} instead of [drive])"

    def seconds_per_period(self, frequency_hz: np.ndarray) -> np.ndarray:
        seconds = super().seconds_per_period(frequency_hz)
        if self.drive.kind == TORQUE:
            seconds = seconds + self.drive.n_intervals / self.drive.n_periods * MICROSECONDS_PER_INTERVAL * 1e-6
        return seconds

    def integrate(self, inputs: Inputs, quantities: Sequence[str] | None) -> tuple[Sections, Values]:
        from magpend_core.recorded_drive import recorded_sections

        cells = recorded_sections(
            inputs.parameters[:, 0],
            self.drive.intervals,
            inputs.initial_states,
            ends=self.drive.section_ends,
            **self.settings,
            system=replace(self.model.system, method=self.integration.method),
            quantities=quantities,
        )
        return cells, {}

    def no_extension(self) -> str:
        return "cells under a recorded drive do not go on"
