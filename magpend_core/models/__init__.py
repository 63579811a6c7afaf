"""Load the models that ship with magpend by name, and other models from their definition as text.

`load_model` finds a model by name, or reads what a run keeps of it. Nothing here imports the compiler.
"""

from __future__ import annotations

import copyreg
import importlib
import json
from collections.abc import Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

from magpend_core.crossing import Crossing
from magpend_core.disturbance import Disturbance
from magpend_core.models import imported, model
from magpend_core.models.imported import import_object as import_object
from magpend_core.models.model import Model, Parameters
from magpend_core.models.model import ModelError as ModelError
from magpend_core.models.noisy import noisy
from magpend_core.models.parameters import ParameterError, near_names
from magpend_core.models.sectioned import sectioned

DEFAULT = "pendulum"
"""The model of a specification that names none."""

ROOMS = ("pendulum", "double_pendulum", "duffing")
"""Modules here that have a tuple ``MODELS``."""


LIBRARY = Path(__file__).with_name("library")
"""Models that ship as text: a file each, named after the model."""


@cache
def _models() -> dict[str, Model]:
    rooms = (importlib.import_module(f"{__name__}.{room}") for room in ROOMS)
    return {model.name: model for room in rooms for model in room.MODELS}


@cache
def _texts() -> dict[str, Path]:
    return {path.stem: path for path in sorted(LIBRARY.glob("*.toml"))}


def model_names() -> tuple[str, ...]:
    """Return the names of the shipped models, without reading those that are text files."""
    return (*_models(), *_texts())


def load_model(reference: str | Mapping[str, Any] | Model = DEFAULT) -> Model:
    """Return a model by its name or from its text. No code from the text is executed; equal texts give the same object.

    Parameters
    ----------
    reference
        Name of a model that ships; or what `Model.reference` gives, as a table or as its JSON text: a model
        as text, or the description of a Python object (see `import_object`). A model is returned as it is.

    Raises
    ------
    ModelError
        If there is none, with the nearest names; if a text is no model, with all its problems.
    """
    if isinstance(reference, Model):
        return reference
    if isinstance(reference, Mapping):
        return _of_table(reference)
    if reference.lstrip().startswith("{"):
        try:
            return _of_table(json.loads(reference))
        except (ValueError, RecursionError) as error:
            raise ModelError([f"the text of a model is damaged ({error})."]) from None
    if imported.is_object_path(reference):
        if (known := imported.known_model({imported.KEY: reference})) is not None:
            return known
        raise ModelError(
            [
                f"model {reference!r} is a Python object, which is imported where a specification names it, by "
                f"--import-object {reference}, or by magpend.import_object."
            ]
        )
    if reference in _models():
        return _models()[reference]
    if reference in _texts():
        return _shipped(reference)
    hint = near_names(reference, model_names(), "models")
    raise ModelError([f"model {reference!r} does not exist; {hint}"])


def _of_table(table: Mapping[str, Any]) -> Model:
    """Return the model that a table defines. Tables with the same meaning give the same object."""
    try:
        table = _with_rates(table)
        # not sorted: the order of the states is the model's
        text = json.dumps(table)
        if imported.KEY in table:
            return imported.known_model(table) or _described(text)
        model = _read(json.dumps(_read(text).reference))
        assert isinstance(model.reference, Mapping)
        return _by_meaning.setdefault(json.dumps(sorted(model.reference.items())), model)
    except ParameterError as error:
        raise ModelError(error.problems) from None
    except (TypeError, ValueError, RecursionError) as error:
        raise ModelError([f"the text of a model is no plain data ({error})."]) from None


def _with_rates(table: Mapping[str, Any]) -> Mapping[str, Any]:
    from magpend_core.models.text.lines import expanded

    return expanded(table)


_by_meaning: WeakValueDictionary[str, Model] = WeakValueDictionary()
"""Models of texts by their tables, in whatever order the tables stand."""


@lru_cache(maxsize=64)
def _described(text: str) -> Model:
    return imported.described_model(json.loads(text))


@lru_cache(maxsize=64)
def _read(text: str) -> Model:
    from magpend_core.models.text import read_model

    return read_model(json.loads(text))


@cache
def _shipped(name: str) -> Model:
    from magpend_core.models.text import read_shipped

    return read_shipped(_texts()[name])


def load_preset(name: str | None = None, **overrides: float) -> Parameters:
    """Return the parameters of the default model, the paper's pendulum, with some values replaced.

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
    """Return the names of a model's presets; the first is the default."""
    return load_model(model).preset_names


def preset_provenance(name: str | None = None, model: str = DEFAULT) -> dict[str, str]:
    """Return for each parameter of a preset where its value comes from: the paper, or a calibration.

    Returns
    -------
    dict
        Parameter name to a phrase, for the model's parameters that the preset has.
    """
    known, preset = load_model(model).parameter_names, load_model(model).preset(name)
    return {n: phrase for n, phrase in preset.provenance.items() if n in known}


def _reduced(parameters: Parameters) -> tuple[Any, ...]:
    own = parameters.model
    return _again, (own.reference, parameters.as_dict(), own.crossing, own.disturbance)


def _again(
    reference: str | Mapping[str, Any],
    values: dict[str, float],
    crossing: Crossing | None = None,
    disturbance: Disturbance | None = None,
) -> Parameters:
    found = load_model(reference)
    if disturbance is not None:
        return Parameters(noisy(found, disturbance), values)
    return Parameters(found if crossing is None else sectioned(found, crossing), values)


copyreg.pickle(Parameters, _reduced)
model.model_named = load_model
