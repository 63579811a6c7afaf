"""Define products of a run: results per cell, analyses of its result cube, and figures.

A product is a declaration: a model of its options, a line of help, and the names of its functions as
``"module:function"``. A function is imported when it is called. The command line, the specification and the
reference pages can therefore list products without importing their code. `pipeline.products.registry` lists
the products by name.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_serializer
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from pipeline.products.column import Columns


@dataclass(frozen=True)
class Variable:
    """Declaration of a variable of a result cube: name, dims, data type, fill value, units.

    Attributes
    ----------
    name : str
        Name in the cube.
    own_dims : tuple of str
        Dims after the cell dims.
    dtype : str
        Data type in the store.
    fill : float or int
        Value of a pending cell.
    units : str
        Unit; empty if the elements have different ones.
    long_name : str
        Description in words.
    attrs : mapping
        Further attributes.
    """

    name: str
    own_dims: tuple[str, ...]
    dtype: str
    fill: float | int
    units: str
    long_name: str
    attrs: Mapping[str, Any] = field(default_factory=dict)

    def attributes(self) -> dict[str, Any]:
        """Return all attributes of the variable as written to the store."""
        units = {"units": self.units} if self.units else {}
        return {**units, "long_name": self.long_name, **self.attrs}

    def itemsize(self, sizes: Mapping[str, int]) -> int:
        """Return the uncompressed size of the variable per cell [bytes]."""
        import numpy as np

        return int(np.dtype(self.dtype).itemsize) * math.prod(sizes[d] for d in self.own_dims)


def flag_attrs(codes: Any) -> dict[str, Any]:
    """Return the CF flag attributes of a variable that holds codes of an `IntEnum`. Each member of the enum must have a
    ``sentence``.
    """
    return {
        "flag_values": [int(s) for s in codes],
        "flag_meanings": " ".join(s.name.lower() for s in codes),
        "comment": "; ".join(f"{int(s)} {s.name.lower()}: {s.sentence}" for s in codes),
    }


def option(default: Any = ..., help: str = "", *, unit: str = "", flag: str = "", **bounds: Any) -> Any:
    """Return a pydantic field for an `Options` model, with help, unit and bounds.

    Parameters
    ----------
    default
        Default value; ``...`` makes the option required.
    help
        One sentence, without the unit.
    unit
        Unit of the number, such as ``1/s``; shown in square brackets after the sentence.
    flag
        Name on the command line if it is not the field's own, such as ``--from``.
    bounds
        Bounds of pydantic: ``ge``, ``gt``, ``le``, ``lt``, ``min_length``. The help states them, and they are
        checked before anything is computed.
    """
    return Field(default, description=help, json_schema_extra={"unit": unit, "flag": flag}, **bounds)


STRICT = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)
"""Settings of models of data from users: strict types, no unknown keys, no NaN or infinity."""


class Options(BaseModel):
    """Base class of the options of a product: types, defaults, bounds and help."""

    model_config = STRICT

    def plain(self) -> dict[str, Any]:
        """Return all options as JSON values."""
        return self.model_dump(mode="json")

    def changed(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, as JSON values."""
        return {
            name: value
            for name, value in self.plain().items()
            if type(self).model_fields[name].is_required() or value != default_of(type(self), name)
        }

    def part(self, model: type[Options]) -> dict[str, Any]:
        """Return the values of the options that this model shares with another `Options` model."""
        return {name: getattr(self, name) for name in model.model_fields}


def default_of(model: type[Options], name: str) -> Any:
    """Return the default of an option as a JSON value. Return None for a required option."""
    info: FieldInfo = model.model_fields[name]
    value = info.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return None
    return list(value) if isinstance(value, tuple) else value


def flag_of(model: type[Options], name: str) -> str:
    """Return the command-line flag of a field, such as ``--max-period``."""
    extra: Any = model.model_fields[name].json_schema_extra or {}
    return str(extra.get("flag") or f"--{name.replace('_', '-')}")


def as_flags(model: type[Options], options: Mapping[str, Any]) -> list[str]:
    """Return options as words of a shell command, such as ``--period 4``."""
    words = []
    for name, value in options.items():
        flag = flag_of(model, name)
        if isinstance(value, bool):
            words.append(flag if value else flag.replace("--", "--no-", 1))
        elif isinstance(value, Mapping):
            words += [f"{flag} {key}={_text(one, ':')}" for key, one in value.items()]
        else:
            words.append(f"{flag} {shlex.quote(_text(value))}")
    return words


def _text(value: Any, between: str = " ") -> str:
    if isinstance(value, list | tuple):
        return between.join(map(_text, value))
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def bounds_of(info: FieldInfo) -> str:
    """Return the bounds of a field in words, such as ``above 0, at most 1``; an empty text if there are none."""
    words = {"gt": "above {}", "ge": "{} or more", "lt": "below {}", "le": "at most {}"}
    found = []
    for bound in info.metadata:
        for name, text in words.items():
            if getattr(bound, name, None) is not None:
                found.append(text.format(f"{getattr(bound, name):g}"))
    return ", ".join(found)


@dataclass(frozen=True)
class Table:
    """Result of an analysis as a table: rows for CSV and JSON, and lines to print.

    Attributes
    ----------
    rows : list of dict
        Rows for ``--csv`` and ``--json``, with equal keys; numbers in SI units, unrounded.
    lines : list of str
        Lines to print.
    nothing : str
        Reason for an empty result, if that is an error of the command; else empty.
    graph : dict, optional
        Node-link data that take the place of the rows in JSON.
    header : sequence of str
        Names of the columns, for a table that may have no rows.
    """

    rows: Sequence[Mapping[str, Any]]
    lines: Sequence[str]
    nothing: str = ""
    graph: Mapping[str, Any] | None = None
    header: Sequence[str] = ()

    def csv(self) -> str:
        """Return the table's rows as CSV text, with NaN as empty fields."""
        text = io.StringIO()
        names = dict.fromkeys(name for row in self.rows for name in row) or self.header
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: "" if v != v else v for k, v in row.items()} for row in self.rows)
        return text.getvalue()


def padded(table: Sequence[Sequence[str]], indent: str = "  ", right: bool = False) -> list[str]:
    """Format a table of texts as lines whose columns are padded to equal width."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = ([(t.rjust if right and k else t.ljust)(widths[k]) for k, t in enumerate(line)] for line in table)
    return [indent + "  ".join(line).rstrip() for line in lines]


@dataclass(frozen=True)
class CellProduct:
    """Declaration of a product that a run computes for every cell, requested by ``[products] NAME = {...}``.

    Attributes
    ----------
    name : str
        Key in the specification's table ``[products]``.
    help : str
        One sentence on the product.
    options : type of Options
        Model of its options.
    variables : callable
        ``variables(options, model)`` returns the tuple of `Variable` that the cube gets.
    sizes : callable
        ``sizes(options, model)`` returns the sizes of their own dims by name.
    cost : callable
        ``cost(options)`` returns the work per cell, in drive periods of a plain integration.
    compute : str
        ``"module:function"``: ``compute(job, options)`` with a `pipeline.compute.integrate.Job`, which holds
        integrated cells, returns the variables with leading dims (branch, point).
    settle : callable
        ``settle(options, model)`` returns the options with values that follow from the model filled in. It
        raises ValueError with a sentence that begins with the option's name if they do not fit the model.
    coordinates : callable
        ``coordinates(options, model)`` returns the labels along the product's own dims, by dim.
    watches : callable
        ``watches(options)`` returns the names of the quantities to watch while cells are integrated.
    shortest : callable
        ``shortest(options)`` returns the options with the least work, for compiling ahead.
    follows_motion : bool
        Whether it follows the motion between section points, which a map has not.
    version : int
        Number of its results, see `magpend_core.versions`.
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
    watches: Callable[[Any], Sequence[str]] = lambda options: ()
    shortest: Callable[[Any], Any] = lambda options: options
    follows_motion: bool = False
    version: int = 1


Motion = Literal["steady", "recorded", "drifting", "noisy"]
"""Kind of motion of a run, see `pipeline.motion`."""


@dataclass(frozen=True)
class Analysis:
    """Declaration of an analysis of a result cube: ``magpend analyse NAME DIR``; its results are stored in
    ``DIR/derived``.

    Attributes
    ----------
    name : str
        Name of the analysis and its command.
    help : str
        First paragraph: one sentence for lists. Further paragraphs: help for readers of the table.
    options : type of Options
        Model of its options.
    compute : str
        ``"module:function"``: ``compute(run, options)`` returns a Dataset. ``run.cube()`` is the cube, and
        ``run.derive(name, **options)`` another analysis of the same cells.
    columns : tuple of Column
        Variables of the Dataset, see `pipeline.products.column`. The dims and coordinates of the cube, and a variable
        for each state, parameter or quantity of the model, are not among them.
    table : str
        ``"module:function"``: ``table(ds)`` returns a `Table`. Empty for a result that other analyses use and
        that has no command.
    needs : str
        ``"module:function"`` or empty: ``needs(run, options)`` raises ValueError with a sentence if the run
        does not suit the analysis. It is called before anything is computed.
    settle : str
        ``"module:function"`` or empty: ``settle(run, options)`` returns the options with values that follow
        from the run filled in (an interval, the nearest value of an axis), so that equivalent options share
        one result.
    builds_on : tuple of str
        Analyses that `compute` derives; their versions count in this one's.
    figure : str
        Name of the figure that shows the result best, or empty.
    ignores : tuple of str
        Options that do not change the result.
    motions : tuple of str
        Kinds of motion that its runs may have; see `pipeline.motion`.
    follows_motion : bool
        Whether it follows the motion between section points, which a map has not.
    by_point : bool
        Whether each parameter point is analysed on its own, so that `compute` may be given blocks of points, whose
        results `pipeline.results.ragged.joined` joins.
    parts : str
        ``"module:function"`` or empty: ``parts(run, options)`` returns a list of parts that are computed independently
        of each other, such as curves, in the order of the rows of the result. They are plain values. It derives the
        results of other analyses that `compute` needs. ``compute(run, options, parts)`` gets any neighbouring ones.
    rows : str
        Dim along which the results of parts are joined.
    together : int
        Fewest parts that are computed together, if they share calls of the engine or take less than a second each.
    whole : str
        Reason for an analysis with neither `by_point` nor `parts`, which is computed in one process.
    finish : str
        ``"module:function"`` or empty: ``finish(run, ds, options)`` completes the result of all blocks by what needs
        them all.
    version : int
        Number of its results: raised when they change on purpose, see `magpend_core.versions`.
    """

    name: str
    help: str
    options: type[Options]
    compute: str
    columns: Columns = ()
    table: str = ""
    needs: str = ""
    settle: str = ""
    builds_on: tuple[str, ...] = ()
    figure: str = ""
    ignores: tuple[str, ...] = ()
    motions: tuple[Motion, ...] = ("steady",)
    follows_motion: bool = False
    by_point: bool = False
    parts: str = ""
    rows: str = ""
    together: int = 1
    whole: str = ""
    finish: str = ""
    version: int = 1


WIDTH: Any = option(178.0, "Width of the figure; 85 is a journal's column.", unit="mm", ge=40.0, le=1000.0)


class FigureOptions(Options):
    """Options that every figure has."""

    at: dict[str, float] = option({}, "Value of an axis that the figure does not show.")
    nearest: bool = option(False, "Use the axes' values nearest to --at, and print them; otherwise --at must match.")
    degrees: bool = option(False, "Use degrees instead of radians.")
    width: float = WIDTH
    xlim: tuple[float, float] | None = option(None, "Range of the horizontal axis, in its unit.")
    ylim: tuple[float, float] | None = option(None, "Range of the vertical axis, in its unit.")
    style: str | Path | list[str | Path | dict[str, Any]] | dict[str, Any] = option(
        "", "Style of matplotlib that changes magpend's: its name, or a style file."
    )
    dpi: float | None = option(
        None, "Resolution; by default 200, or that of the style", unit="1/in", ge=20.0, le=2400.0
    )

    @field_serializer("style", when_used="json")
    def _plain_style(self, style: Any) -> Any:
        return json.loads(json.dumps(style, default=str))

    def label(self) -> str:
        """Return the part of the figure's file name that lists the options with non-default values.

        The drive frequency as the continuation parameter is left out.
        """
        given = self.changed()
        if given.get("parameter") == "frequency_hz":
            del given["parameter"]
        if self.style:
            given["style"] = re.sub(r"[^\w.]+", "-", str(given["style"])).strip("-")
        first = [name for name in _SPEAKS_FOR_ITSELF if name in given]
        order = [*first, *(name for name in given if name not in first)]
        return "".join(f"_{_words(name, given[name])}" for name in order)

    def label_without(self, name: str) -> str:
        """Return the part of the figure's file name that lists the options, without one of them."""
        return FigureOptions.label(self.model_copy(update={name: ""}))


class StateOptions(FigureOptions):
    """Options of a figure of one state; the figure's file name always contains the state."""

    state: str = option("", "State to draw; by default the model's first.")


_SPEAKS_FOR_ITSELF = ("state", "quantity", "layout", "show")


def _words(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return name if value else f"no_{name}"
    if isinstance(value, dict):
        bound = "" if name == "at" else f"{name}_"
        return "_".join(f"{bound}{key}_{_word(number)}" for key, number in value.items())
    if isinstance(value, list):
        return "_".join([name, *(_word(part) for part in value)])
    return _word(value) if name in _SPEAKS_FOR_ITSELF else f"{name}_{_word(value)}"


_UNNAMEABLE = r'[/\\:<>"|?*]'
"""Characters that no file name has on Windows; on Linux only the first."""


def _word(value: Any) -> str:
    # all digits, since other values give other figures
    return f"{value:.15g}" if isinstance(value, float) else re.sub(_UNNAMEABLE, "-", str(value))


@dataclass(frozen=True)
class Figure:
    """Declaration of a figure of a run, drawn by ``magpend plot NAME DIR``.

    Attributes
    ----------
    name : str
        Name of the figure, with which the file's name begins.
    help : str
        First paragraph: one sentence for lists.
    options : type of FigureOptions
        Model of its options.
    draw : str
        ``"module:function"``: ``draw(run, options)`` returns a `pipeline.plots.style.DataFigure`, the figure
        with the Dataset drawn. It reads ``run.cube()`` and ``run.derive(name, **options)``, and integrates
        nothing itself.
    needs : str
        See `Analysis`.
    panels : str
        Number of panels: ``one``, ``several``, or ``either``, which depends on the run.
    unless : tuple, optional
        Option and value that turn one panel into several, or several into one.
    motions, follows_motion
        See `Analysis`; a figure of an analysis is refused with that.
    """

    name: str
    help: str
    options: type[FigureOptions]
    draw: str
    needs: str = ""
    panels: Literal["one", "several", "either"] = "one"
    unless: tuple[str, Any] | None = None
    motions: tuple[Motion, ...] = ("steady", "recorded", "drifting", "noisy")
    follows_motion: bool = False

    def panels_with(self, options: FigureOptions) -> Literal["one", "several", "either"]:
        """Return the number of panels that the figure has with some options."""
        if self.unless is None or getattr(options, self.unless[0]) != self.unless[1]:
            return self.panels
        return "several" if self.panels == "one" else "one"


def function_of(name: str) -> Callable[..., Any]:
    """Import and return the function that ``"module:function"`` names."""
    found: Callable[..., Any] = resolve_name(name)
    return found
