"""Define models as text: expressions parsed with a whitelist, never evaluated as code."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magpend_core.models.model import ModelError
from magpend_core.models.text.model import TextModel, model_of
from magpend_core.models.text.reading import read_definition

__all__ = ["TextModel", "read_model"]


def read_model(table: Mapping[str, Any], place: str = "model") -> TextModel:
    """Return the model that a table of text defines. Nothing is derived or compiled yet.

    Parameters
    ----------
    table
        Plain data, as TOML has it under ``[model]``.
    place
        How errors call the table.

    Raises
    ------
    ModelError
        With all problems at once, each with its place in the text.
    """
    definition, problems = read_definition(table, place)
    if definition is None:
        raise ModelError(problems)
    return model_of(definition)


def read_shipped(path: Path) -> TextModel:
    """Read a shipped model from its TOML file. The file is the model's table, and the file's name is the model's name.

    Raises
    ------
    ModelError
        As `read_model`.
    """
    table = {"name": path.stem, **tomllib.loads(path.read_text("utf-8"))}
    definition, problems = read_definition(table, path.name)
    if definition is None:
        raise ModelError(problems)
    return model_of(definition, shipped=True)
