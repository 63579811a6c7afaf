"""Find the phase of a model's stroboscopic section, counted from the rising edge of the drive."""

from __future__ import annotations

import numpy as np

from magpend_core.models.model import Parameters
from pipeline.rig.edges import find_edges
from pipeline.specification.problems import SpecError

_SAMPLES = 4096
_SNAP = 2e-3
"""Fraction of a period below which a phase counts as 0, since a flank is as wide."""


def section_phase(parameters: Parameters, frequency_hz: float) -> float:
    """Return the phase of the model's stroboscopic section after the drive's rising edge, as a fraction of the period.

    Parameters
    ----------
    parameters
        Parameters of the model, for its forcing.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    float
        In [0, 1): 0 for sections at the rising edge, 0.25 at the maximum of a sine. Also 0 without a drive.
    """
    from magpend_core.pointwise import drive_level

    period = 1 / frequency_hz
    time = np.arange(2 * _SAMPLES) * period / _SAMPLES
    try:
        rising = find_edges(time, drive_level(time, parameters, frequency_hz)).rising
    except SpecError:
        return 0.0
    share = float(-rising[0] / period % 1.0)
    return 0.0 if min(share, 1.0 - share) < _SNAP else share
