"""Format the tables of analyses: rows of numbers for programs, aligned lines for people."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

FEW_POINTS = 6
"""Most parameter points that get a table each."""

MOST_RANGES = 6
"""Most ranges of an axis that are listed."""

Row = dict[str, Any]


def where_of(ds: xr.Dataset, at: Mapping[str, int]) -> Row:
    """Return the parameter values at a point, by dim."""
    return {d: float(ds[d].values[i]) for d, i in at.items()}


def words_of(array: xr.DataArray) -> list[str]:
    """Return the labels of an array of codes, in the order of the codes."""
    return str(array.attrs["flag_meanings"]).split()


def labels(one: xr.Dataset, *names: str) -> Row:
    """Return the labels of variables that hold a code each; those that are missing are left out."""
    return {name: words_of(one[name])[int(one[name])] for name in names if name in one}


def points_of(ds: xr.Dataset, dims: Sequence[str]) -> Iterator[tuple[dict[str, int], Row]]:
    """Yield the parameter points: the indices by dim, and the parameter values."""
    for index in np.ndindex(*(ds.sizes[d] for d in dims)):
        at = dict(zip(dims, index, strict=True))
        yield at, where_of(ds, at)


def point_table(
    ds: xr.Dataset, where: Row, rows: Sequence[Row], words: Callable[[Row], Mapping[str, str]]
) -> list[str]:
    """Return the lines of the table of one parameter point, with its heading."""
    here = [row for row in rows if all(row[k] == v for k, v in where.items())]
    return heading(ds, where) + aligned([words(row) for row in here])


def unit_of(ds: xr.Dataset, dim: str) -> str:
    """Return the unit of an axis with a leading space; empty for a dimensionless axis."""
    unit = ds[dim].attrs.get("units", "1")
    return "" if unit == "1" else f" {unit}"


def heading(ds: xr.Dataset, where: Row) -> list[str]:
    """Return the heading of a parameter point as a list of lines; empty if nothing is swept."""
    text = ", ".join(f"{d} {v:g}{unit_of(ds, d)}" for d, v in where.items())
    return [f"{text}:"] if text else []


def number(value: float, spec: str) -> str:
    """Format a number; return a dash if it is not finite."""
    return format(value, spec) if np.isfinite(value) else "-"


def with_interval(row: Row) -> str:
    """Format a fraction with its interval."""
    return f"{row['fraction']:.4f} ({row['low']:.4f} to {row['high']:.4f})"


def distinct(values: Iterable[Any]) -> str:
    """Join the distinct values in sorted order."""
    return ", ".join(map(str, sorted(set(values))))


def ranges(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    """Return the columns with the range of each axis and the number of points."""
    words = {}
    for d in dims:
        values = [row[d] for row in rows]
        words[f"{d}{unit_of(ds, d)}"] = f"{min(values):g} to {max(values):g}"
    return words | {"points": str(len(rows))}


def largest_share(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> str:
    """Format the largest fraction and its parameter point."""
    best = max(rows, key=lambda row: (np.nan_to_num(row["fraction"], nan=-1.0),))
    if not np.isfinite(best["fraction"]):
        return "-"
    where = ", ".join(f"{best[d]:g}{unit_of(ds, d)}" for d in dims)
    return f"{number(best['fraction'], '.4f')} at {where}"


def summary(
    ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str], describe: Callable[..., dict[str, str]]
) -> list[str]:
    """Return the lines of a table with one row per id."""
    key = "attractor_id" if rows and "attractor_id" in rows[0] else "label"
    groups: dict[int, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return aligned([describe(ds, groups[i], dims) for i in sorted(groups)])


def aligned(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """Align rows under their headings."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names] + [[row.get(name, "") for name in names] for row in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    lines = ["  ".join(w.ljust(n) for w, n in zip(line, widths, strict=True)).rstrip() for line in cells]
    return [f"  {line}" for line in lines] if rows else []


def with_error(value: float, error: float, most: int = 6) -> str:
    """Format a value and its standard error to two digits of the error, with at most `most` decimals."""
    if not np.isfinite(value):
        return "-"
    if not (np.isfinite(error) and error >= 1e-6):
        return f"{value:.{most}g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, most))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def axis_ranges(ds: xr.Dataset, dim: str, rows: Sequence[Row], alone: bool) -> str:
    """Format the ranges of neighbouring axis values; the whole range if they are many or not `alone`."""
    axis = ds[dim].values.astype(np.float64)
    values = np.array(sorted({row[dim] for row in rows}))
    places = np.searchsorted(np.sort(axis), values)
    parts = np.split(values, np.flatnonzero(np.diff(places) > 1) + 1)
    if not alone or len(parts) > MOST_RANGES:
        more = f" in {len(parts)} ranges" if alone else ""
        return f"{values[0]:g} to {values[-1]:g}{more}"
    return ", ".join(f"{p[0]:g}" if len(p) == 1 else f"{p[0]:g} to {p[-1]:g}" for p in parts)
