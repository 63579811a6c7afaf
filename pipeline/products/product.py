"""The product door: what a run can compute of its cells, find in its cube, or draw.

A product is a declaration: one model of its options, a line of help, and the names of the functions that
do the work as ``"module:function"``, imported when they are called. So the command line, the specification
and the reference pages read what there is without importing any of it. `pipeline.products.registry` lists
the products by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from pipeline.products.variable import Variable

FILE_FORMATS = ("png", "pdf", "svg")
COLUMN_MM = 85.0
"""Width of a journal's column."""


def option(default: Any = ..., help: str = "", *, unit: str = "", flag: str = "", **bounds: Any) -> Any:
    """Return a field of an `Options` model.

    Parameters
    ----------
    default
        ``...`` makes the option a required one.
    help
        One sentence, without the unit.
    unit
        Unit of the number, such as ``1/s``; shown in square brackets after the sentence.
    flag
        Name on the command line if it is not the field's own, such as ``--from``.
    bounds
        ``ge``, ``gt``, ``le``, ``lt``, ``min_length``: pydantic's; stated in the help and checked before
        anything is computed.
    """
    return Field(default, description=help, json_schema_extra={"unit": unit, "flag": flag}, **bounds)


class Options(BaseModel):
    """Options of a product: types, defaults, bounds and help, in this one place."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    def plain(self) -> dict[str, Any]:
        """All options as JSON values."""
        return self.model_dump(mode="json")

    def changed(self) -> dict[str, Any]:
        """Options that differ from their defaults, as JSON values."""
        return {
            name: value
            for name, value in self.plain().items()
            if type(self).model_fields[name].is_required() or value != default_of(type(self), name)
        }

    def part(self, model: type[Options]) -> dict[str, Any]:
        """Options that another model has too, for the analysis that takes these."""
        return {name: getattr(self, name) for name in model.model_fields}


def default_of(model: type[Options], name: str) -> Any:
    """Default of an option as a JSON value, ``None`` if it is a required one."""
    info: FieldInfo = model.model_fields[name]
    value = info.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return None
    return list(value) if isinstance(value, tuple) else value


class NoOptions(Options):
    """A product without options."""


@dataclass(frozen=True)
class Table:
    """What an analysis has to say.

    Attributes
    ----------
    rows : list of dict
        For ``--csv`` and ``--json``: all rows have the same keys; numbers in SI units, unrounded.
    lines : list of str
        What is printed.
    nothing : str
        Why nothing was found, where that is an error of the command; else empty.
    """

    rows: Sequence[Mapping[str, Any]]
    lines: Sequence[str]
    nothing: str = ""


@dataclass(frozen=True)
class CellProduct:
    """What is computed of every cell during a run, asked for by ``[products] NAME = {...}``.

    Attributes
    ----------
    name : str
        Key in the specification's table ``[products]``.
    help : str
    options : type of Options
    variables : callable
        ``variables(options, model)``: the tuple of `Variable` that the cube gets.
    sizes : callable
        ``sizes(options, model)``: the sizes of their own dims by name.
    cost : callable
        ``cost(options)``: what a cell takes, in drive periods of a plain integration.
    compute : str
        ``"module:function"``: ``compute(job, options)`` with a `pipeline.compute.task.Job`, the cells as they
        were integrated; returns the variables, with leading dims (branch, point).
    settle : callable
        ``settle(options, model)``: the options with what follows from the model filled in; raises
        ValueError with a sentence that begins with the option's name if they do not fit it.
    coordinates : callable
        ``coordinates(options, model)``: values of the product's own dims by name, where they have names.
    integrate : callable
        ``integrate(options)``: keywords of `magpend_core.run_branches` that the product needs.
    shortest : callable
        ``shortest(options)``: the options with the least work, for what is compiled ahead.
    """

    name: str
    help: str
    options: type[Options]
    variables: Callable[[Any, Any], tuple[Variable, ...]]
    sizes: Callable[[Any, Any], dict[str, int]]
    cost: Callable[[Any], float]
    compute: str
    settle: Callable[[Any, Any], Any] = lambda options, model: options
    coordinates: Callable[[Any, Any], dict[str, Sequence[Any]]] = lambda options, model: {}
    integrate: Callable[[Any], dict[str, Any]] = lambda options: {}
    shortest: Callable[[Any], Any] = lambda options: options


@dataclass(frozen=True)
class Analysis:
    """What can be found in a stored cube: ``magpend analyse NAME DIR``, kept in ``DIR/derived``.

    Attributes
    ----------
    name : str
    help : str
        First paragraph: one sentence for lists. Further ones: what the reader of the table must know.
    options : type of Options
    compute : str
        ``"module:function"``: ``compute(run, options)`` gives a Dataset. ``run.cube()`` is the cube,
        ``run.derive(name, **options)`` another analysis of the same cells.
    table : str
        ``"module:function"``: ``table(ds)`` gives a `Table`. Empty: a result that others build on, without
        a command.
    needs : str
        ``"module:function"`` or empty: ``needs(run, options)`` raises ValueError with a sentence if the
        run does not have what the analysis takes; called before anything is computed.
    settle : str
        ``"module:function"`` or empty: ``settle(run, options)`` gives the options with what follows from
        the run filled in (an interval, the value that an axis has), so that two spellings of one thing
        are one result.
    builds_on : tuple of str
        Analyses that `compute` derives: their code is part of this one's version.
    figure : str
        Name of the figure that shows it best, or empty.
    ignores : tuple of str
        Options that change nothing in the result.
    """

    name: str
    help: str
    options: type[Options]
    compute: str
    table: str = ""
    needs: str = ""
    settle: str = ""
    builds_on: tuple[str, ...] = ()
    figure: str = ""
    ignores: tuple[str, ...] = ()


class FigureOptions(Options):
    """Options that every figure has."""

    at: dict[str, float] = option({}, "Value of an axis that the figure has no room for.")
    nearest: bool = option(
        False,
        "Take the nearest values that the axes have for --at, and say which; otherwise others are refused.",
    )
    degrees: bool = option(False, "Degrees instead of radians.")
    width: float = option(
        178.0, "Width of the figure; 85 is a journal's column", unit="mm", ge=40.0, le=1000.0
    )
    xlim: tuple[float, float] | None = option(None, "Range of the horizontal axis, in its unit.")
    ylim: tuple[float, float] | None = option(None, "Range of the vertical axis, in its unit.")
    out: str = option("", "Figure file; by default in DIR/figures, named by what it shows.")
    format: Literal["", "png", "pdf", "svg"] = option("", "File format; by default png, or that of --out.")

    def label(self) -> str:
        """What the file's name says beside the figure's: options that are not as by default."""
        given = {name: value for name, value in self.changed().items() if name not in ("out", "format")}
        first = [name for name in _SPEAKS_FOR_ITSELF if name in given]
        order = [*first, *(name for name in given if name not in first)]
        return "".join(f"_{_words(name, given[name])}" for name in order)


class StateOptions(FigureOptions):
    """Options of a figure of one state; its name is always in the file's."""

    state: str = option("", "State that is drawn; by default the model's first.")


_SPEAKS_FOR_ITSELF = ("state", "quantity", "layout", "show")


def _words(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return name if value else f"no_{name}"
    if isinstance(value, dict):
        return "_".join(f"{key}_{_word(number)}" for key, number in value.items())
    if isinstance(value, list):
        return "_".join([name, *(_word(part) for part in value)])
    return _word(value) if name in _SPEAKS_FOR_ITSELF else f"{name}_{_word(value)}"


def _word(value: Any) -> str:
    # all digits: values that differ are other pictures
    return f"{value:.15g}" if isinstance(value, float) else str(value).replace("/", "-")


@dataclass(frozen=True)
class Figure:
    """What can be drawn of a run: ``magpend plot NAME DIR``.

    Attributes
    ----------
    name : str
        Also begins the file's name.
    help : str
    options : type of FigureOptions
    draw : str
        ``"module:function"``: ``draw(run, options)`` gives a `pipeline.plots.style.DataFigure`: the figure
        and the Dataset drawn. It reads ``run.cube()`` and ``run.derive(name, **options)`` and integrates
        nothing of its own.
    needs : str
        As in `Analysis`.
    """

    name: str
    help: str
    options: type[FigureOptions]
    draw: str
    needs: str = ""


Product = CellProduct | Analysis | Figure


def function_of(name: str) -> Callable[..., Any]:
    """Import the function that ``"module:function"`` names."""
    found: Callable[..., Any] = resolve_name(name)
    return found
