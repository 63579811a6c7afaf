"""Define the analysis ``tongues`` (Arnold tongues) of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.rotation import TurningState
from pipeline.analysis.branches import Scope, curves_dataset, curves_from, dataset_of, explore, windows_of
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.bifurcations import FOLD, KINDS
from pipeline.analysis.branches.product import interval_of, swept_axis
from pipeline.analysis.branches.starting_orbits import family_of, parameters_at
from pipeline.analysis.branches.tongues import Row, Search, fractions_of, locked_orbits
from pipeline.analysis.run import OpenRun
from pipeline.analysis.selection import select_points
from pipeline.analysis.tabular import Row as TableRow
from pipeline.analysis.tabular import Words, aligned, counted, number
from pipeline.analysis.tolerances import BRANCH_RTOL
from pipeline.layout.vocabulary import axis_name, parameter_name, parameters_of, split_dims
from pipeline.products.product import Table
from pipeline.products.rotation import RotationFlag
from pipeline.products.tongues import TongueOptions

PURPOSE = "tongues are searched on one row of cells"

IN_TONGUE = Settings(longest_step=0.05)
"""Settings with long steps: of the orbits in a tongue only the folds are wanted."""

ACCURACY = 10.0 * BRANCH_RTOL
"""Least error of a fold, in units of the interval of the parameter: that of the integrations."""


def needs_rotation(run: OpenRun, options: TongueOptions) -> None:
    """Raise ValueError unless the run has rotation numbers and sweeps the parameter along which tongues are
    searched.
    """
    cube = run.cube()
    if "rotation" not in cube:
        raise ValueError("the cube has no rotation numbers; run it with [products] rotation = {} in its specification")
    if options.parameter and swept_axis(run, options.parameter) is None:
        raise ValueError(f"--parameter {options.parameter}: the run does not sweep it; tongues are searched along it.")


def settle_tongues(run: OpenRun, options: TongueOptions) -> TongueOptions:
    """Fill in the parameter, its interval and the row of cells; raise SpecError unless the two parameters differ."""
    from pipeline.specification.problems import SpecError

    parameter = options.parameter
    if axis_name(options.second) == axis_name(parameter):
        raise SpecError(f"{options.second} is swept already; give another second parameter, or --parameter.")
    low, high = interval_of(run, parameter, options.low, options.high)
    interval_of(run, options.second, options.second_low, options.second_high)
    return options.model_copy(update={"parameter": parameter, "low": low, "high": high})


def tongues(run: OpenRun, options: TongueOptions) -> xr.Dataset:
    """Find orbits with rotation numbers p/q along a row of cells, and continue their folds in the parameter plane."""
    point, base = _row_of(run, options), parameters_of(run.cube())
    first, second = axis_name(options.parameter), axis_name(options.second)
    assert options.low is not None
    assert options.high is not None
    frequency, packed = parameters_at(point.isel({first: 0}), base)
    base = base.replace(**dict(zip(base.names, map(float, packed), strict=True)))
    family = family_of(base.model.system, 1, frequency, packed, first, options.high - options.low)
    search = Search(family, *_turning(run))
    starts = locked_orbits(cells_of(point, first), search, options.max_denominator)
    found = {f: s for f, s in starts.items() if s is not None}
    longest = max((s.family.period for s in found.values()), default=1)
    of = f"{counted(len(found), 'starting orbit')} of {counted(len(starts), 'fraction')}"
    run.echo(f"tongues: {of}, periods up to {longest}")
    branches = explore(list(found.values()), Scope(options.low, options.high, longest, 0, IN_TONGUE))
    numbers = fractions_of(branches, search)
    located = dataset_of(branches, first, base)
    on_row = _on_row(list(starts), numbers, located, ACCURACY * (options.high - options.low))
    folds = located.isel(bifurcation=[k for tongue in on_row for k in tongue.folds])
    bounds = ((options.low, options.high), (options.second_low, options.second_high))
    edges = curves_from(folds, base, second, bounds, longest, generations=0) if branches else []
    of_curve = [numbers[int(folds["of_branch"][curve.start])] for curve in edges]
    ds = curves_dataset(edges, first, second, base.model)
    ds = ds.assign({k: ("curve", v, {"units": "1"}) for k, v in _parts(of_curve).items()})
    row = float(point[second]) if second in point.coords else float(base[second])
    return ds.assign(_variables(on_row)).assign_attrs(row=row, max_denominator=options.max_denominator)


def _row_of(run: OpenRun, options: TongueOptions) -> xr.Dataset:
    cube, first = run.cube(), axis_name(options.parameter)
    part = select_points(cube, options.at)
    others = [d for d in map(str, split_dims(part["status"])[0]) if d != first]
    long = [d for d in others if part.sizes[d] > 1]
    if long:
        value = float(part[long[0]].values[part.sizes[long[0]] // 2])
        raise ValueError(f"{PURPOSE}; choose a value of {', '.join(long)}, such as --at {long[0]}={value:g}")
    return part.isel(dict.fromkeys(others, 0))


def _turning(run: OpenRun) -> tuple[TurningState, int]:
    options: Any = run.spec.products["rotation"]
    names = run.model.state_names
    return TurningState(tuple(map(names.index, options.of)), options.center, options.section), options.n_periods


def cells_of(point: xr.Dataset, first: str) -> Row:
    """Return a row of cells in rising order of the first parameter; unreliable rotation numbers are NaN."""
    starts = [d for d in point["status"].dims if d != first]
    good = point["rotation"].where(point["rotation_flag"] == RotationFlag.GOOD)
    stacked = point[["orbit_period"]].assign(rotation=good).transpose(first, *starts)
    last = point["section"].isel(period_index=-1).transpose(first, *starts, "state").values
    order = np.argsort(point[first].values)
    n = point.sizes[first]
    return Row(
        point[first].values[order].astype(np.float64),
        stacked["rotation"].values.reshape(n, -1)[order],
        stacked["orbit_period"].values.reshape(n, -1)[order],
        last.reshape(n, -1, last.shape[-1])[order],
    )


def _parts(fractions: Sequence[Fraction | None]) -> dict[str, np.ndarray]:
    pairs = [(0, 0) if f is None else (f.numerator, f.denominator) for f in fractions]
    columns = np.array(pairs, np.int32).reshape(-1, 2)
    return {"numerator": columns[:, 0], "denominator": columns[:, 1]}


@dataclass(eq=False)
class _Tongue:
    """A tongue p/q on the row of cells: its branches, the bounds of its stable orbits, and its outermost folds."""

    fraction: Fraction
    n_branches: int
    ends: tuple[float, float] = (np.nan, np.nan)
    kinds: tuple[str, str] = ("", "")
    error: float = np.nan
    folds: tuple[int, ...] = ()


def _on_row(
    fractions: Sequence[Fraction], numbers: Sequence[Fraction | None], located: xr.Dataset, least: float
) -> list[_Tongue]:
    """Describe each tongue on the row of cells by the stable segments of its branches."""
    windows, found = windows_of(located), []
    is_fold = located["kind"].values == KINDS.index(FOLD)
    for fraction in fractions:
        own = [i for i, f in enumerate(numbers) if f == fraction]
        folds = np.flatnonzero(is_fold & np.isin(located["of_branch"].values, own))
        values = located["value"].values[folds]
        outer = folds[[int(np.argmin(values)), int(np.argmax(values))]] if len(folds) else folds
        tongue = _Tongue(fraction, len(own), folds=tuple(dict.fromkeys(outer.tolist())))
        stable = [w for w in windows if w["branch"] in own]
        if stable:
            first, last = min(stable, key=lambda w: w["from"]), max(stable, key=lambda w: w["to"])
            tongue.ends, tongue.kinds = (first["from"], last["to"]), (first["begins"], last["ends"])
            here = np.isin(located["value"].values, tongue.ends)
            tongue.error = max(float(located["bracket"].values[here].max(initial=0.0)), least)
        found.append(tongue)
    return found


def _variables(tongues: Sequence[_Tongue]) -> dict[str, Any]:
    columns = {f"tongue_{name}": values for name, values in _parts([t.fraction for t in tongues]).items()}
    columns["n_branches"] = np.array([t.n_branches for t in tongues], np.int32)
    for i, name in enumerate(("low", "high")):
        columns[f"tongue_{name}"] = np.array([t.ends[i] for t in tongues], np.float64)
        columns[f"tongue_{name}_kind"] = np.array([t.kinds[i] for t in tongues], np.str_)
    columns["tongue_error"] = np.array([t.error for t in tongues], np.float64)
    return {
        name: ("tongue", values, {} if values.dtype.kind == "U" else {"units": "1"}) for name, values in columns.items()
    }


def tongues_table(ds: xr.Dataset) -> Table:
    """Return the table of the tongues on the row of cells, with text lines on the curves of their edges."""
    first, second = (parameter_name(str(ds.attrs[f"{role}_parameter"])) for role in ("first", "second"))
    rows = [_row(ds.isel(tongue=k), ds) for k in range(ds.sizes["tongue"])]
    n_found = sum(row["branches"] > 0 for row in rows)
    lines = [
        f"{counted(n_found, 'tongue')} with denominators up to {ds.attrs['max_denominator']}; stable orbits along "
        f"{first} at {second} {ds.attrs['row']:g}",
        *aligned([_words(row) for row in rows if not _is_thin(row)]),
    ]
    without = {
        "narrower than the error of its ends": [row["tongue"] for row in rows if _is_thin(row)],
        "no orbit found": [row["tongue"] for row in rows if not row["branches"]],
        "only unstable orbits found": [row["tongue"] for row in rows if row["branches"] and not row["begins"]],
    }
    lines += [line for why, names in without.items() if names for line in ("", f"{why}: {', '.join(names)}")]
    return Table(rows, lines, "" if n_found else "no motion is locked to the drive; widen the row of cells.")


def _row(one: xr.Dataset, ds: xr.Dataset) -> TableRow:
    p, q = int(one["tongue_numerator"]), int(one["tongue_denominator"])
    low, high = float(one["tongue_low"]), float(one["tongue_high"])
    is_own = (ds["numerator"].values == p) & (ds["denominator"].values == q)
    return {
        "tongue": f"{p}/{q}",
        "from": low,
        "to": high,
        "width": high - low,
        "begins": str(one["tongue_low_kind"].item()),
        "ends": str(one["tongue_high_kind"].item()),
        "error": float(one["tongue_error"]),
        "branches": int(one["n_branches"]),
        "curves": int(is_own.sum()),
    }


def _is_thin(row: TableRow) -> bool:
    """Return whether a tongue is not shown to be wider than the errors of its two ends."""
    return bool(row["width"] <= 2.0 * row["error"])


def _words(row: TableRow) -> Words:
    words = {name: number(row[name], ".7f") for name in ("from", "to")}
    return {
        "tongue": row["tongue"],
        **words,
        "width": number(row["width"], ".3g"),
        "error": number(row["error"], ".1g"),
        "branches": str(row["branches"]),
        "curves": str(row["curves"]),
    }
