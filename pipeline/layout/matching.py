"""Which cells of one run are cells of another: the same numbers go in, bit for bit. Pure numpy.

A cell's result depends on what it is integrated from alone, so a run can take the cells that another holds,
whatever the axes, starts and tasks of either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.layout.cells import InitialStates, Inputs, initial_states, parameter_axes
from pipeline.layout.identity import CODE, differences
from pipeline.spec.parsing import Spec
from pipeline.spec.tables import FREQUENCY

NOWHERE = -1
"""Place of a cell that a run does not have."""

_CODE = (*CODE, "compute.walking", "compute.recorded", "spec.drives")


def deciding(identity: Mapping[str, Any]) -> dict[str, Any]:
    """Part of a run's identity that decides how a cell is integrated, whatever it is integrated from.

    Left out are the cells (axes, starts, parameters), their layout, what is inferred between them, the number
    of kept sections, and the products, which have their own conditions.
    """
    spec = identity["spec"]
    integration = {name: value for name, value in spec["integration"].items() if name != "n_keep"}
    return {
        **{key: identity[key] for key in ("format", "kernel_version", "model_digest")},
        "code": {name: version for name, version in identity["code"].items() if name in _CODE},
        **{name: spec[name] for name in ("kind", "drive", "section") if name in spec},
        "integration": integration,
        **({"path": spec["continuation"]["path"]} if "continuation" in spec else {}),
    }


def unlike(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return a line for each thing that keeps the cells of one run from being those of another."""
    return differences(deciding(old), deciding(new))


@dataclass(frozen=True)
class Way:
    """The part of its path that a block of a continuation walks.

    Attributes
    ----------
    direction : str
    values : ndarray
        The whole path, in the order in which it is walked.
    first : int
        How many points of it come before the block.
    """

    direction: str
    values: np.ndarray
    first: int


def way_of(spec: Spec, block: tuple[slice, ...]) -> Way | None:
    """Return what a block walks, all in one direction; None in a sweep."""
    if spec.continuation is None:
        return None
    path, values = _path_of(spec)
    directions, part = spec.continuation.directions, block[path]
    direction = directions[block[-1].start // len(initial_states(spec.initial_conditions))]
    if direction == "down":
        return Way(direction, values[::-1], len(values) - part.stop)
    return Way(direction, values, part.start)


def _path_of(spec: Spec) -> tuple[int, np.ndarray]:
    """Number and values of the axis along which branches walk."""
    assert spec.continuation is not None
    axes = parameter_axes(spec)
    path = [a.parameter for a in axes].index(spec.continuation.path)
    return path, axes[path].values


class Finder:
    """Finds cells of a run by what they are integrated from.

    A cell of a walk depends on all that come before it. So those of walks from one initial state are the same
    up to the first point that differs, and none beyond.

    Parameters
    ----------
    spec
        Of the run that has the cells.
    """

    def __init__(self, spec: Spec) -> None:
        self._names = spec.values.names
        self._packed = spec.values.pack()
        self._hz = np.float64(np.nan if spec.frequency_hz is None else spec.frequency_hz)
        self._axes = parameter_axes(spec)
        states = initial_states(spec.initial_conditions)
        self._starts = _Grid(states) if states.grid is not None else _Rows(states)
        self._path: int | None = None
        self._directions: tuple[str, ...] = ()
        n_last = states.shape
        if spec.continuation is not None:
            self._path, self._directions = _path_of(spec)[0], spec.continuation.directions
            n_last = (len(states) * len(self._directions),)
        self.shape = (*(len(a.values) for a in self._axes), *n_last)

    def find(self, inputs: Inputs, way: Way | None = None) -> np.ndarray:
        """Return the flat index in this run of each cell, shape (branch, point), `NOWHERE` if it has it not.

        Parameters
        ----------
        inputs
            Branches as they begin, not as they go on in a later block.
        way
            What they walk; None in a sweep.
        """
        n_branches, n_points = inputs.frequency_hz.shape
        here = self._fixed(inputs)
        steps: list[np.ndarray] = []
        for i, axis in enumerate(self._axes):
            if i == self._path:
                steps.append(np.zeros((n_branches, 1), np.int64))
                continue
            step, on = _on_axis(axis.values, self._values(inputs, axis.parameter))
            steps.append(step[:, None])
            here &= on
        start, on = self._starts.find(inputs.initial_states)
        here = np.repeat((here & on)[:, None], n_points, axis=1)
        if way is not None:
            assert self._path is not None
            if way.direction not in self._directions:
                return np.full(here.shape, NOWHERE)
            start = start + self._directions.index(way.direction) * len(self._starts)
            own = self._axes[self._path].values
            point = way.first + np.arange(n_points)
            here &= point < _n_alike(own if way.direction == "up" else own[::-1], way.values)
            point = np.minimum(point, len(own) - 1)
            steps[self._path] = point if way.direction == "up" else len(own) - 1 - point
        n_starts = math.prod(self.shape[len(self._axes) :])
        place = np.zeros((n_branches, n_points), np.int64)
        for axis, step in zip(self._axes, steps, strict=True):
            place = place * len(axis.values) + step
        return np.where(here, place * n_starts + start[:, None], NOWHERE)

    def _fixed(self, inputs: Inputs) -> np.ndarray:
        """Which branches have this run's values of all that it does not sweep."""
        swept = {a.parameter for a in self._axes}
        fixed = [i for i, name in enumerate(self._names) if name not in swept]
        here = (_bits(inputs.parameters[:, 0, fixed]) == _bits(self._packed[fixed])).all(axis=1)
        if FREQUENCY not in swept:
            here &= _bits(inputs.frequency_hz[:, 0]) == _bits(self._hz)
        return np.asarray(here)

    def _values(self, inputs: Inputs, name: str) -> np.ndarray:
        if name == FREQUENCY:
            return inputs.frequency_hz[:, 0]
        return inputs.parameters[:, 0, self._names.index(name)]


def _n_alike(old: np.ndarray, new: np.ndarray) -> int:
    """Number of points at the begin of two paths that are the same."""
    n = min(len(old), len(new))
    differ = np.flatnonzero(_bits(old[:n]) != _bits(new[:n]))
    return int(differ[0]) if len(differ) else n


class _Grid:
    """Initial states of a grid."""

    def __init__(self, states: InitialStates) -> None:
        self._states = states

    def __len__(self) -> int:
        return len(self._states)

    def find(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat index of each state, and whether it is there."""
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
    """Initial states of a list or of samples."""

    def __init__(self, states: InitialStates) -> None:
        self._table = states.at(np.arange(len(states)))
        marks = _marks(self._table)
        self._order = np.argsort(marks, kind="stable")
        self._marks = marks[self._order]

    def __len__(self) -> int:
        return len(self._table)

    def find(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flat index of each state, the first of equal ones, and whether it is there."""
        place = np.searchsorted(self._marks, _marks(wanted))
        row = self._order[np.minimum(place, len(self._order) - 1)]
        # a mark that two states share makes the second one absent, never another
        return row, (_bits(self._table[row]) == _bits(wanted)).all(axis=1)


def _bits(values: Any) -> np.ndarray:
    """Numbers as they are stored: 0.0 and -0.0 differ, NaN is NaN."""
    return np.asarray(np.ascontiguousarray(values, np.float64).view(np.int64)).reshape(np.shape(values))


def _on_axis(axis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index of each value on an axis in rising order, and whether it is there."""
    step = np.minimum(np.searchsorted(axis, values), len(axis) - 1)
    return step, _bits(axis[step]) == _bits(values)


def _marks(rows: np.ndarray) -> np.ndarray:
    """One number for each row, the same for equal ones."""
    mark = np.zeros(len(rows), np.uint64)
    for column in _bits(rows).view(np.uint64).T:
        mark = (mark ^ column) * np.uint64(0x9E3779B97F4A7C15)
        mark ^= mark >> np.uint64(29)
    return mark


def apart(old: Spec, new: Spec) -> list[str]:
    """Say why two runs that are integrated alike have no cell in common.

    Returns
    -------
    list of str
        A line for each parameter, and for the starts, of which they share no value.
    """
    lines = []
    left, right = _swept(old), _swept(new)
    for name in left:
        if not np.isin(_bits(right[name]), _bits(left[name])).any():
            lines.append(f"{name}: {_said(left[name])} there, {_said(right[name])} now; no value is the same")
    states = initial_states(new.initial_conditions)
    own = initial_states(old.initial_conditions)
    starts = _Grid(own) if own.grid is not None else _Rows(own)
    if not starts.find(states.at(np.arange(len(states))))[1].any():
        lines.append("initial_conditions: no initial state is the same, to the last bit")
    return lines or ["there is no cell in which all parameters and the initial state are the same"]


def _swept(spec: Spec) -> dict[str, np.ndarray]:
    """All values of each parameter and of the frequency."""
    hz = np.nan if spec.frequency_hz is None else spec.frequency_hz
    values = {
        FREQUENCY: np.array([hz]),
        **dict(zip(spec.values.names, spec.values.pack()[:, None], strict=True)),
    }
    return values | {axis.parameter: axis.values for axis in parameter_axes(spec)}


def _said(values: np.ndarray) -> str:
    if len(values) == 1:
        return repr(float(values[0]))
    return f"{float(values[0])!r} to {float(values[-1])!r} in {len(values)} values"
