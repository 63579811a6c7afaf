"""Format the tables of analyses, as rows of numbers for programs and as aligned text lines for people.

A table is declared by dicts. A row for programs lists the names of its variables (`values`). A row for people
maps each heading to a text; a column with None is not shown for that row (`aligned`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.products.product import Table, padded
from pipeline.results.ragged import SET, dims_of, index_of_rows, is_ragged
from pipeline.specification.tables import FREQUENCY, RATES

FEW_POINTS = 6
"""Most parameter points that get a table each."""

MOST_RANGES = 6
"""Most ranges of an axis that are listed."""

MOST_ROWS = 30
"""Most rows that are printed: of ids, or of the sets of a parameter point."""

FRACTION = ("fraction", "low", "high")
"""Names of a fraction and its interval."""

_NAMING = ("parameter", "first_parameter", "second_parameter", "path", "moving")
"""Attributes of results that name a parameter."""

Row = dict[str, Any]
Words = Mapping[str, str | None]


def where_of(ds: xr.Dataset, at: Mapping[str, int]) -> Row:
    """Return the parameter values of a parameter point, by axis name."""
    return {d: float(ds[d].values[i]) for d, i in at.items()}


def words_of(array: xr.DataArray) -> list[str]:
    """Return the labels that belong to an array's codes, in the order of the codes."""
    return str(array.attrs["flag_meanings"]).split()


def values(one: xr.Dataset, *names: str) -> Row:
    """Return scalar variables of a dataset by name. Codes are replaced by their labels, and missing variables are left
    out.
    """
    found = {name: one[name].item() for name in names if name in one}
    return {n: words_of(one[n])[v] if "flag_meanings" in one[n].attrs else v for n, v in found.items()}


def plain_table(ds: xr.Dataset) -> Table:
    """Return a table of any result: its variables in columns, and a row for each combination of the coordinates.

    The coordinates are those of the variable with the most dims. A variable without some of them is repeated.
    """
    like = max(ds.data_vars.values(), key=lambda variable: variable.ndim)
    names = [*(str(d) for d in like.dims if d in ds.coords), *(str(n) for n in ds.data_vars if ds[n].ndim <= like.ndim)]
    columns = {name: _labelled(ds[name].broadcast_like(like).transpose(*like.dims)) for name in names}
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    heads = {
        name: f"{plain(name)}{f' [{unit}]' if (unit := shown_unit(ds[name].attrs)) != '1' else ''}" for name in names
    }
    words = [{heads[k]: number(v, ".6g") if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    lines = aligned(words[:MOST_ROWS], "")
    if len(rows) > MOST_ROWS:
        lines.append(f"and {len(rows) - MOST_ROWS} more rows; all are in --csv and --json")
    return Table(rows, lines, header=names)


def _labelled(array: xr.DataArray) -> list[Any]:
    """Return the elements of an array in a list, codes as their labels."""
    found: list[Any] = array.values.ravel().tolist()
    return [words_of(array)[k] for k in found] if "flag_meanings" in array.attrs else found


def shown(ds: xr.Dataset, table: Callable[[xr.Dataset], Table]) -> Table:
    """Return the table of a result. A parameter that has the name of a column has the column ``parameter_NAME``.

    Parameters
    ----------
    ds
        Result of an analysis.
    table
        Returns the table of a result.
    """
    axes = [str(d) for d in ds.dims if d in ds.coords and ds[d].dtype.kind == "f"]
    names = dict.fromkeys([*axes, *(str(ds.attrs[key]) for key in _NAMING if key in ds.attrs)])
    names = {name: None for name in names if name and name not in _RATES}
    # while the table is made, each has a name that no column has, of the same length
    marked = {name: chr(_PRIVATE + k) + name[1:] for k, name in enumerate(names)}
    held = ds.rename({d: marked[d] for d in axes if d in marked})
    for variable in held.variables.values():  # values of fixed parameters are known by this
        if (name := str(variable.attrs.get("long_name", "")).removeprefix("value of ")) in marked:
            variable.attrs = {**variable.attrs, "long_name": f"value of {marked[name]}"}
    held.attrs = {key: marked.get(v, v) if key in _NAMING else v for key, v in ds.attrs.items()}
    found = table(held)
    columns = dict.fromkeys(name for row in [*found.rows, dict.fromkeys(found.header)] for name in row)
    own = {marked[name]: f"parameter_{name}" if name in columns else name for name in names}
    plain_names = {mark: name for name, mark in marked.items()}

    def named(key: str) -> str:
        return own[key] if key in own else str(_replaced(key, plain_names))

    return Table(
        [{named(key): _replaced(value, plain_names) for key, value in row.items()} for row in found.rows],
        [_replaced(line, plain_names) for line in found.lines],
        _replaced(found.nothing, plain_names),
        _replaced(found.graph, plain_names),
        [named(key) for key in found.header],
    )


_RATES = {FREQUENCY, FREQUENCY_DIM, *(rate.column for rate in RATES.values())}
"""Names of the drive's rate, which tables know."""

_PRIVATE = 0xE000
"""First of the characters that Unicode leaves to private use."""


def _replaced(value: Any, names: Mapping[str, str]) -> Any:
    """Return a text, or all texts in nested data, with some names in place of others."""
    if isinstance(value, str):
        for old, new in names.items():
            value = value.replace(old, new)
        return value
    if isinstance(value, Mapping):
        return {_replaced(key, names): _replaced(one, names) for key, one in value.items()}
    return [_replaced(one, names) for one in value] if isinstance(value, list) else value


def header_of(ds: xr.Dataset, dim: str, row: Callable[[xr.Dataset], Row]) -> tuple[str, ...]:
    """Return the names of a table's columns, also for a result without rows: those of a row of zeros.

    Parameters
    ----------
    ds
        Result of the analysis.
    dim
        Dim of the rows.
    row
        Returns the row of a place on this dim.
    """
    sizes = {str(d): max(n, 1) for d, n in ds.sizes.items()}
    names = {
        name: ([d for d in v.dims if d != dim], np.zeros([sizes[str(d)] for d in v.dims if d != dim], v.dtype), v.attrs)
        for name, v in ds.variables.items()
    }
    return tuple(row(xr.Dataset(names, attrs=ds.attrs)))


def state_columns(names: Iterable[str], taken: Iterable[str]) -> dict[str, str]:
    """Return the column of each state beside other columns: ``state_NAME`` where one of these has the state's name."""
    others = set(taken)
    return {name: f"state_{name}" if name in others else name for name in names}


def counted(n: int, noun: str) -> str:
    """Format a number with its noun, in the plural unless the number is 1."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def points_of(ds: xr.Dataset, dims: Sequence[str]) -> Iterator[tuple[dict[str, int], Row]]:
    """Yield each parameter point: its index along each axis, and its parameter values."""
    for index in np.ndindex(*(ds.sizes[d] for d in dims)):
        at = dict(zip(dims, index, strict=True))
        yield at, where_of(ds, at)


def sets_of(ds: xr.Dataset, there: np.ndarray | None = None) -> Iterator[tuple[Row, xr.Dataset]]:
    """Yield the rows of a result, or those that a mask selects, each as its parameter values and its variables."""
    if not is_ragged(ds):
        dims = [str(d) for d in ds["kind"].dims if d != "attractor"]
        for *index, i in np.argwhere(ds["kind"].transpose(*dims, "attractor").values > 0).tolist():
            at = dict(zip(dims, index, strict=True))
            yield where_of(ds, at), ds.isel({**at, "attractor": i})
        return
    places = index_of_rows(ds)
    for row in range(ds.sizes[SET]) if there is None else np.flatnonzero(there).tolist():
        at = {d: int(i[row]) for d, i in zip(dims_of(ds), places, strict=True)}
        yield where_of(ds, at), ds.isel({**at, SET: row})


def point_table(ds: xr.Dataset, where: Row, rows: Sequence[Row], words: Callable[[Row], Words]) -> list[str]:
    """Return the text lines of the table for one parameter point; there is no heading if nothing is swept."""
    text = ", ".join(f"{d} {v:g}{unit_of(ds, d)}" for d, v in where.items())
    here = [row for row in rows if all(row[k] == v for k, v in where.items())]
    return [f"{text}:"] * bool(text) + aligned([words(row) for row in here])


def at_point(ds: xr.Dataset, row: Row, dims: Sequence[str]) -> Words:
    """Return the parameter values of a table row as columns of the table."""
    return {f"{d}{unit_of(ds, d)}": f"{row[d]:g}" for d in dims}


def unit_of(ds: xr.Dataset, dim: str) -> str:
    """Return the unit of an axis with a leading space; an empty text for a dimensionless axis."""
    unit = shown_unit(ds[dim].attrs)
    return "" if unit == "1" else f" {unit}"


def number(value: float, spec: str) -> str:
    """Format a number by a given format, such as ``.3f``; a dash if it is not finite."""
    return format(value, spec) if np.isfinite(value) else "-"


def in_scale(value: float, scale: float) -> str:
    """Format a state's value to four digits of its scale at least, and 0 where it is the rounding of one; a dash if it
    is not finite.
    """
    if not np.isfinite(value) or abs(value) < 1e-12 * scale:
        return "0" if np.isfinite(value) else "-"
    return format(value, f".{max(4, 4 + int(np.floor(np.log10(abs(value) / scale))))}g")


def plain(label: str) -> str:
    """Replace underscores by spaces in a label."""
    return label.replace("_", " ")


def with_interval(row: Row, names: Sequence[str], spec: str) -> str:
    """Format a number with its confidence interval from three columns of a table row; a dash if it is not finite."""
    value, low, high = (row[name] for name in names)
    return f"{value:{spec}} ({low:{spec}} to {high:{spec}})" if np.isfinite(value) else "-"


def distinct(values: Iterable[Any]) -> str:
    """Join the distinct values of a list into one text, sorted and separated by commas."""
    return ", ".join(map(str, sorted(set(values))))


def ranges(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> dict[str, str]:
    """Summarise table rows in columns: the range of values on each axis, and the number of parameter points."""
    words = {}
    for d in dims:
        values = [row[d] for row in rows]
        words[f"{d}{unit_of(ds, d)}"] = f"{min(values):g} to {max(values):g}"
    return words | {"points": str(len(rows))}


def largest_share(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> str:
    """Format the largest basin fraction among some table rows, with the parameter values where it occurs."""
    best = max(rows, key=lambda row: (np.nan_to_num(row["fraction"], nan=-1.0),))
    if not np.isfinite(best["fraction"]):
        return "-"
    where = ", ".join(f"{best[d]:g}{unit_of(ds, d)}" for d in dims)
    return f"{number(best['fraction'], '.4f')} at {where}"


def summary(
    ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str], describe: Callable[..., Words], key: str
) -> list[str]:
    """Group table rows by the value of a column, and return a text table with one line per group."""
    groups: dict[int, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return aligned([describe(ds, groups[i], dims) for i in sorted(groups)])


def leading(rows: Sequence[Row], key: str, size: str) -> tuple[list[Row], int]:
    """Return the rows of the `MOST_ROWS` groups with the largest fractions or sizes, and the number of other groups."""
    sizes: dict[int, tuple[float, int]] = {}
    for row in rows:
        own = (float(np.nan_to_num(row.get("fraction", np.nan))), row[size])
        sizes[row[key]] = max(own, sizes.get(row[key], (0.0, 0)))
    kept = set(sorted(sizes, key=lambda i: sizes[i], reverse=True)[:MOST_ROWS])
    return [row for row in rows if row[key] in kept], len(sizes) - len(kept)


def aligned(rows: Sequence[Words], indent: str = "  ", *, right: bool = False) -> list[str]:
    """Align table rows in columns under their headings. With `right`, all columns but the first are aligned to the
    right.
    """
    names = list(dict.fromkeys(name for row in rows for name, text in row.items() if text is not None))
    return padded([names, *([row.get(name) or "" for name in names] for row in rows)], indent, right) if rows else []


def with_error(value: float, error: float, most: int = 6) -> str:
    """Format a value and its standard error to two digits of the error, with at most `most` decimals."""
    if not np.isfinite(value):
        return "-"
    if not (np.isfinite(error) and error >= 1e-6):
        return f"{value:.{most}g}"
    digits = int(np.clip(1 - np.floor(np.log10(error)), 0, most))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def value_with_error(value: float, error: float) -> str:
    """Format a value with its error, to the first digit of the error, with at most 12 decimals."""
    digits = int(np.clip(np.ceil(-np.log10(error)), 0, 12))
    return f"{round(value, digits) + 0.0:.{digits}f} ± {error:.0e}"


def axis_ranges(ds: xr.Dataset, dim: str, rows: Sequence[Row], alone: bool) -> str:
    """Format the axis values of some table rows as ranges, such as "1 to 1.4, 2 to 2.2"."""
    axis = ds[dim].values.astype(np.float64)
    values = np.array(sorted({row[dim] for row in rows}))
    places = np.searchsorted(np.sort(axis), values)
    parts = np.split(values, np.flatnonzero(np.diff(places) > 1) + 1)
    if not alone or len(parts) > MOST_RANGES:
        more = f" in {len(parts)} ranges" if alone else ""
        return f"{values[0]:g} to {values[-1]:g}{more}"
    return ", ".join(f"{p[0]:g}" if len(p) == 1 else f"{p[0]:g} to {p[-1]:g}" for p in parts)
