"""Continue branches in a new task from the final states of the preceding task, with the same bits as in one task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from magpend_core import Status
from pipeline.motion.steady import Inputs

WALKED = ("section", "rest_state", "status", "step_size")
"""Variables that say where a branch was left; the last kept section is the state at the cell's end."""


def going_on(inputs: Inputs, before: Mapping[str, np.ndarray]) -> Inputs:
    """Replace the initial states of branches by the states in which the preceding task ended.

    Parameters
    ----------
    inputs
        Branches as if they began here.
    before
        Variables `WALKED` of the cell before each branch's first one, in the order of the branches: any
        leading dims, a point of the path among them, then the variable's own.
    """
    n_branches, n_states = inputs.initial_states.shape
    section = before["section"]
    states = section.reshape(n_branches, -1, n_states)[:, -1]
    if "rest_state" in before:  # a branch goes on from where it did not come back to the section
        is_left = before["status"].reshape(n_branches, 1) == Status.NO_RETURN
        states = np.where(is_left, before["rest_state"].reshape(n_branches, n_states), states)
    return replace(inputs, initial_states=states, step_size=before["step_size"].reshape(n_branches))
