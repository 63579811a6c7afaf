"""Measure numbers that analyses of a run have computed: columns of their tables and variables of their results.

Any analysis can be named, so a claim on a basin fraction, an exponent, a dimension, the edge of a tongue or the place
of a bifurcation needs no measure of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.products.product import function_of
from pipeline.products.registry import ANALYSES
from pipeline.report.estimates import Estimate, Results, absent
from pipeline.specification.problems import SpecError, unknown_name

if TYPE_CHECKING:
    import xarray as xr

Options = Mapping[str, Any]
Row = Mapping[str, Any]

NORMAL = 1.959963984540054
"""Standard errors on either side of a 95 % interval of a normal distribution."""

_CLOSE = 1e-9
"""Largest relative difference of two numbers that count as equal in ``where``."""


def analysed(results: Results, name: str, options: Options) -> xr.Dataset:
    """Return the result of the analysis that the options of a measure name."""
    analysis = str(options["analysis"])
    if analysis not in ANALYSES:
        raise SpecError(unknown_name("analysis", analysis, ANALYSES))
    return results.run(name).derive(analysis, **options.get("with", {}))


def rows_of(results: Results, name: str, options: Options) -> list[Row]:
    """Return the rows of an analysis' table that match ``where``."""
    ds = analysed(results, name, options)
    rows = list(function_of(ANALYSES[str(options["analysis"])].table)(ds).rows)
    where = options.get("where", {})
    if rows and (unknown := [key for key in where if key not in rows[0]]):
        raise SpecError(unknown_name(f"column of {options['analysis']}", unknown[0], rows[0]))
    return [row for row in rows if all(_same(row[key], wanted) for key, wanted in where.items())]


def _same(value: Any, wanted: Any) -> bool:
    if isinstance(wanted, str) or isinstance(value, str):
        return str(value) == str(wanted)
    return math.isclose(float(value), float(wanted), rel_tol=_CLOSE, abs_tol=_CLOSE)


def tabulated(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return a number in the table of an analysis.

    Options: ``analysis`` and ``with``, its options; ``where``, the values of columns that choose rows;
    ``column``; ``rank`` among several rows, 1 for the largest number (by default there must be one row);
    ``plus``, a constant to add. The interval is taken from the table: from the columns ``low`` and ``high`` of
    a fraction, from ``COLUMN_stderr`` (times 1.96), or from the column that ``error`` names, a bound of the
    error. Without any of these it has no width.
    """
    name = str(options["column"])
    rows = rows_of(results, of[0], options)
    if rows and name not in rows[0]:
        raise SpecError(unknown_name(f"column of {options['analysis']}", name, rows[0]))
    rows = [row for row in rows if math.isfinite(float(row[name]))]
    rank = options.get("rank")
    if not rows or (rank or 1) > len(rows):
        return absent(f"the table of {options['analysis']} has {len(rows)} such rows with a number")
    if rank is None and len(rows) > 1:
        return absent(f"the table of {options['analysis']} has {len(rows)} such rows; give rank, or more of where")
    row = sorted(rows, key=lambda row: -float(row[name]))[(rank or 1) - 1]
    value = float(row[name])
    low, high = _interval_of(row, name, value, options.get("error"))
    plus = float(options.get("plus", 0.0))
    cells = row.get("n_cells")
    n = int(cells) if cells is not None else None
    return Estimate(value + plus, low + plus, high + plus, _about(row, options), n=n)


def _interval_of(row: Row, name: str, value: float, error: str | None) -> tuple[float, float]:
    if error is not None:
        half = float(row[error])
    elif name == "fraction":
        return float(row["low"]), float(row["high"])
    else:
        half = NORMAL * float(row.get(f"{name}_stderr", 0.0))
    return value - half, value + half


def _about(row: Row, options: Options) -> str:
    chosen = ", ".join(f"{key} {value}" for key, value in options.get("where", {}).items())
    kind = str(row.get("nature") or row.get("kind") or row.get("type") or "").replace("_", " ")
    cells = f"{row['n_cells']} cells" if "n_cells" in row else ""
    words = ", ".join(part for part in (chosen, kind, cells) if part)
    return f"analyse {options['analysis']}: {options['column']}" + (f" ({words})" if words else "")


def counted_rows(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the number of rows in the table of an analysis, such as the number of attractors.

    Options: ``analysis`` and ``with``, its options; ``where``, the values of columns that choose rows. The
    interval has no width.
    """
    n = len(rows_of(results, of[0], options))
    return Estimate(n, n, n, _about({}, {**options, "column": "rows"}))


def derived_number(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return a number that an analysis finds once per parameter point, such as the basin entropy.

    Options: ``analysis`` and ``with``, its options; ``variable`` of its result; ``at``, values of swept
    parameters. The interval is the one that the analysis gives: ``VARIABLE_low`` and ``VARIABLE_high``, or
    1.96 times ``VARIABLE_stderr``. Without either it has no width.
    """
    ds, name = analysed(results, of[0], options), str(options["variable"])
    if name not in ds:
        raise SpecError(unknown_name(f"variable of {options['analysis']}", name, map(str, ds.data_vars)))
    try:
        one = ds.sel({key: value for key, value in options.get("at", {}).items()}, method="nearest", tolerance=1e-9)
    except KeyError:
        return absent(f"the run has no values {options['at']}")
    found = one[name].squeeze()
    if found.ndim:
        raise SpecError(f"{name}: has a value for each {' and '.join(map(str, found.dims))}; choose one by at.")
    value = float(found)
    if not math.isfinite(value):
        return absent(f"{options['analysis']} could not compute {name}")
    low, high = (float(one[f"{name}{end}"]) if f"{name}{end}" in one else math.nan for end in ("_low", "_high"))
    if not (math.isfinite(low) and math.isfinite(high)):
        half = NORMAL * float(one[f"{name}_stderr"]) if f"{name}_stderr" in one else 0.0
        low, high = value - half, value + half
    return Estimate(value, low, high, f"analyse {options['analysis']}: {name}")


def ratio_of_intervals(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the ratio of the distances between three successive bifurcations, (v2 - v1)/(v3 - v2).

    For three period doublings of a cascade it approximates Feigenbaum's constant 4.669. Options: ``type``,
    ``low``, ``high``, ``max_period``, as in `located_bifurcation`; exactly three bifurcations must lie there.
    The interval follows from the brackets of the three.
    """
    from pipeline.analysis.branches.table import table_of
    from pipeline.layout.vocabulary import parameter_name

    given = {name: options[name] for name in ("low", "high", "max_period")}
    found = results.run(of[0]).derive("branches", **given, generations=int(options.get("generations", 1)))
    rows = [row for row in table_of(found) if row["type"] == options["type"]]
    if len(rows) != 3:
        return absent(f"{len(rows)} such bifurcations were found, and three are needed")
    name = parameter_name(str(found.attrs["parameter"]))
    first, second, third = (float(row[name]) for row in rows)
    brackets = [float(row["bracket"]) for row in rows]
    value = (second - first) / (third - second)
    above, below = brackets[0] + brackets[1], brackets[1] + brackets[2]
    half = abs(value) * (above / abs(second - first) + below / abs(third - second))
    text = f"located at {first:.7g}, {second:.7g} and {third:.7g}"
    return Estimate(value, value - half, value + half, text)
