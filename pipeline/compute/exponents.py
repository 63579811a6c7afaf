"""The product ``lyapunov``: exponents of a task's cells, from the last kept section of each on."""

from __future__ import annotations

import numpy as np

from magpend_core import LyapunovExponents, Sections, Status, lyapunov_exponents
from magpend_core.engine.lyapunov import MOST_LOSS
from magpend_core.engine.system import System
from pipeline.layout.schema import LYAPUNOV_VARIABLES, LyapunovFlag
from pipeline.spec.parsing import STATES, Spec

AUDIT = 0.01
"""Largest allowed difference between the sum of the exponents and the divergence, in units of the sum of
their moduli."""


def exponents(
    parameters: np.ndarray, frequency_hz: np.ndarray, cells: Sections, spec: Spec, system: System
) -> dict[str, np.ndarray]:
    """Return `LYAPUNOV_VARIABLES` for the cells of a task.

    Parameters
    ----------
    parameters, frequency_hz
        As `run_branches` took them, shapes (branch, point, parameter) and (branch, point).
    cells
        What it returned.
    spec
        Specification with the product.
    system
        What is integrated.

    Returns
    -------
    dict
        Arrays with leading dims (branch, point). A cell without an attractor (diverged, step limit,
        unreached) has NaN and the flag ``ABSENT``.
    """
    options = spec.products.lyapunov
    assert options is not None
    integration = spec.integration
    branch, point = np.nonzero(np.isin(cells.status, (Status.PERIODIC, Status.BOUNDED)))
    found = lyapunov_exponents(
        parameters[branch, point], frequency_hz[branch, point], cells.section[branch, point, -1],
        rtol=integration.rtol, atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period, system=system, **options.model_dump(),
    )  # fmt: skip
    is_closed = cells.status[branch, point] == Status.PERIODIC
    values = {
        "lyapunov": np.where(is_closed[:, None], _falling(found.weighted), found.exponents),
        "lyapunov_stderr": found.stderr,
        "lyapunov_blocks": found.blocks,
        "divergence": found.divergence,
        "lyapunov_flag": flags(found),
    }
    filled = {}
    for variable in LYAPUNOV_VARIABLES:
        own = values[variable.name].shape[1:]
        filled[variable.name] = np.full((*cells.status.shape, *own), variable.fill, variable.dtype)
        filled[variable.name][branch, point] = values[variable.name]
    return filled


def _falling(rates: np.ndarray) -> np.ndarray:
    return np.sort(rates, axis=1)[:, ::-1]


def flags(found: LyapunovExponents) -> np.ndarray:
    """Codes of `LyapunovFlag`; only a whole spectrum can be held against the divergence."""
    flag = np.full(len(found.status), LyapunovFlag.GOOD, np.int8)
    if found.exponents.shape[1] == len(STATES):
        missing = np.abs(found.exponents.sum(axis=1) - found.divergence)
        flag[missing > AUDIT * np.abs(found.exponents).sum(axis=1)] = LyapunovFlag.AUDIT_FAILED
    flag[found.loss > MOST_LOSS] = LyapunovFlag.UNRESOLVED
    flag[found.status != Status.BOUNDED] = LyapunovFlag.FAILED
    return flag
