"""Define the analysis ``tipping``: the attractors that cells reach after a drift, and the critical values."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.analysis.attractors.destinations import ELSEWHERE
from pipeline.analysis.tipping.declaration import COURSES, TippingOptions
from pipeline.analysis.tipping.endings import UNKNOWN_END, Group, Known, compared, drifted, endings, ends_s, finals_of
from pipeline.analysis.tipping.tracking import UNDECIDED_COURSE, Cells, Ends, courses
from pipeline.layout.cells import CellMap, initial_states
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import (
    axis_name,
    drift_attributes,
    letter,
    model_attribute,
    parameter_name,
    parameter_units,
    split_dims,
)
from pipeline.motion.drifting import Drifting
from pipeline.products.product import Table
from pipeline.products.reporting import report
from pipeline.results.outcomes import DIVERGED
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, aligned, counted, header_of, plain, unit_of, words_of
from pipeline.specification.tables import FREQUENCY

NOT_DECIDED = plain(COURSES[UNDECIDED_COURSE])


def needs_drift(run: OpenRun, options: TippingOptions) -> None:
    """Raise ValueError unless the run's parameters come to rest before it ends."""
    spec = run.spec
    total = spec.integration.n_transient + spec.integration.n_keep
    packed, frequency, _ = _cells(run)
    last = (ends_s(spec, packed, frequency) * frequency).max()
    if last > total * (1.0 + 1e-9):
        raise ValueError(
            f"the run ends after {total} periods, while its parameters move until period {int(np.ceil(last - 1e-9))}; "
            "raise integration.n_transient or n_keep."
        )
    if axis_name(options.parameter) not in run.cube()["status"].dims and spec.axes:
        raise ValueError(f"{options.parameter} is not an axis of this run; its axes: {', '.join(spec.axes)}.")


def tipping(run: OpenRun, options: TippingOptions) -> xr.Dataset:
    """Find the attractor that each cell reaches after the drift, and bisect the values at which it changes."""
    cube, model = run.cube(), run.spec.model
    dims, starts = split_dims(cube["status"])
    order = (*dims, *starts)
    shape = tuple(cube.sizes[d] for d in order)
    status = cube["status"].transpose(*order).values.ravel()
    last = cube["section"].isel(period_index=-1).transpose(*order, "state").values.reshape(-1, len(model.states))
    cells = _cells(run)
    run.echo(f"tipping: going on at the final parameters for {options.settle + options.keep} periods")
    groups = list(endings(run, finals_of(run.spec, *cells[:2]), last, status, options))
    reached = Ends.of(groups)
    outcome = reached.outcome.reshape(shape)
    course = courses(run, cells, reached, options).reshape(shape).astype(np.int8)
    result = xr.Dataset(
        {
            **_attractors_of(groups),
            "outcome": (order, outcome.astype(np.int32)),
            "course": (order, course, code_flags(COURSES)),
        }
    )
    result = result.assign_coords({k: v for k, v in cube.coords.items() if set(v.dims) <= set(order)})
    axis = parameter_name(options.parameter)
    others = tuple(name for name in run.spec.axes if name != axis)
    brackets: list[Bracket] = []
    whole: list[Bracket] = []
    if axis in run.spec.axes and len(run.spec.axes[axis].array()) > 1:
        whole = _brackets(run, axis, others, outcome, dims)
        brackets = Bisection(run, axis, others, reached.known, options).run_all(whole[: options.brackets])
    attrs = {"model": model_attribute(model), **drift_attributes(model), "parameter": axis, "n_brackets": len(whole)}
    return result.assign(_of_brackets(brackets, others, model)).assign_attrs(attrs)


def _cells(run: OpenRun) -> Cells:
    """Return all cells in the order of the cube."""
    cells = CellMap(run.spec)
    inputs = cells.inputs(tuple(slice(0, n) for n in cells.shape))
    return inputs.parameters[:, 0], inputs.frequency_hz[:, 0], inputs.initial_states


def _attractors_of(groups: list[Group]) -> dict[str, Any]:
    """Return a table of the attractors of all groups, in the order of their numbers (see `Ends`)."""
    rows: list[tuple[int, int, xr.Dataset]] = []
    for number, group in enumerate(groups):
        for local in sorted({int(o) for o in group.outcome if o >= 0}):
            assert group.ids is not None
            rows.append((number, int((group.outcome == local).sum()), group.ids.isel(attractor=local)))
    kinds = [words_of(one["kind"])[int(one["kind"])] for *_, one in rows]
    points = [one["attractor_points"].values[0] for *_, one in rows]
    n_states = len(groups[0].final.parameters.model.state_names)
    return {
        "attractor_kind": ("attractor", np.array(kinds, dtype="U32")),
        "attractor_period": ("attractor", np.array([int(one["orbit_period"]) for *_, one in rows], np.int32)),
        "attractor_group": ("attractor", np.array([number for number, *_ in rows], np.int32)),
        "attractor_n_cells": ("attractor", np.array([n for _, n, _ in rows], np.int64)),
        "attractor_point": (("attractor", "state"), np.reshape(points, (len(rows), n_states))),
        "final_parameters": ("group", np.array(_sentences(groups), dtype=str)),
    }


def _sentences(groups: list[Group]) -> list[str]:
    """Return the final parameters that distinguish each group, as texts; empty if there is one group."""
    values = [{**g.final.parameters, "frequency_hz": g.final.frequency_hz} for g in groups]
    differ = [name for name in values[0] if len({own[name] for own in values}) > 1]
    return [", ".join(f"{name} = {own[name]:g}" for name in differ) for own in values]


def _brackets(
    run: OpenRun, axis: str, others: tuple[str, ...], outcome: np.ndarray, dims: tuple[str, ...]
) -> list[Bracket]:
    """Return the intervals of the swept number in which cells change their attractor."""
    values, *beside = (run.spec.axes[name].array() for name in (axis, *others))
    moved = np.moveaxis(outcome, [parameter_name(d) for d in dims].index(axis), -1)
    flat = moved.reshape(*(len(o) for o in beside), -1, len(values))
    found = []
    for *point, start in np.ndindex(flat.shape[:-1]):
        row = flat[(*point, start)]
        here = tuple(float(o[i]) for o, i in zip(beside, point, strict=True))
        for a, b in brackets_of(row):
            found.append(Bracket(start, here, float(values[a]), float(values[b]), int(row[a]), int(row[b])))
    return found


def _of_brackets(brackets: list[Bracket], others: tuple[str, ...], model: Model) -> dict[str, Any]:
    """Return the variables of the critical values, over the dim ``critical``."""
    columns: dict[str, tuple[list[Any], str]] = {
        "critical_value": ([b.middle for b in brackets], "float64"),
        "critical_low": ([b.low for b in brackets], "float64"),
        "critical_high": ([b.high for b in brackets], "float64"),
        "critical_from": ([b.outcome_low for b in brackets], "int32"),
        "critical_to": ([b.outcome_high for b in brackets], "int32"),
        "critical_start": ([b.start for b in brackets], "int64"),
        "critical_n_evaluated": ([b.n_evaluated for b in brackets], "int32"),
        "critical_decided": ([b.is_decided for b in brackets], "int8"),
    }
    found: dict[str, Any] = {name: ("critical", np.array(values, dtype)) for name, (values, dtype) in columns.items()}
    for i, name in enumerate(others):
        about = {"units": parameter_units(axis_name(name), model), "long_name": f"value of {name}"}
        found[f"critical_at_{axis_name(name)}"] = ("critical", np.array([b.point[i] for b in brackets], float), about)
    return found


def outcome_word(outcome: int) -> str:
    """Return the name of an outcome: a letter, diverged, or not decided."""
    return {DIVERGED: "diverged", UNKNOWN_END: NOT_DECIDED}.get(outcome) or letter(outcome)


def tipping_table(ds: xr.Dataset) -> Table:
    """Return a row per critical value; the lines also list the attractors and the cells that reach them."""
    rows = [_row(ds.isel(critical=i)) for i in range(ds.sizes["critical"])]
    axis = str(ds.attrs["parameter"])
    dim = axis_name(axis)
    lines = ["attractors reached at the final parameters", *aligned(_attractors(ds))]
    lines += _counts(ds["outcome"], dim, outcome_word, "cells on each")
    lines += _counts(ds["course"], dim, lambda k: plain(COURSES[k]), "cells by what becomes of their first attractor")
    unit = unit_of(ds, dim) if dim in ds.coords else ""
    n, shown = int(ds.attrs["n_brackets"]), len(rows)
    lines.append(f"{counted(n, 'critical value')} of {axis}" if n else "no cell changes its attractor along the sweep")
    if shown < n:
        lines[-1] += f"; the first {shown} are bisected (--brackets)"
    lines += aligned([_words(row, unit) for row in rows])
    return Table(rows, lines, header=header_of(ds, "critical", _row))


def _row(one: xr.Dataset) -> Row:
    row: Row = {
        "start": int(one["critical_start"]),
        **{name: float(one[f"critical_{name}"]) for name in ("value", "low", "high")},
        "from": outcome_word(int(one["critical_from"])),
        "to": outcome_word(int(one["critical_to"])),
        "n_evaluated": int(one["critical_n_evaluated"]),
        "decided": bool(one["critical_decided"]),
    }
    more = {str(name)[len("critical_at_") :]: float(one[name]) for name in one if str(name).startswith("critical_at_")}
    return {**more, **row}


def _words(row: Row, unit: str) -> dict[str, str | None]:
    own = ("start", "value", "low", "high", "from", "to", "n_evaluated", "decided")
    half = 0.5 * (row["high"] - row["low"])
    digits = int(np.clip(np.ceil(-np.log10(half)), 1, 14)) if half > 0 else 14
    return {
        **{name: f"{value:g}" for name, value in row.items() if name not in own},
        "start": str(row["start"]),
        f"critical value{unit}": f"{row['value']:.{digits}f} ± {half:.1g}",
        "from": row["from"],
        "to": row["to"],
        "trajectories": str(row["n_evaluated"]),
        "evidence": "both ends decided" if row["decided"] else "a trajectory inside is not decided",
    }


def _attractors(ds: xr.Dataset) -> list[dict[str, str | None]]:
    names = ("attractor_kind", "attractor_period", "attractor_n_cells", "attractor_point", "attractor_group")
    return [
        {
            "letter": letter(i),
            "kind": plain(kind),
            "period": str(period or "-"),
            "cells": str(n),
            "a section point": f"({', '.join(f'{x:.6g}' for x in point)})",
            "at": str(ds["final_parameters"].values[group]) or None,
        }
        for i, (kind, period, n, point, group) in enumerate(zip(*(ds[k].values.tolist() for k in names), strict=True))
    ]


def _counts(cells: xr.DataArray, dim: str, word: Callable[[int], str], title: str) -> list[str]:
    """Return the lines with the numbers of cells with each code, per value of a swept number."""
    seen = sorted({int(o) for o in np.unique(cells.values)}, key=lambda o: (word(o) == NOT_DECIDED, o < 0, o))
    if dim not in cells.dims:
        return [f"{title}: {', '.join(f'{word(o)} {int((cells == o).sum())}' for o in seen)}"]
    rows: list[dict[str, Any]] = []
    for i, value in enumerate(cells[dim].values):
        here = cells.isel({dim: i}).values
        found = {word(o): str(int((here == o).sum())) for o in seen}
        if rows and [rows[-1][name] for name in found] == list(found.values()):
            rows[-1]["to"] = value
            continue
        rows.append({"from": value, **found, "to": value})
    words = []
    for row in rows:
        first, last = row.pop("from"), row.pop("to")
        text = f"{first:g}" if first == last else f"{first:g} to {last:g}"
        words.append({f"{dim}{unit_of(cells.to_dataset(name='cells'), dim)}": text, **row})
    return [title, *aligned(words)]


@dataclass(frozen=True)
class Bracket:
    """An interval of a swept number, at whose ends a trajectory ends on different attractors."""

    start: int  # number of the initial condition
    point: tuple[float, ...]  # values of the other axes
    # ends of the interval
    low: float
    high: float
    # attractors at the ends, or `DIVERGED`
    outcome_low: int
    outcome_high: int
    n_evaluated: int = 0  # trajectories integrated by the bisection
    is_decided: bool = True  # false if the bisection met a trajectory whose attractor could not be found

    @property
    def middle(self) -> float:
        """Middle of the interval."""
        return 0.5 * (self.low + self.high)

    def halved(self, outcome: int) -> Bracket:
        """Return the half at whose ends the outcomes differ, the lower one if both do, by the outcome in the middle."""
        n = self.n_evaluated + 1
        if outcome == UNKNOWN_END:
            return replace(self, n_evaluated=n, is_decided=False)
        if outcome == self.outcome_low:
            return replace(self, low=self.middle, n_evaluated=n)
        return replace(self, high=self.middle, outcome_high=outcome, n_evaluated=n)


def brackets_of(outcomes: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of indices of neighbouring known outcomes that differ; `UNKNOWN_END` is not known."""
    known = np.flatnonzero(outcomes != UNKNOWN_END)
    return [(a, b) for a, b in pairwise(known.tolist()) if outcomes[a] != outcomes[b]]


class Bisection:
    """A bisection of many brackets of a run's swept number at the same time.

    The others are the names of the other swept parameters, in the order of `Bracket.point`. The known attractors are
    those that the run's own cells reach.
    """

    def __init__(self, run: OpenRun, axis: str, others: tuple[str, ...], known: Known, options: TippingOptions) -> None:
        self.run, self.axis, self.others, self.known, self.options = run, axis, others, known, options
        self.starts = initial_states(run.spec.initial_conditions)
        self.width = options.interval * float(np.ptp(run.spec.axes[axis].array()))

    def run_all(self, brackets: list[Bracket]) -> list[Bracket]:
        """Return the brackets, halved until they are narrow enough or cannot be decided."""
        most_steps = 60  # most bisections; float64 has 53 binary digits
        found = list(brackets)
        widest = max((one.high - one.low for one in found), default=0.0)
        needed = min(most_steps, math.ceil(math.log2(max(widest / self.width, 1.0)))) if self.width else most_steps
        for step in range(most_steps):
            open_ = [i for i, b in enumerate(found) if self._is_open(b)]
            if not open_:
                break
            report("bisecting", step, needed)
            for i, outcome in zip(open_, self._outcomes([found[i] for i in open_]).tolist(), strict=True):
                found[i] = found[i].halved(outcome)
        return found

    def _is_open(self, bracket: Bracket) -> bool:
        is_wide = bracket.high - bracket.low > self.width and bracket.low < bracket.middle < bracket.high
        return bracket.is_decided and is_wide

    def _outcomes(self, brackets: list[Bracket]) -> np.ndarray:
        """Return the attractors that trajectories reach in the middles of brackets."""
        spec = self.run.spec
        names = spec.values.names
        packed = np.tile(spec.values.pack(), (len(brackets), 1))
        frequency = np.full(len(brackets), np.nan if spec.frequency_hz is None else spec.frequency_hz)
        for i, bracket in enumerate(brackets):
            here = {self.axis: bracket.middle, **dict(zip(self.others, bracket.point, strict=True))}
            frequency[i] = here.pop(FREQUENCY, frequency[i])
            for name, value in here.items():
                packed[i, names.index(name)] = value
        starts = self.starts.at(np.array([b.start for b in brackets]))
        assert isinstance(spec.motion, Drifting)
        found = drifted(spec.motion, packed, frequency, starts)
        finals = finals_of(spec, packed, frequency)
        outcome = compared(self.run, self.known, finals, found.final_state[:, 0], found.status[:, 0], self.options)
        return np.where(outcome == ELSEWHERE, UNKNOWN_END, outcome)
