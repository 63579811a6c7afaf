"""Write ends of attractors, curves, lines and changes of a plane as variables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.atlas.effects import Effect
from pipeline.analysis.atlas.ends import GOES_ON, SHRINKS, TOUCHES, End
from pipeline.analysis.atlas.lines import Line
from pipeline.analysis.atlas.plane import Array, Change, Plane
from pipeline.analysis.atlas.searching import Searched
from pipeline.analysis.atlas.verdicts import Verdict
from pipeline.analysis.branches.searching import VERDICTS
from pipeline.analysis.events.kinds import EVENTS
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.results.ragged import padded

WHATS = (*EVENTS, GOES_ON, SHRINKS, TOUCHES)
"""What explains a change, in the order of the codes in results."""


def ends_dataset(
    plane: Plane, wanted: Sequence[Sequence[float]], ends: Sequence[End], states: Sequence[str]
) -> xr.Dataset:
    """Return ends between neighbouring points as rows."""
    rows, n = np.array([int(one[0]) for one in wanted], int), len(states)
    places = plane.values[plane.node[rows]].copy()
    for k, (one, end) in enumerate(zip(wanted, ends, strict=True)):
        places[k, int(one[1])] = end.value
    empty = np.full(n, np.nan)
    variables: dict[str, Any] = {
        "set_row": ("end", rows.astype(np.int32)),
        "axis": ("end", np.array([int(one[1]) for one in wanted], np.int8)),
        "what": ("end", np.array([WHATS.index(end.what) for end in ends], np.int8), code_flags(WHATS)),
        "end_period": ("end", np.array([end.period for end in ends], np.int32)),
        "end_first": ("end", places[:, 0]),
        "end_second": ("end", places[:, 1]),
        "end_error": ("end", [e.error / plane.size[int(w[1])] for w, e in zip(wanted, ends, strict=True)]),
        "end_section": (
            ("end", "state"),
            np.array([empty if e.state is None else e.state for e in ends]).reshape(-1, n),
        ),
        "why": ("end", np.array([end.why for end in ends], object)),
    }
    attrs = {"first_parameter": plane.names[0], "second_parameter": plane.names[1]}
    return xr.Dataset(variables, {"state": list(states)}, attrs)


def of_curves(curves: xr.Dataset, others: Sequence[Array], told: Sequence[Effect]) -> dict[str, Any]:
    """Return what curves do to attractors."""
    unstable = np.full((curves.sizes["curve"], curves.sizes["point"]), -1, np.int8)
    for one, row in zip(others, unstable, strict=True):
        row[: len(one)] = one
    return {
        "others_unstable": (("curve", "point"), unstable),
        "n_crossed": ("curve", np.array([one.n_crossed for one in told], np.int32)),
        "n_effects": ("curve", np.array([one.n_effects for one in told], np.int32)),
        "effect": ("curve", np.array([one.why for one in told], object)),
    }


def of_searched(plane: Plane, searched: Sequence[Searched]) -> dict[str, Any]:
    """Return the points at which all orbits were searched; nothing without any."""
    if not searched:
        return {}
    places = plane.values[[one.node for one in searched]]
    codes = np.array([VERDICTS.index(one.verdict) for one in searched], np.int8)
    return {
        "searched_first": ("searched", places[:, 0]),
        "searched_second": ("searched", places[:, 1]),
        "n_orbits": ("searched", np.array([one.n_orbits for one in searched], np.int32)),
        "n_hidden": ("searched", np.array([len(one.hidden) for one in searched], np.int32)),
        "index_verdict": ("searched", codes, code_flags(VERDICTS)),
    }


def of_lines(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the lines."""
    places = padded([line.places for line in lines], 2)
    return {
        "line_what": ("line", np.array([WHATS.index(line.what) for line in lines], np.int8), code_flags(WHATS)),
        "line_period": ("line", np.array([line.period for line in lines], np.int32)),
        "line_size": ("line", np.array([len(line.places) for line in lines], np.int32)),
        "line_first": (("line", "vertex"), places[..., 0]),
        "line_second": (("line", "vertex"), places[..., 1]),
    }


def of_changes(plane: Plane, changes: Sequence[Change], found: Sequence[Verdict]) -> dict[str, Any]:
    """Return the changes with the verdicts on them."""
    row, other = (np.array([getattr(one, name) for one in changes], int) for name in ("row", "other"))
    after = np.where(other >= 0, plane.period[other], -1) if len(row) else row
    places = np.array([one.place for one in found]).reshape(-1, 2)
    variables: dict[str, Any] = {
        "change_attractor": ("change", plane.attractor[row].astype(np.int32)),
        "change_set": ("change", plane.kind[row].astype(np.int8), code_flags(SETS)),
        "change_period": ("change", plane.period[row].astype(np.int32)),
        "period_after": ("change", after.astype(np.int32)),
        "what": ("change", np.array([WHATS.index(one.what) for one in found], np.int8), code_flags(WHATS)),
        "on_curve": ("change", np.array([one.curve for one in found], np.int32)),
        "on_line": ("change", np.array([one.line for one in found], np.int32)),
        "change_cells": ("change", plane.cells[row].astype(np.int32)),
        "why": ("change", np.array([one.why for one in found], object)),
        "change_error": ("change", np.array([one.error for one in found], float)),
    }
    for axis, which in enumerate(("first", "second")):
        variables[f"change_{which}"] = ("change", places[:, axis])
        for role in ("here", "there"):
            nodes = np.array([getattr(one, role) for one in changes], int)
            variables[f"{role}_{which}"] = ("change", plane.values[nodes, axis])
    return variables
