"""Units of what can be varied."""

from __future__ import annotations

from magpend_core.models import load_model
from pipeline.analysis.branches.problems import FREQUENCY


def units_of(parameter: str) -> str:
    """Unit of a parameter by name, empty if it is not the pendulum's."""
    if parameter == FREQUENCY:
        return "Hz"
    return load_model().parameter(parameter).unit


STATE_UNITS = "rad, rad, rad/s, rad/s"
