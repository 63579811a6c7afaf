"""Compute the product ``rotation``: the rotation number of each cell, from its last section point onwards."""

from __future__ import annotations

import numpy as np

from magpend_core import Status
from magpend_core.rotation import WIDEST_TURN, RotationNumbers, TurningState, rotation_numbers
from pipeline.compute.integrate import Job
from pipeline.products.rotation import ROTATION_VARIABLES, RotationFlag, RotationOptions


def rotation(job: Job, options: RotationOptions) -> dict[str, np.ndarray]:
    """Compute the rotation numbers of the cells of a task, with their errors and quality flags.

    Arrays have dims (branch, point). A cell without an attractor (diverged, step limit, unreached) has NaN and the flag
    ``ABSENT``.
    """
    cells, inputs, integration = job.cells, job.inputs, job.spec.integration
    branch, point = np.nonzero(np.isin(cells.status, (Status.PERIODIC, Status.BOUNDED)))
    names = job.spec.motion.system.state_names
    found = rotation_numbers(
        inputs.parameters[branch, point],
        inputs.frequency_hz[branch, point],
        cells.section[branch, point, -1],
        system=job.spec.motion.system,
        turning=TurningState(tuple(names.index(name) for name in options.of), options.center, options.section),
        n_periods=options.n_periods,
        orbit_period=np.where(options.section, 0, cells.orbit_period[branch, point]),
        rtol=integration.rtol,
        atol=integration.atol,
    )
    values = {"rotation": found.rotation, "rotation_error": found.error, "rotation_flag": flags(found)}
    filled = {}
    for variable in ROTATION_VARIABLES:
        filled[variable.name] = np.full(cells.status.shape, variable.fill, variable.dtype)
        filled[variable.name][branch, point] = values[variable.name]
    return filled


def flags(found: RotationNumbers) -> np.ndarray:
    """Return a quality flag (`RotationFlag`) for the rotation number of each cell."""
    flag = np.full(len(found.status), RotationFlag.GOOD, np.int8)
    flag[found.widest_turn > WIDEST_TURN] = RotationFlag.COARSE
    flag[found.status != Status.BOUNDED] = RotationFlag.FAILED
    return flag
