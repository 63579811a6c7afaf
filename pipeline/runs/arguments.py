"""Name the arguments of Python functions in errors, where messages name options of the command line."""

from __future__ import annotations

import contextlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from pipeline.products.product import Options
from pipeline.products.registry import ANALYSES, FIGURES

P = ParamSpec("P")
T = TypeVar("T")
Kinds = Mapping[str, str]
"""Type of each argument as text, by name."""

# a command of the terminal stays as it is, up to the end of its clause
_COMMAND = r"magpend [a-z]+ (?:[^;,()\n.]|\.(?=\S))*"
_PAIR = r"\w[\w.]*=(?:\.\.\.|[^\s;,()]*[^\s;,():.])"
_NUMBERS = r"[-+]?\d[\d.]*(?:e[-+]?\d+)?(?<!\.)(?: [-+]?\d[\d.]*(?:e[-+]?\d+)?(?<!\.))*"
_VALUE = rf"=\S*[\w'\")\]]| (?:{_PAIR}|{_NUMBERS}|[A-Z](?:[A-Z_:]*[A-Z_])?(?![A-Za-z])|\S+(?=: ))"
_WORD = re.compile(rf"{_COMMAND}|--(?P<flag>[a-z][a-z0-9-]*[a-z0-9])(?P<value>{_VALUE})?(?P<colon>:)?")
_OTHER_NAMES = {"axis": ("axes", "ranges"), "set": ("overrides",)}
"""Arguments of functions whose option has another name."""


@contextlib.contextmanager
def arguments_in_errors(kinds: Kinds, flags: Mapping[str, str] | None = None) -> Iterator[None]:
    """Replace options of the command line by arguments in the messages of errors that leave the context.

    Parameters
    ----------
    kinds
        Arguments that the caller has.
    flags
        Names of arguments by option, where they differ.
    """
    try:
        yield
    except Exception as error:

        def said(text: Any) -> Any:
            return in_python(text, kinds, flags or {}) if isinstance(text, str) else text

        error.args = tuple(said(text) for text in error.args)
        if isinstance(problems := getattr(error, "problems", None), list):
            error.problems = [said(text) for text in problems]  # type: ignore[attr-defined]
        raise


def options_in_errors(model: type[Options]) -> contextlib.AbstractContextManager[None]:
    """Return a context in whose errors the options of an analysis or figure are named as arguments."""
    extras: dict[str, Any] = {name: info.json_schema_extra or {} for name, info in model.model_fields.items()}
    flags = {extra["flag"].removeprefix("--"): name for name, extra in extras.items() if extra.get("flag")}
    return arguments_in_errors({name: str(info.annotation) for name, info in model.model_fields.items()}, flags)


def names_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Wrap a function of ``import magpend`` so that its errors name its arguments.

    A function that takes the name of an analysis or figure also has the options of it as arguments.
    """

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        signature = inspect.signature(function)
        kinds = {name: str(p.annotation) for name, p in signature.parameters.items()}
        name = kwargs.get("name", args[1] if len(args) > 1 and "name" in kinds else "")
        product: Any = {**FIGURES, **ANALYSES}.get(str(name)) if "name" in kinds else None
        with contextlib.ExitStack() as stack:
            stack.enter_context(arguments_in_errors(kinds))
            if product is not None:
                stack.enter_context(options_in_errors(product.options))
            return function(*args, **kwargs)

    return called


def in_python(text: str, kinds: Kinds, flags: Mapping[str, str]) -> str:
    """Return a message with arguments in place of options; commands of the terminal and unknown options stay."""

    def renamed(found: re.Match[str]) -> str:
        name = _argument(found["flag"] or "", kinds, flags)
        if not name:
            return found[0]
        if found["value"]:
            return f"{name}={_value(found['value'][1:])}{found['colon'] or ''}"
        if "bool" in kinds.get(name, ""):
            return f"{name}={not (found['flag'] or '').startswith('no-')}{found['colon'] or ''}"
        return f"{name}:" if found["colon"] else f"{name}="

    return _WORD.sub(renamed, text)


def _argument(flag: str, kinds: Kinds, flags: Mapping[str, str]) -> str:
    plain = flag.removeprefix("no-")
    own = plain.replace("-", "_")
    names = (flags.get(plain, own), own, f"{own}s", f"n_{own}", *_OTHER_NAMES.get(own, ()))
    return next((name for name in names if name in kinds), "")


def _value(given: str) -> str:
    """Return the Python text of an option's value."""
    name, is_pair, value = given.partition("=")
    if is_pair:
        return f"{{{name!r}: {_range(value)}}}"
    if re.fullmatch(_NUMBERS, given):
        return given if " " not in given else f"({given.replace(' ', ', ')})"
    return given if re.fullmatch(r"[A-Z_]+", given) else repr(given)


def _range(value: str) -> str:
    parts = value.split(":")
    if len(parts) == 3:
        return (
            "{" + ", ".join(f"{key!r}: {part}" for key, part in zip(("start", "stop", "num"), parts, strict=True)) + "}"
        )
    return value if len(parts) == 1 else f"({', '.join(parts)})"
