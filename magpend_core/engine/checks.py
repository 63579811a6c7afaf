"""Check the functions of a system against its declaration, in plain Python, before they are compiled.

The engine does not check what the functions of a system return. A tuple that is too short would make it read other
memory; a wrong Jacobian would give wrong exponents without a warning; an edge outside the period would never occur. So
the functions are first run as plain Python (every primitive of `simd` has that form) at a few states and instants.

Reading order: `check_system` is called before each integration. `_Functions` calls the functions and collects
problems; `_Motion` holds the checks of `rhs`, `jacobian`, `forcing` and `layers`. Checks of switches and impacts are in
`event_checks`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from magpend_core.engine import event_checks
from magpend_core.engine.jacobians import declaration_problems, places_of, whole_jacobian
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System

N_SAMPLES = 16
"""States and instants at which the functions are run."""

STEP = 1e-4
"""Largest step of the finite differences, in units of a state's scale."""

LEAST_MISTAKE = 1e-3
"""Smallest relative error of the Jacobian that is reported.

If the rates solve an implicit equation by a fixed number of iterations, the Jacobian may differ by a tenth of this
where the iterations converge slowly.
"""

SATURATED = 1e100
"""Rates from which derivatives are not compared: exponentials are cut off there, and their differences are 0."""

TWICE = 2
"""An error is reported if it occurs at this many samples; a single sample may lie within a layer."""

_NOT_RUN = object()


class SystemCheckError(ValueError):
    """An error for a system whose functions contradict its declaration.

    Attributes
    ----------
    problems : list of str
        A sentence for each problem: the function or field, what it gives, what it must give.
    """

    def __init__(self, name: str, problems: list[str]) -> None:
        self.problems = problems
        super().__init__(f"The system {name!r} cannot be integrated:\n" + "\n".join(f"- {p}" for p in problems))


@dataclass
class _Checked:
    """Range over which each parameter of a system has been checked; the last entry is the drive frequency."""

    low: np.ndarray
    high: np.ndarray

    def covers(self, packed: np.ndarray, frequency: np.ndarray) -> bool:
        if not (self.low[-1] <= frequency.min() and frequency.max() <= self.high[-1]):
            return False
        return bool(((self.low[:-1] <= packed) & (packed <= self.high[:-1])).all())


_CHECKED: dict[tuple[System, bool], _Checked] = {}


def check_system(
    system: System, parameters: np.ndarray, frequency_hz: np.ndarray, states: np.ndarray, *, jacobian: bool = False
) -> None:
    """Check a system before it is integrated; raise `SystemCheckError` if its functions contradict its declaration.

    The checks are: the lengths of the returned tuples; times and widths of the edges; finite constants; a forcing with
    the drive's period; equal rates after a full turn of an angle; and, if the Jacobian is used, the Jacobian against
    finite differences. They are made once for each system. Constants and edges are checked again if a parameter leaves
    the range that was checked. Functions that cannot run as plain Python (such as intrinsics of numba) are skipped.

    Parameters
    ----------
    system
        What will be integrated.
    parameters
        Packed parameters, shape (..., n_parameters), all finite.
    frequency_hz
        The leading shape of `parameters` [Hz].
    states
        Initial states, shape (n, n_states).
    jacobian
        Whether the Jacobian will be used.

    Raises
    ------
    SystemCheckError
        With all problems by name.
    """
    subject = system if system.tangents_of is None else system.tangents_of
    if subject.recorded_for is not None:  # a recorded drive has no period: check the original system
        subject = subject.recorded_for
    parameters = parameters[..., : len(subject.parameter_names)]
    key = (subject, jacobian or system.tangents_of is not None)
    if not frequency_hz.size or not len(states):
        return
    packed = parameters.reshape(frequency_hz.size, parameters.shape[-1])
    checked = _CHECKED.get(key)
    if checked is not None and checked.covers(packed, frequency_hz):
        return
    with np.errstate(all="ignore"):
        problems = _problems(subject, key[1], checked, packed, frequency_hz.ravel(), states)
    if problems:
        raise SystemCheckError(subject.name, problems)
    low = np.append(packed.min(axis=0), frequency_hz.min())
    high = np.append(packed.max(axis=0), frequency_hz.max())
    if checked is not None:
        low, high = np.minimum(low, checked.low), np.maximum(high, checked.high)
    _CHECKED[key] = _Checked(low, high)


def _problems(
    system: System,
    linearised: bool,
    checked: _Checked | None,
    packed: np.ndarray,
    frequency: np.ndarray,
    states: np.ndarray,
) -> list[str]:
    """Return the problems of a system: in its declaration, in its constants at extreme parameters, and in its functions
    at sample states.
    """
    if checked is None:
        problems = list(_declaration(system, linearised))
        if problems:
            return problems
    functions = _Functions(system)
    for cell in _extremes(packed, frequency, checked):
        problems = functions.cell_problems(np.float64(frequency[cell]), packed[cell])
        if problems:
            return problems
    if checked is not None:
        return []
    for i in np.unique(np.linspace(0, len(packed) - 1, N_SAMPLES).astype(int)):
        if functions.has_values(f := np.float64(frequency[i]), packed[i]):
            return _Motion(system, functions, packed[i], f, states).problems(linearised)
    return []  # the constants are not finite at any of the parameter sets


def _declaration(system: System, linearised: bool) -> Iterator[str]:
    """Yield the problems in a system's plain fields, such as names, scales and counts."""
    n, names = system.n_states, ", ".join(system.state_names)
    if not n:
        yield "state_names is empty; a system has one state at least."
    for field in ("is_angle", "units", "scales", "sizes", "escape"):
        values = getattr(system, field)
        if len(values) != n:
            yield f"{field} has {len(values)} entries; it must have one for each of the {n} states ({names})."
    for field in ("units", "scales", "sizes", "escape"):
        for name, value in zip(system.state_names, getattr(system, field), strict=False):
            if not value > 0.0 or (field != "escape" and not np.isfinite(value)):
                yield f"{field}: {value!r} for {name} is out of bounds; it must be greater than 0" + (
                    " and finite." if field != "escape" else "."
                )
    for field in ("state_names", "parameter_names", "quantity_names"):
        own = getattr(system, field)
        for name in sorted({name for name in own if own.count(name) > 1}):
            yield f"{field} has {name!r} twice; names must differ."
    for field in ("n_edges", "n_constants"):
        if getattr(system, field) < 0:
            yield f"{field} = {getattr(system, field)} is out of bounds: it must be 0 or more."
    if not 1 <= system.controlled <= max(n, 1):
        yield f"n_controlled = {system.n_controlled} is out of bounds: it must be between 1 and {n}."
    yield from declaration_problems(system)
    yield from event_checks.declaration(system)
    if linearised and system.jacobian is None:
        yield "jacobian is missing; exponents, multipliers and orbits need it."
    if system.quantity_names and system.quantities is None:
        yield f"quantities is missing, and quantity_names has {len(system.quantity_names)}."


def _extremes(packed: np.ndarray, frequency: np.ndarray, checked: _Checked | None) -> list[int]:
    """Return the indices of the cells to check: those with a parameter outside the range checked so far."""
    cells = {0} if checked is None else set()
    for i, column in enumerate((*packed.T, frequency)):
        for cell in (int(column.argmin()), int(column.argmax())):
            if checked is None or not checked.low[i] <= column[cell] <= checked.high[i]:
                cells.add(cell)
    return sorted(cells)


class _Functions:
    """A system's functions as plain Python. Problems in calls are collected in a list."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.problems: list[str] = []

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of the system; if it raises an error, report a problem and return `_NOT_RUN`."""
        function: Callable[..., Any] = plain(getattr(self.system, name))
        try:
            return function(*arguments)
        except NotImplementedError:
            return _NOT_RUN
        except Exception as error:
            self.problems.append(f"{name} fails: {type(error).__name__}: {error}.")
            return _NOT_RUN

    def numbers(self, name: str, wanted: int, what: str, *arguments: Any) -> tuple[np.ndarray, ...] | None:
        """Call a function that must return a tuple of `wanted` numbers. If it does not, report a problem and return
        None.
        """
        values = self.call(name, *arguments)
        if values is _NOT_RUN:
            return None
        if isinstance(values, tuple) and len(values) == wanted:
            return tuple(np.broadcast_to(np.asarray(v, np.float64), N_SAMPLES) for v in values)
        kind = "nothing" if values is None else f"a {type(values).__name__}"
        given = f"{len(values)} numbers" if isinstance(values, tuple) else kind
        self.problems.append(f"{name} returns {given}; it must return a tuple of {wanted}: {what}.")
        return None

    def constants(self, frequency: np.float64, p: np.ndarray) -> tuple[np.float64, ...]:
        out = np.full(self.system.n_constants, np.nan)
        self.call("constants", frequency, p, out)
        return tuple(out)

    def has_values(self, frequency: np.float64, p: np.ndarray) -> bool:
        """Return whether the constants are finite for a frequency and parameters. Always True if the system declares no
        poles.
        """
        return not self.system.has_poles or bool(np.isfinite(self.constants(frequency, p)).all())

    def edges(self, frequency: np.float64, p: np.ndarray) -> np.ndarray:
        table = np.full((3, self.system.n_edges), np.nan)
        self.call("edges", frequency, p, *table)
        return table

    def cell_problems(self, frequency: np.float64, p: np.ndarray) -> list[str]:
        self.problems = []
        at = f"at frequency_hz = {frequency:g}"
        values = self.constants(frequency, p)
        if not self.problems and not self.system.has_poles:
            bad = [f"number {i} is {c}" for i, c in enumerate(values) if not np.isfinite(c)]
            if bad:
                self.problems.append(
                    f"constants leaves entries that are not finite {at}: {', '.join(bad[:4])}; it must fill "
                    f"all n_constants = {len(values)} (NaN: not filled, or not a number)."
                )
        if self.system.n_edges:
            before = len(self.problems)
            table = self.edges(frequency, p)
            if len(self.problems) == before:
                self.problems += _edge_problems(table, 1.0 / frequency, at)
        return self.problems


def _edge_problems(table: np.ndarray, period: float, at: str) -> Iterator[str]:
    times, half_widths, jumps = table
    filled = "edges must fill all n_edges = " + str(len(times))
    for i, time in enumerate(times):
        if not 0.0 <= time < period:
            yield f"edges: time {i} is {time:g} s {at}; it must be in [0, {period:g}) s, and {filled}."
    if not np.isnan(times).any() and (np.diff(times) <= 0.0).any():
        yield f"edges: the times {[float(t) for t in times]} s {at} must rise from each to the next."
    for i, width in enumerate(half_widths):
        if not width > 0.0:
            yield f"edges: half-width {i} is {width:g} s {at}; it must be greater than 0, and {filled}."
    for i, jump in enumerate(jumps):
        if not (np.isfinite(jump) and jump >= 0.0):
            yield f"edges: jump {i} is {jump:g} {at}; it must be finite and 0 or greater, and {filled}."


class _Motion:
    """Checks of the functions that the engine calls at every step. They run on sample states and times like those of a
    run.
    """

    def __init__(
        self, system: System, functions: _Functions, p: np.ndarray, frequency: np.float64, states: np.ndarray
    ) -> None:
        functions.problems = []
        self.system, self.functions = system, functions
        self.scales = np.asarray(system.units, np.float64)
        self.period = 1.0 / frequency
        self.times = self.period * (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
        self.edges = functions.edges(frequency, p) if system.n_edges else np.empty((3, 0))
        self.own = functions.constants(frequency, p)
        self.c = self._constants_at(self.times)
        self.edge_at_start = bool(system.n_edges) and self.edges[0, 0] == 0.0
        self.y = self._states(states)
        self.u: Any = 0.0

    def _constants_at(self, times: np.ndarray) -> tuple[Any, ...]:
        return (*self.own, *event_checks.modes_at(self.system, times, self.edges))

    def _states(self, states: np.ndarray) -> np.ndarray:
        """Return random sample states around the first initial states of a run, shape (n_states, sample)."""
        spread = np.random.default_rng(7).uniform(-1.0, 1.0, (N_SAMPLES, self.system.n_states))
        starts = states[np.arange(N_SAMPLES) % min(len(states), 4), : self.system.n_states]
        samples = starts + spread * self.scales
        bound = 0.9 * np.asarray(self.system.escape, np.float64)
        samples = np.clip(samples, -bound, bound)
        angles = np.asarray(self.system.is_angle, bool)
        samples[:, angles] = np.remainder(samples[:, angles] + np.pi, 2.0 * np.pi) - np.pi
        return np.ascontiguousarray(samples.T)

    def problems(self, linearised: bool) -> list[str]:
        """Run all checks and return the problems; stop early if the forcing or the rates fail."""
        found = self.functions.problems
        self._check_forcing()
        if found:
            return found
        rates = self._rates(self.y)
        if rates is None:
            return found
        good = np.isfinite(rates).all(axis=0)
        if not good.any():
            found.append(f"rhs is finite at none of {N_SAMPLES} states around the initial ones.")
            return found
        self._check_angles(rates)
        if linearised:
            self._check_jacobian(rates)
        if self.system.has_layers:
            self._check_layers(rates)
        event_checks.motion_problems(self, rates)
        if self.system.quantities is not None:
            names = self.system.quantity_names
            self.functions.numbers(
                "quantities", len(names), ", ".join(names), self.times, tuple(self.y), tuple(rates), self.u, self.c
            )
        return found

    def _check_forcing(self) -> None:
        shares = np.append(np.arange(N_SAMPLES) + 0.5, (0.0, N_SAMPLES)) / N_SAMPLES
        times = self.period * shares
        u = self.functions.call("forcing", times, self._constants_at(times))
        if u is _NOT_RUN:
            return
        if isinstance(u, tuple):
            self.functions.problems.append("forcing returns a tuple; it must return one number.")
            return
        u = np.broadcast_to(np.asarray(u, np.float64), len(shares))
        self.u = u[:N_SAMPLES]
        if self.system.forcing_is_time:
            self._check_period()
            return
        first, last = u[N_SAMPLES:]
        if not np.isfinite(u).all():
            self.functions.problems.append("forcing is not finite at some instants of the period.")
        elif abs(last - first) > 1e-6 * np.abs(u).max() and not self.edge_at_start:
            self.functions.problems.append(
                f"forcing is {first:g} at time 0 and {last:g} at 1/frequency; it must have the period of the "
                "drive, or an edge at time 0."
            )

    def _check_period(self) -> None:
        """Check that the rates repeat after one drive period, for a system whose `forcing` returns the time itself."""
        ends = []
        for time in (0.0, self.period):
            self.u = np.full(N_SAMPLES, time)
            self.c = self._constants_at(self.u)
            ends.append(self._rates(self.y))
        self.u, self.c = self.times, self._constants_at(self.times)
        if ends[0] is None or ends[1] is None or self.edge_at_start:
            return
        size = np.nanmax(np.abs(ends[0]), axis=1, initial=0.0)[:, None]
        changed = np.abs(ends[1] - ends[0]) > 1e-6 * size
        for i in np.flatnonzero(changed.sum(axis=1) >= TWICE):
            self.functions.problems.append(
                f"rhs: the rate of {self.system.state_names[i]} differs between time 0 and 1/frequency; it "
                "must have the period of the drive, or an edge at time 0."
            )

    def _rates(self, y: np.ndarray) -> np.ndarray | None:
        names = ", ".join(self.system.state_names)
        what = f"a rate for each of the states ({names})"
        values = self.functions.numbers("rhs", self.system.n_states, what, tuple(y), self.u, self.c)
        return None if values is None else np.array(values)

    def _check_angles(self, rates: np.ndarray) -> None:
        names = self.system.state_names
        angles = [i for i in range(len(names)) if self.system.is_angle[i]]
        changes = {i: self._change_by_turn(rates, i) for i in angles}
        broken = [i for i in angles if changes[i].any()]
        for i in broken:
            partners = [j for j in broken if j != i and not self._change_by_turn(rates, i, j).any()]
            remedy = (
                f"; it may with {names[partners[0]]}: take their difference as a state, which is no angle, in place of "
                "one of them"
                if partners
                else ""
            )
            for k in np.flatnonzero(changes[i]):
                self.functions.problems.append(
                    f"is_angle: {names[i]} is declared an angle, but the rate of {names[k]} "
                    f"changes by {changes[i][k]:g} when it goes round by 2 pi{remedy}."
                )

    def _change_by_turn(self, rates: np.ndarray, *turning: int) -> np.ndarray:
        """Return by how much each rate changes when some states go round by 2 pi together; 0 up to rounding."""
        size = np.abs(rates[:, np.isfinite(rates).all(axis=0)]).max(axis=1)
        turned = self.y.copy()
        turned[list(turning)] += 2.0 * np.pi
        after = self._rates(turned)
        assert after is not None
        change = np.abs(after - rates)
        if self.system.is_map:  # an angle may go round with the angle before it
            angles = np.asarray(self.system.is_angle)
            change[angles] = np.abs(np.remainder(change[angles] + np.pi, 2.0 * np.pi) - np.pi)
        changed = (change > 1e-6 * size[:, None]).sum(axis=1) >= TWICE
        return np.where(changed, change.max(axis=1), 0.0)

    def _check_jacobian(self, rates: np.ndarray) -> None:
        """Compare the Jacobian with finite differences of the rates. Differences with two step sizes bound their own
        error.
        """
        n, names = self.system.n_states, self.system.state_names
        what = "the derivatives of each rate by each state, row by row"
        if self.system.jacobian_entries is not None:
            what = "the derivatives whose places jacobian_entries has"
        n_entries = len(places_of(self.system))
        flat = self.functions.numbers("jacobian", n_entries, what, tuple(self.y), self.u, self.c)
        if flat is None:
            return
        given = whole_jacobian(self.system, np.array(flat).T).transpose(1, 2, 0)
        known = (np.abs(rates) < SATURATED).all(axis=0)
        size = np.abs(rates[:, known]).max(axis=1, initial=0.0)
        for j in range(n):
            step = STEP * self.scales[j]
            coarse, fine = self._slopes(j, step), self._slopes(j, 0.5 * step)
            slopes = (4.0 * fine - coarse) / 3.0
            rounding = 1e-14 * size[:, None] / step
            own_error = 10.0 * (np.abs(fine - coarse) + rounding) + 1e-8 * size[:, None] / self.scales[j]
            allowed = LEAST_MISTAKE * (np.abs(given[:, j]) + np.abs(slopes)) + own_error
            wrong = known & (np.abs(given[:, j] - slopes) > allowed)
            for i in np.flatnonzero(wrong.sum(axis=1) >= TWICE):
                k = int(np.flatnonzero(wrong[i])[0])
                self.functions.problems.append(
                    f"jacobian: entry {i * n + j}, the derivative of the rate of {names[i]} by {names[j]}, "
                    f"is {given[i, j, k]:g} where differences of rhs give {slopes[i, k]:g}."
                )

    def _slopes(self, j: int, step: float) -> np.ndarray:
        right, left = self.y.copy(), self.y.copy()
        right[j] += step
        left[j] -= step
        above, below = self._rates(right), self._rates(left)
        assert above is not None
        assert below is not None
        return np.asarray((above - below) / (right[j] - left[j]))

    def _check_layers(self, rates: np.ndarray) -> None:
        timed = (self.times,) if self.system.timed_layers else ()
        found = self.functions.call("layers", tuple(self.y), (*rates, *timed), self.c)
        problems = self.functions.problems
        if found is _NOT_RUN:
            return
        if not isinstance(found, tuple) or not all(isinstance(x, tuple) and len(x) == 4 for x in found):
            problems.append(
                "layers must return a tuple of tuples (value, rate, half_width, per_strength), one per layer."
            )
        elif not found:
            problems.append("layers returns none; leave it out, or set has_layers = False.")
        else:
            for i, (_, _, half_width, _) in enumerate(found):
                if not (np.asarray(half_width) > 0.0).all():
                    problems.append(f"layers: half_width of layer {i} must be greater than 0.")
