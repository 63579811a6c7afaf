"""Turn problems of a specification into sentences: key path, value, bound, remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

_TAG = "("
"""First character of the union tags in pydantic's locations, which do not belong to the key path."""


class SpecError(ValueError):
    """An error for an invalid specification; its message lists all problems.

    Attributes
    ----------
    problems : list of str
        A sentence for each problem: the dotted key path, the value, the bound and what to do.
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        super().__init__("\n".join(self.problems))


def shown(value: Any) -> str:
    """Format a value for a message; a long one is cut in the middle."""
    most = 120  # characters of a value that a message repeats
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits; a list in itself
        return f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[: most - 40]} ... {text[-30:]}"


def unknown_key(path: str, key: str, known: Iterable[str]) -> str:
    """Return the message for an unknown key, with the nearest known keys."""
    names = list(known)
    near = difflib.get_close_matches(key, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"known keys: {', '.join(names)}."
    return f"{path}: unknown key; {hint}"


def unknown_choice(path: str, value: Any, choices: Sequence[str]) -> str:
    """Return the message for a value that is none of the choices, with the nearest one."""
    near = difflib.get_close_matches(value, choices, n=1, cutoff=0.5) if isinstance(value, str) else []
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"{path} = {shown(value)}: must be {' or '.join(repr(c) for c in choices)}.{hint}"


def unknown_name(what: str, name: str, known: Iterable[str]) -> str:
    """Return the message for an unknown name, with the nearest known names."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"known: {', '.join(names) or 'none'}."
    return f"unknown {what} {name!r}; {hint}"


M = TypeVar("M", bound=BaseModel)


def validated(model: type[M], values: Mapping[str, Any], prefix: str = "") -> M:
    """Validate a table of options and return it.

    Parameters
    ----------
    model
        Class of the table.
    values
        Values by name. A whole number may be given as ``64.0``, and a tuple as a list.
    prefix
        Dotted path of the table, for the messages.

    Raises
    ------
    SpecError
        If values are not valid; the message lists all problems.
    """
    try:
        return model.model_validate({name: _exact(model, name, value) for name, value in values.items()})
    except ValidationError as error:
        raise SpecError(problems_of(error, model, prefix)) from None


def checked(model: type[BaseModel], value: Any, path: str, problems: list[str]) -> Any:
    """Return a table validated by a pydantic model; if it is invalid, add its problems to `problems` and return
    None.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        problems += problems_of(error, model, path)
        return None


def table_at(data: Mapping[str, Any], key: str, problems: list[str]) -> dict[str, Any]:
    """Return the table under a TOML key, or an empty table if the key is missing. If the value is no table, add a
    problem and return an empty table.
    """
    table = data.get(key, {})
    if isinstance(table, dict):
        return table
    problems.append(f"{key} = {shown(table)}: must be a table; write [{key}].")
    return {}


def _exact(model: type[BaseModel], name: str, value: Any) -> Any:
    """Convert a whole float to int, or a list to a tuple, where pydantic's strict validation requires it."""
    kind = model.model_fields[name].annotation if name in model.model_fields else None
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, Mapping):
        return {key: tuple(v) if isinstance(v, list) and "tuple" in str(kind) else v for key, v in value.items()}
    return tuple(value) if isinstance(value, list) and "tuple" in str(kind) else value


def problems_of(error: ValidationError, model: type[BaseModel], prefix: str) -> list[str]:
    """Return a sentence for each problem that pydantic found.

    Parameters
    ----------
    error
        Error from pydantic.
    model
        Model that was validated; it gives the known keys.
    prefix
        Dotted path of the validated table.
    """
    return [_sentence(dict(item), model, prefix) for item in error.errors(include_url=False)]


def _path(prefix: str, location: Sequence[int | str]) -> str:
    path = prefix
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        elif not part.startswith(_TAG):
            path += f".{part}" if path else part
    return path


_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text in quotes",
    "list_type": "a list in square brackets",
    "tuple_type": "a list in square brackets",
    "dict_type": "a table",
    "finite_number": "a finite number",
}


_LENGTHS = {"short": ("min_length", "at least", "add what is missing"), "long": ("max_length", "at most", "cut it")}


def _sentence(item: dict[str, Any], model: type[BaseModel], prefix: str) -> str:
    location, kind, value = item["loc"], item["type"], item["input"]
    path, context = _path(prefix, location), item.get("ctx", {})
    if kind == "extra_forbidden":
        return unknown_key(path, str(location[-1]), _known_keys(model, location))
    if kind == "missing":
        return f"{path}: missing; add it."
    if kind == "literal_error":
        choices = [c.strip(" '") for c in context["expected"].replace(" or ", ",").split(",")]
        return unknown_choice(path, value, choices)
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        return f"{path} = {shown(value)}: must be {words} {context[name]}."
    if kind == "model_type":
        return f"{path} = {shown(value)}: must be a table{_example(model, location)}."
    if kind in _TYPES:
        return f"{path} = {shown(value)}: must be {_TYPES[kind]}."
    is_text, (_, _, way) = kind.startswith("string_"), kind.rpartition("_")
    if way in _LENGTHS and kind.endswith(f"too_{way}"):
        name, words, remedy = _LENGTHS[way]
        what = f"{context[name]} {'character' if is_text else 'value'}{'s' * (context[name] != 1)}"
        return f"{path} = {shown(value)}: must have {words} {what}; {remedy}."
    message = item["msg"].removeprefix("Value error, ")
    return f"{path}: {message}"


def _example(model: type[BaseModel], location: Sequence[int | str]) -> str:
    """Return an example of a table that may have been meant, or its keys."""
    fields = model.model_fields
    if location or "start" in fields:
        return " such as {start = 2.0, stop = 3.0, num = 101}"
    required = [name for name, info in fields.items() if info.is_required()]
    return f" with the key {required[0]}" if required else f" of {', '.join(fields)}; {{}} takes the defaults"


def _known_keys(model: type[BaseModel], location: Sequence[int | str]) -> list[str]:
    if len([part for part in location if not str(part).startswith(_TAG)]) == 1:
        return [field.alias or name for name, field in model.model_fields.items()]
    nested = getattr(model, "nested_model", None)
    return list(nested.model_fields) if nested is not None else []


INSTALL = "pip install '.[{}]' in a checkout of magpend"


def import_extra(package: str, extra: str, asker: str) -> Any:
    """Import a package of an extra.

    Parameters
    ----------
    package
        Name of the package.
    extra
        Name of the extra that has it.
    asker
        Option or file that needs the package, for the message.

    Raises
    ------
    SpecError
        If the package is not installed.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError:
        how = INSTALL.format(extra)
        raise SpecError(f"{asker}: needs {package}, which is not installed: {how}.") from None
