"""Read models and specifications that users give in Python as names, paths, TOML text or dicts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models import load_model as named_model
from magpend_core.models.model import Model
from pipeline.specification.files import read_toml, toml_tables
from pipeline.specification.models import find_model, is_model_file
from pipeline.specification.toml import toml_key, toml_value


def load_model(reference: str | Path | Mapping[str, Any] | Model = "pendulum") -> Model:
    """Return a model given by name, path, TOML text or table; warn of unused parts of its text.

    Parameters
    ----------
    reference
        Name of a model that ships; path of a model's file or of a specification; TOML text of either; or a
        table with the keys of ``[model]``. A `Model` is returned unchanged.

    Raises
    ------
    ModelError, SpecError
        If there is no such model (the message lists the nearest names), or if it is wrong (the message lists
        all problems).
    """
    model = _found(reference)
    if model is not reference:
        for remark in model.remarks:
            warnings.warn(remark, stacklevel=2)
    return model


def _found(reference: str | Path | Mapping[str, Any] | Model) -> Model:
    """Return a model given by name, path, TOML text or table, like `load_model` but without warnings."""
    if isinstance(reference, str) and not reference.lstrip().startswith("{") and is_toml_text(reference):
        return _model_in(toml_tables(reference.encode(), "the text"), Path())
    if isinstance(reference, Path) or (isinstance(reference, str) and is_model_file(reference)):
        path = Path(reference)
        tables = read_toml(path)
        return find_model(str(path)) if "equations" in tables else _model_in(tables, path.parent)
    return named_model(reference)


def _model_in(tables: Mapping[str, Any], folder: Path) -> Model:
    """Return the model that the tables of a specification refer to, or that the tables themselves define."""
    if "equations" in tables:
        return find_model({"name": "model", **tables}, folder)
    return find_model(tables["model"], folder) if "model" in tables else named_model()


def is_toml_text(given: Any) -> bool:
    """Return whether a value is TOML text, and not a path or a name."""
    return isinstance(given, str) and ("\n" in given or "=" in given)


def toml_of(table: Mapping[str, Any]) -> str:
    """Return a table as TOML text, one line per key."""
    return "".join(f"{toml_key(key)} = {toml_value(value)}\n" for key, value in _plain(table).items())


def _plain(given: Any) -> Any:
    """Convert numpy numbers and arrays inside dicts and lists to plain Python numbers and lists."""
    if isinstance(given, Mapping):
        return {str(key): _plain(value) for key, value in given.items()}
    if isinstance(given, list | tuple):
        return [_plain(value) for value in given]
    if isinstance(given, np.ndarray | np.generic):
        return given.tolist()
    return str(given) if isinstance(given, Path) else given
