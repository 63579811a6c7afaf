"""Integrate states of one parameter point together, with the tolerance of portraits."""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.models.model import Parameters
from magpend_core.precision import tolerances_at
from magpend_core.sampling import Drive, Samples, sample
from pipeline.results.tolerances import PORTRAIT_RTOL


def flown(
    parameters: Parameters, states: np.ndarray, times: np.ndarray, drive: Drive | None = None, **more: Any
) -> Samples:
    """Return states (n, state) at instants [s] after the start of a drive; more options are those of `sample`."""
    n = len(states)
    return sample(
        parameters.model.system,
        np.tile(parameters.pack(), (n, 1)),
        states,
        [times],
        piece=np.zeros(n, np.int64),
        drives=[drive],
        **tolerances_at(PORTRAIT_RTOL),
        **more,
    )
