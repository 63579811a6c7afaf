"""Turn the fields of an options class into options of the command line, with types, defaults, bounds and help."""

from __future__ import annotations

import inspect
import types
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import typer

from pipeline.cli import console, outputs
from pipeline.cli.common import read_pairs, read_ranges

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

    from pipeline.products.product import Options

Command = Callable[..., None]

QUIET = Annotated[bool, typer.Option("--quiet", "-q", help="Print only results and warnings.")]
VERBOSE = Annotated[bool, typer.Option("--verbose", "-v", help="Print more, and the traceback of an error.")]
FORCE = Annotated[bool, typer.Option("--force", help="Replace files that magpend did not write.")]
LOGFILE = Annotated[
    Path | None, typer.Option("--log", metavar="FILE", help="Also write a log with times to this file.")
]
IMPORT = Annotated[
    str | None,
    typer.Option(
        metavar="MODULE:NAME", help="Import this Python object, the model of a run; otherwise nothing is imported."
    ),
]
# as in `FigureOptions`, whose import would make every help wait for pydantic
STYLE = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="Style of matplotlib that changes magpend's: its name, or a style file."),
]
DPI = Annotated[
    float | None,
    typer.Option(
        metavar="X", help="Resolution; by default 200, or that of the style [1/in]; 20 or more, at most 2400."
    ),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"magpend {metadata.version('magpend')}")
        raise typer.Exit


def _print_versions(wanted: bool) -> None:
    if wanted:
        from pipeline.runs.environment import show_versions

        show_versions()
        raise typer.Exit


VERSION = Annotated[
    bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
]
VERSIONS = Annotated[
    bool,
    typer.Option(
        "--versions", callback=_print_versions, is_eager=True, help="Print what a report of an error needs, and exit."
    ),
]
_METAVARS = {int: "N", float: "X", str: "TEXT"}
_VOICES = {"quiet": (QUIET, False), "verbose": (VERBOSE, False), "log": (LOGFILE, None)}
_IMPORTED = "import_object"


def speaking(command: Command) -> Command:
    """Wrap a command so that it has the options that all commands share (``--quiet``, ``--log``, ...) and shows its
    progress.
    """
    has_force = any(p.name == "force" for p in _own(command))

    def run(*args: Any, **given: Any) -> None:
        outputs.allow(given["force"] if has_force else given.pop("force"))
        console.configure(**{name: given.pop(name) for name in _VOICES})
        if (path := given.pop(_IMPORTED)) is not None:
            from magpend_core.models import import_object

            import_object(path, ".")
        with console.progress(command.__name__):
            command(*args, **given)

    voices = [_keyword(name, kind, default) for name, (kind, default) in _VOICES.items()]
    if not has_force:
        voices.append(_keyword("force", FORCE, False))
    voices.append(_keyword(_IMPORTED, IMPORT, None))
    return _signed(run, command, [*_own(command), *voices])


def drawing(command: Command) -> Command:
    """Wrap a command that draws figures so that it has the options ``--style`` and ``--dpi``."""

    def run(*args: Any, style: str | None, dpi: float | None, **given: Any) -> None:
        from pipeline.plots import looks
        from pipeline.products.product import FigureOptions
        from pipeline.specification.problems import validated

        looked = validated(FigureOptions, {"style": style or "", "dpi": dpi})
        with looks.given(looked.style, looked.dpi):
            command(*args, **given)

    looks_options = [_keyword("style", STYLE, None), _keyword("dpi", DPI, None)]
    return _signed(run, command, [*_own(command), *looks_options])


def taking(model: type[Options], command: Command) -> Command:
    """Replace the parameter ``options`` of a command's function by one command-line option for each field of an options
    class.

    The given values are validated together, and the command is called with the model.
    """

    def run(*args: Any, **given: Any) -> None:
        from pipeline.products.product import flag_of
        from pipeline.specification.problems import SpecError, validated

        wanted, problems = {}, []
        for name in model.model_fields:
            value = given.pop(name)
            if value is None or value == []:
                continue
            try:
                wanted[name] = _value(model.model_fields[name], flag_of(model, name), value)
            except SpecError as error:
                problems += error.problems
        if problems:
            raise SpecError(problems)
        command(*args, options=validated(model, wanted), **given)

    own = [p for p in _own(command) if p.name != "options"]
    return _signed(run, command, [*own, *(_parameter(model, name) for name in model.model_fields)])


def completing(words: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a function for shell completion, which lists the words that begin with what the user has typed."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words() if word.startswith(incomplete)]

    return complete


def help_of(info: FieldInfo) -> str:
    """Return the help text of a field: its description, its unit and its bounds."""
    from pipeline.products.product import bounds_of

    extra: Any = info.json_schema_extra or {}
    text = (info.description or "").rstrip(".")
    unit = f" [{extra['unit']}]" if extra.get("unit") else ""
    limits = bounds_of(info)
    return f"{text}{unit}{'; ' if limits else ''}{limits}."


def kind_of(info: FieldInfo) -> Any:
    """Return the type of a field on the command line: of several types, the first other than ``None``."""
    kind = info.annotation
    if get_origin(kind) in (Union, types.UnionType):
        kind, *_ = [part for part in get_args(kind) if part is not type(None)]
    return kind


def _parameter(model: type[Options], name: str) -> inspect.Parameter:
    from pipeline.products.product import default_of, flag_of

    info, flag = model.model_fields[name], flag_of(model, name)
    kind, default = kind_of(info), default_of(model, name)
    text = help_of(info) + (f" Default: {_shown(default)}." if default not in (None, "", [], {}, False) else "")
    declared: dict[str, Any] = {"help": text}
    if get_origin(kind) is Literal:
        choices = [c for c in get_args(kind) if c]
        declared |= {"metavar": "|".join(choices), "autocompletion": completing(lambda: choices)}
        kind = str
    elif kind is bool:
        flag = f"{flag}/--no-{flag[2:]}" if default else flag
    elif get_origin(kind) is dict:
        declared |= {"metavar": "NAME=LOW:HIGH" if _of_ranges(kind) else "NAME=VALUE"}
        kind = list[str]
    elif get_origin(kind) is tuple:
        declared |= {"metavar": "LOW HIGH" if float in get_args(kind) else "A B"}
    elif kind in _METAVARS:
        declared |= {"metavar": _METAVARS[kind]}
    return _keyword(
        name,
        Annotated[kind if info.is_required() else kind | None, typer.Option(flag, **declared)],
        inspect.Parameter.empty if info.is_required() else None,
    )


def _shown(default: Any) -> str:
    return "yes" if default is True else f"{default:g}" if isinstance(default, float) else str(default)


def _value(info: FieldInfo, flag: str, value: Any) -> Any:
    if get_origin(kind_of(info)) is dict:
        return read_ranges(flag, value) if _of_ranges(kind_of(info)) else read_pairs(flag, value, "frequency=2.2")
    return value


def _of_ranges(kind: Any) -> bool:
    return get_origin(get_args(kind)[1]) is tuple


def _own(command: Command) -> list[inspect.Parameter]:
    return list(inspect.signature(command, eval_str=True).parameters.values())


def _keyword(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _signed(run: Command, command: Command, parameters: Sequence[inspect.Parameter]) -> Command:
    signed: Any = run
    signed.__name__, signed.__doc__ = command.__name__, command.__doc__
    signed.__signature__ = inspect.Signature([p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters])
    signed.__annotations__ = {p.name: p.annotation for p in parameters}
    return run
