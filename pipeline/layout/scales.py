"""Find the sizes of a run's states from its starts and a short motion, where the text of its model gives no scale.

A state of 1e-9 m or of 1e9 persons would be compared with tolerances made for numbers of the order of one. Its size
becomes its scale, and the unit of its absolute tolerance and of its bound. It is a power of ten, and 1 for all that is
between 0.1 and 100 (`magpend_core.natural`). A run keeps its sizes in the text of its model, as the key ``size``.

The size is between the largest value of the later motion (a tenth of the largest value at all, if that is more) and
the largest value at all: wide starts do not hide a small attractor, and a state that comes to rest at 0 keeps about the
size that it began with. The motion is integrated with numpy as the text is written; only its order of magnitude counts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import rates_of, value_of
from magpend_core.natural import natural_size
from pipeline.layout.cells import initial_states
from pipeline.layout.domains import parameter_points
from pipeline.specification.models import KEPT
from pipeline.specification.spec import Spec
from pipeline.specification.tables import FREQUENCY

MOST_CELLS, MOST_POINTS = 32, 8
"""Most cells whose motion is integrated, and most parameter points that they are spread over."""

ATTEMPTS, TOLERANCE = 300, 1e-2
"""Attempted steps, and their error relative to the largest values so far."""

PER_PERIOD = 12
"""Least number of steps per period of a drive."""

GROWS = 1.2
"""A state whose last quarter of the motion exceeds all before by this factor is on its way to somewhere else."""


def with_sizes(spec: Spec, kept: Spec | None = None) -> Spec:
    """Return a specification with the sizes of the states in the text of its model; unchanged if all are 1.

    Parameters
    ----------
    spec
        Any specification.
    kept
        Specification that a run keeps: its sizes are taken if its model has these states.
    """
    model = load_model(spec.reference)
    if not isinstance(model, TextModel) or model.shipped:
        return spec
    given = model.definition.table["states"]
    open_states = [s.name for s in model.states if not s.on_circle and not _says(given[s.name])]
    if not open_states:
        return spec
    old = None if kept is None else load_model(kept.reference)
    if old is not None and old.state_names == model.state_names:
        found = {s.name: s.size for s in old.states}
    else:
        found = dict(zip(model.state_names, sizes_of_states(spec, model), strict=True))
    changed = {name: found[name] for name in open_states if found[name] != 1.0}
    if not changed:
        return spec
    states = {name: {**_entry(given[name]), "size": size} for name, size in changed.items()}
    return Spec.parse({**spec.as_dict(), "model": {**model.definition.table, "states": {**given, **states}}}, KEPT)


def size_remarks(spec: Spec) -> list[str]:
    """Return a line that tells the sizes other than 1 that a run's motion gave its states; empty if all are 1."""
    found = [f"{s.name} {s.size:g} {s.unit}" for s in spec.model.states if s.size != 1.0]
    return [f"scales from the motion: {', '.join(found)} (a state's scale = ... replaces its own)"] if found else []


def _entry(value: Any) -> dict[str, Any]:
    return dict(value) if isinstance(value, Mapping) else {"unit": value}


def _says(value: Any) -> bool:
    return isinstance(value, Mapping) and bool({"scale", "size"} & set(value))


def sizes_of_states(spec: Spec, model: TextModel) -> list[float]:
    """Return the size of each state of a model in a run: of its starts, and of a short motion from some of them."""
    points = parameter_points(spec)
    points = [points[i] for i in np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).astype(int))]
    states = initial_states(spec.initial_conditions)
    chosen = np.unique(np.linspace(0, len(states) - 1, MOST_CELLS // len(points)).astype(np.int64))
    y = np.tile(states.at(chosen), (len(points), 1)).T
    columns: dict[str, Any] = {"pi": np.pi}
    for name in (*model.parameter_names, FREQUENCY):
        columns[name] = np.repeat(
            [float(p[name] or 1.0) if name == FREQUENCY else p[name] for p in points], len(chosen)
        )
    columns["f"] = columns.pop(FREQUENCY)
    n_periods = spec.integration.n_transient + spec.integration.n_keep
    with np.errstate(all="ignore"):
        times, path = _Motion(model.definition, columns).path(y, n_periods / columns["f"])
    return [natural_size(*_size(times, np.abs(own))) for own in path.transpose(1, 0, 2)]


def _size(times: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the bounds of a state's size, from its absolute values (time, cell) on paths that may end in NaN."""
    whole = np.isfinite(values).all(axis=0)
    last = times[-1]
    late = np.where(times >= 0.75 * last, values, 0.0).max(axis=0)
    early = np.where(times < 0.75 * last, values, 0.0).max(axis=0)
    settles = whole & (late <= GROWS * early)
    if not settles.any():
        start = float(values[0].max())
        return start, start
    high = float(values[:, settles].max())
    low = float(np.where(times >= 0.5 * last, values, 0.0)[:, settles].max())
    return max(low, 0.1 * high), high


class _Motion:
    """The motion of some cells by the method of Bogacki and Shampine (Appl. Math. Lett. 2, 1989, 321), each with steps
    of its own.
    """

    def __init__(self, definition: Definition, columns: Mapping[str, Any]) -> None:
        self.definition, self.columns = definition, columns

    def _known(self, t: np.ndarray, y: np.ndarray) -> dict[str, Any]:
        phase = t * self.columns["f"]
        states = dict(zip(self.definition.equations, y, strict=True))
        return {**self.columns, **states, "t": t, "phase": phase - np.floor(phase)}

    def _rates(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        rates = rates_of(self.definition, self._known(t, y))
        return np.array([np.broadcast_to(rate, t.shape) for rate in rates.values()], np.float64)

    def path(self, y: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return times (step, cell) and states (step, state, cell) from the starts (state, cell) on.

        A cell that has arrived at its end, or fails, stays where it is.
        """
        t, slope = np.zeros(y.shape[1]), self._rates(np.zeros(y.shape[1]), y)
        longest = ends / PER_PERIOD if self.definition.autonomous else 1.0 / (self.columns["f"] * PER_PERIOD)
        peak = np.abs(y).max(axis=1, keepdims=True)
        pace = np.where(peak > 0.0, np.abs(slope) / peak, 0.0).max(axis=0)
        h = np.minimum(longest, np.where(pace > 0.0, TOLERANCE / pace, TOLERANCE * longest))
        times, path = [t], [y]
        for _ in range(ATTEMPTS):
            h = np.minimum(h, ends - t)
            if not (h > 0.0).any():
                break
            k2 = self._rates(t + 0.5 * h, y + 0.5 * h * slope)
            k3 = self._rates(t + 0.75 * h, y + 0.75 * h * k2)
            after = y + h * (2.0 * slope + 3.0 * k2 + 4.0 * k3) / 9.0
            k4 = self._rates(t + h, after)
            error = np.abs(h * (-5.0 * slope + 6.0 * k2 + 8.0 * k3 - 9.0 * k4) / 72.0)
            size = np.maximum(np.nanmax(np.where(np.isfinite(y), np.abs(y), 0.0), axis=1, keepdims=True), peak)
            size = np.where(size > 0.0, size, np.nanmax(np.abs(after), axis=1, keepdims=True))
            worst = np.where(size > 0.0, error / (TOLERANCE * size), 0.0).max(axis=0)
            taken = np.isfinite(after).all(axis=0) & np.isfinite(k4).all(axis=0) & (worst <= 1.0)
            landed = self._after_impacts(t + h, y, after)
            if landed is not after:
                k4 = self._rates(t + h, landed)
            factor = np.clip(0.9 * np.nan_to_num(worst, nan=1e9, posinf=1e9).clip(1e-9) ** (-1.0 / 3.0), 0.2, 4.0)
            y, slope = np.where(taken, landed, y), np.where(taken, k4, slope)
            t, h = np.where(taken, t + h, t), np.minimum(h * np.where(taken, factor, np.minimum(factor, 0.5)), longest)
            peak = np.maximum(peak, np.abs(y).max(axis=1, keepdims=True))
            times.append(t)
            path.append(y)
        stuck = (h <= 1e-12 * longest) & (t < ends)
        path[-1] = np.where(stuck, np.nan, path[-1])
        return np.array(times), np.array(path)

    def _after_impacts(self, t: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Return the states after the impacts of a step: where a surface is crossed, or lies behind and falls further
        back.
        """
        names = list(self.definition.equations)
        for impact in self.definition.impacts:
            first, last = (self._value(impact.of, t, y) * impact.direction for y in (before, after))
            hit = (last > 0.0) & (last > first)
            if hit.any():
                moved = after.copy()
                for name, tree in impact.set.items():
                    moved[names.index(name)] = np.where(hit, self._value(tree, t, after), moved[names.index(name)])
                after = moved
        return after

    def _value(self, tree: Any, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        known = self._known(t, y)
        for name in self.definition.used([tree]):
            if name in self.definition.define:
                known[name] = value_of(self.definition.define[name], known)
        return np.broadcast_to(value_of(tree, known), t.shape)
