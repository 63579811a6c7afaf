"""Describe a run for the page when it loads: its content, names, drawing and colours."""

from __future__ import annotations

import itertools
import math
import shlex
from typing import Any

import numpy as np

from magpend_core.models.model import Model
from magpend_core.models.parameters import FRACTION, NON_NEGATIVE, POSITIVE, Parameter
from pipeline.explorer.data.colours import schemes
from pipeline.explorer.data.explored import Axis, ExploredRun
from pipeline.explorer.data.orbits import fixed_points
from pipeline.explorer.data.verticals import plain, verticals
from pipeline.layout.vocabulary import DIVERGED, FAILED, FREQUENCY_DIM, PENDING, grid_dim
from pipeline.products.registry import ANALYSES
from pipeline.runs.derive import AnalysedRun, prepared
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import RATES
from pipeline.store.run import RunDirectory

VIEW_FORMAT = 1
"""Of the answers; a page refuses another one."""

_LOWEST = {POSITIVE: 0.0, NON_NEGATIVE: 0.0, FRACTION: 0.0}


def describe_view(run: RunDirectory, live: bool) -> dict[str, Any]:
    """Return all that the page needs to know about a run when it loads, as JSON can say it.

    Only coordinates, the cells' status and what is kept in ``derived/`` are read. `live` says whether the page can have
    trajectories integrated while one watches. Values of states and parameters are in the model's own units.
    """
    explored = ExploredRun.open(run)
    return {
        "format": VIEW_FORMAT,
        "title": run.info.title,
        "name": _name(run),
        "digest": run.digest,
        "kind": run.spec.kind,
        "version": _version(),
        "complete": run.complete,
        "cells": _cells(explored),
        "live": live,
        "n_keep": explored.n_keep,
        "model": _model(explored),
        "axes": [_axis(explored, axis) for axis in explored.axes],
        "starts": {"dims": list(explored.start_dims), "count": _n_starts(explored)},
        "verticals": [v.describe() for v in verticals(explored)],
        "colours": [s.describe() for s in schemes(explored)],
        "has": _has(explored),
        "planes": [list(pair) for pair in planes(explored)],
        "commands": commands(explored, _name(run)),
    }


def _name(run: RunDirectory) -> str:
    files = run.info.files
    return files.local.resolve().name if files.local else files.name.rstrip("/").rpartition("/")[2]


def _version() -> str:
    from importlib import metadata

    return metadata.version("magpend")


def _cells(run: ExploredRun) -> dict[str, int]:
    committed = sum(run.plan.cells_in(task) for task in run.commits)
    counts = np.zeros(1 + max(DIVERGED, *FAILED, PENDING), np.int64)
    if committed:
        status = run.cube()["status"].values.ravel()
        found = np.bincount(status, minlength=counts.size)
        counts = found
    pending = int(counts[PENDING]) if committed else run.plan.n_cells
    return {
        "total": run.plan.n_cells,
        "pending": pending,
        "failed": int(sum(counts[code] for code in (DIVERGED, *FAILED))),
    }


def _n_starts(run: ExploredRun) -> int:
    sizes = dict(zip(run.plan.dims, run.plan.shape, strict=True))
    return math.prod(sizes[d] for d in run.start_dims)


# ---------------------------------------------------------------- the model


def _model(run: ExploredRun) -> dict[str, Any]:
    model = run.model
    return {
        "name": model.name,
        "title": model.title,
        "section": _section(model),
        "period": model.clock.period,
        "time": model.clock.unit,
        "forced": model.clock.has_drive,
        "states": [_named(s, s.on_circle, s.scale, s.rate or None) for s in model.states],
        "quantities": [_named(q, False, 1.0, None) for q in model.quantities],
        "parameters": [_parameter(run, p) for p in model.parameters],
        "portraits": [list(pair) for pair in model.portraits],
        "drawing": _drawing(run),
    }


def _named(one: Any, angle: bool, scale: float, rate: str | None) -> dict[str, Any]:
    named = {"name": one.name, "label": plain(one.symbol, one.name), "meaning": one.meaning, "unit": one.unit}
    return {**named, "angle": angle, "scale": scale, "rate": rate}


def _section(model: Model) -> str:
    return f"{model.clock.section} at {model.section}"


def _parameter(run: ExploredRun, parameter: Parameter) -> dict[str, Any]:
    """Return a parameter for the page, with its value (None if swept) and the range in which users can change it.

    This is the range of its axis; without an axis, 0.5 to 1.5 times its value, within its bounds.
    """
    swept = {a.parameter: a.values for a in run.axes if a.swept}
    if parameter.name in swept:
        values = swept[parameter.name]
        value, low, high = None, float(values.min()), float(values.max())
    else:
        value = float(run.parameters[parameter.name])
        reach = 0.5 * abs(value) or 1.0
        low = max(value - reach, _LOWEST.get(parameter.bound, -math.inf))
        high = min(value + reach, 1.0) if parameter.bound == FRACTION else value + reach
    return {
        "name": parameter.name,
        "label": plain(parameter.symbol, parameter.name),
        "meaning": parameter.meaning,
        "unit": parameter.unit,
        "value": value,
        "low": low,
        "high": high,
    }


def _drawing(run: ExploredRun) -> dict[str, Any] | None:
    drawing, model = run.model.drawing, run.model
    if drawing is None:
        return None
    values = {**{a.parameter: float(a.values[0]) for a in run.axes}, **run.parameters.as_dict()}
    moving = drawing.points(np.zeros((1, len(model.states))), values)
    return {
        "lines": [list(line) for line in drawing.lines],
        "fixed": fixed_points(model, values),
        "trace": drawing.trace,
        "unit": drawing.unit,
        "points": list(moving),
    }


# ---------------------------------------------------------------- axes, planes, results


def _axis(run: ExploredRun, axis: Axis) -> dict[str, Any]:
    factor = 1.0  # by which the page multiplies what it shows
    if axis.name == FREQUENCY_DIM:
        label = meaning = run.spec.motion.frequency_meaning
        unit = "Hz"
        if run.spec.rate == "omega":
            rate = RATES["omega"]
            label, meaning, factor = "ω", rate.meaning, rate.factor
            unit = "1" if all(state.unit == "1" for state in run.model.states) else rate.unit
    else:
        parameter = run.model.parameter(axis.parameter)
        label, unit = plain(parameter.symbol, parameter.name), parameter.unit
        meaning = parameter.meaning
    path = run.path == axis.name
    return {
        "name": axis.name,
        "parameter": axis.parameter,
        "label": label,
        "meaning": meaning,
        "unit": unit,
        "values": axis.values.tolist(),
        "factor": factor,
        "path": path,
    }


def planes(run: ExploredRun) -> list[tuple[str, str]]:
    """Return the pairs of states that the page offers as planes of initial states.

    First that of the run's own grid, then pairs of angles, then what phase portraits show.
    """
    model = run.model
    gridded = [s.name for s in model.states if grid_dim(s.name) in run.start_dims]
    found = [*itertools.combinations(gridded, 2), *itertools.combinations(model.angles, 2), *model.portraits]
    return [pair for pair in dict.fromkeys(found) if pair[0] != pair[1]]


def _has(run: ExploredRun) -> dict[str, bool]:
    return {
        "attractors": run.kept("attractors") is not None,
        "branches": run.kept("branches") is not None,
        "curves": run.bifurcation_curves() is not None,
        "atlas": run.atlas() is not None,
        "events": bool(run.kept_each("events")),
        "basins": run.kept("basins") is not None,
        "lyapunov": any(str(n).startswith("lyapunov") for n in run.cube().data_vars) or run.kept("chaos") is not None,
        "drawing": run.model.drawing is not None,
        "mirror": run.model.mirror is not None,
    }


def commands(run: ExploredRun, directory: str) -> dict[str, str]:
    """Return the command for each analysis that is not yet stored and that the run allows."""
    wanted = [name for name in ("attractors", "branches", "basins", "atlas") if run.kept(name) is None]
    return {name: f"magpend analyse {name} {shlex.quote(directory)}" for name in wanted if can_have(run, name)}


def can_have(run: ExploredRun, name: str) -> bool:
    """Return whether an analysis suits a run, with its default options."""
    try:
        prepared(AnalysedRun.of(run), ANALYSES[name], ANALYSES[name].options())
    except SpecError:
        return False
    return True
