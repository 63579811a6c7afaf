"""Find the model of a specification: one shipped with magpend, a text, a file, or a Python object.

A run never keeps only the path of a file or of an object. It keeps a model's text in ``run.json``, and a
description of a Python object. Reading a run's model reads no other file and imports nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magpend_core.models import ModelError, import_model, load_model, model_names
from magpend_core.models.imported import KEY, is_object_path
from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError
from magpend_core.models.text.lines import is_equations
from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError, shown
from pipeline.specification.toml import table_lines, toml_value

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
            return load_model(reference)
        if not isinstance(reference, str):
            raise SpecError(
                f"{at} = {shown(reference)}: must be a name in quotes, such as {model_names()[0]!r}, a file "
                '"FILE.toml", a Python object "package.module:NAME", or a table [model] with states, '
                "parameters and equations."
            )
        if is_equations(reference):
            return load_model({"equations": reference})
        if folder is not None and is_object_path(reference):
            return import_model(reference, folder)
        if is_model_file(reference):
            return _of_file(reference, folder, at)
        return load_model(reference)
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
    rate, quantities = ("0*t" if forced else "0"), reference.get("quantities", {})
    table = {
        "name": "stand-in",
        "states": reference["states"],
        "parameters": reference.get("parameters", {}),
        "presets": reference.get("presets", {}),
        "quantities": dict.fromkeys(quantities, "0") if isinstance(quantities, Mapping) else {},
        "equations": dict.fromkeys(reference["states"], rate),
    }
    try:
        return load_model(table)
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
            return load_model(read_model_file(path) if is_model_file(inner) else inner)
        return load_model(read_model_file(path))
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


def model_toml(reference: str | Mapping[str, Any]) -> str:
    """Format the reference to a model as TOML: one line for a name, or the tables of a model given as text.

    For a Python object this is its import path, which is imported when the file is read. Tables must come
    last in a file.
    """
    if isinstance(reference, str):
        return f"model = {toml_value(reference)}\n"
    if KEY in reference:
        return f"model = {toml_value(reference[KEY])}\n"
    return "\n".join(table_lines("model", reference)) + "\n"
