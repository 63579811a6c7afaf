"""Units of what can be varied."""

from __future__ import annotations

from magpend_core.models.pendulum.parameters import describe, load_preset
from pipeline.analysis.branches.problems import FREQUENCY


def units_of(parameter: str) -> str:
    """Unit of a parameter by name, empty if it is not the pendulum's."""
    if parameter == FREQUENCY:
        return "Hz"
    return describe(load_preset()).get(parameter, {"unit": ""})["unit"]


STATE_UNITS = "rad, rad, rad/s, rad/s"
