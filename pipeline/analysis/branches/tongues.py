"""Define the analysis ``tongues``: find phase-locked orbits with rotation number p/q along rows of cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor
from typing import Any

import numpy as np
import xarray as xr

from magpend_core import run_branches
from magpend_core.orbits import scaled_distance
from magpend_core.precision import limits_at, tolerances_at
from magpend_core.rotation import CLOSED_TURNS, TurningState, rotation_numbers
from pipeline.analysis.branches.analysis import windows_of
from pipeline.analysis.branches.arclength import Settings, correct, kernel_of
from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.declaration import TongueOptions
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.following import Branch, problem_of
from pipeline.analysis.branches.intervals import interval_of, swept_axis
from pipeline.analysis.branches.kinds import FOLD, KINDS
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.lockstep import Query, Steps, run_together
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.starting_orbits import family_of, parameters_at
from pipeline.layout.vocabulary import axis_name, parameter_name, parameters_of, split_dims
from pipeline.products.product import Table
from pipeline.products.rotation import RotationFlag
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points
from pipeline.results.tabular import Row as TableRow
from pipeline.results.tabular import Words, aligned, counted, number
from pipeline.results.tolerances import BRANCH_RTOL
from pipeline.specification.problems import SpecError


@dataclass(frozen=True)
class TongueSettings:
    """Numbers of the search for locked orbits between cells."""

    # most halvings of an interval of the parameter in which a fraction is passed between two cells; more find thinner
    # tongues
    bisections: int = 26
    # drive periods for which a trajectory settles after each halving; more find tongues of weakly attracting orbits,
    # and take longer
    n_transient: int = 300
    # periods q among which the closest return of a trajectory is sought, as a first guess of the orbit
    recurrences: int = 8
    tolerance: float = 1e-9  # of the integrations for the search; Newton's method has its own
    locked: float = 1e-6  # largest distance of a closed cell's rotation number from a fraction that counts as equal


IN_TONGUE = Settings(longest_step=0.05)
"""Settings with long steps: of the orbits in a tongue only the folds are wanted."""


@dataclass(frozen=True, eq=False)
class Row:
    """Cells along one parameter, with their rotation numbers, orbit periods (0: not closed) and section points."""

    values: np.ndarray  # (value,): rising values of the parameter
    rotation: np.ndarray  # (value, start): NaN where unknown
    orbit_period: np.ndarray  # (value, start)
    section: np.ndarray  # (value, start, state): a section point of each


@dataclass(frozen=True, eq=False)
class Search:
    """Settings of the search for locked orbits: family, rotating state and number of periods to average over."""

    family: Family
    turning: TurningState
    n_periods: int
    settings: TongueSettings = TongueSettings()

    def rotation(self, values: np.ndarray, states: np.ndarray, closed: np.ndarray | None = None) -> np.ndarray:
        """Compute the rotation numbers of trajectories that start at given states and values of the free parameter."""
        rows = self.family.rows(self._unknowns(values, states))
        found = rotation_numbers(
            rows.parameters,
            rows.frequency_hz,
            rows.states,
            system=self.family.system,
            turning=self.turning,
            n_periods=self.n_periods,
            orbit_period=closed,
            **tolerances_at(self.settings.tolerance),
        )
        return np.asarray(np.where(found.error <= CLOSED_TURNS, found.rotation, np.nan))

    def sections(self, values: np.ndarray, states: np.ndarray, n_transient: int, n_keep: int) -> np.ndarray:
        """Integrate trajectories over a transient; return the next section points (trajectory, n_keep, state)."""
        rows = self.family.rows(self._unknowns(values, states))
        found = run_branches(
            rows.parameters[:, None],
            rows.frequency_hz[:, None],
            rows.states,
            n_transient=n_transient,
            n_keep=n_keep,
            **limits_at(self.settings.tolerance),
            system=self.family.system,
        )
        return np.asarray(found.section[:, 0])

    def _unknowns(self, values: np.ndarray, states: np.ndarray) -> np.ndarray:
        return np.asarray(np.column_stack([states, values]) / self.family.unit)


def fractions_between(low: float, high: float, most: int) -> list[Fraction]:
    """Return all fractions in an interval with denominators up to `most`, in rising order."""
    return sorted(
        {Fraction(p, q) for q in range(1, most + 1) for p in range(ceil(low * q - 1e-9), floor(high * q + 1e-9) + 1)}
    )


def locked_orbits(row: Row, search: Search, most: int) -> dict[Fraction, Start | None]:
    """Find an orbit for each rotation number p/q that occurs along a row of cells, with q up to a largest one.

    Fractions are in rising order; None where no closed cell has it and the search failed.
    """
    known = row.rotation[np.isfinite(row.rotation)]
    if not known.size:
        return {}
    wanted = fractions_between(float(known.min()), float(known.max()), most)
    found = {fraction: _of_cells(row, search, fraction) for fraction in wanted}
    missing = {f: gap for f in wanted if found[f] is None and (gap := _passed(row, f)) is not None}
    found |= _between_cells(row, search, missing)
    ready = {f: start for f, start in found.items() if start is not None}
    corrected = run_together([_corrected(start, k) for k, start in enumerate(ready.values())], "polishing orbits")
    return found | dict(zip(ready, corrected, strict=True))


def _of_cells(row: Row, search: Search, fraction: Fraction) -> Start | None:
    """Return the periodic orbit of least period among the cells with a rotation number; None if there is none."""
    has = (row.orbit_period > 0) & (np.abs(row.rotation - float(fraction)) < search.settings.locked)
    if not has.any():
        return None
    period = int(row.orbit_period[has].min())
    places = np.argwhere(has & (row.orbit_period == period))
    i, j = places[len(places) // 2]
    family = replace(search.family, period=period)
    return Start(family, row.section[i, j], float(row.values[i]))


def _passed(row: Row, fraction: Fraction) -> tuple[int, int] | None:
    """Find a cell after which the rotation number passes a fraction; return its indices (value, start), or None."""
    off = row.rotation - float(fraction)
    places = np.argwhere(off[:-1] * off[1:] < 0.0)
    if not len(places):
        return None
    steps = [abs(row.rotation[i + 1, j] - row.rotation[i, j]) for i, j in places]
    i, j = places[int(np.argmin(steps))]
    return int(i), int(j)


def _between_cells(row: Row, search: Search, gaps: dict[Fraction, tuple[int, int]]) -> dict[Fraction, Start | None]:
    """Find locked orbits between adjacent cells by bisection in the parameter, for all fractions at once."""
    if not gaps:
        return {}
    targets = np.array([float(f) for f in gaps])
    ends = np.array([[row.values[i], row.values[i + 1]] for i, _ in gaps.values()])
    rising = np.array([row.rotation[i, j] < row.rotation[i + 1, j] for i, j in gaps.values()])
    states = np.array([row.section[i, j] for i, j in gaps.values()])
    for _ in range(search.settings.bisections):
        middle = ends.mean(axis=1)
        reached = search.sections(middle, states, search.settings.n_transient, 1)[:, -1]
        states = np.where(np.isfinite(reached).all(axis=1)[:, None], reached, states)
        off = search.rotation(middle, states) - targets
        is_low = (off < 0.0) == rising
        is_done = ~(np.abs(off) > search.settings.locked)  # NaN: nothing more can be learnt there
        ends = np.where(is_done[:, None], np.stack([middle, middle], axis=1), ends)
        ends[is_low & ~is_done, 0] = middle[is_low & ~is_done]
        ends[~is_low & ~is_done, 1] = middle[~is_low & ~is_done]
        if is_done.all():
            break
    longest = max(f.denominator for f in gaps)
    sections = search.sections(ends.mean(axis=1), states, 0, (search.settings.recurrences + 1) * longest)
    return {
        f: _closest_return(replace(search.family, period=f.denominator), points, float(value))
        for f, points, value in zip(gaps, sections, ends.mean(axis=1), strict=True)
    }


def _closest_return(family: Family, points: np.ndarray, value: float) -> Start | None:
    distance = scaled_distance(points[family.period :], points[: -family.period], family.system)
    if not np.isfinite(distance).all():
        return None
    return Start(family, points[int(np.argmin(distance))], value)


def _corrected(start: Start, number: int) -> Steps[Start | None]:
    """Refine an orbit together with its parameter value, since a thin tongue has the orbit near one value only."""
    problem, u = problem_of(start.family), start.family.unknowns(start.state, [start.value])
    value = yield Query(problem, u)
    found = (yield from correct(problem, u, kernel_of(value), Settings())) if value.is_finite else None
    if found is None:
        return None
    state, parameter = start.family.state(found.u), float(start.family.values(found.u)[0])
    return Start(start.family, state, parameter, number)


def fraction_of(branch: Branch, search: Search) -> Fraction | None:
    """Return the rotation number p/q of a branch, from its first orbit; None if its turns are no whole number."""
    family, first = branch.family, branch.points[0]
    values, states = family.values(first.u), family.state(first.u)[None]
    closed = None if search.turning.of_section else np.array([family.period])
    whole = float(search.rotation(values, states, closed)[0]) * family.period
    return Fraction(round(whole), family.period) if abs(whole - np.round(whole)) < search.settings.locked else None


def needs_rotation(run: OpenRun, options: TongueOptions) -> None:
    """Raise ValueError unless the run has rotation numbers and sweeps the parameter of the row of cells."""
    cube = run.cube()
    if "rotation" not in cube:
        raise ValueError("the cube has no rotation numbers; run it with [products] rotation = {} in its specification")
    if options.parameter and swept_axis(run, options.parameter) is None:
        raise ValueError(f"--parameter {options.parameter}: the run does not sweep it; tongues are searched along it.")


def settle_tongues(run: OpenRun, options: TongueOptions) -> TongueOptions:
    """Fill in the parameter, its interval and the row of cells; raise SpecError unless the two parameters differ."""
    if axis_name(options.second) == axis_name(options.parameter):
        raise SpecError(f"{options.second} is swept already; give another second parameter, or --parameter.")
    low, high = interval_of(run, options.parameter, options.low, options.high)
    interval_of(run, options.second, options.second_low, options.second_high)
    return options.model_copy(update={"low": low, "high": high})


def tongues(run: OpenRun, options: TongueOptions) -> xr.Dataset:
    """Find orbits with rotation numbers p/q along a row of cells, and continue their folds in the parameter plane."""
    # least error of a fold, in units of the interval of the parameter: that of the integrations
    error = 10.0 * BRANCH_RTOL
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
    numbers = [fraction_of(branch, search) for branch in branches]
    located = dataset_of(branches, first, base)
    on_row = _on_row(list(starts), numbers, located, error * (options.high - options.low))
    folds = located.isel(bifurcation=[k for tongue in on_row for k in tongue.folds])
    bounds = ((options.low, options.high), (options.second_low, options.second_high))
    edges = curves_from(folds, base, second, bounds, longest, generations=0) if branches else []
    of_curve = [numbers[int(folds["of_branch"][curve.start])] for curve in edges]
    ds = curves_dataset(edges, first, second, base.model)
    ds = ds.assign({k: ("curve", v) for k, v in _parts(of_curve).items()})
    row = float(point[second]) if second in point.coords else float(base[second])
    return ds.assign(_variables(on_row)).assign_attrs(row=row, max_denominator=options.max_denominator)


def _row_of(run: OpenRun, options: TongueOptions) -> xr.Dataset:
    cube, first = run.cube(), axis_name(options.parameter)
    part = select_points(cube, options.at)
    others = [d for d in map(str, split_dims(part["status"])[0]) if d != first]
    long = [d for d in others if part.sizes[d] > 1]
    if long:
        value = float(part[long[0]].values[part.sizes[long[0]] // 2])
        told = f"choose a value of {', '.join(long)}, such as --at {long[0]}={value:g}"
        raise ValueError(f"tongues are searched on one row of cells; {told}")
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
    return {name: ("tongue", values) for name, values in columns.items()}


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
    return {
        "tongue": row["tongue"],
        **{name: number(row[name], ".7f") for name in ("from", "to")},
        "width": number(row["width"], ".3g"),
        "error": number(row["error"], ".1g"),
        "branches": str(row["branches"]),
        "curves": str(row["curves"]),
    }
