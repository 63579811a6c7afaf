"""Evaluate a run's equations at its starts, and refuse those without values."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.sectioned import SectionedModel
from magpend_core.models.text.definition import OMEGA
from magpend_core.models.text.grammar import names
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import rates_of
from pipeline.layout.cells import Origins, initial_states, parameter_axes
from pipeline.specification.drift import MOST_CORNERS
from pipeline.specification.expressions import read_expression
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


def check_starts(spec: Spec) -> None:
    """Refuse a run of a model written as text if its equations cannot be evaluated at the initial conditions.

    They must also have the drive's period in time, in most of some drawn states at the ends of every axis; and what
    crosses the level of a section must change along the motion at one end at least.

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
    _check_origins(spec)
    check_states(model, states.at(chosen) + origins_at(spec, points)[:, None], points)
    if isinstance(model, TextModel) and model.clock.has_drive and spec.drive is None:
        _check_period(model, states.at(chosen[: len(SHARES)]), points)
    if isinstance(spec.model, SectionedModel):
        _check_section(spec.model, points)


def origins_at(spec: Spec, points: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Return the origins of the starts at parameter points, shape (point, n_states)."""
    packed = np.array([[float(point[name]) for name in spec.values.names] for point in points])
    frequency = np.array([np.nan if point[FREQUENCY] is None else point[FREQUENCY] for point in points], float)
    return Origins.of(spec).at(packed, frequency)


def _check_origins(spec: Spec) -> None:
    """Raise SpecError for an origin of starts that has no finite value at some values of the axes."""
    axes = {a.parameter: a.values for a in parameter_axes(spec)}
    fixed = {**spec.values, FREQUENCY: spec.frequency_hz}
    for state, text in (spec.initial_conditions.origin or {}).items():
        tree = read_expression(f"origin.{state}", text, spec.model.parameter_names)
        used = {FREQUENCY if name == "f" else str(name) for name, _ in names(tree)}
        own = {name: values for name, values in axes.items() if name in used}
        mesh = [m.ravel() for m in np.meshgrid(*own.values(), indexing="ij")] or [np.zeros(1)]
        columns = dict(zip(own, mesh, strict=False))
        points = [{**fixed, **dict(zip(columns, row, strict=True))} for row in zip(*columns.values(), strict=True)]
        found = origins_at(spec, points or [fixed])[:, spec.model.state_names.index(state)]
        if not np.isfinite(found).all():
            k = int(np.argmin(np.isfinite(found)))
            at = ", ".join(f"{name} = {float(values[k]):.6g}" for name, values in columns.items())
            raise SpecError(
                f"initial_conditions.origin.{state} = {text!r}: is {found[k]:g}{f' at {at}' if at else ''}; it must "
                "have a finite value at all values of the axes."
            )


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
                    f"model.equations.{name} = {definition.lines[name].text!r}: does not repeat after a period "
                    f"of the drive, 1/f, at {at}. Time must enter with this period: write 2*pi*f*t, or phase, and give "
                    f"the drive's rate as frequency_hz.{_hiding(model, name)}",
                )
    if problems:
        raise SpecError(list(problems.values()))


def _check_section(model: SectionedModel, points: Sequence[Mapping[str, Any]]) -> None:
    """Raise `SpecError` for a section of an expression that the motion keeps at all points."""
    text = model.expressed
    if not isinstance(text, TextModel) or text.definition.surface is None:
        return
    from magpend_core.models.text.surfaces import tangent_problem

    problems = [tangent_problem(text, {name: float(p[name]) for name in text.parameter_names}) for p in points]
    if all(problems):
        raise SpecError(f"section.of = {model.through.of!r}: at the run's parameters it {problems[0]}")


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
        "f": frequency,
        "phase": SHARES,
        "t": (SHARES + late) / frequency,
        **{name: float(point[name]) for name in model.parameter_names},
        **dict(zip(model.state_names, rows, strict=True)),
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
        Initial states in the model's units, shape (n, n_states), or (point, n, n_states).
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

    n = states.shape[-2]
    many = np.broadcast_to(states, (len(points), *states.shape[-2:])).reshape(-1, states.shape[-1])
    columns = dict(zip(model.state_names, many.T, strict=True))
    for name in model.parameter_names:
        columns[name] = np.repeat([float(p[name]) for p in points], n)
    zero = np.zeros(n * len(points))
    frequency = [p.get(FREQUENCY) or 1.0 for p in points]
    columns = {"t": zero, "phase": zero, "f": np.repeat(frequency, n)} | columns
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
