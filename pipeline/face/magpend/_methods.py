"""Make methods for analyses and figures, with the keywords, defaults and help of their options in `pipeline.products`.

A class declares a method by the options class: ``basins = AnalysisMethod(BasinOptions)``. Type checkers see the
keywords of that class. The function behind the method is made when it is first used.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MethodType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, Literal, ParamSpec, Protocol, TypeVar, cast, overload

import numpy as np

from pipeline.products.product import Analysis, Figure, Options, bounds_of
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawn
    from matplotlib.figure import SubFigure

P = ParamSpec("P")
R = TypeVar("R", covariant=True)
Echo = Callable[[str], None]
Panels = np.ndarray[tuple[int], np.dtype[np.object_]]
"""The axes of several panels, in the order in which they are drawn."""


# ---- what type checkers see ---------------------------------------------------------------------


class AnalysisCall(Protocol[P]):
    """An analysis with the keywords of its options. Beside `workers`, `scheduler` or `echo` they are not checked."""

    @overload
    def __call__(self, *args: P.args, **options: P.kwargs) -> xr.Dataset: ...
    @overload
    def __call__(self, *args: Any, workers: int | None, **options: Any) -> xr.Dataset: ...
    @overload
    def __call__(self, *args: Any, scheduler: str | None, **options: Any) -> xr.Dataset: ...
    @overload
    def __call__(self, *args: Any, echo: Echo | None, **options: Any) -> xr.Dataset: ...


class FigureCall(Protocol[P, R]):
    """A figure with the keywords of its options. Beside `ax`, `figure` or `echo` they are not checked."""

    @overload
    def __call__(self, *args: P.args, **options: P.kwargs) -> R: ...
    @overload
    def __call__(self, *, ax: Axes | None, **options: Any) -> R: ...
    @overload
    def __call__(self, *, figure: Drawn | SubFigure | None, **options: Any) -> R: ...
    @overload
    def __call__(self, *, echo: Echo | None, **options: Any) -> R: ...


class BifurcationCall(FigureCall[P, Any], Protocol[P]):
    """A figure of one panel, or of two with ``layout="side"``."""

    @overload
    def __call__(self, *, layout: Literal["side"], **options: Any) -> Panels: ...  # type: ignore[overload-overlap]
    @overload
    def __call__(self, *args: P.args, **options: P.kwargs) -> Axes: ...
    @overload
    def __call__(self, *, ax: Axes | None, **options: Any) -> Axes: ...
    @overload
    def __call__(self, *, figure: Drawn | SubFigure | None, **options: Any) -> Axes: ...
    @overload
    def __call__(self, *, echo: Echo | None, **options: Any) -> Axes: ...


# ---- the methods --------------------------------------------------------------------------------


class _Method(Generic[P]):
    def __init__(self, options: Callable[P, Options]) -> None:
        self.options = options

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name


class AnalysisMethod(_Method[P]):
    """The method of a run for the analysis of its name. As an attribute of the class it also takes a directory."""

    @overload
    def __get__(self, run: None, owner: type) -> AnalysisCall[Concatenate[str | Path | RunDirectory, P]]: ...
    @overload
    def __get__(self, run: RunDirectory, owner: type) -> AnalysisCall[P]: ...
    def __get__(self, run: RunDirectory | None, owner: type) -> Any:
        return _bound(analysis(self.name), run)


class FigureMethod(_Method[P], Generic[P, R]):
    """The method of `Plots` for the figure of its name."""

    def __get__(self, plots: Any, owner: type) -> FigureCall[P, R]:
        return cast("FigureCall[P, R]", _bound(figure(self.name), plots))


class OnePanel(FigureMethod[P, "Axes"]):
    """A figure of one panel."""


class SeveralPanels(FigureMethod[P, Panels]):
    """A figure of several panels."""


class AnyPanels(FigureMethod[P, Any]):
    """A figure of one panel or several."""


class Bifurcation(FigureMethod[P, Any]):
    """The bifurcation diagram, whose option `layout` says how many panels it has."""

    def __get__(self, plots: Any, owner: type) -> BifurcationCall[P]:
        return cast("BifurcationCall[P]", _bound(figure(self.name), plots))


def _bound(function: Callable[..., Any], instance: object) -> Any:
    return function if instance is None else MethodType(function, instance)


Keywords = Mapping[str, tuple[str, str]]
"""Type and help of keywords that are no options."""
_ECHO: Keywords = {"echo": ("Callable[[str], None] | None", "Function that prints a line about each computation.")}
_WHERE: Keywords = {
    "workers": ("int | None", "Number of processes or threads that share the parameter points."),
    "scheduler": ("str | None", "Where they run, as for `magpend.run`."),
    **_ECHO,
}
_INTO: Keywords = {
    "ax": ("Axes | None", "Axes to draw into; for a figure of one panel."),
    "figure": ("Figure | SubFigure | None", "Empty figure or subfigure to draw into; by default pyplot makes one."),
    **_ECHO,
}


@cache
def analysis(name: str) -> Callable[..., xr.Dataset]:
    """Return the function of an analysis, which takes a run or its directory, and keywords."""

    def analyse(source: str | Path | RunDirectory, options: dict[str, Any], **where: Any) -> xr.Dataset:
        from pipeline.runs.derive import derive

        return derive(source, name, options, **where)

    about = "Result, which is also kept in the run directory; its ``.magpend.table()`` is a pandas table."
    return _function(analyse, "str | Path | Run", ANALYSES[name], _WHERE, "Dataset", about)


@cache
def figure(name: str) -> Callable[..., Any]:
    """Return the function of a figure, which takes `Plots` and keywords."""
    product = FIGURES[name]

    def draw(plots: Any, options: dict[str, Any], **into: Any) -> Any:
        from pipeline.runs.drawing import draw_panels

        drawn = draw_panels(plots._source, name, options, **into)
        if len(drawn) == 1 and (product.panels != "several" or product.unless is not None):
            return drawn[0]
        panels = np.empty(len(drawn), object)
        panels[:] = drawn
        return panels

    kind, about = {
        "one": ("Axes", "The axes drawn into."),
        "several": ("ndarray", "Array of the panels' axes, without colour bars."),
        "either": ("Axes | ndarray", "The axes; an array of axes if there are several panels."),
    }[product.panels]
    if product.unless is not None:
        other = "an array of axes" if product.panels == "one" else "the axes of the one panel"
        kind, about = "Axes | ndarray", f"{about} With ``{product.unless[0]}={product.unless[1]!r}``: {other}."
    return _function(draw, "Plots", product, _INTO, kind, about)


def _function(
    call: Callable[..., Any], source: str, product: Analysis | Figure, more: Keywords, returned: str, about: str
) -> Callable[..., Any]:
    """Return a function of a source and of keywords, with the signature and the docstring that the options give."""
    from pipeline.runs.arguments import options_in_errors

    fields = product.options.model_fields
    required = {name: info for name, info in fields.items() if info.is_required()}
    fields = {**required, **fields}
    Parameter = inspect.Parameter
    parameters = [Parameter("source", Parameter.POSITIONAL_OR_KEYWORD, annotation=source)]
    for name, info in fields.items():
        default = Parameter.empty if name in required else info.get_default(call_default_factory=True)
        parameters.append(Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=info.annotation))
    for name, (kind, _) in more.items():
        parameters.append(Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=kind))
    known = [*fields, *more]

    def function(source: Any, **given: Any) -> Any:
        if unknown := [unknown_name("option", name, known) for name in given if name not in known]:
            raise SpecError(unknown)
        aside = {name: given.pop(name) for name in more if name in given}
        with options_in_errors(product.options):
            return call(source, given, **aside)

    made: Any = function
    made.__module__ = "magpend"
    made.__name__ = made.__qualname__ = product.name
    made.__signature__ = inspect.Signature(parameters, return_annotation=returned)
    helps = {name: _help(info, product.options) for name, info in fields.items()}
    helps |= {name: text for name, (_, text) in more.items()}
    made.__doc__ = _docstring(_in_python(product.help, product.options), helps, returned, about)
    return made  # type: ignore[no-any-return]


# ---- docstrings ---------------------------------------------------------------------------------


def _docstring(summary: str, helps: Mapping[str, str], returned: str, about: str) -> str:
    # what a command prints is nothing to a method
    parts = re.sub(r"Prints [^.]*\.\s*", "", summary).split("\n\n")
    lines = [line for part in parts for line in (*_wrapped(part), "")]
    lines += ["Parameters", "----------"]
    lines += [line for name, text in helps.items() for line in (name, *_wrapped(text, "    "))]
    lines += ["", "Returns", "-------", returned, *_wrapped(about, "    "), "", "Raises", "------", "SpecError"]
    lines += ["    If an option is unknown or out of bounds, or if the run does not suit; before anything is computed."]
    return "\n".join(lines)


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(" ".join(text.split()), 110, initial_indent=indent, subsequent_indent=indent)


def _help(info: Any, options: type[Options]) -> str:
    text, bounds = _in_python((info.description or "").rstrip("."), options), bounds_of(info)
    unit = (info.json_schema_extra or {}).get("unit")
    return f"{text}{f' [{unit}]' if unit else ''}{f' ({bounds})' if bounds else ''}."


def _in_python(text: str, options: type[Options]) -> str:
    """Replace options of the command line by the names of keywords."""
    extras: dict[str, Any] = {name: info.json_schema_extra or {} for name, info in options.model_fields.items()}
    flags = {extra.get("flag") or f"--{name.replace('_', '-')}": name for name, extra in extras.items()}
    return re.sub(r"--[a-z-]+[a-z]", lambda flag: f"`{flags[flag[0]]}`" if flag[0] in flags else flag[0], text)
