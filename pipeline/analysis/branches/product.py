"""Branches and curves as analyses of a run (`pipeline.products.branches`)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import xarray as xr

from pipeline.products.branches import BranchOptions, CurveOptions
from pipeline.products.product import Table

if TYPE_CHECKING:
    from pipeline.store.run import Run


def settle_branches(run: Run, options: BranchOptions) -> BranchOptions:
    """Complete the interval from the run's axis; refuse an empty one."""
    low, high = _interval(run, options.parameter, options.low, options.high)
    return options.model_copy(update={"low": low, "high": high})


def branches(run: Any, options: BranchOptions) -> xr.Dataset:
    """Branches of periodic orbits along a parameter, from the orbits that attract a run's cells."""
    from pipeline.analysis.attractors.attractors import parameters_of
    from pipeline.analysis.branches import Scope, attracting, dataset_of, explore, recurrent

    cube = run.cube()
    low, high = _ends(options)
    base, scale = parameters_of(cube), high - low
    starts = attracting(run.derive("attractors"), base, options.parameter, scale, options.max_period)
    if options.recurrences:
        longest = min(options.recurrences, options.max_period)
        starts += recurrent(cube, base, options.parameter, scale, longest)
    starts = [s for s in starts if low <= s.value <= high]
    run.echo(f"branches: {len(starts)} starting orbits")
    scope = Scope(low, high, options.max_period, options.generations)
    return dataset_of(explore(starts, scope), options.parameter, base)


def _ends(options: BranchOptions) -> tuple[float, float]:
    assert options.low is not None
    assert options.high is not None
    return options.low, options.high


def settle_curves(run: Run, options: CurveOptions) -> CurveOptions:
    """Complete the branches' interval; refuse a plane that is none."""
    from pipeline.spec.problems import SpecError

    settled = options.model_copy(update=settle_branches(run, options).part(BranchOptions))
    second = options.second
    if second == options.parameter:
        raise SpecError([f"{second} is the branches' own parameter; give another one."])
    axis = run.cube().coords.get("frequency" if second == "frequency_hz" else second)
    if axis is not None and axis.ndim > 0 and axis.size > 1:
        raise SpecError(
            [f"the run sweeps {second}, so that its branches lie at several values; use a run that does not."]
        )
    _interval(run, second, options.second_low, options.second_high)
    return settled


def curves(run: Any, options: CurveOptions) -> xr.Dataset:
    """Curves of the bifurcations located by `branches`, in the plane of its parameter and a second one."""
    from pipeline.analysis.attractors.attractors import parameters_of
    from pipeline.analysis.branches import curves_dataset, curves_from

    located = run.derive("branches", **options.part(BranchOptions))
    bounds = (_ends(options), (options.second_low, options.second_high))
    base = parameters_of(run.cube())
    found = curves_from(located, base, options.second, bounds, options.curve_period)
    return curves_dataset(found, options.parameter, options.second)


def _interval(run: Run, parameter: str, low: float | None, high: float | None) -> tuple[float, float]:
    """Check the parameter and complete its interval from the run's axis."""
    from magpend_core.models.parameters import unknown_name_problem
    from pipeline.analysis.attractors.attractors import parameters_of
    from pipeline.spec.problems import SpecError

    ds = run.cube()
    names = (*parameters_of(ds).names, "frequency_hz")
    if parameter not in names:
        raise SpecError([unknown_name_problem(parameter, names)])
    axis = ds.coords.get("frequency" if parameter == "frequency_hz" else parameter)
    if axis is not None and axis.ndim > 0 and axis.size > 1:
        ends = float(axis.min()), float(axis.max())
    elif low is None or high is None:
        raise SpecError([f"the run does not sweep {parameter}; give the interval with --from and --to."])
    else:
        ends = low, high
    chosen = (ends[0] if low is None else float(low), ends[1] if high is None else float(high))
    if not chosen[0] < chosen[1]:
        raise SpecError(
            [
                f"the interval {chosen[0]} to {chosen[1]} of {parameter} is empty; "
                "--from must be less than --to."
            ]
        )
    if parameter == "frequency_hz" and chosen[0] <= 0.0:
        raise SpecError([f"--from {chosen[0]}: a drive frequency must be greater than 0."])
    for value in chosen if parameter != "frequency_hz" else ():
        parameters_of(ds).replace(**{parameter: value})
    return chosen


def branches_table(ds: xr.Dataset) -> Table:
    """Table of the bifurcations, and lines of the stable segments."""
    from pipeline.analysis.branches import table_of

    rows = [_row(ds, row) for row in table_of(ds)]
    return Table(rows, [*_lines(ds), "", *_windows(ds)])


def curves_table(ds: xr.Dataset) -> Table:
    """Table of the curves: kind, period, points and range."""
    from pipeline.analysis.branches.dataset import KINDS

    first, second = str(ds.attrs["first_parameter"]), str(ds.attrs["second_parameter"])
    rows: list[dict[str, Any]] = []
    for i in range(ds.sizes["curve"]):
        one, n = ds.isel(curve=i), int(ds["n_points"][i])
        ends = {
            f"{name}_{word}": float(getattr(one[role].values[:n], word)())
            for role, name in (("first", first), ("second", second)) for word in ("min", "max")
        }  # fmt: skip
        rows.append(
            {
                "curve": i, "type": KINDS[int(one["kind"])], "period": int(one["orbit_period"]),
                "n_points": n, **ends,
            }
        )  # fmt: skip
    lines = [f"{len(rows)} curves in the plane of {first} and {second}"]
    for row in rows:
        spans = ", ".join(
            f"{name} {row[f'{name}_min']:.7g} to {row[f'{name}_max']:.7g}" for name in (first, second)
        )
        lines.append(f"  {row['curve']}: {row['type']}, period {row['period']}: {spans}")
    return Table(rows, lines)


def _row(ds: xr.Dataset, row: dict[str, Any]) -> dict[str, Any]:
    names = (
        "value", "bracket", "type", "criticality", "period", "side", "multiplier_real", "multiplier_imag",
        "unstable_below", "unstable_above", "frequency_hz", "branch", "to_branch",
    )  # fmt: skip
    known = {**row, "multiplier_real": row["multiplier"].real, "multiplier_imag": row["multiplier"].imag}
    parameter = str(ds.attrs["parameter"])
    kept = [name for name in names if name != parameter]
    return {parameter if name == "value" else name: known[name] for name in kept}


def _lines(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import table_of

    names = ("type", "criticality", "period", "side", "multiplier", "unstable below, above", "branch")
    rows = [(str(ds.attrs["parameter"]), *names)]
    for row in table_of(ds):
        to = f" -> {row['to_branch']}" if row["to_branch"] >= 0 else ""
        rows.append(
            (
                f"{row['value']:.7f}", row["type"], row["criticality"], str(row["period"]), row["side"],
                _number(row["multiplier"]), f"{row['unstable_below']}, {row['unstable_above']}",
                f"{row['branch']}{to}{_at(row)}",
            )
        )  # fmt: skip
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in rows]
    return [f"{ds.sizes['bifurcation']} bifurcations on {ds.sizes['branch']} branches", "", *lines]


def _at(row: dict[str, Any]) -> str:
    """The drive's frequency, unless that is what is varied."""
    return "" if math.isnan(row["frequency_hz"]) else f" at {row['frequency_hz']:g} Hz"


def _number(z: complex) -> str:
    return f"{z.real:.5f}" if abs(z.imag) < 1e-9 else f"{z.real:.5f}{z.imag:+.5f}i"


def _windows(ds: xr.Dataset) -> list[str]:
    from pipeline.analysis.branches import windows_of

    lines = ["stable segments"]
    for w in windows_of(ds):
        ends = f"{w['from']:.7f} ({w['begins']}) to {w['to']:.7f} ({w['ends']})"
        lines.append(f"  period {w['period']}, {w['side']}, branch {w['branch']}{_at(w)}: {ends}")
    return lines
