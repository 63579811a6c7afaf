"""Declare the variables of an analysis' result: the name, dims, meaning and unit of each, once.

`pipeline.layout.columns` writes them to results as attributes, and `pipeline.cli.reference` to the docs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

POINTS = "*"
"""Among the dims of a column: all swept parameters. The dims of cells are `POINTS` and `STARTS`."""

STARTS = "+"
"""Among the dims of a column: all dims of the initial conditions."""

STATES = "states"
"""Unit of a column whose numbers have, along the dim ``state``, the units of the states."""

UNITS = "see unit"
"""Unit of a column whose numbers have the units of the variable ``unit``, along one of its dims."""

OWN = ""
"""Unit of a column that the analysis itself knows, such as that of a channel."""


@dataclass(frozen=True)
class Column:
    """Declaration of a variable of a result.

    Attributes
    ----------
    name : str
        Name of the variable.
    dims : str
        Its dims, separated by blanks; `POINTS` and `STARTS` stand for those of a run, ``angle`` for that of the model.
    text : str
        The meaning in words: its ``long_name``. ``{period}``, ``{periods}`` and ``{time}`` stand for the words and the
        unit of the model's clock.
    unit : str
        Unit of its numbers; ``{parameter}`` stands for the unit of the parameter that the attribute ``parameter`` of
        the result names.
    own : str
        For values of a swept parameter: their name in results of users, such as ``bifurcation_{parameter}``, with the
        name of the attribute that names the parameter.
    """

    name: str
    dims: str
    text: str
    unit: str = "1"
    own: str = ""


def swept(name: str, dims: str, text: str, own: str = "{parameter}") -> Columns:
    """Return a column with values of a swept parameter, and the name that it has in results of users."""
    return (Column(name, dims, text, own[own.index("{") :], own),)


Columns = tuple[Column, ...]


def over(dims: str, unit: str = "1", /, **texts: str) -> Columns:
    """Return the columns with some names and meanings that have their dims and their unit in common."""
    return tuple(Column(name, dims, text, unit) for name, text in texts.items())


_PARTS = {
    "real": "real part",
    "imag": "imaginary part",
    "low": "lower end of the interval",
    "high": "upper end of the interval",
    "stderr": "standard error",
    "error": "error",
    "coarse": "on boxes of twice the width",
}


def in_parts(columns: Columns, *parts: str) -> Columns:
    """Return for each column one for each of its parts, such as ``NAME_real`` and ``NAME_imag``."""
    return tuple(
        replace(column, name=f"{column.name}_{part}", text=f"{column.text}, {_PARTS[part]}")
        for column in columns
        for part in parts
    )


def with_parts(columns: Columns, *parts: str) -> Columns:
    """Return columns with those of their parts, such as the ends of their intervals, ``NAME_low`` and ``NAME_high``."""
    return columns + in_parts(columns, *parts)


def only(columns: Columns, names: str) -> Columns:
    """Return the columns with some names, which are separated by blanks."""
    found = {column.name: column for column in columns}
    return tuple(found[name] for name in names.split())
