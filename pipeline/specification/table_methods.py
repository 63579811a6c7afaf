"""Make the methods of `magpend.Spec`, one for each table of a specification, whose keywords are the table's keys."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable
from functools import wraps
from typing import Any, Generic, Literal, ParamSpec, TypeVar, get_args, get_origin

from pydantic import BaseModel

from pipeline.products.product import bounds_of
from pipeline.specification.problems import shown, unknown_key

P = ParamSpec("P")
S = TypeVar("S")

T = TypeVar("T")

PREFIX = "with_"
_FILLED_IN = ("kind", "sha256", "text")
"""Keys that are not given by hand."""


class TableMethod(Generic[P]):
    """A method of `Spec` that changes the keys of a table, or replaces it if keys are required.

    Parameters
    ----------
    table
        Model of the table. Type checkers see the method's keywords in it.
    summary
        Docstring of the method, without its parameters.
    path
        Path of the table if it is not the method's name. With ``{name}`` the method takes a first argument `name`.
    argument
        Description of that argument.
    """

    def __init__(self, table: Callable[P, BaseModel], summary: str, path: str = "", argument: str = "") -> None:
        self.table: Any = table
        self.summary, self.path, self.argument = summary, path, argument

    def __set_name__(self, owner: type, name: str) -> None:
        self.path = self.path or name.removeprefix(PREFIX)
        fields = {k: info for k, info in self.table.model_fields.items() if k not in _FILLED_IN}
        required = [k for k, info in fields.items() if info.is_required()]
        replaces = bool(self.argument or required)

        def method(*args: Any, **kwargs: Any) -> Any:
            given = _bound(made.__signature__, args, kwargs, self.path.removesuffix(".{name}"))
            spec = given.pop("self")
            path = self.path.format(name=given.pop("name")) if self.argument else self.path
            keys = {fields[key].alias or key: value for key, value in given.items()}
            return spec._replaced(path, keys) if replaces else spec._updated(path, keys)

        Parameter = inspect.Parameter
        parameters = [Parameter("self", Parameter.POSITIONAL_OR_KEYWORD)]
        if self.argument:
            parameters.append(Parameter("name", Parameter.POSITIONAL_OR_KEYWORD, annotation=str))
        for key in dict.fromkeys([*required, *fields]):
            default = Parameter.empty if key in required else None
            parameters.append(
                Parameter(key, Parameter.KEYWORD_ONLY, default=default, annotation=fields[key].annotation)
            )
        made: Any = method
        made.__name__, made.__qualname__, made.__module__ = name, f"Spec.{name}", owner.__module__
        made.__signature__ = inspect.Signature(parameters, return_annotation="Spec")
        notes = ([("name", self.argument)] if self.argument else []) + [(k, _note(i)) for k, i in fields.items()]
        made.__doc__ = "\n".join([self.summary, "", "Parameters", "----------", *_lines(notes)])
        self.method = knows_its_keys(made, "" if self.argument else self.path)

    def __get__(self, spec: S | None, owner: type[S]) -> Callable[P, S]:
        found: Callable[P, S] = self.method if spec is None else self.method.__get__(spec, owner)
        return found


def _bound(signature: inspect.Signature, args: tuple[Any, ...], keys: dict[str, Any], path: str) -> dict[str, Any]:
    """Return the arguments of a method by name; raise TypeError that names what is missing, or has no name."""
    parameters = list(signature.parameters.values())
    named = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    extra = args[len(parameters) - len(named) :]
    if extra:
        raise TypeError(f"{path}: {shown(extra[0])} has no key; give values by name, as in {named[0]}=...")
    missing = [p.name for p in parameters[len(args) :] if p.default is p.empty and p.name not in keys]
    if missing:
        raise TypeError("\n".join(f"{path}.{name}: missing; add {name}=..." for name in missing))
    return dict(signature.bind(*args, **keys).arguments)


def _lines(notes: list[tuple[str, str]]) -> list[str]:
    return [
        line
        for name, note in notes
        for line in (name, *textwrap.wrap(note, 110, initial_indent="    ", subsequent_indent="    "))
    ]


def _note(info: Any) -> str:
    extra: Any = info.json_schema_extra or {}
    unit = f" [{extra['unit']}]" if extra.get("unit") else ""
    words = [(info.description or "").rstrip(".") + unit, bounds_in_words(info).replace("`", "")]
    default = "" if info.is_required() else default_in_words(info).strip("`")
    words += [f"default {default}" if default not in ("", "()") else ""]
    return "; ".join(word for word in words if word) + "."


def default_in_words(info: Any) -> str:
    """Return the default of a key as Markdown; empty if it says nothing."""
    if info.is_required():
        return "required"
    default = info.get_default(call_default_factory=True)
    if default is None or default in ("", {}):
        return ""
    return f"`{str(default).lower() if isinstance(default, bool) else repr(default)}`"


def bounds_in_words(info: Any) -> str:
    """Return the bounds or the choices of a key as Markdown."""
    if get_origin(info.annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(info.annotation))
    inner = [part for kind in get_args(info.annotation) for part in getattr(kind, "__metadata__", ())]
    words = [bounds_of(info)] + [bounds_of(part) for part in inner if hasattr(part, "metadata")]
    return ", ".join(word for word in words if word)


def knows_its_keys(method: Callable[P, T], path: str = "") -> Callable[P, T]:
    """Wrap a method of `Spec` so that an unknown keyword raises a TypeError with the nearest known keys.

    `path` is that of its table, by default the method's name.
    """
    path = path or method.__qualname__.removesuffix(".__init__").rpartition(".")[2].removeprefix(PREFIX)

    @wraps(method)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        parameters = inspect.signature(method).parameters
        if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            keys = list(parameters)[1:]
            unknown = [_unknown(path, key, value, keys) for key, value in kwargs.items() if key not in keys]
            if unknown:
                raise TypeError("\n".join(unknown))
        return method(*args, **kwargs)

    return called


def _unknown(path: str, key: str, value: Any, keys: list[str]) -> str:
    hint = (
        f" A parameter of the model is given by overrides={{{key!r}: {shown(value)}}}." if "overrides" in keys else ""
    )
    return unknown_key(f"{path}.{key}", key, keys) + hint
