"""Find cells with bitwise equal inputs in two runs, so that one run can take over the other's results.

A cell's result depends on its inputs alone: parameters, initial state, and how it is integrated. A run can
therefore take over another run's cells, even if their axes, starts and tasks differ.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.layout.cells import CellMap, InitialStates
from pipeline.layout.identity import differences, numbered
from pipeline.motion.steady import Inputs
from pipeline.specification.noise import NoiseTable
from pipeline.specification.tables import FREQUENCY

NOWHERE = -1
"""Index that stands for a cell that the run does not have."""


def deciding(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a run's identity that affects how a cell is integrated.

    It leaves out the cells themselves (axes, starts, parameters), their layout, the rules of inference
    between them, the number of kept sections, and the products, which have their own conditions.
    """
    spec = identity["spec"]
    integration = {name: value for name, value in spec["integration"].items() if name != "n_keep"}
    return {
        **{key: identity[key] for key in ("format", "model_digest")},
        "versions": {name: identity["versions"][name] for name in ("engine", "cells")},
        **{name: spec[name] for name in ("kind", "drive", "section", "drift") if name in spec},
        "integration": integration,
        **({"noise": NoiseTable.model_validate(spec["noise"]).deciding} if "noise" in spec else {}),
        **({"path": spec["continuation"]["path"]} if "continuation" in spec else {}),
    }


def unlike(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return a line of text for each integration setting that differs between two runs; if any differs, no cell is
    shared.
    """
    return differences(deciding(numbered(old)), deciding(new))


@dataclass(frozen=True)
class Way:
    """Order in which a continuation visits its parameter values, and the position of a block of cells in this order."""

    direction: str  # ``"up"`` or ``"down"``
    values: np.ndarray  # the whole path, in the order in which it is walked
    first: int  # number of points on the path before the block


def way_of(cells: CellMap, block: tuple[slice, ...]) -> Way | None:
    """Return the order in which a block of cells of a continuation visits the parameter values. Return None for a
    sweep.
    """
    if cells.walk is None or cells.path is None:
        return None
    values, part = cells.axes[cells.path].values, block[cells.path]
    direction = cells.walk.directions[block[-1].start // len(cells.states)]
    if direction == "down":
        return Way(direction, values[::-1], len(values) - part.stop)
    return Way(direction, values, part.start)


class Finder:
    """Search for cells of a run by their inputs: parameter values and initial state.

    A cell of a continuation depends on all cells before it. Two continuations from one initial state
    therefore agree up to the first parameter value that differs, and nowhere beyond.

    Parameters
    ----------
    cells
        Cells of the run.
    """

    def __init__(self, cells: CellMap) -> None:
        self.cells = cells
        self._starts = _index(cells.states)

    def find(self, inputs: Inputs, way: Way | None = None) -> np.ndarray:
        """Return the flat index in this run of each given cell, shape (branch, point); `NOWHERE` for a cell not in this
        run.

        Parameters
        ----------
        inputs
            Branches with the initial states from which they begin, not those of a later block.
        way
            The path of the branches; None in a sweep.
        """
        n_branches, n_points = inputs.frequency_hz.shape
        here = self._fixed(inputs)
        steps: list[np.ndarray] = []
        axes, path = self.cells.axes, self.cells.path
        for i, axis in enumerate(axes):
            if i == path:
                steps.append(np.zeros((n_branches, 1), np.int64))
                continue
            step, on = _on_axis(axis.values, self._values(inputs, axis.parameter))
            steps.append(step[:, None])
            here &= on
        if self.cells.origins.trees:  # what is counted from an expression is not found again to the last bit
            return np.full((n_branches, n_points), NOWHERE)
        start, on = self._starts.find(inputs.initial_states)
        here = np.repeat((here & on)[:, None], n_points, axis=1)
        if way is not None:
            assert path is not None
            assert self.cells.walk is not None
            directions, own = self.cells.walk.directions, axes[path].values
            if way.direction not in directions:
                return np.full(here.shape, NOWHERE)
            start = start + directions.index(way.direction) * len(self._starts)
            point = way.first + np.arange(n_points)
            here &= point < _n_alike(own if way.direction == "up" else own[::-1], way.values)
            point = np.minimum(point, len(own) - 1)
            steps[path] = point if way.direction == "up" else len(own) - 1 - point
        n_starts = math.prod(self.cells.shape[len(axes) :])
        place = np.zeros((n_branches, n_points), np.int64)
        for axis, step in zip(axes, steps, strict=True):
            place = place * len(axis.values) + step
        return np.where(here, place * n_starts + start[:, None], NOWHERE)

    def _fixed(self, inputs: Inputs) -> np.ndarray:
        """Return a mask of the branches that agree with this run in every parameter that this run does not sweep."""
        swept = {a.parameter for a in self.cells.axes}
        fixed = [i for i, name in enumerate(self.cells.names) if name not in swept]
        here = (_bits(inputs.parameters[:, 0, fixed]) == _bits(self.cells.packed[fixed])).all(axis=1)
        if FREQUENCY not in swept:
            here &= _bits(inputs.frequency_hz[:, 0]) == _bits(self.cells.fixed_hz)
        return np.asarray(here)

    def _values(self, inputs: Inputs, name: str) -> np.ndarray:
        if name == FREQUENCY:
            return inputs.frequency_hz[:, 0]
        return inputs.parameters[:, 0, self.cells.names.index(name)]


def _n_alike(old: np.ndarray, new: np.ndarray) -> int:
    """Return the number of leading parameter values that two continuation paths have in common."""
    n = min(len(old), len(new))
    differ = np.flatnonzero(_bits(old[:n]) != _bits(new[:n]))
    return int(differ[0]) if len(differ) else n


class _Grid:
    """Search index over the initial states of a grid."""

    def __init__(self, states: InitialStates) -> None:
        self._states = states

    def __len__(self) -> int:
        return len(self._states)

    def find(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert self._states.grid is not None
        here = np.ones(len(wanted), bool)
        place = np.zeros(len(wanted), np.int64)
        # the dims of a grid are in the order of the states that span them
        for i, column in enumerate(self._states.columns):
            if column.ndim == 0:
                here &= _bits(wanted[:, i]) == _bits(column)
                continue
            step, on = _on_axis(column, wanted[:, i])
            place, here = place * len(column) + step, here & on
        return place, here


class _Rows:
    """Search index over the initial states of a list or of samples."""

    def __init__(self, states: InitialStates) -> None:
        self._table = states.at(np.arange(len(states)))
        marks = _marks(self._table)
        self._order = np.argsort(marks, kind="stable")
        self._marks = marks[self._order]

    def __len__(self) -> int:
        return len(self._table)

    def find(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place = np.searchsorted(self._marks, _marks(wanted))
        row = self._order[np.minimum(place, len(self._order) - 1)]
        # if two different states share a mark, the second one is not found; a wrong one is never returned
        return row, (_bits(self._table[row]) == _bits(wanted)).all(axis=1)


def _index(states: InitialStates) -> _Grid | _Rows:
    return _Rows(states) if states.grid is None else _Grid(states)


def _bits(values: Any) -> np.ndarray:
    """Return the bit patterns of floats as integers. In this form 0.0 and -0.0 differ, and NaNs with the same bits are
    equal.
    """
    return np.asarray(np.ascontiguousarray(values, np.float64).view(np.int64)).reshape(np.shape(values))


def _on_axis(axis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = np.minimum(np.searchsorted(axis, values), len(axis) - 1)
    return step, _bits(axis[step]) == _bits(values)


def _marks(rows: np.ndarray) -> np.ndarray:
    """Return a hash of each row of an array; equal rows have equal hashes."""
    mark = np.zeros(len(rows), np.uint64)
    for column in _bits(rows).view(np.uint64).T:
        mark = (mark ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mark ^= mark >> np.uint64(29)
    return mark


def apart(old: CellMap, new: CellMap) -> list[str]:
    """Return a line of text per reason why two runs with equal integration settings have no cell in common.

    Returns
    -------
    list of str
        A line for each parameter without a common value, and for the starts if none is common.
    """
    lines = []
    left, right = _swept(old), _swept(new)
    for name in left:
        if not np.isin(_bits(right[name]), _bits(left[name])).any():
            lines.append(f"{name}: {_said(left[name])} there, {_said(right[name])} now; no value is the same")
    if old.origins.trees:
        lines.append("initial_conditions: starts with an origin there, whose cells are not taken by other runs")
    elif not _index(old.states).find(new.states.at(np.arange(len(new.states))))[1].any():
        lines.append("initial_conditions: no initial state is the same, to the last bit")
    return lines or ["there is no cell in which all parameters and the initial state are the same"]


def _swept(cells: CellMap) -> dict[str, np.ndarray]:
    """Return all values of each parameter and of the drive frequency in a run, by name."""
    values = {FREQUENCY: np.array([cells.fixed_hz]), **dict(zip(cells.names, cells.packed[:, None], strict=True))}
    return values | {axis.parameter: axis.values for axis in cells.axes}


def _said(values: np.ndarray) -> str:
    if len(values) == 1:
        return repr(float(values[0]))
    return f"{float(values[0])!r} to {float(values[-1])!r} in {len(values)} values"
