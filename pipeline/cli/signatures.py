"""Generate the typed methods of ``import magpend`` from the options of analyses and figures.

`pipeline.cli.reference` writes the files, and its ``--check`` fails while one is out of date. The options models
stay the only place of names, types, defaults, bounds and help.
"""

from __future__ import annotations

import re
import textwrap
import types
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from pipeline.products.product import Figure, Options
from pipeline.products.registry import ANALYSES, COMMANDS, FIGURES

FACE = Path(__file__).parents[1] / "face" / "magpend"
WIDTH = 120

_ECHO = ("echo", "Callable[[str], None] | None = None", "Function that prints a line about each computation.")
_PLACES = (
    ("workers", "int | None = None", "Number of processes or threads; 0: the calling thread alone."),
    ("scheduler", "str | None = None", "Where blocks of parameter points are analysed, as for `magpend.run`."),
)
_AX = ("ax", "Axes | None = None", "Axes to draw into; for a figure of one panel.")
_FIGURE = (
    "figure",
    "Figure | SubFigure | None = None",
    "Empty figure or subfigure to draw into. By default pyplot makes a figure.",
)
Parameter = tuple[str, str, str]
"""Name, the rest of its line in a signature, and help."""

_HEAD = '''"""{summary}

Generated from the options of `pipeline.products` by ``python -m pipeline.cli.reference``; do not edit.
"""

'''


def generated() -> dict[Path, Callable[[], str]]:
    """Return the generated files, each with the function that returns its text."""
    return {FACE / "_analyses.py": analyses, FACE / "_figures.py": figures, FACE / "__init__.pyi": stub}


def analyses() -> str:
    """Return the module with one method for each analysis."""
    names = ", ".join(f'"{name}"' for name in COMMANDS)
    head = _HEAD.format(summary="Define a method of a run for every analysis.") + textwrap.dedent(
        """\
        from __future__ import annotations

        from collections.abc import Callable, Mapping
        from typing import TYPE_CHECKING, Literal

        from magpend._bases import AnalysingRun

        if TYPE_CHECKING:
            import xarray as xr

        """
    )
    head += _bracketed("AnalysisName = Literal[", names, "]") + '\n"""Names of the analyses."""\n\n\n'
    head += 'class Analyses(AnalysingRun):\n    """An opened run with a method for every analysis."""\n'
    return head + "".join(_analysis(name) for name in COMMANDS)


def _analysis(name: str) -> str:
    parameters = _of_analysis(name)
    text = _docstring(
        ANALYSES[name].help,
        parameters,
        (
            "Dataset",
            "Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.",
        ),
        ANALYSES[name].options,
    )
    return f'\n{_def(name, parameters, "xr.Dataset")}\n{text}\n        return self._analysed("{name}", locals())\n'


def _of_analysis(name: str) -> list[Parameter]:
    return [*_parameters(ANALYSES[name].options), *_PLACES, _ECHO]


def figures() -> str:
    """Return the module with one method for each figure."""
    head = _HEAD.format(summary="Define a method for every figure of a run.") + textwrap.dedent(
        """\
        from __future__ import annotations

        from collections.abc import Callable, Mapping
        from typing import TYPE_CHECKING, Any, Literal, overload

        from magpend._bases import Drawing, Panels

        if TYPE_CHECKING:
            from pathlib import Path

            from matplotlib.axes import Axes
            from matplotlib.figure import Figure, SubFigure


        class Plots(Drawing):
            \"\"\"The figures of a run or a cube, by name; each method draws one and returns its axes.\"\"\"
        """
    )
    return head + "".join(_figure(FIGURES[name]) for name in FIGURES)


_RETURNED = {
    "one": ("Axes", "The axes drawn into."),
    "several": ("Panels", "Array of the panels' axes, without colour bars."),
    "either": ("Any", "The axes; an array of axes if there are several panels."),
}


def _figure(figure: Figure) -> str:
    parameters = [*_parameters(figure.options, ("out", "format")), _AX, _FIGURE, _ECHO]
    returned, about = _RETURNED[figure.panels]
    overloads = ""
    if figure.unless is not None:
        other = "several" if figure.panels == "one" else "one"
        overloads = _overload(figure, figure.panels, False) + _overload(figure, other, True)
        returned, about = "Any", f"{about} With ``{figure.unless[0]}={figure.unless[1]!r}``: "
        about += _RETURNED[other][1][:1].lower() + _RETURNED[other][1][1:]
    text = _docstring(figure.help, parameters, (returned, about), figure.options)
    call = {"one": "_one", "several": "_several", "either": "_either"}["either" if figure.unless else figure.panels]
    body = f'        return self.{call}("{figure.name}", locals())\n'
    return f"{overloads}\n{_def(figure.name, parameters, returned)}\n{text}\n{body}"


def _overload(figure: Figure, panels: str, asked: bool) -> str:
    """Return the overload of a method for those values of an option that give one or several panels."""
    assert figure.unless is not None
    option, special = figure.unless
    kind = figure.options.model_fields[option]
    values = get_args(kind.annotation) if get_origin(kind.annotation) is Literal else (False, True)
    chosen = [value for value in values if (value == special) == asked]
    default = "" if asked else f" = {_literal(kind.default)}"
    line = f"Literal[{', '.join(_literal(v) for v in chosen)}]{default}"
    own = _parameters(figure.options, ("out", "format"))
    parameters = [(name, line if name == option else rest, text) for name, rest, text in own]
    return f"\n    @overload\n{_def(figure.name, [*parameters, _AX, _FIGURE, _ECHO], _RETURNED[panels][0])} ...\n"


def stub() -> str:
    """Return the stub of the package, which tells editors and type checkers what its names are."""
    magpend: Any = import_module("magpend")
    homes: dict[str, list[str]] = {}
    for name, home in magpend._HOME_OF.items():
        homes.setdefault(home, []).append(name)
    homes["pipeline.plots"] = magpend._plot_names()
    lines = ['# Generated by "python -m pipeline.cli.reference"; do not edit.', "# ruff: noqa: I001", ""]
    lines += [
        "from collections.abc import Callable, Mapping",
        "from pathlib import Path",
        "from typing import Literal",
        "",
    ]
    lines += ["import xarray as xr", ""]
    lines += [_import(home, names) for home, names in sorted(homes.items())]
    lines += ["", "__version__: str", ""]
    for name in COMMANDS:
        lines.append(_def(name, _of_analysis(name), "xr.Dataset", "source: str | Path | Run", "") + " ...")
    return "\n".join(lines) + "\n"


def _import(home: str, names: Sequence[str]) -> str:
    exported = ", ".join(f"{name} as {name}" for name in sorted(names))
    return _bracketed(f"from {home} import ", exported, "", "()")


# ---- parts of a function ------------------------------------------------------------------------


def _parameters(options: type[Options], left_out: Sequence[str] = ()) -> list[Parameter]:
    """Return the parameters of a method, required ones first, from the fields of an options model."""
    found = [
        (name, _annotation(info) + ("" if info.is_required() else f" = {_default(info)}"), _help(info, options))
        for name, info in options.model_fields.items()
        if name not in left_out
    ]
    return sorted(found, key=lambda parameter: " = " in parameter[1])


def _annotation(info: FieldInfo) -> str:
    return _type(info.annotation)


def _type(kind: Any) -> str:
    """Return a type as it is written; a dict as a Mapping, because no function changes it."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"Literal[{', '.join(_literal(v) for v in inner)}]"
    if origin in (Union, types.UnionType):
        return " | ".join(_type(part) for part in inner)
    if origin is dict:
        return f"Mapping[{', '.join(_type(part) for part in inner)}]"
    if origin is not None:
        return f"{origin.__name__}[{', '.join('...' if part is ... else _type(part) for part in inner)}]"
    return "None" if kind is type(None) else str(kind.__name__)


def _literal(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _default(info: FieldInfo) -> str:
    value = info.get_default(call_default_factory=True)
    return _literal(value)


def _help(info: FieldInfo, options: type[Options]) -> str:
    from pipeline.cli.options import bounds_of

    extra: Any = info.json_schema_extra or {}
    text = _words((info.description or "").rstrip("."), options) + (f" [{extra['unit']}]" if extra.get("unit") else "")
    bounds = bounds_of(info)
    return f"{text}{f' ({bounds})' if bounds else ''}."


def _words(text: str, options: type[Options]) -> str:
    """Replace options of the command line by the names of parameters."""
    flags = {
        (info.json_schema_extra or {}).get("flag") or f"--{n.replace('_', '-')}": n for n, info in _fields(options)
    }
    return re.sub(r"--[a-z-]+[a-z]", lambda flag: f"`{flags[flag[0]]}`" if flag[0] in flags else flag[0], text)


def _fields(options: type[Options]) -> Iterable[tuple[str, Any]]:
    return options.model_fields.items()


def _def(name: str, parameters: Sequence[Parameter], returned: str, first: str = "self", indent: str = "    ") -> str:
    """Return the head of a function, in lines that the formatter leaves as they are."""
    arguments = [first, "*", *(f"{own}: {rest}" for own, rest, _ in parameters)]
    head, tail = f"{indent}def {name}(", f") -> {returned}:"
    inline = ", ".join(arguments)
    if len(head + inline + tail) <= WIDTH:
        return head + inline + tail
    if len(indent) + 4 + len(inline) <= WIDTH:
        return f"{head}\n{indent}    {inline}\n{indent}{tail}"
    return f"{head}\n" + "".join(f"{indent}    {argument},\n" for argument in arguments) + f"{indent}{tail}"


def _bracketed(head: str, inner: str, tail: str, brackets: str = "") -> str:
    """Return a list of names in one line or, if it is too long, one name per line."""
    if len(head + inner + tail) <= WIDTH:
        return head + inner + tail
    opened, closed = (brackets[0], brackets[1]) if brackets else ("", "")
    lines = "".join(f"    {name},\n" for name in inner.split(", "))
    if not brackets and len(inner) + 4 <= WIDTH:
        lines = f"    {inner}\n"
    return f"{head}{opened}\n{lines}{closed}{tail}"


def _docstring(help: str, parameters: Sequence[Parameter], returned: tuple[str, str], options: type[Options]) -> str:
    # what a command prints is nothing to a method
    told = re.sub(r"Prints [^.]*\.\s*", "", _words(help, options))
    parts = [" ".join(part.split()) for part in told.split("\n\n") if part.strip()]
    lines = [line for part in parts for line in (*_filled(part, 8, 3 if part is parts[0] else 0), "")]
    lines += ["Parameters", "----------"]
    for name, _, text in parameters:
        lines += [name, *(f"    {line}" for line in _filled(text, 12))]
    lines += ["", "Returns", "-------", returned[0], *(f"    {line}" for line in _filled(returned[1], 12))]
    lines += ["", "Raises", "------", "SpecError"]
    lines += ["    If an option is out of bounds, or if the run does not suit; before anything is computed."]
    text = "\n".join(f"        {line}" if line else "" for line in lines)
    return f'        """{text.lstrip()}\n        """'


def _filled(text: str, indent: int, first: int = 0) -> list[str]:
    filled = textwrap.wrap(" " * first + text, WIDTH - indent, break_long_words=False, break_on_hyphens=False)
    return [line.lstrip() if k == 0 else line for k, line in enumerate(filled)]
