"""Evaluate a run's equations at its starts: refuse those without values, and find the sizes of states.

A state of 1e-9 m or of 1e9 persons would be compared with tolerances made for numbers of the order of one. Its size
becomes its scale, and the unit of its absolute tolerance and of its bound. It is a power of ten, and 1 for all that is
between 0.1 and 100 (`magpend_core.sizes`). A run keeps its sizes in the text of its model, as the key ``size``.

The size is between the largest value of the later motion (a tenth of the largest value at all, if that is more) and
the largest value at all: wide starts do not hide a small attractor, and a state that comes to rest at 0 keeps about the
size that it began with. The motion is integrated with numpy as the text is written; only its order of magnitude counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.text.definition import OMEGA, Definition
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import rates_of, value_of
from magpend_core.sizes import natural_size
from pipeline.layout.cells import initial_states, parameter_axes
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import FREQUENCY

if TYPE_CHECKING:
    from magpend_core.models.model import Model
    from magpend_core.models.text.domains import Fault

MOST_STARTS = 4096
"""Most starts at which the equations are evaluated. Of more starts so many are chosen, evenly spread."""
SHARES = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19]) % 1.0
"""Instants in the drive's period at which the equations are compared with themselves one period later: at none of
them an edge is to be expected.
"""
PERIODIC, TWICE = 1e-6, 2
"""Largest relative difference after a period, and least number of instants with a larger one."""
MOST_CORNERS = 64
"""Most corners of the box of swept parameters at which the equations are evaluated."""


def check_starts(spec: Spec) -> None:
    """Refuse a run of a model written as text if its equations cannot be evaluated at the initial conditions.

    They must also have the drive's period in time, in most of some drawn states at the ends of every axis.

    They are evaluated at time 0 at all starts (at most `MOST_STARTS`), at both ends of every axis. If they
    have values at some of the ends, the run is not refused: the status of its cells shows where they have
    none.

    Raises
    ------
    SpecError
        If they have none. The message names each part of the text without a value, the reason, and the
        numbers.
    """
    states = initial_states(spec.initial_conditions)
    chosen = np.unique(np.linspace(0, len(states) - 1, min(len(states), MOST_STARTS)).astype(np.int64))
    points = parameter_points(spec)
    model = load_model(spec.reference)
    check_states(model, states.at(chosen), points)
    if isinstance(model, TextModel) and not model.autonomous and spec.drive is None:
        _check_period(model, states.at(chosen[: len(SHARES)]), points)


def parameter_points(spec: Spec) -> list[dict[str, Any]]:
    """Return the values of the parameters and of the frequency at both ends of every axis, at most `MOST_CORNERS`."""
    axes = parameter_axes(spec)
    ends = [np.unique([a.values.min(), a.values.max()]).tolist() for a in axes]
    corners = itertools.islice(itertools.product(*ends), MOST_CORNERS)
    fixed = {**spec.values, FREQUENCY: spec.frequency_hz}
    return [{**fixed, **dict(zip([a.parameter for a in axes], corner, strict=True))} for corner in corners]


def _check_period(model: TextModel, states: np.ndarray, points: Sequence[Mapping[str, Any]]) -> None:
    """Raise `SpecError` for an equation that does not repeat after a period of the drive."""
    definition = model.definition
    problems: dict[str, str] = {}
    for point in points:
        before, after = (_rates(model, states, point, late) for late in (0.0, 1.0))
        for name in definition.equations:
            size = np.abs(before[name]).max()
            if (np.abs(after[name] - before[name]) > PERIODIC * size).sum() >= TWICE:
                at = ", ".join(f"{n} = {point[n]:.6g}" for n in (FREQUENCY, *model.parameter_names))
                problems.setdefault(
                    name,
                    f"model.equations.{name} = {definition.table['equations'][name]!r}: does not repeat after a period "
                    f"of the drive, 1/f, at {at}. Time must enter with this period: write 2*pi*f*t, or phase, and give "
                    f"the drive's rate as frequency_hz.{_hiding(model, name)}",
                )
    if problems:
        raise SpecError(list(problems.values()))


def _hiding(model: TextModel, name: str) -> str:
    """Say that ``omega`` in an equation is a state or parameter of the model, if it is."""
    definition = model.definition
    if OMEGA not in definition.used([definition.equations[name]]):
        return ""
    own = {**dict.fromkeys(model.parameter_names, "parameter"), **{s.name: "state" for s in definition.states}}
    return f" Here {OMEGA} is a {own[OMEGA]} of the model, which hides the drive's." if OMEGA in own else ""


def _rates(model: TextModel, states: np.ndarray, point: Mapping[str, Any], late: float) -> dict[str, np.ndarray]:
    """Return the rates of the states at some instants of the drive's period, `late` periods later."""
    definition, frequency = model.definition, point[FREQUENCY] or 1.0
    rows = np.resize(states, (len(SHARES), states.shape[1])).T
    known: dict[str, Any] = {
        "pi": np.pi,
        **{name: float(point[name]) for name in model.parameter_names},
        **dict(zip(model.state_names, rows, strict=True)),
        "f": frequency,
        "phase": SHARES,
        "t": (SHARES + late) / frequency,
    }
    with np.errstate(all="ignore"):
        values = rates_of(definition, known)
    return {name: np.nan_to_num(np.broadcast_to(value, SHARES.shape)) for name, value in values.items()}


def check_states(model: Model, states: np.ndarray, points: Sequence[Mapping[str, Any]]) -> None:
    """Refuse states at which the equations of a model written as text cannot be evaluated.

    Parameters
    ----------
    model
        Any model; one that is not a text is not checked.
    states
        Initial states in the model's units, shape (n, n_states).
    points
        Parameter points at which the states are checked: values by parameter name, and ``frequency_hz``
        (None for none).

    Raises
    ------
    SpecError
        If the equations have no value; see `check_starts`.
    """
    if not isinstance(model, TextModel):
        return
    from magpend_core.models.text.domains import domain_faults

    n = len(states)
    columns = dict(zip(model.state_names, np.tile(states, (len(points), 1)).T, strict=True))
    for name in model.parameter_names:
        columns[name] = np.repeat([float(p[name]) for p in points], n)
    zero = np.zeros(n * len(points))
    frequency = [p.get(FREQUENCY) or 1.0 for p in points]
    columns |= {"t": zero, "phase": zero, "f": np.repeat(frequency, n)}
    faults = domain_faults(model.definition, columns)
    parts = [{name: v[i * n : (i + 1) * n] for name, v in columns.items()} for i in range(len(points))]
    # an axis may end at a pole; cells at other parameters then have values
    if faults and (len(points) == 1 or all(domain_faults(model.definition, part) for part in parts)):
        raise SpecError([_sentence(model, fault, columns, n * len(points)) for fault in faults])


def _sentence(model: Model, fault: Fault, columns: Mapping[str, np.ndarray], total: int) -> str:
    own = {n: v for n, v in fault.values.items() if n not in model.state_names}
    if fault.is_constant:
        at = ", ".join(f"{name} = {value:.6g}" for name, value in own.items())
        return (
            f"model.{fault.place}: {fault.part}: {fault.why}{' at ' if at else ''}{at}, in every state; "
            "choose other values, or write the part otherwise."
        )
    with_states = {name: columns[name][fault.row] for name in model.state_names}
    at = ", ".join(f"{name} = {value:.6g}" for name, value in {**with_states, **own}.items())
    share = f" ({fault.count} of {total} starts)" if total > 1 else ""
    return (
        f"model.{fault.place}: {fault.part}: {fault.why} at the start {at}{share}; begin elsewhere, or write "
        "where(condition, a, b) with a value that exists there."
    )


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
