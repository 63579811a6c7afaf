"""Define the analysis ``tipping``: the attractors that cells reach after a drift, and the critical values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core import Status
from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.run import OpenRun
from pipeline.analysis.tabular import Row, aligned, counted, plain, unit_of, words_of
from pipeline.analysis.tipping.endings import NONE, Final, Group, endings, ends_s, finals_of
from pipeline.layout.cells import CellMap, initial_states
from pipeline.layout.vocabulary import axis_name, drift_attributes, letter, model_attribute, parameter_name, split_dims
from pipeline.motion.drifting import Drifting
from pipeline.products.product import Table
from pipeline.products.reporting import report
from pipeline.products.tipping import TippingOptions
from pipeline.specification.tables import FREQUENCY

if TYPE_CHECKING:
    from magpend_core import Sections


MOST_VALUES = 40
"""Most values of the swept number that are listed one by one."""

MOST_STEPS = 60
"""Most bisections; float64 has 53 binary digits."""

MOST_KNOWN = 3
"""Cells of each attractor that go on beside those that are examined."""


def needs_drift(run: OpenRun, options: TippingOptions) -> None:
    """Raise ValueError unless the run's parameters come to rest before it ends."""
    spec = run.spec
    total = spec.integration.n_transient + spec.integration.n_keep
    packed, frequency = _cells(run)
    late = ends_s(spec, packed, frequency) * frequency > total * (1.0 + 1e-9)
    if late.any():
        needed = int(np.ceil((ends_s(spec, packed, frequency) * frequency).max() - 1e-9))
        raise ValueError(
            f"the run ends after {total} periods, while its parameters move until period {needed}; raise "
            "integration.n_transient or n_keep."
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
    packed, frequency = _cells(run)
    run.echo(f"tipping: going on at the final parameters for {options.settle + options.keep} periods")
    groups = list(endings(run, finals_of(run.spec, packed, frequency), last, status, options))
    ids, table = _numbered(groups)
    outcome = np.full(len(status), NONE)
    for group, own in zip(groups, ids, strict=True):
        outcome[group.cells] = [own.get(int(o), int(o)) for o in group.outcome]
    outcome = outcome.reshape(shape)
    result = xr.Dataset(table).assign(
        outcome=(
            order,
            outcome.astype(np.int32),
            {"units": "1", "long_name": "attractor reached, -2 diverged, -1 none"},
        )
    )
    result = result.assign_coords({k: v for k, v in cube.coords.items() if set(v.dims) <= set(order)})
    axis = parameter_name(options.parameter)
    brackets: list[Bracket] = []
    whole: list[Bracket] = []
    if axis in run.spec.axes and len(run.spec.axes[axis].array()) > 1:
        whole = _brackets(run, axis, outcome, dims)
        brackets = Bisection(run, axis, _others(run, axis), groups, ids, options).run_all(whole[: options.brackets])
    unit = _unit(run, axis)
    result = result.assign(_of_brackets(brackets, axis, _others(run, axis), unit))
    attrs = {"model": model_attribute(model), **drift_attributes(model), "parameter": axis, "n_brackets": len(whole)}
    return result.assign_attrs(attrs)


def _unit(run: OpenRun, axis: str) -> str:
    """Return the unit of a swept number."""
    return "Hz" if axis == FREQUENCY else run.spec.model.parameter(axis).unit


def _cells(run: OpenRun) -> tuple[np.ndarray, np.ndarray]:
    """Return the parameters and frequencies of all cells, in the order of the cube."""
    cells = CellMap(run.spec)
    inputs = cells.inputs(tuple(slice(0, n) for n in cells.shape))
    return inputs.parameters[:, 0], inputs.frequency_hz[:, 0]


def _others(run: OpenRun, axis: str) -> tuple[str, ...]:
    return tuple(name for name in run.spec.axes if name != axis)


def _numbered(groups: list[Group]) -> tuple[list[dict[int, int]], dict[str, Any]]:
    """Number the attractors of all groups, and return the numbers by group with a table of the attractors."""
    ids: list[dict[int, int]] = []
    rows: list[dict[str, Any]] = []
    for number, group in enumerate(groups):
        own: dict[int, int] = {}
        reached = sorted({int(o) for o in group.outcome if o >= 0})
        for local in reached:
            assert group.ids is not None
            one = group.ids.isel(attractor=local)
            own[local] = len(rows)
            rows.append(
                {
                    "group": number,
                    "kind": words_of(one["kind"])[int(one["kind"])],
                    "period": int(one["orbit_period"]),
                    "n_cells": int((group.outcome == local).sum()),
                    "point": one["attractor_points"].values[0],
                }
            )
        ids.append(own)
    states = groups[0].final.parameters.model.state_names
    empty = np.zeros((0, len(states)))
    table = {
        "attractor_kind": ("attractor", np.array([r["kind"] for r in rows], dtype="U32")),
        "attractor_period": ("attractor", np.array([r["period"] for r in rows], np.int32), {"units": "1"}),
        "attractor_group": ("attractor", np.array([r["group"] for r in rows], np.int32), {"units": "1"}),
        "attractor_n_cells": ("attractor", np.array([r["n_cells"] for r in rows], np.int64), {"units": "1"}),
        "attractor_point": (("attractor", "state"), np.array([r["point"] for r in rows]) if rows else empty),
        "final_parameters": ("group", np.array([_sentence(g, groups) for g in groups], dtype=str)),
    }
    return ids, {name: xr.Variable(*entry) for name, entry in table.items()}


def _sentence(group: Group, groups: list[Group]) -> str:
    """Return the final parameters that distinguish a group, as a text; empty if there is one group."""
    parts = []
    values = [{**g.final.parameters, "frequency_hz": g.final.frequency_hz} for g in groups]
    own = {**group.final.parameters, "frequency_hz": group.final.frequency_hz}
    for name, value in own.items():
        if len({v[name] for v in values}) > 1:
            parts.append(f"{name} = {value:g}")
    return ", ".join(parts)


def _brackets(run: OpenRun, axis: str, outcome: np.ndarray, dims: tuple[str, ...]) -> list[Bracket]:
    """Return the intervals of the swept number in which cells change their attractor."""
    at = [parameter_name(d) for d in dims].index(axis)
    values = run.spec.axes[axis].array()
    others = [run.spec.axes[name].array() for name in _others(run, axis)]
    moved = np.moveaxis(outcome, at, -1)
    n_points = tuple(len(o) for o in others)
    flat = moved.reshape(*n_points, -1, len(values))
    found = []
    for *point, start in np.ndindex(flat.shape[:-1]):
        row = flat[(*point, start)]
        for a, b in brackets_of(values, row):
            here = tuple(float(o[i]) for o, i in zip(others, point, strict=True))
            found.append(Bracket(start, here, float(values[a]), float(values[b]), int(row[a]), int(row[b])))
    return found


def _of_brackets(brackets: list[Bracket], axis: str, others: tuple[str, ...], unit: str) -> dict[str, Any]:
    """Return the variables of the critical values, over the dim ``critical``."""

    def column(values: list[Any], dtype: str, long_name: str, units: str = "1") -> Any:
        return xr.Variable("critical", np.array(values, dtype), {"units": units, "long_name": long_name})

    found = {
        "critical_value": column([0.5 * (b.low + b.high) for b in brackets], "float64", f"critical {axis}", unit),
        "critical_low": column([b.low for b in brackets], "float64", "last value with the first attractor", unit),
        "critical_high": column([b.high for b in brackets], "float64", "first value with the second one", unit),
        "critical_from": column([b.outcome_low for b in brackets], "int32", "attractor below, -2 diverged"),
        "critical_to": column([b.outcome_high for b in brackets], "int32", "attractor above, -2 diverged"),
        "critical_start": column([b.start for b in brackets], "int64", "initial condition"),
        "critical_n_evaluated": column([b.n_evaluated for b in brackets], "int32", "trajectories of the bisection"),
        "critical_decided": column([b.is_decided for b in brackets], "int8", "1 if every one reached an attractor"),
    }
    for i, name in enumerate(others):
        found[f"critical_at_{axis_name(name)}"] = column([b.point[i] for b in brackets], "float64", name)
    return found


def outcome_word(outcome: int) -> str:
    """Return the name of an outcome: a letter, diverged, or not decided."""
    return {DIVERGED: "diverged", NONE: "not decided"}.get(outcome) or letter(outcome)


def tipping_table(ds: xr.Dataset) -> Table:
    """Return a row per critical value; the lines also list the attractors and the cells that reach them."""
    rows = [_row(ds.isel(critical=i)) for i in range(ds.sizes["critical"])]
    lines = ["attractors reached at the final parameters", *aligned(_attractors(ds)), *_counts(ds)]
    axis = str(ds.attrs["parameter"])
    dim = axis_name(axis)
    unit = unit_of(ds, dim) if dim in ds.coords else ""
    n, shown = int(ds.attrs["n_brackets"]), len(rows)
    lines.append(f"{counted(n, 'critical value')} of {axis}" if n else "no cell changes its attractor along the sweep")
    if shown < n:
        lines[-1] += f"; the first {shown} are bisected (--brackets)"
    return Table(rows, [*lines, *aligned([_words(row, unit) for row in rows])])


def _row(one: xr.Dataset) -> Row:
    row: Row = {
        "start": int(one["critical_start"]),
        "value": float(one["critical_value"]),
        "low": float(one["critical_low"]),
        "high": float(one["critical_high"]),
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
    words = []
    for i in range(ds.sizes["attractor"]):
        one = ds.isel(attractor=i)
        at = str(ds["final_parameters"].values[int(one["attractor_group"])])
        states = ", ".join(f"{x:.6g}" for x in np.atleast_1d(one["attractor_point"].values))
        words.append(
            {
                "letter": letter(i),
                "kind": plain(str(one["attractor_kind"].values)),
                "period": str(int(one["attractor_period"]) or "-"),
                "cells": str(int(one["attractor_n_cells"])),
                "a section point": f"({states})",
                "at": at or None,
            }
        )
    return words


def _counts(ds: xr.Dataset) -> list[str]:
    """Return the lines with the numbers of cells on each attractor, per value of the swept number."""
    dim = axis_name(str(ds.attrs["parameter"]))
    dims, _ = split_dims(ds["outcome"])
    outcome = ds["outcome"]
    seen = sorted({int(o) for o in np.unique(outcome.values)}, key=lambda o: (o < 0, o))
    if dim not in dims:
        counts = ", ".join(f"{outcome_word(o)} {int((outcome == o).sum())}" for o in seen)
        return [f"cells: {counts}"]
    values = ds[dim].values
    rows: list[dict[str, Any]] = []
    for i, value in enumerate(values):
        here = outcome.isel({dim: i}).values
        found = {outcome_word(o): str(int((here == o).sum())) for o in seen}
        if rows and [rows[-1][word] for word in found] == list(found.values()):
            rows[-1]["to"] = value
            continue
        rows.append({"from": value, **found, "to": value})
    head = f"{dim}{unit_of(ds, dim)}"
    words = []
    for row in rows:
        first, last = row.pop("from"), row.pop("to")
        words.append({head: f"{first:g}" if first == last else f"{first:g} to {last:g}", **row})
    return ["cells on each", *aligned(words)]


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

    def halved(self, middle: float, outcome: int) -> Bracket:
        """Return the half at whose ends the outcomes differ, the lower one if both do."""
        n = self.n_evaluated + 1
        if outcome == NONE:
            return replace(self, n_evaluated=n, is_decided=False)
        if outcome == self.outcome_low:
            return replace(self, low=middle, n_evaluated=n)
        return replace(self, high=middle, outcome_high=outcome, n_evaluated=n)


def brackets_of(values: np.ndarray, outcomes: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of neighbouring known outcomes that differ, as indices of the swept values.

    Parameters
    ----------
    values
        Of the swept number, rising, shape (n,).
    outcomes
        At these values, shape (n,); `NONE` where nothing is known.
    """
    known = np.flatnonzero(outcomes != NONE)
    pairs = zip(known[:-1].tolist(), known[1:].tolist(), strict=True)
    return [(a, b) for a, b in pairs if outcomes[a] != outcomes[b]]


class Bisection:
    """A bisection of many brackets at the same time.

    Parameters
    ----------
    run
        Run whose parameters move.
    axis
        Name of the swept number.
    others
        Names of the other swept parameters, in the order of `Bracket.point`.
    groups
        What is known of the run's own cells, see `endings`.
    ids
        For each group the numbers that its attractors have in the brackets.
    options
        Width and lengths.
    """

    def __init__(
        self,
        run: OpenRun,
        axis: str,
        others: tuple[str, ...],
        groups: list[Group],
        ids: list[dict[int, int]],
        options: TippingOptions,
    ) -> None:
        self.run, self.axis, self.others, self.options = run, axis, others, options
        self.starts = initial_states(run.spec.initial_conditions)
        span = run.spec.axes[axis].array()
        self.width = options.width * float(np.ptp(span))
        self.known = {
            group.final.key: (group.final, *_examples(group, own)) for group, own in zip(groups, ids, strict=True)
        }

    def run_all(self, brackets: list[Bracket]) -> list[Bracket]:
        """Return the brackets, halved until they are narrow enough or cannot be decided."""
        found = list(brackets)
        for step in range(MOST_STEPS):
            open_ = [i for i, b in enumerate(found) if self._is_open(b)]
            if not open_:
                break
            report("bisecting", step, MOST_STEPS)
            middles = np.array([0.5 * (found[i].low + found[i].high) for i in open_])
            outcomes = self._outcomes([found[i] for i in open_], middles)
            for i, middle, outcome in zip(open_, middles.tolist(), outcomes.tolist(), strict=True):
                found[i] = found[i].halved(middle, outcome)
        return found

    def _is_open(self, bracket: Bracket) -> bool:
        middle = 0.5 * (bracket.low + bracket.high)
        is_wide = bracket.high - bracket.low > self.width and bracket.low < middle < bracket.high
        return bracket.is_decided and is_wide

    def _outcomes(self, brackets: list[Bracket], middles: np.ndarray) -> np.ndarray:
        """Return the attractors that trajectories reach with given values of the swept number."""
        spec = self.run.spec
        names = spec.values.names
        packed = np.tile(spec.values.pack(), (len(brackets), 1))
        frequency = np.full(len(brackets), np.nan if spec.frequency_hz is None else spec.frequency_hz)
        for i, bracket in enumerate(brackets):
            here = {self.axis: middles[i], **dict(zip(self.others, bracket.point, strict=True))}
            frequency[i] = here.pop(FREQUENCY, frequency[i])
            for name, value in here.items():
                packed[i, names.index(name)] = value
        starts = self.starts.at(np.array([b.start for b in brackets]))
        found = drifted(self.run, packed, frequency, starts)
        finals = finals_of(spec, packed, frequency)
        return self._compared(finals, found.final_state[:, 0], found.status[:, 0])

    def _compared(self, finals: list[Final], states: np.ndarray, status: np.ndarray) -> np.ndarray:
        """Return the known attractors on which cells end; cells of each known attractor go on beside them."""
        outcome = np.full(len(finals), NONE)
        outcome[status == Status.DIVERGED] = DIVERGED
        keys = [final.key for final in finals]
        for key in dict.fromkeys(keys):
            own = np.flatnonzero([k == key for k in keys])
            if key not in self.known:
                continue
            final, examples, labels = self.known[key]
            n = len(examples)
            both = np.concatenate([examples, states[own]])
            codes = np.concatenate([np.full(n, int(Status.BOUNDED)), status[own]])
            (group,) = endings(self.run, [final] * len(both), both, codes, self.options)
            names = {int(o): int(label) for o, label in zip(group.outcome[:n], labels, strict=True) if o >= 0}
            names[DIVERGED] = DIVERGED
            outcome[own] = [names.get(int(o), NONE) for o in group.outcome[n:]]
        return outcome


def _examples(group: Group, ids: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return states on each attractor of a group, and the attractors' numbers."""
    states, labels = [np.zeros((0, group.settled.shape[1]))], []
    own = group.outcome[np.searchsorted(group.cells, group.integrated)]
    for local, number in ids.items():
        chosen = np.flatnonzero(own == local)[:MOST_KNOWN]
        states.append(group.settled[chosen])
        labels += [number] * len(chosen)
    return np.concatenate(states), np.array(labels, np.int64)


def drifted(run: OpenRun, packed: np.ndarray, frequency_hz: np.ndarray, starts: np.ndarray) -> Sections:
    """Integrate cells of a run over its whole length, with other parameters; only the last section is kept."""
    motion, integration = run.spec.motion, run.spec.integration
    assert isinstance(motion, Drifting)
    length = {"n_transient": integration.n_transient + integration.n_keep - 1, "n_keep": 1}
    return motion.sections(packed, frequency_hz, starts, **length, max_orbit_period=1)
