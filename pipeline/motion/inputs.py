"""Define what the integration of cells begins with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magpend_core.status import Status

WALKED = ("section", "rest_state", "status", "step_size")
"""Variables that say where a branch was left; the last kept section is the state at the cell's end."""


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

    def continuing(self, before: Mapping[str, np.ndarray]) -> Inputs:
        """Replace the initial states of branches by the states in which the preceding task ended, so that the bits are
        those of one task.

        Parameters
        ----------
        before
            Variables `WALKED` of the cell before each branch's first one, in the order of the branches: any
            leading dims, a point of the path among them, then the variable's own.
        """
        n_branches, n_states = self.initial_states.shape
        states = before["section"].reshape(n_branches, -1, n_states)[:, -1]
        if "rest_state" in before:  # a branch goes on from where it did not come back to the section
            is_left = before["status"].reshape(n_branches, 1) == Status.NO_RETURN
            states = np.where(is_left, before["rest_state"].reshape(n_branches, n_states), states)
        return replace(self, initial_states=states, step_size=before["step_size"].reshape(n_branches))

    def take(self, branches: Any) -> Inputs:
        """Return the inputs of selected branches."""
        step = None if self.step_size is None else self.step_size[branches]
        return Inputs(self.parameters[branches], self.frequency_hz[branches], self.initial_states[branches], step)
