"""Find a model by its name, equations, table, text or file, or as a Python object.

A run never keeps only the path of a file or of an object. It keeps a model's text in ``run.json``, and a
description of a Python object. Reading a run's model reads no other file and imports nothing.
"""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magpend_core.models import ModelError, import_object, model_names
from magpend_core.models import load_model as named_model
from magpend_core.models.imported import KEY, is_object_path
from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError
from magpend_core.models.text.functions import read_function
from magpend_core.models.text.lines import is_equations, read_lines
from pipeline.specification.files import read_toml, toml_tables
from pipeline.specification.problems import SpecError, shown

SUFFIX = ".toml"
A_MODEL = (
    'model: this is the text of a model, not a specification. Write a specification with model = "FILE.toml", '
    "kind, parameters and initial_conditions. To show the model: magpend model show FILE.toml."
)
KEPT = None
"""Value of `folder` for data that a run keeps: no file is read, nothing is imported."""


def find_model(reference: Any, folder: str | Path | None = ".", at: str = "model") -> Model:
    """Load the model that the key ``model`` of a specification or run refers to.

    Parameters
    ----------
    reference
        A name; a table (the model as text); a model's file, ``FILE.toml``; or a Python object,
        ``package.module:NAME``, which is imported: its module's code is executed.
    folder
        Folder that paths of files are relative to, and in which modules are also found; `KEPT` to read and
        import nothing.
    at
        Key path, for the messages.

    Raises
    ------
    SpecError
        If there is a problem; the message lists all problems with their key paths.
    """
    try:
        if isinstance(reference, Mapping | Model):
            return named_model(reference)
        if not isinstance(reference, str):
            raise SpecError(
                f"{at} = {shown(reference)}: must be a name in quotes, such as {model_names()[0]!r}, a file "
                '"FILE.toml", a Python object "package.module:NAME", or a table [model] with states, '
                "parameters and equations."
            )
        if is_equations(reference):
            return named_model({"equations": reference})
        if folder is not None and is_object_path(reference):
            return import_object(reference, folder)
        if is_model_file(reference):
            return _of_file(reference, folder, at)
        return named_model(reference)
    except ParameterError as error:
        raise SpecError([_placed(p, at, reference) for p in error.problems]) from None


def _placed(problem: str, at: str, reference: Any) -> str:
    if not isinstance(reference, Mapping) or KEY in reference:
        return f"{at}: {problem}"
    head = "model."
    return f"{at}.{problem.removeprefix(head)}" if problem.startswith(head) else f"{at}: {problem}"


def add_model(reference: Any, folder: str | Path | None, problems: list[str]) -> Model | None:
    """Return the model that `find_model` finds, or None after adding its problems to `problems`."""
    try:
        return find_model(reference, folder)
    except SpecError as error:
        problems += error.problems
        return None


def stand_in(reference: Any, folder: str | Path | None, *, forced: bool) -> Model | None:
    """Return a placeholder model with the states and parameters of a faulty model, so that other tables can be checked.

    With it the other tables are checked, too. None if the states or parameters are also wrong.

    Parameters
    ----------
    reference, folder
        Arguments that `find_model` has refused.
    forced
        Whether the model should have a drive.
    """
    if is_model_file(reference) and folder is not None:
        try:
            reference = read_model_file(Path(folder) / reference)
        except SpecError:
            return None
    if not isinstance(reference, Mapping) or not isinstance(reference.get("states"), Mapping):
        return None
    kind, quantities = "map" if reference.get("kind") == "map" else "flow", reference.get("quantities", {})
    rate = "0*t" if forced and kind == "flow" else "0"
    table = {
        "kind": kind,
        "name": "stand-in",
        "states": reference["states"],
        "parameters": reference.get("parameters", {}),
        "presets": reference.get("presets", {}),
        "quantities": dict.fromkeys(quantities, "0") if isinstance(quantities, Mapping) else {},
        "equations": dict.fromkeys(reference["states"], rate),
    }
    try:
        return named_model(table)
    except ModelError:
        return None


def is_model_file(reference: Any) -> bool:
    """Return whether a reference to a model is the path of a TOML file."""
    return isinstance(reference, str) and reference.endswith(SUFFIX)


def read_model_file(path: str | Path) -> dict[str, Any]:
    """Read a model file and return its table; the keys are at the top level or below ``[model]``.

    Without the key ``name`` the model is named after the file.

    Raises
    ------
    SpecError
        If the file cannot be read or is not TOML.
    """
    tables = read_toml(path)
    inner = tables.get("model")
    table = dict(inner) if isinstance(inner, dict) else tables
    return {"name": Path(path).stem, **table}


def _of_file(name: str, folder: str | Path | None, at: str) -> Model:
    if folder is None:
        raise SpecError(f"{at} = {name!r}: a run keeps the text of a model, not the name of its file.")
    path = Path(folder) / name
    try:
        inner = read_toml(path).get("model")
        if isinstance(inner, str):  # a specification that names its model
            path = path.parent / inner
            return named_model(read_model_file(path) if is_model_file(inner) else inner)
        return named_model(read_model_file(path))
    except ModelError as error:
        raise SpecError([f"{path.name}: {p.removeprefix('model.')}" for p in error.problems]) from None
    except SpecError as error:
        raise SpecError([f"{at}: {p}" for p in error.problems]) from None


def kept_reference(model: Model) -> str | dict[str, Any]:
    """Return the form in which a run stores its model: the name of a shipped model, or its definition as a dict."""
    reference = model.reference
    return reference if isinstance(reference, str) else dict(reference)


def with_model_table(data: Mapping[str, Any], folder: str | Path) -> Mapping[str, Any]:
    """Replace the path of a model file in a specification by the content of the file, so that single keys can be
    changed.

    The path of a file that cannot be read stays; the parser of the specification reports the problem.
    """
    if not is_model_file(data.get("model")):
        return data
    try:
        return {**data, "model": read_model_file(Path(folder) / data["model"])}
    except SpecError:
        return data


def model(
    equations: str | Path | Mapping[str, Any] | Model | Callable[..., Any],
    /,
    *,
    name: str | None = None,
    kind: Literal["flow", "map"] | None = None,
    title: str | None = None,
    source: str | None = None,
    section: str | None = None,
    states: Mapping[str, str | Mapping[str, Any]] | Sequence[str] | None = None,
    parameters: Mapping[str, float | Mapping[str, Any]] | None = None,
    drive: str | None = None,
    define: Mapping[str, str] | None = None,
    quantities: Mapping[str, str | Mapping[str, Any]] | None = None,
    impacts: Sequence[Mapping[str, Any]] | None = None,
    drawing: Mapping[str, Any] | None = None,
    mirror: Mapping[str, Any] | None = None,
    presets: Mapping[str, Mapping[str, Any]] | None = None,
    classifier: Mapping[str, Any] | None = None,
    **values: float | Mapping[str, Any],
) -> Model:
    """Return a model from a Python function or from equations, or one given by name, path, TOML text or table.

    Parameters
    ----------
    equations
        A function ``f(t, y, p)`` as for `scipy.integrate.solve_ivp`, which returns the rates of `states`: it is
        called once with symbols, and its equations are then text like any others. Or lines ``x' = v`` (rates),
        ``drive = A*cos(omega*t)`` (parts with a name) and ``d = 0.2`` (parameters); ``x'' = ...`` makes the
        states ``x`` and ``x_dot``. Or a dict of right sides by state. In expressions ``t`` is the time [s], ``f``
        the frequency of the drive [Hz], and ``omega`` 2 pi f. The states have the order of the equations, all
        derivatives last. Otherwise the name of a model that ships, the path of a model's file or of a
        specification, TOML text of either, or a table with the keys of ``[model]``; then no keyword is taken.
    kind
        ``"map"`` if a line ``x' = ...`` gives the next ``x``, and not its rate.
    name, title, source, section
        Name, by default ``model``; what the model is, in a line; where its equations come from; the instant of
        its sections.
    states, parameters, define, quantities
        Entries by name as in the table ``[model]``: a unit, ``{"unit": "rad", "on_circle": True}``,
        ``{"value": 0.2, "unit": "1/s", "bound": "positive"}``. What the lines do not say is added to them.
        For a function: the names of the states, in the order of ``y``, and the parameters, in the order of ``p``.
    drive
        Of a function that depends on ``t``: the parameter that is the angular frequency, the frequency or the period of
        its drive. Specifications give its value as ``frequency_hz``; in the text it is an expression of ``f``.
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
    >>> duffing = model("x'' = -d*x' + x - x**3 + A*cos(omega*t)", d=0.2, A=0.3)
    >>> duffing.state_names
    ('x', 'x_dot')
    >>> model(lambda t, y, p: [y[1], -p.k * y[0]], states=("x", "v"), k=2.0)
    model model
      states x [1], v [1]
      parameters k = 2
      x' = v
      v' = -k*x
    """
    tables = {
        "name": name,
        "kind": kind,
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
    if callable(equations):
        found = named_model(read_function(equations, given, values, drive))
    elif drive is not None:
        raise SpecError(
            f"drive = {shown(drive)}: names a parameter of a function; equations as text have the frequency f of their "
            'drive. A parameter of this name stands in parameters: parameters={"drive": 1.0}.'
        )
    elif _is_equations(equations):
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
