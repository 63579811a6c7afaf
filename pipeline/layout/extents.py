"""Find the sizes of a run's states and the extents of their motion, before the run begins.

Two numbers of a state have different uses. Its *size* is the unit of its absolute tolerance and of its bound: the power
of ten nearest to its largest values, and 1 for all that is between 0.1 and 100 (`magpend_core.sizes`). Its *motion* is
the range of its values, by which analyses measure differences: it is not rounded, and does not depend on where the zero
of the state is. A run keeps both in the text of its model, as the keys ``size`` and ``motion``.

Both come from the later motion of some cells, so that wide starts do not hide a small attractor; a state that comes to
rest keeps a share of the motion that led there. The motion is integrated with numpy as the text is written, in steps
that are the same in any units and from any zero; explicitly, or implicitly where that comes much farther.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.keys import flat
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import rates_of, value_of
from magpend_core.sizes import natural_size
from pipeline.layout.cells import initial_states
from pipeline.layout.evaluation import origins_at, parameter_points
from pipeline.specification.models import KEPT
from pipeline.specification.spec import Spec
from pipeline.specification.tables import FREQUENCY

MOST_MOVED, MOST_POINTS = 32, 8
"""Most cells whose motion is integrated, and most parameter points that they are spread over."""

ATTEMPTS = 400
"""Attempted steps or iterates."""

LEAVES_BY = 1.2
"""A state whose later motion leaves the range of the earlier one by this factor is on its way to somewhere else."""

FARTHER = 10.0
"""Factor by which implicit steps must come farther than as many explicit ones to be taken in their place."""

MOST_IMPLICIT = 16
"""Most states of a system whose motion may be followed implicitly: an implicit step takes a rate for each of them."""

LEAST_OF_MOTION = 0.1
"""Least share of the whole motion, or of the largest value, that counts: more than what errors of the steps move."""

LEAST_EXTENT = 1e-9
"""Extent of a motion, relative to its largest value, below which it is rounding."""


def with_sizes(spec: Spec, kept: Spec | None = None) -> Spec:
    """Return a specification with the sizes of the states and their motion in the text of its model.

    Parameters
    ----------
    spec
        Any specification.
    kept
        Specification that a run keeps: its sizes and its motion are taken if its model has these states.
    """
    model = load_model(spec.reference)
    if not isinstance(model, TextModel) or model.shipped:
        return spec
    given = flat(model.definition.table["states"])
    open_states = [s.name for s in model.states if not s.on_circle and not _says(given[s.name])]
    if not open_states:
        return spec
    old = None if kept is None else load_model(kept.reference)
    if old is not None and old.state_names == model.state_names:
        found = {s.name: (s.size, s.motion) for s in old.states}
    else:
        found = _measured(spec, model)
    states = {name: _entry(given[name], *found[name]) for name in open_states}
    if all(given[name] == entry for name, entry in states.items()):
        return spec
    return Spec.parse({**spec.as_dict(), "model": {**model.definition.table, "states": {**given, **states}}}, KEPT)


def size_remarks(spec: Spec) -> list[str]:
    """Return a line that tells the sizes other than 1 that a run's motion gave its states; empty if all are 1."""
    found = ", ".join(f"{s.name} {s.size:g} {s.unit}" for s in spec.model.states if s.size != 1.0)
    return [f"units of atol from the motion: {found} (a state's scale = ... replaces its own)"] if found else []


def _entry(value: Any, size: float, motion: tuple[float, float] | None) -> Any:
    """Return the text of a state with its size, unless it is 1, and its motion, unless it does not move."""
    found: dict[str, Any] = {} if size == 1.0 else {"size": size}
    if motion is not None:
        found["motion"] = list(motion)
    return {**(value if isinstance(value, Mapping) else {"unit": value}), **found} if found else value


def _says(value: Any) -> bool:
    return isinstance(value, Mapping) and bool({"scale", "size", "motion"} & set(value))


def _measured(spec: Spec, model: TextModel) -> dict[str, tuple[float, tuple[float, float] | None]]:
    """Return the size of each state of a model in a run, and the least and largest value of its motion.

    The motion is None for a state that does not move.
    """
    points = parameter_points(spec)
    points = [points[i] for i in np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).astype(int))]
    states = initial_states(spec.initial_conditions)
    chosen = np.unique(np.linspace(0, len(states) - 1, MOST_MOVED // len(points)).astype(np.int64))
    y = (states.at(chosen) + origins_at(spec, points)[:, None]).reshape(-1, len(model.states)).T
    columns: dict[str, Any] = {"pi": np.pi}
    for name in (*model.parameter_names, FREQUENCY):
        columns[name] = np.repeat(
            [float(p[name] or 1.0) if name == FREQUENCY else p[name] for p in points], len(chosen)
        )
    frequency = columns.pop(FREQUENCY)
    n_periods = spec.integration.n_transient + spec.integration.n_keep
    motion, seconds = _Motion(model.definition, frequency, columns), n_periods / frequency
    with np.errstate(all="ignore"):
        times, path = motion.followed(y, seconds) if model.clock.is_continuous else motion.iterated(y, n_periods)
        own = [(natural_size(*_size(times, np.abs(x))), _extent(times, x)) for x in path.transpose(1, 0, 2)]
    return dict(zip(model.state_names, own, strict=True))


def _size(times: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the bounds of a state's size, from its absolute values (time, cell) on paths that may end in NaN."""
    whole = np.isfinite(values).all(axis=0)
    last = times[-1]
    late = np.where(times >= 0.75 * last, values, 0.0).max(axis=0)
    early = np.where(times < 0.75 * last, values, 0.0).max(axis=0)
    settles = whole & (late <= LEAVES_BY * early)
    if not settles.any():
        start = float(values[0].max())
        return start, start
    high = float(values[:, settles].max())
    low = float(np.where(times >= 0.5 * last, values, 0.0)[:, settles].max())
    return max(low, LEAST_OF_MOTION * high), high


def _extent(times: np.ndarray, values: np.ndarray) -> tuple[float, float] | None:
    """Return the least and the largest value of a state's later motion, from its values (time, cell) on paths that may
    end in NaN; None if it does not move.

    Paths that still leave their earlier range count, with their earlier half, if there are no others.
    """
    is_late = times >= 0.5 * times[-1]
    early, late = _range(values, ~is_late), _range(values, is_late)
    more = (LEAVES_BY - 1.0) * (early[1] - early[0])
    settles = np.isfinite(values).all(axis=0) & (late[0] >= early[0] - more) & (late[1] <= early[1] + more)
    if settles.any():
        low, high = late[0][settles].min(), late[1][settles].max()
    else:
        low, high = early[0].min(), early[1].max()
        settles = np.isfinite(values[0])
    short = LEAST_OF_MOTION * (max(high, early[1][settles].max()) - min(low, early[0][settles].min())) - (high - low)
    if short > 0.0:
        low, high = low - 0.5 * short, high + 0.5 * short
    return (float(low), float(high)) if high - low > LEAST_EXTENT * max(abs(low), abs(high)) else None


def _range(values: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest of each cell's values (time, cell) that are chosen and finite."""
    chosen = where & np.isfinite(values)
    return np.where(chosen, values, np.inf).min(axis=0), np.where(chosen, values, -np.inf).max(axis=0)


class _Motion:
    """Integrate the motion of some cells, each in steps of its own.

    Explicit steps are those of Bogacki and Shampine (Appl. Math. Lett. 2, 1989, 321), implicit ones those of Shampine
    and Reichelt (SIAM J. Sci. Comput. 18, 1997, 1, section 3.1).
    """

    def __init__(self, definition: Definition, frequency: np.ndarray, columns: Mapping[str, Any]) -> None:
        self.definition, self.frequency, self.columns = definition, frequency, columns

    def _known(self, t: np.ndarray, y: np.ndarray) -> dict[str, Any]:
        phase = t * self.frequency
        states = dict(zip(self.definition.equations, y, strict=True))
        timed = {"f": self.frequency, "t": t, "phase": phase - np.floor(phase)}
        return {**timed, **self.columns, **states}

    def _rates(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        rates = rates_of(self.definition, self._known(t, y))
        return np.array([np.broadcast_to(rate, t.shape) for rate in rates.values()], np.float64)

    def followed(self, y: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return times (step, cell) and states (step, state, cell) from the starts (state, cell) on. A cell is followed
        by explicit steps, or by implicit ones if these come much farther.
        """
        times, path, h = self._path(y, ends, self._step)
        if len(y) > MOST_IMPLICIT:
            return times, path
        jacobian, _ = self._derivatives(times[-1], path[-1], h, self._rates(times[-1], path[-1]))
        fastest = np.abs(np.linalg.eigvals(jacobian)).max(axis=1)
        if not (h * fastest > 1.0).any():  # stability allows 2.5, and a rejected step is halved
            return times, path
        far, other, _ = self._path(y, ends, self._implicit_step)
        is_stiff = far[-1] > FARTHER * times[-1]
        n = max(len(times), len(far))
        times, far, path, other = (
            np.pad(x, [(0, n - len(x))] + [(0, 0)] * (x.ndim - 1), "edge") for x in (times, far, path, other)
        )
        return np.where(is_stiff, far, times), np.where(is_stiff, other, path)

    def _path(
        self, y: np.ndarray, ends: np.ndarray, step: Callable[..., tuple[np.ndarray, ...]]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return times and states as `followed` does, and the lengths of the next steps, 0 at the end.

        A cell that has arrived at its end, or fails, stays where it is.
        """
        tolerance = 3e-3  # a step's error relative to the extent of its cell's motion so far
        # attempts after which a cell takes its first step whatever the error: of a state that leaves its start by a
        # high power of the time, the error is a share of its motion that no shorter step makes less
        first = 12
        per_period = 12  # least number of steps per period of a drive
        t, slope = np.zeros(y.shape[1]), self._rates(np.zeros(y.shape[1]), y)
        longest = 1.0 / (self.frequency * per_period) if self.definition.has_drive else ends / per_period
        least = tolerance * np.ptp(y, axis=1, keepdims=True)  # a cell that begins at rest hardly moves
        pace = np.where(least > 0.0, np.abs(slope) * tolerance / least, 0.0).max(axis=0)
        h = np.minimum(longest, tolerance * np.where(pace > 0.0, 1.0 / pace, longest))
        low, high, times, path = y, y, [t], [y]
        for attempt in range(ATTEMPTS):
            h = np.minimum(h, ends - t)
            if not (h > 0.0).any():
                break
            after, k4, error = step(t, y, h, slope)
            extent = np.fmax(high, after) - np.fmin(low, after)
            size = np.maximum(np.maximum(extent, least), LEAST_EXTENT * np.abs(y))
            worst = np.where(size > 0.0, error / (tolerance * size), 0.0).max(axis=0)
            is_near = (worst <= 1.0) | ((t == 0.0) & (attempt >= first))
            taken = np.isfinite(after).all(axis=0) & np.isfinite(k4).all(axis=0) & is_near
            landed = self._after_impacts(t + h, y, after)
            if landed is not after:
                k4 = self._rates(t + h, landed)
            factor = np.clip(0.9 * np.nan_to_num(worst, nan=1e9, posinf=1e9).clip(1e-9) ** (-1.0 / 3.0), 0.2, 4.0)
            y, slope = np.where(taken, landed, y), np.where(taken, k4, slope)
            t, h = np.where(taken, t + h, t), np.minimum(h * np.where(taken, factor, np.minimum(factor, 0.5)), longest)
            low, high = np.fmin(low, y), np.fmax(high, y)
            times.append(t)
            path.append(y)
        stuck = (h <= 1e-12 * longest) & (t < ends)
        path[-1] = np.where(stuck, np.nan, path[-1])
        return np.array(times), np.array(path), np.minimum(h, ends - t)

    def _implicit_step(self, t: np.ndarray, y: np.ndarray, h: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the states after a step, the rates there, and the step's error."""
        d, e = 1.0 / (2.0 + np.sqrt(2.0)), 6.0 + np.sqrt(2.0)
        jacobian, by_time = self._derivatives(t, y, h, slope)
        matrix = np.eye(len(y)) - (h * d)[:, None, None] * jacobian

        def solved(right: np.ndarray) -> np.ndarray:
            return np.asarray(np.linalg.solve(matrix, right.T[..., None])[..., 0].T)

        k1 = solved(slope + h * d * by_time)
        middle = self._rates(t + 0.5 * h, y + 0.5 * h * k1)
        k2 = solved(middle - k1) + k1
        after = y + h * k2
        last = self._rates(t + h, after)
        k3 = solved(last - e * (k2 - middle) - 2.0 * (k1 - slope) + h * d * by_time)
        return after, last, np.abs(h * (k1 - 2.0 * k2 + k3) / 6.0)

    def _derivatives(self, t: np.ndarray, y: np.ndarray, h: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return differences of the rates (state, cell): by the states (cell, state, state), by time (state, cell)."""
        share = np.sqrt(np.finfo(float).eps)
        units = np.maximum(np.abs(y), np.abs(h * slope))
        columns = []
        for i, unit in enumerate(np.where(units > 0.0, units, 1.0)):
            moved = y.copy()
            moved[i] += share * unit
            columns.append((self._rates(t, moved) - slope) / (moved[i] - y[i]))
        later = share * np.where(t == 0.0, 1.0 / self.frequency, t)
        by_time = (self._rates(t + later, y) - slope) / later
        return tuple(np.where(np.isfinite(x), x, 0.0) for x in (np.array(columns).transpose(2, 1, 0), by_time))

    def _step(self, t: np.ndarray, y: np.ndarray, h: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the states after a step, the rates there, and the step's error."""
        k2 = self._rates(t + 0.5 * h, y + 0.5 * h * slope)
        k3 = self._rates(t + 0.75 * h, y + 0.75 * h * k2)
        after = y + h * (2.0 * slope + 3.0 * k2 + 4.0 * k3) / 9.0
        k4 = self._rates(t + h, after)
        return after, k4, np.abs(h * (-5.0 * slope + 6.0 * k2 + 8.0 * k3 - 9.0 * k4) / 72.0)

    def iterated(self, y: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers (iterate, cell) and the states (iterate, state, cell) of a map from the starts on."""
        path = [y]
        for i in range(min(n, ATTEMPTS)):
            path.append(self._rates(np.full(y.shape[1], float(i)), path[-1]))
        return np.tile(np.arange(len(path), dtype=np.float64)[:, None], (1, y.shape[1])), np.array(path)

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
