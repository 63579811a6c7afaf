"""Define presets: named values of a model's parameters, each with a phrase that says where it comes from.

A preset is a TOML file, whether it ships in a model's room or was written by a person or by a fit::

    model = "pendulum"                  # whose parameters they are
    base = "wojna2018"                  # optional: a preset that ships and has the rest
    title = "magnets of the test rig"   # optional

    [values]                            # in the model's units; the table's name does not matter
    alpha1 = 1.1306

    [provenance]                        # by parameter, or by table
    alpha1 = "fit of six torque curves, +- 0.0003 N m"

Those that ship name no model: several models of a room share them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from magpend_core.models.parameters import Parameter, ParameterError, near_names

SUFFIX = ".toml"
KEYS = ("model", "base", "title")


@dataclass(frozen=True)
class Preset:
    """Named values of parameters, and the source of each value.

    Attributes
    ----------
    provenance : dict
        A phrase by parameter name.
    model : str
        Whose parameters they are; empty if it ships.
    base : str
        A preset that ships and has the values that this one has not; empty if there is none.
    title : str
        What it is, in a line.
    """

    name: str
    values: Mapping[str, float]
    provenance: Mapping[str, str] = field(default_factory=dict)
    model: str = ""
    base: str = ""
    title: str = ""

    @classmethod
    def read(cls, path: Path) -> Preset:
        """Read a preset from a TOML file: tables of values, and ``[provenance]`` by parameter or by table.

        Raises
        ------
        ParameterError
            If it cannot be read or is no such file; all problems at once. Names and bounds are checked
            against a model by `Model.preset`.
        """
        try:
            tables = tomllib.loads(path.read_text("utf-8"))
        except OSError as error:
            raise ParameterError([f"{path}: cannot be read ({error.strerror or error})."]) from None
        except UnicodeDecodeError:
            raise ParameterError([f"{path}: is not text in UTF-8; a preset is a TOML file."]) from None
        except tomllib.TOMLDecodeError as error:
            raise ParameterError([f"{path}: is not valid TOML: {error}."]) from None
        problems = _problems(tables)
        if problems:
            raise ParameterError([f"{path}: {p}" for p in problems])
        head = {key: tables.pop(key, "") for key in KEYS}
        origin = tables.pop("provenance", {})
        values = {name: value for table in tables.values() for name, value in table.items()}
        known = {n: origin.get(n, origin.get(t, "")) for t, table in tables.items() for n in table}
        return cls(path.stem, values, known, **head)


def _problems(tables: Mapping[str, Any]) -> list[str]:
    """Return an error sentence for each entry that does not belong in a preset's file."""
    problems = [
        f"{key} = {tables[key]!r}: must be a text in quotes."
        for key in KEYS
        if not isinstance(tables.get(key, ""), str)
    ]
    own = {key: table for key, table in tables.items() if key not in (*KEYS, "provenance")}
    for key, table in own.items():
        if not isinstance(table, dict):
            hint = near_names(key, (*KEYS, "provenance"), "keys")
            problems.append(f"{key}: is no table of values and no key of a preset; {hint}")
    names = [name for table in own.values() if isinstance(table, dict) for name in table]
    problems += [f"{name}: has two values; keep one." for name in dict.fromkeys(names) if names.count(name) > 1]
    origin = tables.get("provenance", {})
    if not isinstance(origin, dict):
        return [*problems, f"provenance = {origin!r}: must be a table; write [provenance]."]
    for name, phrase in origin.items():
        if not isinstance(phrase, str):
            problems.append(f"provenance.{name} = {phrase!r}: must be a text in quotes.")
        if name not in (*names, *own):
            problems.append(f"provenance.{name}: nothing of this name has a value; drop it, or give one.")
    return problems


def is_file(name: str | Path) -> bool:
    """Return whether a preset is given by a file: a path, or a name that ends in ``.toml``."""
    return isinstance(name, Path) or str(name).endswith(SUFFIX)


def find_preset(name: str | Path, folder: str | Path = ".") -> str | Preset:
    """Return the preset in a file, or the name of a shipped preset unchanged; `Model.load` accepts both.

    Parameters
    ----------
    name
        Name of a shipped preset, or a file: a path, or a text that ends in ``.toml``.
    folder
        Folder to which the path of a file is relative.

    Raises
    ------
    ParameterError
        If the file cannot be read or is no preset.
    """
    return Preset.read(Path(folder) / name) if is_file(name) else str(name)


class Owner(Protocol):
    """Protocol of a model with presets: the attributes of `Model` that this module uses."""

    @property
    def name(self) -> str:
        """Name of the model."""

    @property
    def presets(self) -> tuple[Preset, ...]:
        """Presets that ship with the model."""

    @property
    def preset_names(self) -> tuple[str, ...]:
        """Names of the presets that ship with the model."""

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the model's parameters."""

    def preset(self, name: str) -> Preset:
        """Return the model's preset of this name."""

    def parameter(self, name: str) -> Parameter:
        """Return the model's parameter of this name."""


def completed(preset: Preset, model: Owner, model_named: Callable[[str], Owner]) -> Preset:
    """Return a preset with missing values taken from its base preset, checked against a model.

    Raises
    ------
    ParameterError
        If the preset is for a model with other presets, a value has no provenance or is out of bounds, or a name or
        the base is unknown; lists all problems.
    """
    where = f"{preset.name}{SUFFIX}"
    if not preset.model:
        raise ParameterError([f'{where}: model: missing; add model = "{model.name}".'])
    try:
        owner = model if preset.model == model.name else model_named(preset.model)
    except ParameterError as error:
        raise ParameterError([f"{where}: {p}" for p in error.problems]) from None
    if owner.presets != model.presets:
        raise ParameterError(
            [f"{where}: is of model {owner.name!r}, whose parameters are not those of {model.name!r}."]
        )
    base, problems = Preset("", {}), []
    if preset.base:
        try:
            base = owner.preset(preset.base)
        except ParameterError as error:
            problems += [f"base: {p}" for p in error.problems]
    # a preset that was completed before has those of its base, which other models of the room may own
    own = {name: value for name, value in preset.values.items() if base.values.get(name) != value}
    problems += value_problems(owner, own, preset.provenance)
    values, origin = {**base.values, **preset.values}, {**base.provenance, **preset.provenance}
    absent = [n for n in model.parameter_names if n not in values]
    if absent and not problems:
        known = " or ".join(repr(name) for name in owner.preset_names)
        problems = [f"{', '.join(absent)}: no value; give them, or set base to a preset that has: {known}."]
    if problems:
        raise ParameterError([f"{where}: {p}" for p in problems])
    return Preset(preset.name, values, origin, preset.model, preset.base, preset.title)


def value_problems(model: Owner, values: Mapping[str, Any], sources: Mapping[str, str]) -> list[str]:
    """Return an error sentence for each name, value or provenance that does not fit a model."""
    problems = []
    for name, value in values.items():
        try:
            problem = model.parameter(name).problem(value)
        except ParameterError as error:
            problem = str(error)
        problems += [problem] if problem else []
        if not sources.get(name, "").strip():
            problems.append(f"{name}: has no provenance; say in [provenance] where the value comes from.")
    return problems
