"""Compute the product ``lyapunov``: the Lyapunov exponents of each cell, from its last section point onwards."""

from __future__ import annotations

import numpy as np

from magpend_core import LyapunovExponents, Status, lyapunov_exponents
from magpend_core.lyapunov import MOST_LOSS
from pipeline.compute.integrate import Job
from pipeline.products.lyapunov import LYAPUNOV_VARIABLES, LyapunovFlag, LyapunovOptions


def exponents(job: Job, options: LyapunovOptions) -> dict[str, np.ndarray]:
    """Compute the Lyapunov exponents of the cells of a task, with their errors and quality flags.

    Arrays have leading dims (branch, point). A cell without an attractor (diverged, step limit, unreached) has NaN and
    the flag ``ABSENT``.
    """
    cells, inputs, integration = job.cells, job.inputs, job.spec.integration
    branch, point = np.nonzero(np.isin(cells.status, (Status.PERIODIC, Status.BOUNDED)))
    found = lyapunov_exponents(
        inputs.parameters[branch, point],
        inputs.frequency_hz[branch, point],
        cells.section[branch, point, -1],
        rtol=integration.rtol,
        atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period,
        system=job.spec.motion.system,
        **options.model_dump(),
    )
    is_closed = cells.status[branch, point] == Status.PERIODIC
    falling = np.sort(found.weighted, axis=1)[:, ::-1]
    values = {
        "lyapunov": np.where(is_closed[:, None], falling, found.exponents),
        "lyapunov_stderr": found.stderr,
        "lyapunov_blocks": found.blocks,
        "divergence": found.divergence,
        "lyapunov_flag": flags(found, is_flow=job.spec.motion.system.section is not None),
    }
    filled = {}
    for variable in LYAPUNOV_VARIABLES:
        own = values[variable.name].shape[1:]
        filled[variable.name] = np.full((*cells.status.shape, *own), variable.fill, variable.dtype)
        filled[variable.name][branch, point] = values[variable.name]
    return filled


def flags(found: LyapunovExponents, *, is_flow: bool = False) -> np.ndarray:
    """Return a quality flag for the Lyapunov exponents of each cell. A full spectrum must add up to the divergence of
    the vector field.

    One exponent of a flow must be 0, unless the motion comes to rest.
    """
    # largest allowed difference between the sum of the exponents and the divergence, in units of the sum of their
    # moduli
    audit = 0.01
    sigma = 5.0  # standard errors by which a flow's exponent nearest to 0 may differ from 0
    flag = np.full(len(found.status), LyapunovFlag.GOOD, np.int8)
    if found.is_whole:
        missing = np.abs(found.exponents.sum(axis=1) - found.divergence)
        moduli = np.abs(found.exponents)
        allowed = audit * moduli.sum(axis=1)
        flag[missing > allowed] = LyapunovFlag.AUDIT_FAILED
        if is_flow:
            nearest = moduli.argmin(axis=1)[:, None]
            error = np.take_along_axis(found.stderr, nearest, axis=1)[:, 0]
            least = np.take_along_axis(moduli, nearest, axis=1)[:, 0]
            flag[least > np.maximum(allowed, sigma * error)] = LyapunovFlag.AUDIT_FAILED
    flag[found.loss > MOST_LOSS] = LyapunovFlag.UNRESOLVED
    flag[found.status != Status.BOUNDED] = LyapunovFlag.FAILED
    return flag
