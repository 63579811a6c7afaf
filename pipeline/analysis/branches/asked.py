"""Start branches where a user asks for it: at a given state, or at all equilibria of a box of states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magpend_core.equilibria import find_equilibria
from magpend_core.models.model import Model, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.models.text import TextModel
from magpend_core.models.text.intervals import Rates
from magpend_core.orbits import wrap_angles
from magpend_core.pointwise import jacobian_at
from pipeline.analysis.branches.boxes import Box, enclose_equilibria, search_equilibria
from pipeline.analysis.branches.declaration import BranchOptions, StartOptions
from pipeline.analysis.branches.deflation import orbit_near
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.searching import family_at, rows_of, where_variables
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import axis_in_own_words, place_in_words
from pipeline.layout.vocabulary import axis_name, parameter_name, parameters_of
from pipeline.results.run import OpenRun
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.tables import FREQUENCY

COUNTS = ("proved", "border", "undecided", "jumps", "no_text")
"""Values of `box_verdict`: why the number of equilibria is proved, or is not."""


def check_asked(run: OpenRun, options: BranchOptions, interval: tuple[float, float]) -> None:
    """Raise SpecError unless the options on starts name all states, with numbers in their bounds."""
    model, name, (low, high) = run.model, parameter_name(options.parameter), interval
    problems = start_problems(model, options, name, word=run.spec.rate)
    if not low <= (value := options.start.get(name, low)) <= high:
        own, given = axis_in_own_words(name, run.spec.rate)
        value, (low, high) = float(given(value)), sorted(float(given(x)) for x in interval)
        problems.append(f"--start: {own} = {value:g} is outside of {low:g} to {high:g}; change --from and --to.")
    if options.start and 0 < options.max_period < options.start_period:
        problems.append(f"--start-period {options.start_period} is above --period {options.max_period}; raise that.")
    if problems:
        raise SpecError(problems)
    if options.all_equilibria or options.within:
        if not model.clock.has_equilibria:
            raise SpecError(
                f"--all-equilibria: {model.name} is no flow without a drive; --isolas finds all its orbits."
            )
        if not options.all_equilibria:
            raise SpecError("--within is the box of --all-equilibria; give that, too, such as --all-equilibria 1.")
        if problems := _box_problems(model, options.within):
            raise SpecError(problems)


def start_problems(model: Model, options: StartOptions, *others: str, word: str = FREQUENCY) -> list[str]:
    """Return what is wrong with --start: it names all states, and may name some `others`. Messages call the drive's
    rate by the specification's `word`.
    """
    if not options.start:
        return []
    known = (*model.state_names, *others)
    told = [axis_in_own_words(name, word)[0] for name in known]
    problems = [f"--start: {unknown_name('state', one, told)}" for one in options.start if one not in known]
    if missing := [state for state in model.state_names if state not in options.start]:
        problems.append(f"--start: give all states; missing: {', '.join(missing)}.")
    if options.start_period == 0 and not model.clock.has_equilibria:
        problems.append(f"--start-period 0: {model.name} has no equilibria; its orbits have period 1 or more.")
    return problems


def _box_problems(model: Model, within: Mapping[str, tuple[float, float]]) -> list[str]:
    names = model.state_names
    problems = [f"--within: {unknown_name('state', name, names)}" for name in within if name not in names]
    for state, is_angle in zip(names, model.is_angle, strict=True):
        if state not in within:
            if not is_angle:
                problems.append(f"--within: no range of {state}; add {state}=LOW:HIGH.")
            continue
        low, high = within[state]
        if not low < high:
            problems.append(f"--within {state}={low:g}:{high:g} is empty; give the lesser number first.")
    return problems


def given_starts(run: OpenRun, options: BranchOptions, interval: tuple[float, float]) -> tuple[list[Start], list[str]]:
    """Return the orbit or equilibrium near the state of --start at each point of the run's other axes, and a text line
    for each point without one.
    """
    if not options.start:
        return [], []
    cube, base, name = run.cube(), parameters_of(run.cube()), axis_name(options.parameter)
    own = base[name] if name in base.names else interval[0]
    default = own if interval[0] <= own <= interval[1] and name not in cube.dims else interval[0]
    value = options.start.get(parameter_name(name), default)
    state = np.array([options.start[state] for state in run.model.state_names])
    rests = run.model.clock.has_equilibria and (run.model.crossing is None or not options.start_period)
    period, starts, lines = (0 if rests else options.start_period), [], []
    for _, where, family in rows_of(cube, base, name, interval[1] - interval[0]):
        there = family_at(family, value)
        near, own_period = _closed_near(there, state, period)
        if near is None:
            what = f"no orbit of period {period}" if period else "no equilibrium"
            at = ", ".join(place_in_words(n, run.spec.rate, v) for n, v in {name: value, **where}.items())
            lines.append(f"start at {at}: Newton's method found {what} from there")
        else:
            starts.append(Start(replace(there, period=own_period), near, value))
    return starts, lines


def _closed_near(family: Family, state: np.ndarray, period: int) -> tuple[np.ndarray | None, int]:
    """Return a point of the orbit or equilibrium that Newton's method finds from a state, and its least period."""
    if not period:
        found = find_equilibria(family.system, state[None], family.parameters, max_iterations=100)
        return (wrap_angles(found.states[0], family.system) if found.converged[0] else None), 0
    orbit = orbit_near(state, period, family.frequency_hz, family.parameters, family.system)
    return (None, period) if orbit is None else (orbit.points[0], orbit.period)


# ---- all equilibria ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Counted:
    """All equilibria that were found in a box at one parameter point, and whether their number is proved."""

    family: Family  # of period 1, with the parameter's value among its parameters
    value: float
    where: Mapping[str, float]
    states: np.ndarray  # (n, n_states)
    verdict: str  # of `COUNTS`

    @property
    def starts(self) -> list[Start]:
        """The equilibria as starts of branches."""
        return [Start(replace(self.family, period=0), state, self.value) for state in self.states]

    @property
    def jacobians(self) -> np.ndarray:
        """Jacobians at the equilibria [1/s per unit of the states], (n, n_states, n_states)."""
        n = self.family.system.n_states
        if not len(self.states):
            return np.zeros((0, n, n))
        return np.asarray(jacobian_at(self.family.system, self.states, self.family.parameters))

    @property
    def n_stable(self) -> int:
        """Number of equilibria whose eigenvalues all have negative real parts."""
        return int((np.linalg.eigvals(self.jacobians).real < 0.0).all(axis=1).sum())

    @property
    def index_sum(self) -> int:
        """Sum of the signs of det(-J)."""
        return int(np.sign(np.linalg.det(-self.jacobians)).sum())


def count_equilibria(run: OpenRun, options: BranchOptions, interval: tuple[float, float]) -> list[Counted]:
    """Find all equilibria of the box at some values of the parameter, for all points of the run's other axes."""
    n, (low, high) = options.all_equilibria, interval
    if not n:
        return []
    base, box = parameters_of(run.cube()), _box_of(run.model, options.within)
    values = (low + (high - low) * (np.arange(n) + 0.5) / n).tolist()
    rows = list(rows_of(run.cube(), base, axis_name(options.parameter), high - low))
    return [_count(family_at(family, value), value, where, base, box) for _, where, family in rows for value in values]


def _box_of(model: Model, within: Mapping[str, tuple[float, float]]) -> Box:
    ends = np.array([within.get(state, (-np.pi, np.pi)) for state in model.state_names])
    full = np.array(model.is_angle) & (ends[:, 1] - ends[:, 0] >= 2.0 * np.pi * (1.0 - 1e-3))
    ends[full] = -np.pi, np.pi
    return Box(ends[:, 0], ends[:, 1], full)


def _count(family: Family, value: float, where: Mapping[str, float], base: Parameters, box: Box) -> Counted:
    model, system, packed = of_flow(base).model, family.system, family.parameters
    states, verdict = np.zeros((0, system.n_states)), "no_text"
    if isinstance(model, TextModel):
        own = dict(zip(system.parameter_names, packed.tolist(), strict=True))
        rates = Rates(model.definition, {name: own[name] for name in model.parameter_names})
        verdict = "jumps"
        if not rates.obstacle:
            found = enclose_equilibria(rates, box)
            verdict = "border" if found.on_border else "proved" if found.is_proved else "undecided"
            states = np.array([*found.states, *found.on_border]).reshape(-1, system.n_states)
    if verdict in ("proved", "border"):
        states = wrap_angles(states, system)
    else:
        states = search_equilibria(system, packed, box, wrap_angles(states, system))
    return Counted(family, value, where, states, verdict)


def counted_variables(counted: Sequence[Counted], model: Model) -> dict[str, Any]:
    """Return dataset variables on the equilibria that were counted, over ``box``; none without a count."""
    if not counted:
        return {}
    numbers = {
        "n_equilibria": [len(one.states) for one in counted],
        "n_stable_equilibria": [one.n_stable for one in counted],
        "equilibria_index_sum": [one.index_sum for one in counted],
    }
    codes = np.array([COUNTS.index(one.verdict) for one in counted], np.int8)
    return {
        **where_variables("box", counted, model),
        **{name: ("box", np.array(values, np.int32)) for name, values in numbers.items()},
        "box_verdict": ("box", codes, code_flags(COUNTS)),
    }
