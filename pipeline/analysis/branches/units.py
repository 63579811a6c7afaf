"""Return the units of parameters and states of a run's model."""

from __future__ import annotations

from magpend_core.models.model import Model
from pipeline.analysis.branches.problems import FREQUENCY


def parameter_units(parameter: str, model: Model | None) -> str:
    """Return the unit of a parameter or of the drive frequency; an empty text if there is no model."""
    if parameter == FREQUENCY:
        return "Hz"
    return model.parameter(parameter).unit if model is not None else ""


def state_units(model: Model | None) -> str:
    """Return the units of the states, separated by commas; "1" if there is no model."""
    return ", ".join(model.state_units) if model is not None else "1"
