"""Read measured points: values over a parameter from a CSV file, for figures that draw them over computed ones."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.analysis.branches.problems import parameter_units
from pipeline.layout.own_words import rate_attribute, spelling_of
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, model_attribute, parameter_name
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import FREQUENCY, RATES

POINT = "measured"
"""Dim of measured points."""


def read_points(
    path: str | Path,
    model: Model,
    along: str,
    *,
    others: Sequence[str] = (),
    needed: Sequence[str] = ("amplitude",),
    known: Sequence[str] = ("phase",),
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
    rate
        Word of the run for the drive's rate, in which figures show it.

    Returns
    -------
    Dataset
        Over `POINT` ``parameter``, the levels by axis, and the columns; parameters in the unit of the cube.

    Raises
    ------
    SpecError
        If the file cannot be read, a column is missing or there twice, or a value is no number.
    """
    header, rows = _table(path)
    axes = {axis: _column(path, header, axis, model) for axis in (axis_name(along), *map(axis_name, others))}
    first = axes.pop(axis_name(along))
    missing = [] if first else [_spellings(along, model)]
    missing += [name for name in needed if name not in header]
    if missing:
        raise SpecError(
            f"--points {path}: has no column {', '.join(missing)}; the first line names the columns, and it has "
            f"{', '.join(header)}."
        )
    variables: dict[str, Any] = {}
    for axis, column in {"parameter": first, **axes}.items():
        if column:
            convert = spelling_of(column, model)[1]
            name = axis_name(along) if axis == "parameter" else axis
            about = {"units": parameter_units(name, model), "long_name": parameter_name(name)}
            variables[axis] = (POINT, convert(_numbers(path, header, rows, column)), about)
    for name in (*needed, *known):
        if name in header:
            variables[name] = (POINT, _numbers(path, header, rows, name))
    return xr.Dataset(variables, attrs={"model": model_attribute(model), **rate_attribute(rate)})


def _table(path: str | Path) -> tuple[list[str], list[list[str]]]:
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SpecError(f"--points {path}: {error}.") from None
    rows = [row for row in rows if any(field.strip() for field in row)]
    if not rows:
        raise SpecError(f"--points {path}: has no rows; the first line names the columns, each other one is a point.")
    return [name.strip() for name in header], rows


def _column(path: str | Path, header: Sequence[str], axis: str, model: Model) -> str:
    """Return the column of an axis; empty if there is none."""
    found = [name for name in header if spelling_of(name, model)[0] == axis]
    if len(found) > 1:
        raise SpecError(f"--points {path}: the columns {' and '.join(found)} are the same axis; drop all but one.")
    return found[0] if found else ""


def _spellings(axis: str, model: Model) -> str:
    name = parameter_name(axis)
    others = [word for word in RATES if word != FREQUENCY and word not in model.parameter_names]
    return f"{name} (or {', '.join(others)})" if axis_name(axis) == FREQUENCY_DIM else name


def _numbers(path: str | Path, header: Sequence[str], rows: Sequence[Sequence[str]], column: str) -> np.ndarray:
    """Return a column as numbers; an empty field is NaN."""
    place, values = header.index(column), []
    for i, row in enumerate(rows, 2):
        text = row[place].strip() if place < len(row) else ""
        try:
            values.append(float(text) if text else np.nan)
        except ValueError:
            raise SpecError(f"--points {path}: row {i}, {column} = {text!r}: must be a number.") from None
    return np.array(values)
