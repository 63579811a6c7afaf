"""Where in the drive's period a model takes its sections, seen from the rising edge that a rig shows."""

from __future__ import annotations

import numpy as np

from magpend_core.models.parameters import Parameters
from pipeline.rig.edges import find_edges
from pipeline.spec.problems import SpecError

_SAMPLES = 4096
_SNAP = 2e-3
"""Shares of a period below this are none: a flank is as wide."""


def section_phase(parameters: Parameters, frequency_hz: float) -> float:
    """Share of the period from the drive's rising edge to the model's section.

    Parameters
    ----------
    parameters
        Of the model; its forcing is looked at.
    frequency_hz
        Drive frequency [Hz].

    Returns
    -------
    float
        In [0, 1): 0 where sections are taken at the rising edge, 0.25 at the maximum of a sine; 0, too, for a
        drive that does nothing.
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
