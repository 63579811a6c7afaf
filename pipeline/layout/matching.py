"""Which cells of one run are cells of another: the same numbers go in, bit for bit. Pure numpy.

A cell's result depends on what it is integrated from alone, so a run can take the cells that another holds,
whatever the axes, starts and tasks of either.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.layout.cells import InitialStates, Inputs, initial_states, parameter_axes
from pipeline.layout.identity import CODE, differences
from pipeline.spec.parsing import Spec
from pipeline.spec.tables import FREQUENCY

NOWHERE = -1
"""Place of a cell that a run does not have."""

_CODE = (*CODE, "compute.recorded", "spec.drives")


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
    }


def unlike(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return a line for each thing that keeps the cells of one run from being those of another."""
    return differences(deciding(old), deciding(new))


class Finder:
    """Finds cells of a sweep by what they are integrated from.

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
        self.shape = (*(len(a.values) for a in self._axes), *states.shape)

    def find(self, inputs: Inputs) -> np.ndarray:
        """Return the flat index in this run of each cell, `NOWHERE` if it is none of its cells.

        Parameters
        ----------
        inputs
            Branches of one point each.
        """
        n = len(inputs.initial_states)
        parameters, frequency = inputs.parameters[:, 0], inputs.frequency_hz[:, 0]
        swept = {a.parameter for a in self._axes}
        fixed = [i for i, name in enumerate(self._names) if name not in swept]
        here = (_bits(parameters[:, fixed]) == _bits(self._packed[fixed])).all(axis=1)
        if FREQUENCY not in swept:
            here &= _bits(frequency) == _bits(self._hz)
        place = np.zeros(n, np.int64)
        for axis in self._axes:
            is_frequency = axis.parameter == FREQUENCY
            values = frequency if is_frequency else parameters[:, self._names.index(axis.parameter)]
            step, on = _on_axis(axis.values, values)
            place, here = place * len(axis.values) + step, here & on
        start, on = self._starts.find(inputs.initial_states)
        return np.where(here & on, place * len(self._starts) + start, NOWHERE)


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
