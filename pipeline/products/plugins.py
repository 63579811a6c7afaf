"""Plug-ins: rooms that no other room imports. They add commands, functions, and kinds of input, picture and measure of
studies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any

PLUGINS = ("pipeline.rig.plugin", "pipeline.explorer.plugin")
"""Modules, each with a `Plugin` named ``PLUGIN``."""


@dataclass(frozen=True)
class Plugin:
    """The additions of a plug-in: a place ``module:object`` for each name, imported when it is used."""

    commands: Mapping[str, str] = field(default_factory=dict)  # functions, or groups of them, of the command line
    functions: Mapping[str, str] = field(default_factory=dict)  # those that an option of another room's command calls
    inputs: Mapping[str, str] = field(default_factory=dict)  # `pipeline.report.inputs.Input` by the key of a study
    pictures: Mapping[str, str] = field(default_factory=dict)  # `pipeline.report.pictures.Picture` by its kind
    measures: Mapping[str, str] = field(default_factory=dict)  # measures of claims
    tables: Mapping[str, str] = field(default_factory=dict)  # functions that make a table of the docs


def added(what: str) -> dict[str, Any]:
    """Return the objects that plug-ins add under one field of `Plugin`, by name."""
    plugins = [resolve_name(f"{module}:PLUGIN") for module in PLUGINS]
    return {name: resolve_name(place) for plugin in plugins for name, place in getattr(plugin, what).items()}
