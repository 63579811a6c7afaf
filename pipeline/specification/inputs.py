"""Read models and specifications that users give in Python as names, paths, TOML text or dicts."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models import load_model as named_model
from magpend_core.models.imported import KEY
from magpend_core.models.model import Model
from magpend_core.models.text.lines import is_equations, read_lines
from pipeline.specification.files import read_toml, toml_tables
from pipeline.specification.models import find_model, is_model_file, kept_reference
from pipeline.specification.problems import SpecError, shown


def model(
    equations: str | Path | Mapping[str, Any] | Model,
    /,
    *,
    name: str | None = None,
    title: str | None = None,
    source: str | None = None,
    section: str | None = None,
    states: Mapping[str, str | Mapping[str, Any]] | None = None,
    parameters: Mapping[str, float | Mapping[str, Any]] | None = None,
    define: Mapping[str, str] | None = None,
    quantities: Mapping[str, str | Mapping[str, Any]] | None = None,
    impacts: Sequence[Mapping[str, Any]] | None = None,
    drawing: Mapping[str, Any] | None = None,
    mirror: Mapping[str, Any] | None = None,
    presets: Mapping[str, Mapping[str, Any]] | None = None,
    classifier: Mapping[str, Any] | None = None,
    **values: float | Mapping[str, Any],
) -> Model:
    """Return a model from its equations, or one given by name, path, TOML text or table.

    Parameters
    ----------
    equations
        Lines ``x' = v`` (rates), ``drive = A*cos(2*pi*f*t)`` (parts with a name) and ``d = 0.2`` (parameters);
        ``x'' = ...`` makes the states ``x`` and ``x_dot``. Or a dict of right sides by state. In expressions
        ``t`` is the time [s] and ``f`` the frequency of the drive [Hz]. The states have the order of the
        equations, all derivatives last. Otherwise the name of a model that ships, the path of a model's file
        or of a specification, TOML text of either, or a table with the keys of ``[model]``; then no keyword
        is taken.
    name, title, source, section
        Name, by default ``model``; what the model is, in a line; where its equations come from; the instant of
        its sections.
    states, parameters, define, quantities
        Entries by name as in the table ``[model]``: a unit, ``{"unit": "rad", "on_circle": True}``,
        ``{"value": 0.2, "unit": "1/s", "bound": "positive"}``. What the lines do not say is added to them.
    impacts, drawing, mirror, presets, classifier
        Tables with the keys of ``[model]``.
    values
        Parameters and their values: ``d=0.2``.

    Returns
    -------
    Model
        The same model as its TOML text gives, with the same digest. ``model.load(d=0.3)`` gives parameters.

    Warns
    -----
    UserWarning
        Of each parameter and part that no expression uses.

    Raises
    ------
    ModelError, SpecError
        If there is no such model (the message lists the nearest names), or if it is wrong (the message lists
        all problems with their lines).

    Examples
    --------
    >>> duffing = model("x'' = -d*x' + x - x**3 + A*cos(2*pi*f*t)", d=0.2, A=0.3)
    >>> duffing.state_names
    ('x', 'x_dot')
    """
    tables = {
        "name": name,
        "title": title,
        "source": source,
        "section": section,
        "states": states,
        "parameters": parameters,
        "define": define,
        "quantities": quantities,
        "impacts": impacts,
        "drawing": drawing,
        "mirror": mirror,
        "presets": presets,
        "classifier": classifier,
    }
    given = {key: table for key, table in tables.items() if table is not None}
    if _is_equations(equations):
        lines = read_lines(equations, given, values)  # type: ignore[arg-type]
        if problems := lines.judged():
            raise SpecError(problems)
        found = named_model(lines.table)
    elif given or values:
        raise SpecError(
            f"model({shown(equations)}, {', '.join(f'{key}=...' for key in (*given, *values))}): keywords belong to "
            'equations, such as "x\' = -d*x"; values of parameters are given by .load(NAME=VALUE), other changes in '
            "the model's text."
        )
    else:
        found = _found(equations)
    return _warned(found, equations)


def load_model(reference: str | Path | Mapping[str, Any] | Model = "pendulum") -> Model:
    """Return a model by name, path, TOML text, table or equations: `model` without keywords, under its older name."""
    return _warned(_found(reference), reference) if not _is_equations(reference) else model(reference)


def _warned(found: Model, given: Any) -> Model:
    """Return a model after a warning for each part of its text that nothing uses."""
    if found is not given:
        for remark in found.remarks:
            warnings.warn(remark, stacklevel=3)
    return found


def _is_equations(given: Any) -> bool:
    """Return whether a value is equations, as lines or as a dict, and not a reference to a model or its table."""
    if isinstance(given, Mapping):
        is_table = KEY in given or any(isinstance(given.get(key), Mapping) for key in ("states", "equations"))
        return not is_table
    if not isinstance(given, str) or given.lstrip().startswith("{"):
        return False
    return is_equations(given) or (is_toml_text(given) and not _has_model(given))


def _has_model(text: str) -> bool:
    """Return whether a text is TOML with a model or a specification."""
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError):
        return any(re.match(r"\s*(\[|model\s*=|kind\s*=)", line) for line in text.splitlines())
    return bool({"equations", "states", "model", "kind"} & tables.keys())


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


def plain_tables(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a specification as plain data: no numpy numbers or paths, and models as `kept_reference`.

    Under ``model`` equations are read as `model` reads them.
    """
    tables = {str(key): _plain(value) for key, value in given.items() if value is not None and key != "model"}
    reference = given.get("model")
    if reference is None:
        return tables
    if isinstance(reference, str) and is_equations(reference):
        reference = model(reference)
    kept = kept_reference(reference) if isinstance(reference, Model) else _plain(reference)
    return {**tables, "model": kept}


def _plain(given: Any) -> Any:
    """Convert numpy numbers and arrays inside dicts and lists to plain Python numbers and lists."""
    if isinstance(given, Mapping):
        return {str(key): _plain(value) for key, value in given.items()}
    if isinstance(given, list | tuple):
        return [_plain(value) for value in given]
    if isinstance(given, np.ndarray | np.generic):
        return given.tolist()
    return str(given) if isinstance(given, Path) else given
