"""The models that ship with magpend, and the door through which everyone else sees them.

`load_model` finds a model by name. Nothing here imports the compiler.
"""

from __future__ import annotations

import importlib
from functools import cache

from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError, Parameters, near_names

DEFAULT = "pendulum"
"""The model of a specification that names none."""

ROOMS = ("pendulum", "double_pendulum", "duffing")
"""Modules here that have a tuple ``MODELS``."""


class ModelError(ParameterError):
    """There is no model of this name."""


@cache
def _models() -> dict[str, Model]:
    rooms = (importlib.import_module(f"{__name__}.{room}") for room in ROOMS)
    return {model.name: model for room in rooms for model in room.MODELS}


def model_names() -> tuple[str, ...]:
    """Names of the models that ship."""
    return tuple(_models())


def load_model(name: str = DEFAULT) -> Model:
    """Return a model by name.

    Raises
    ------
    ModelError
        If there is none, with the nearest names.
    """
    models = _models()
    if name not in models:
        raise ModelError([f"model {name!r} does not exist; {near_names(name, models, 'models')}"])
    return models[name]


def load_preset(name: str | None = None, **overrides: float) -> Parameters:
    """Return the parameters of the default model, the paper's pendulum, some of them replaced.

    Parameters
    ----------
    name
        Preset: ``"wojna2018"`` holds the constants of Wojna et al. (2018); those that the paper
        gives only in figures (drive, magnets) are calibrated, see `preset_provenance`.
    overrides
        Values by parameter name [SI], for example ``q=1.6, duty_cycle=0.5``.

    Raises
    ------
    ParameterError
        If the preset or a name is unknown or a value is out of bounds; all problems at once.

    Examples
    --------
    >>> load_preset(duty_cycle=0.5)["duty_cycle"]
    0.5
    """
    return load_model().load(name, **overrides)


def preset_names(model: str = DEFAULT) -> tuple[str, ...]:
    """Names of a model's presets; the first is its default."""
    return load_model(model).preset_names


def preset_provenance(name: str | None = None, model: str = DEFAULT) -> dict[str, str]:
    """Where each parameter of a preset comes from: the paper, or a calibration.

    Returns
    -------
    dict
        Parameter name to a phrase, for the model's parameters that the preset has.
    """
    known, preset = load_model(model).parameter_names, load_model(model).preset(name)
    return {n: phrase for n, phrase in preset.provenance.items() if n in known}
