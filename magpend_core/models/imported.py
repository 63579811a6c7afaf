"""Import a model that is a Python object if the user names it; otherwise use the description stored in a run.

A run keeps a description: names, units, bounds, presets, and the digest of the files that decide the
equations. Opening or drawing needs no more, and imports nothing. What integrates needs the object itself,
which `import_object` imports once per process; the description then stands for it wherever it is read.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models.clock import DRIVEN, MAP, STROBED
from magpend_core.models.model import Mirror, Model, Preset, Quantity, State
from magpend_core.models.parameters import BOUNDS, Parameter, ParameterError, has_controls

if TYPE_CHECKING:
    from magpend_core.engine.system import System

KEY = "python"
"""Key of a description that holds the object's place; no model as text has it."""

_PATH = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*")
_TEXTS = ("name", "title", "section", "angle_dim", "digest")
_TABLES = ("states", "parameters", "quantities", "presets")

_imported: dict[str, Model] = {}


def is_object_path(text: str) -> bool:
    """Return whether a text has the form of a path to a Python object, ``package.module:NAME``."""
    return _PATH.fullmatch(text) is not None


def import_object(path: str, folder: str | Path | None = None) -> Model:
    """Import a model from ``package.module:NAME``. This runs the module's code: call it only for an object that the
    user named.

    Parameters
    ----------
    path
        ``package.module:NAME`` of a `Model`.
    folder
        A folder in which the module may lie, and then the current one; those of `sys.path` go before them.
        None for `sys.path` alone.

    Returns
    -------
    Model
        The object, whose `Model.reference` is its description. From now on `load_model` gives it wherever it
        finds a description of the same digest.

    Raises
    ------
    ParameterError
        If it cannot be imported or is no model.
    """
    if not is_object_path(path):
        raise ParameterError([f"{path!r}: is no Python object; write package.module:NAME."])
    for place in () if folder is None else (folder, "."):
        if (whole_place := str(Path(place).resolve())) not in sys.path:
            sys.path.append(whole_place)
    module_name, _, attribute = path.partition(":")
    try:
        module = importlib.import_module(module_name)
        found = getattr(module, attribute)
    except Exception as error:
        raise ParameterError(
            [
                f"{path}: cannot be imported ({type(error).__name__}: {error}); the module must be installed, or "
                "lie beside the specification or in the current folder."
            ]
        ) from None
    if not isinstance(found, Model):
        kind = type(found).__name__
        raise ParameterError(
            [
                f"{path}: is of type {kind}; it must be a Model, which names states and parameters and has the "
                "System (magpend_core.models.model.Model)."
            ]
        )
    if found.text is not None:  # written as text: it needs no import
        return found
    if path not in _imported:
        sources = {*found.sources, *([Path(str(module.__file__))] if module.__file__ else [])}
        whole = replace(found, sources=tuple(sorted(sources)))
        _imported[path] = replace(whole, text=_description(path, whole))
    return _imported[path]


def _description(path: str, model: Model) -> dict[str, Any]:
    table: dict[str, Any] = {KEY: path, "digest": model.digest}
    table |= {name: getattr(model, name) for name in ("name", "title", "section", "angle_dim")}
    table["autonomous"] = model.clock.has_equilibria
    if not model.clock.is_continuous:
        table["is_map"] = True
    for name in ("states", "parameters", "quantities"):
        table[name] = {one.name: _plain(one) for one in getattr(model, name)}
    table["presets"] = {
        p.name: {"values": dict(p.values), "provenance": dict(p.provenance), "title": p.title} for p in model.presets
    }
    if model.mirror is not None:
        table["mirror"] = {"signs": list(model.mirror.signs), "half_period": model.mirror.half_period}
    return table


def _plain(one: Any) -> dict[str, Any]:
    values = {f.name: (getattr(one, f.name), f.default) for f in fields(one) if f.name != "name"}
    return {name: value for name, (value, default) in values.items() if value != default}


@dataclass(frozen=True, eq=False)
class DescribedModel(Model):
    """A model known only by its stored description: it has names of states and parameters, but cannot be integrated."""

    @cached_property
    def digest(self) -> str:
        """Return the digest of the model's source files that the description stores."""
        assert self.text is not None
        return str(self.text["digest"])

    @cached_property
    def system(self) -> System:
        """Raise `ParameterError`: a model known by description alone has no equations to integrate."""
        assert self.text is not None
        path = self.text[KEY]
        known = _imported.get(path)
        if known is None:
            why = f"opening a run imports nothing; if you trust it, give --import-object {path}"
        else:
            why = (
                f"the object that was imported has the digest {known.digest}, the run's had {self.digest}: "
                "restore the code of then, or make the run again"
            )
        raise ParameterError([f"model {self.name}: is the Python object {path}; {why}."])


def origin(model: Model) -> tuple[str, str] | None:
    """Return the object path and the folder from which another process can import the model; None if not imported."""
    path = "" if model.text is None else str(model.text.get(KEY, ""))
    known = _imported.get(path)
    if known is None or known.text != model.text:
        return None
    module_name = path.partition(":")[0]
    file = Path(str(sys.modules[module_name].__file__))
    depth = module_name.count(".") + (file.name == "__init__.py")
    return path, str(file.parents[depth])


def known_model(table: Mapping[str, Any]) -> Model | None:
    """Return the model that this process has imported for a description or an object path, or None."""
    known = _imported.get(str(table[KEY]))
    return known if known is not None and (len(table) == 1 or known.text == table) else None


def described_model(table: Mapping[str, Any]) -> Model:
    """Return a model from its stored description alone; it has all names and values, but cannot be integrated.

    Parameters
    ----------
    table
        What `Model.reference` of an imported model is, perhaps from a stranger: it is checked, and nothing
        is imported.

    Raises
    ------
    ParameterError
        If it is no such description; all problems at once.
    """
    path = table.get(KEY)
    if not isinstance(path, str) or not is_object_path(path):
        raise ParameterError([f"{KEY} = {path!r}: must be the place of an object, package.module:NAME."])
    problems = _outer_problems(table)
    if problems:
        raise ParameterError(problems)
    given: dict[str, Any] = {
        "states": _entries(State, table, "states", problems),
        "parameters": _entries(Parameter, table, "parameters", problems),
        "quantities": _entries(Quantity, table, "quantities", problems),
        "presets": _entries(Preset, table, "presets", problems),
        "mirror": _mirror(table, problems),
    }
    problems += [f"parameters.{p.name}.bound: no bound." for p in given["parameters"] if p.bound not in BOUNDS]
    if problems:
        raise ParameterError(problems)
    texts = {name: table[name] for name in _TEXTS if name in table and name != "digest"}
    return DescribedModel(
        **texts,
        **given,
        system_path="",
        sources=(),
        clock=MAP if table.get("is_map") is True else STROBED if table.get("autonomous") is True else DRIVEN,
        text=dict(table),
    )


def _outer_problems(table: Mapping[str, Any]) -> list[str]:
    known = (KEY, *_TEXTS, *_TABLES, "autonomous", "is_map", "mirror")
    problems = [f"{key}: no part of a model's description." for key in table if key not in known]
    problems += [f"{key}: must be a text." for key in _TEXTS if not isinstance(table.get(key), str)]
    problems += [f"{key}: has control characters." for key in _TEXTS if has_controls(str(table.get(key)))]
    problems += [
        f"{key}: must be a table."
        for key in _TABLES
        if not isinstance(table.get(key), Mapping) or (key in ("states", "presets") and not table[key])
    ]
    return problems


def _entries(kind: Any, table: Mapping[str, Any], key: str, problems: list[str]) -> tuple[Any, ...]:
    """Convert a description's table of states, parameters, quantities or presets to objects; collect problems in
    `problems`.
    """
    found = []
    for name, entry in table[key].items():
        where = f"{key}.{name}"
        if not isinstance(entry, Mapping) or (kind is not Preset and not str(name).isidentifier()):
            problems.append(f"{where}: is no entry of a description.")
            continue
        own = _field_problems(kind, entry, where)
        problems += own
        if not own:
            found.append(kind(name=name, **entry))
    return tuple(found)


def _field_problems(kind: Any, entry: Mapping[str, Any], where: str) -> list[str]:
    known = {f.name: f for f in fields(kind) if f.name != "name"}
    wanted: dict[Any, Any] = {"str": str, "bool": bool, "float": (int, float)}
    problems = [f"{where}.{key}: no part of a model's description." for key in entry if key not in known]
    for name, f in known.items():
        if name not in entry:
            problems += [f"{where}.{name}: missing."] if _required(f) else []
            continue
        value = entry[name]
        if f.type in wanted:
            is_right = isinstance(value, wanted[f.type]) and (f.type == "bool" or not isinstance(value, bool))
        else:
            texts = name == "provenance"
            is_right = isinstance(value, Mapping) and all(
                isinstance(v, str) if texts else _is_number(v) for v in value.values()
            )
        problems += [] if is_right else [f"{where}.{name} = {value!r}: is of the wrong kind."]
    return problems


def _required(f: Any) -> bool:
    return f.default is MISSING and f.default_factory is MISSING


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _mirror(table: Mapping[str, Any], problems: list[str]) -> Mirror | None:
    if "mirror" not in table:
        return None
    with contextlib.suppress(TypeError, KeyError, ValueError):
        signs = tuple(table["mirror"]["signs"])
        if len(signs) == len(table["states"]) and set(signs) <= {1, -1}:
            return Mirror(tuple(int(s) for s in signs), table["mirror"]["half_period"] is True)
    problems.append("mirror: must have a sign, 1 or -1, for each state.")
    return None
