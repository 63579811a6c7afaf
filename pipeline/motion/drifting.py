"""Integrate cells whose parameters move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from magpend_core.models.drift.ramps import Ramp
from magpend_core.models.model import Parameters
from pipeline.motion.steady import Inputs, Steady, Values

if TYPE_CHECKING:
    from magpend_core.models.drift.sections import Drift
    from magpend_core.sections import Sections


@dataclass(frozen=True)
class Drifting(Steady):
    """Motion while parameters move."""

    ramps: tuple[Ramp, ...]  # how each parameter moves
    values: Parameters  # values of the parameters that are not swept
    corners: tuple[np.ndarray, np.ndarray]  # packed parameters and frequencies of cells at the ends of all axes

    kind: ClassVar[str] = "drifting"
    has_quantities: ClassVar[bool] = False  # the parameters are others at each section

    @property
    def obstacle(self) -> str:
        names = " and ".join(ramp.parameter for ramp in self.ramps)
        words = f"parameter {names} moves" if len(self.ramps) == 1 else f"parameters {names} move"
        return f"its {words} ([drift])"

    @property
    def needed(self) -> str:
        return "a run with constant parameters, without [drift]"

    @cached_property
    def drift(self) -> Drift:
        """The motion of the parameters, in the form that the numerical core takes."""
        from magpend_core.models.drift.sections import Drift

        return Drift.of(self.model.system, self.ramps, self.values.names, *self.corners)

    def sections(
        self, parameters: np.ndarray, frequency_hz: np.ndarray, starts: np.ndarray, **changed: Any
    ) -> Sections:
        """Integrate cells from time 0 with the settings of the run, or others that are given."""
        from magpend_core.models.drift.sections import drifting_sections

        return drifting_sections(
            self.system, self.drift, parameters, frequency_hz, starts, **{**self.settings, **changed}
        )

    def integrate(self, inputs: Inputs, quantities: Sequence[str] | None) -> tuple[Sections, Values]:
        cells = inputs.parameters[:, 0], inputs.frequency_hz[:, 0], inputs.initial_states
        return self.sections(*cells, quantities=quantities), {}

    def no_extension(self) -> str:
        return "cells whose parameters move do not go on"
