"""Units of what is followed and of what is varied, as the run's model names them."""

from __future__ import annotations

from magpend_core.models.model import Model
from pipeline.analysis.branches.problems import FREQUENCY


def parameter_units(parameter: str, model: Model | None) -> str:
    """Unit of a parameter or of the drive frequency; empty if there is no model to tell."""
    if parameter == FREQUENCY:
        return "Hz"
    return model.parameter(parameter).unit if model is not None else ""


def state_units(model: Model | None) -> str:
    """Units of the states, with commas between; 1 if there is no model to tell."""
    return ", ".join(model.state_units) if model is not None else "1"
