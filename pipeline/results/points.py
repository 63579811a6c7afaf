"""Read measured points from CSV files: values over a parameter, for figures that draw them and for measured branches.

The drive's rate has its column in any of its words, an angle also as ``NAME_deg``. A parameter that has the name of a
measured column, such as ``amplitude``, has the column ``parameter_NAME``.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.layout.own_words import rate_attribute, spelling_of
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_attribute, parameter_name, parameter_units
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import FREQUENCY, RATES

POINT = "measured"
"""Dim of measured points."""

_MEASURED = "measured "

OWN = "parameter_"
"""Prefix of the column of a parameter that has the name of a measured column."""


def read_points(
    path: str | Path,
    model: Model,
    along: str,
    *,
    others: Sequence[str] = (),
    needed: Sequence[str] = ("amplitude",),
    known: Sequence[str] = ("phase",),
    angles: Collection[str] = (),
    rate: str = FREQUENCY,
) -> xr.Dataset:
    """Read measured points from a CSV file whose first line names the columns.

    Parameters
    ----------
    path
        The file.
    model
        Model of the run that the points are drawn over.
    along
        Axis over which the points lie. Its column has its name in any spelling: of the drive ``frequency_hz``,
        ``omega`` or ``period``; of an angle also with ``_deg``.
    others
        Further axes of the run; a column of one, in any spelling, tells the level of each point.
    needed, known
        Columns that must be there, and that may be; others are not read.
    angles
        Those of these columns that are angles [rad] or their rates, and may be in degrees, as ``NAME_deg``.
    rate
        Word of the run for the drive's rate, in which figures show it.

    Returns
    -------
    Dataset
        Over `POINT` ``parameter``, the levels by axis, and the columns; parameters in the unit of the cube. The level
        of an axis that has the name of a column is ``parameter_NAME``.

    Raises
    ------
    SpecError
        If the file cannot be read, a column is missing or there twice, a value is no number, or a row has none of the
        columns; all at once.
    """
    file = PointFile.read(path)
    columns = (*needed, *known)
    of_column = {name: file.place(name, {name, f"{name}_deg"} if name in angles else {name}) for name in columns}
    levels = [axis_name(axis) for axis in others]
    of_axis = {axis: file.place_of_axis(axis, model, columns) for axis in (axis_name(along), *levels)}
    missing = [] if of_axis[axis_name(along)] >= 0 else [_spellings(along, model, columns)]
    missing += [f"{name} (or {name}_deg)" if name in angles else name for name in needed if of_column[name] < 0]
    if missing:
        file.problems.append(
            f"has no column {', '.join(missing)}; the first line names the columns, and it has "
            f"{', '.join(file.header)}."
        )
    file.refuse()
    variables: dict[str, Any] = {}
    for axis, place in of_axis.items():
        if place >= 0:
            first = axis == axis_name(along)
            name = "parameter" if first else f"{OWN}{axis}" if axis in columns else axis
            convert = spelling_of(_plain(file.header[place], columns), model)[1]
            about = {"units": parameter_units(axis, model), "long_name": parameter_name(axis)}
            variables[name] = (POINT, file.numbers(place, convert, needed=first), about)
    for name, place in of_column.items():
        if place >= 0:
            convert = np.asarray if file.header[place] == name else np.radians
            variables[name] = (POINT, file.numbers(place, convert), {"long_name": f"{_MEASURED}{name}"})
    file.refuse()
    empty = np.all([np.isnan(variables[name][1]) for name in columns if name in variables], axis=0)
    for line in np.array(file.lines)[np.broadcast_to(empty, len(file.lines)) & bool(columns)].tolist():
        file.problems.append(f"row {line}: has no {' and no '.join(needed)}; give a value, or drop the row.")
    file.refuse()
    return xr.Dataset(variables, attrs={"model": model_attribute(model), **rate_attribute(rate)})


def level_name(points: xr.Dataset, parameter: str) -> str:
    """Return the name of the variable with the levels of a parameter; empty if the points have none."""
    names = (f"{OWN}{parameter}", f"{OWN}{axis_name(parameter)}", parameter, axis_name(parameter))
    told = (name for name in names if name in points)
    return next((name for name in told if not points[name].attrs["long_name"].startswith(_MEASURED)), "")


@dataclass(frozen=True)
class PointFile:
    """A CSV file whose first line names its columns, with the problems found in it.

    Attributes
    ----------
    path : Path
    header : list of str
        Names of the columns.
    rows : list of list of str
        Fields of the rows that are not blank, one for each column.
    lines : list of int
        Number of the last line of each row in the file.
    problems : list of str
        Sentences for `refuse`.
    """

    path: Path
    header: list[str]
    rows: list[list[str]]
    lines: list[int]
    problems: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, path: str | Path) -> PointFile:
        """Read a file; SpecError if it is no CSV file, has no rows, or a row has more fields than there are columns."""
        try:
            with Path(path).open(encoding="utf-8-sig", newline="") as text:
                reader = csv.reader(text)
                told = [(reader.line_num, [value.strip() for value in row]) for row in reader]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise SpecError(f"{path}: cannot be read as a CSV file ({error}).") from None
        (_, header), *rows = [(line, row) for line, row in told if any(row)] or [(0, [])]
        if not rows:
            raise SpecError(f"{path}: has no rows; the first line names the columns, and each other one is a point.")
        width = len(header)
        found = cls(Path(path), header, [(row + [""] * width)[:width] for _, row in rows], [line for line, _ in rows])
        for line, row in rows:
            if any(row[width:]):
                found.problems.append(
                    f"row {line}: has {len(row)} values for {width} columns; separate values by commas, and write "
                    "decimals with a point."
                )
        found.refuse()
        return found

    def place(self, name: str, spelled: Collection[str], first: int = 0) -> int:
        """Return the place of the one column, from a place on, that has one of some names; -1 if there is none."""
        found = [i for i, column in enumerate(self.header) if i >= first and column in spelled]
        if len(found) > 1:
            twice = " and ".join(self.header[i] for i in found)
            self.problems.append(f"the columns {twice} are the same axis; drop all but one.")
        return found[0] if found else -1

    def place_of_axis(self, axis: str, model: Model, measured: Collection[str]) -> int:
        """Return the place of the column of an axis, in any spelling; -1 if there is none."""
        spelled = {
            column
            for column in self.header
            if column not in measured and spelling_of(_plain(column, measured), model)[0] == axis
        }
        return self.place(axis, spelled)

    def numbers(self, place: int, convert: Callable[[Any], Any] = np.asarray, *, needed: bool = False) -> np.ndarray:
        """Return a column as numbers after a conversion; an empty field is NaN, and a problem if it is `needed`."""
        if place < 0:
            return np.full(len(self.rows), np.nan)
        column, found = self.header[place], []
        for line, row in zip(self.lines, self.rows, strict=True):
            text, where = row[place], f"row {line}, {column}"
            try:
                value = float(text or "nan")
            except ValueError:
                self.problems.append(f"{where} = {text!r}: must be a number.")
                value = np.nan
            else:
                with np.errstate(divide="ignore"):
                    value = float(convert(np.float64(value)))
                if np.isinf(value):
                    least = " other than 0" if float(text) == 0.0 else ""
                    self.problems.append(f"{where} = {text!r}: must be a finite number{least}.")
                elif needed and np.isnan(value):
                    self.problems.append(f"{where}: missing; give a value, or drop the row.")
            found.append(value)
        return np.array(found)

    def refuse(self) -> None:
        """Raise SpecError if there are problems."""
        if self.problems:
            raise SpecError([f"{self.path}: {problem}" for problem in self.problems])


def _plain(column: str, measured: Collection[str]) -> str:
    """Return the parameter of a column: without the prefix if a measured column has its name."""
    base = column.removeprefix(OWN)
    return base if base in measured else column


def _spellings(axis: str, model: Model, measured: Collection[str]) -> str:
    name = parameter_name(axis)
    if name in measured:
        return f"{OWN}{name}"
    if axis_name(axis) == FREQUENCY_DIM:
        others = [word for word in RATES if word != FREQUENCY and word not in model.parameter_names]
        return f"{name} (or {', '.join(others)})" if others else name
    turns = model.parameter(name).unit.startswith("rad") and f"{name}_deg" not in model.parameter_names
    return f"{name} (or {name}_deg)" if turns else name
