"""Compute rate-induced tipping as an analysis of a run (`pipeline.products.tipping`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.run import OpenRun
from pipeline.analysis.tabular import words_of
from pipeline.analysis.tipping.critical import Bisection, Bracket, brackets_of
from pipeline.analysis.tipping.endings import NONE, Group, endings, ends_s, finals_of
from pipeline.layout.cells import CellMap
from pipeline.layout.vocabulary import axis_name, drift_attributes, model_attribute, parameter_name, split_dims
from pipeline.products.tipping import TippingOptions
from pipeline.specification.tables import FREQUENCY


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
