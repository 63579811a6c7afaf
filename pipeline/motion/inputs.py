"""Define what the integration of cells begins with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Inputs:
    """Input arrays of `run_branches` for one task: parameters, frequencies and initial states of its branches.

    Attributes
    ----------
    parameters : ndarray, (branch, point, parameter)
    frequency_hz : ndarray, (branch, point)
    initial_states : ndarray, (branch, n_states)
    step_size : ndarray, (branch,), or None
        First step of each branch that continues an earlier task [s]; NaN for a branch that has ended. None
        for a task in which all branches begin.
    """

    parameters: np.ndarray
    frequency_hz: np.ndarray
    initial_states: np.ndarray
    step_size: np.ndarray | None = None

    def take(self, branches: Any) -> Inputs:
        """Return the inputs of selected branches."""
        step = None if self.step_size is None else self.step_size[branches]
        return Inputs(self.parameters[branches], self.frequency_hz[branches], self.initial_states[branches], step)
