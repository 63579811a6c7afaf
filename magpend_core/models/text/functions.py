"""Read the equations of a model from a Python function, as `scipy.integrate.solve_ivp` takes it.

The function is called once with traced numbers (`tracing`), and what it returns is spelled as text (`spelling`). It is
also called with plain numbers: to find errors of its own, to find its period in time, and to compare it with the text.
"""

from __future__ import annotations

import functools
import inspect
import linecache
import math
import os
import pathlib
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from types import CellType, CodeType, FunctionType, MethodType, TracebackType
from typing import Any

import numpy as np

from magpend_core.models.model import ModelError
from magpend_core.models.parameters import near_names
from magpend_core.models.text.grammar import parse
from magpend_core.models.text.numeric import rates_of, value_of
from magpend_core.models.text.reading import MAX_FUNCTION, read_definition
from magpend_core.models.text.spelling import spelled
from magpend_core.models.text.tables import shown
from magpend_core.models.text.tracing import (
    BUILT_IN,
    MOST_PATHS,
    SUBSTITUTES,
    TOO_MANY_PATHS,
    Path,
    Sheet,
    Traced,
    UntraceableError,
    current_path,
    name,
    number,
    traced_array,
    where,
)

N_SAMPLES = 12
"""Random times, states and parameter values at which a function is called with plain numbers."""
SAME = 1e-8
"""Largest difference of two rates that count as equal, in units of the rate's largest value."""


@dataclass(frozen=True)
class Drive:
    """How a parameter gives the rate of the drive: its text, and the function from its value to the period [s]."""

    text: str
    meaning: str
    period: Callable[[float], float]


DRIVES = (
    Drive("2*pi*f", "angular frequency", lambda value: 2.0 * math.pi / value),
    Drive("f", "frequency", lambda value: 1.0 / value),
    Drive("1/f", "period", lambda value: value),
)


class Values:
    """Parameters as a function sees them: by name (``p.k``, ``p["k"]``) or in their order (``k, c = p``, ``p[0]``)."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getattr__(self, key: str) -> Any:
        if key.startswith("__") or key not in self._values:
            raise AttributeError(f"{key!r} is no parameter; {near_names(key, self._values, 'parameters')}")
        return self._values[key]

    def __getitem__(self, key: str | int | slice) -> Any:
        return getattr(self, key) if isinstance(key, str) else list(self._values.values())[key]

    def __iter__(self) -> Iterator[Any]:
        return iter(self._values.values())

    def __len__(self) -> int:
        return len(self._values)


def read_function(
    function: Callable[..., Any], tables: Mapping[str, Any], values: Mapping[str, Any], drive: str | None = None
) -> dict[str, Any]:
    """Return the table of a model, as text has it, whose equations a Python function computes.

    Parameters
    ----------
    function
        ``f(t, y)``, ``f(t, y, p)`` or ``f(t, y, k, c, ...)`` with parameters by name; returns the rates of the states.
    tables
        Keys of ``[model]`` but the equations. ``states`` may be a sequence of names; their order is that of `y`.
    values
        Parameters and their values, after those of ``tables``.
    drive
        Parameter that is the angular frequency [rad/s], the frequency [Hz] or the period [s] of the drive. In the
        text it is an expression of ``f``, and no parameter.

    Raises
    ------
    ModelError
        If the text of a model cannot say what the function does; the message has the line and the remedy.
    """
    states = _names_of(tables.get("states"))
    parameters = tables.get("parameters") or {}
    if not isinstance(parameters, Mapping):
        raise ModelError(
            [f'parameters = {shown(parameters)}: must be values by name, such as parameters={{"k": 2.0}}.']
        )
    parameters = {**parameters, **values}
    own = {key: value for key, value in parameters.items() if key != drive}
    head = {"name": _name_of(function), **tables, "states": states, "parameters": own}
    definition = _check(
        {**{key: head[key] for key in ("name", "states", "parameters")}, "equations": _no_rates(states)}
    )
    given = {key: value["value"] if isinstance(value, Mapping) else value for key, value in parameters.items()}
    call = _Call(function, {s.name: s.scale for s in definition.states}, given, drive)
    call.try_out()
    roots, variables, source = call.traced()
    found = call.drive_of(roots)
    define = dict(tables.get("define") or {})
    call.write_phases(roots, found)
    if found is not None and drive is not None:
        if found.text == "f":
            _rename(roots, drive, "f")
        else:
            define = {drive: found.text, **define}
    rates, parts = spelled(roots, variables, [*states, *own, *define, "t", "f", "phase", "pi"])
    define |= parts
    table = {key: value for key, value in head.items() if value or key != "parameters"}
    table |= {"define": define} if define else {}
    table["equations"] = dict(zip(states, rates, strict=True))
    if 0 < len(source) <= MAX_FUNCTION:
        table["function"] = source
    call.compare(table, found)
    return table


def _names_of(states: Any) -> dict[str, Any]:
    """Return the entries of a function's states by name, from a table or from their names alone."""
    if isinstance(states, Mapping):
        found = dict(states)
    elif isinstance(states, Iterable):
        found = dict.fromkeys([states] if isinstance(states, str) else states, "1")
    elif states is None:
        found = {}
    else:
        raise ModelError([f'states = {shown(states)}: must be names, in the order of y: states=("x", "v").'])
    if not found:
        raise ModelError(['states: name the states of the function in the order of y: states=("x", "v").'])
    return found


def _no_rates(states: Mapping[str, Any]) -> dict[str, str]:
    return dict.fromkeys(states, "0")


def _check(table: Mapping[str, Any]) -> Any:
    definition, problems = read_definition(table)
    if definition is None:
        raise ModelError(problems)
    return definition


def _name_of(function: Callable[..., Any]) -> str:
    label = getattr(function, "__name__", "")
    return label if label.isidentifier() and label[0].isalpha() and len(label) <= 60 else "model"


@dataclass(frozen=True)
class _Trial:
    """Time, state and parameter values with which a function is called."""

    t: float
    y: np.ndarray
    values: Mapping[str, Any]


@dataclass(frozen=True)
class _Way:
    """One path through a function: the rates returned, the decisions on the way, and its variables at the end."""

    rates: list[Traced]
    decisions: list[tuple[Traced, bool]]
    variables: dict[str, Any]


def _joined(ways: Sequence[_Way], depth: int, sheet: Sheet) -> list[Traced]:
    """Return the rates of all ways as one, by ``where`` of the decisions from the one at `depth` on."""
    if len(ways) == 1:
        return ways[0].rates
    condition = ways[0].decisions[depth][0]
    yes, no = (_joined([w for w in ways if w.decisions[depth][1] is side], depth + 1, sheet) for side in (True, False))
    return [_merged(condition, a, b, sheet) for a, b in zip(yes, no, strict=True)]


def _merged(condition: Traced, yes: Traced, no: Traced, sheet: Sheet) -> Traced:
    """Return a number that is `yes` where a condition holds, else `no`, with what both have in common outside."""
    if sheet.number(yes) == sheet.number(no):
        return yes
    if "sum" in (yes.op, no.op):
        own, others = ({sheet.number(term): term for term in _terms(side)} for side in (yes, no))
        both = [term for key, term in own.items() if key in others]
        mine = [term for key, term in own.items() if key not in others]
        rest = [term for key, term in others.items() if key not in own]
        if both and len(own) == len(_terms(yes)) and len(others) == len(_terms(no)):
            return _total([*both, _merged(condition, _total(mine), _total(rest), sheet)])
    elif (yes.op, yes.value, len(yes.args)) == (no.op, no.value, len(no.args)):
        pairs = list(zip(yes.args, no.args, strict=True))
        differ = [i for i, (a, b) in enumerate(pairs) if sheet.number(a) != sheet.number(b)]
        if len(differ) == 1 and not pairs[differ[0]][0].is_condition:
            args = list(yes.args)
            args[differ[0]] = _merged(condition, *pairs[differ[0]], sheet)
            return Traced(yes.op, tuple(args), yes.value)
    return where(condition, yes, no)


def _terms(root: Traced) -> list[Traced]:
    """Return the terms of a sum in their order; another expression is its one term."""
    found, pending = [], [root]
    while pending:
        node = pending.pop()
        if node.op == "sum":
            pending += node.args[::-1]
        else:
            found.append(node)
    return found


def _total(terms: Sequence[Traced]) -> Traced:
    return functools.reduce(lambda a, b: Traced("sum", (a, b)), terms) if terms else number(0.0)


def _common(found: Sequence[dict[str, Any]], sheet: Sheet) -> dict[str, Any]:
    """Return the variables that are the same on all ways, in their order."""
    if len(found) == 1:
        return found[0]
    values = [{key: sheet.number(v) for key, v in one.items() if isinstance(v, Traced)} for one in found]
    return {key: v for key, v in found[0].items() if key in values[0] and len({one.get(key) for one in values}) == 1}


class _Call:
    """A function with the names of its states and the values of its parameters."""

    def __init__(
        self, function: Callable[..., Any], scales: Mapping[str, float], values: Mapping[str, Any], drive: str | None
    ) -> None:
        self.function = getattr(function, "py_func", function)  # of a function that numba compiles
        self.states, self.drive = list(scales), drive
        self.label = getattr(function, "__name__", type(function).__name__)
        self.values = values if drive is None else {**values, drive: values.get(drive, 1.0)}
        if drive is not None and not (isinstance(self.values[drive], Real) and self.values[drive] > 0.0):
            raise self.error(f"the value of its drive, {drive} = {self.values[drive]!r}, must be greater than 0")
        self.names = self._arguments()
        random, size = np.random.default_rng(0), np.array(list(scales.values()))
        self.trials = [_Trial(0.0, size * random.uniform(0.1, 1.0, len(size)), self.values)]
        for k in range(N_SAMPLES):
            # half of them positive, for roots and logarithms
            y = size * random.uniform(-1.0 if k % 2 else 0.1, 1.0, len(size))
            near = {key: value * random.uniform(0.8, 1.25) for key, value in self.values.items()}
            self.trials.append(_Trial(random.uniform(0.0, 10.0), y, near))

    def _arguments(self) -> list[str] | None:
        """Return the names of the arguments after time and state; None for one that takes all parameters."""
        try:
            given = [p for p in inspect.signature(self.function).parameters.values() if p.kind <= p.VAR_POSITIONAL]
        except (TypeError, ValueError):
            return None
        if len(given) < 2:
            raise self.error("takes fewer than two arguments; write def f(t, y, p)")
        rest = [p for p in given[2:] if p.name in self.values or p.default is p.empty]
        if len(rest) == 1 and rest[0].name not in self.values and rest[0].kind < rest[0].VAR_POSITIONAL:
            return None
        if unknown := [p.name for p in rest if p.name not in self.values]:
            raise self.error(
                f"its argument {unknown[0]} is no parameter; {near_names(unknown[0], self.values, 'parameters')}"
            )
        return [p.name for p in rest]

    def error(self, sentence: str) -> ModelError:
        """Return an error of the function."""
        return ModelError([f"{self.label}: {sentence.rstrip('.')}."])

    def call(self, function: Callable[..., Any], t: Any, y: Any, values: Mapping[str, Any]) -> list[Any]:
        """Return the rates that the function gives, as a list of numbers."""
        rest = [Values(values)] if self.names is None else [values[key] for key in self.names]
        found = function(t, y, *rest)
        rates = [found] if np.ndim(found) == 0 else list(found)
        if len(rates) != len(self.states) or any(np.ndim(rate) for rate in rates):
            what = f"{len(rates)} rates" if not any(np.ndim(rate) for rate in rates) else "an array within its result"
            raise self.error(
                f"returns {what}; it must return a vector with the rates of its {len(self.states)} states, "
                f"{', '.join(self.states[:6])}{', ...' if len(self.states) > 6 else ''}"
            )
        return rates

    def rates(self, trial: _Trial, t: float | None = None) -> np.ndarray | None:
        """Return the rates at a trial, or at another time; None if the function has no value there."""
        try:
            with np.errstate(all="ignore"):
                found = self.call(self.function, trial.t if t is None else t, trial.y.copy(), trial.values)
                rates = np.array(found, dtype=float)
        except (ArithmeticError, ValueError):
            return None
        return rates if np.isfinite(rates).all() else None

    def try_out(self) -> None:
        """Raise if the function fails with plain numbers: then it is wrong in itself."""
        first = self.trials[0]
        try:
            with np.errstate(all="ignore"):
                try:
                    self.call(self.function, first.t, first.y.copy(), first.values)
                except (AttributeError, TypeError):
                    if self.names is None or len(self.names) != 1:
                        raise
                    self.names = None  # f(t, y, p) may take all parameters, although one of them is called p
                    self.call(self.function, first.t, first.y.copy(), first.values)
        except ModelError:
            raise
        except (ArithmeticError, ValueError) as error:
            if all(self.rates(trial) is None for trial in self.trials):
                raise self.error(
                    f"has no rates at any of {len(self.trials)} states between -1 and 1, in units of their scales"
                    f"{_place(error)}: {_said(error)}. Give the states a scale at which it has"
                ) from error
        except Exception as error:
            at = ", ".join(f"{key} = {value:.3g}" for key, value in zip(self.states[:6], first.y, strict=False))
            raise self.error(f"fails at t = 0, {at}{_place(error)}: {_said(error)}") from error

    def traced(self) -> tuple[list[Traced], dict[str, Any], str]:
        """Return the traced rates, the variables of the function, and the source of it and of functions it calls."""
        made: dict[int, Any] = {}
        function, sheet = _rebound(self.function, made), Sheet()
        ways: list[_Way] = []
        plan: list[bool] | None = []
        while plan is not None:
            path = Path(plan, sheet)
            try:
                if len(ways) == MOST_PATHS:
                    raise UntraceableError(TOO_MANY_PATHS)
                ways.append(self._way(function, path))
            except ModelError:
                raise
            except Exception as error:
                raise self.error(f"its equations cannot be read as text{_place(error)}: {_said(error)}") from None
            plan = path.next_plan()
        roots = _joined(ways, 0, sheet)
        return roots, _common([way.variables for way in ways], sheet), _source([one for one, _ in made.values()])

    def _way(self, function: Callable[..., Any], path: Path) -> _Way:
        """Follow the function on one path."""
        code = getattr(_inner(function), "__code__", None)
        variables: dict[str, Any] = {}

        def keep(frame: Any, event: str, _: Any) -> None:
            if event == "return" and frame.f_code is code:
                variables.clear()
                variables.update(frame.f_locals)

        before, token = sys.getprofile(), current_path.set(path)
        sys.setprofile(keep)
        try:
            values = {key: name(key) for key in self.values}
            found = self.call(function, name("t"), traced_array(map(name, self.states)), values)
        finally:
            sys.setprofile(before)
            current_path.reset(token)
        return _Way([number(rate) for rate in found], path.decisions, variables)

    def drive_of(self, roots: Sequence[Traced]) -> Drive | None:
        """Return what the drive's parameter is, from the period of the function; None for a function without time."""
        if not _needs_time(roots):
            if self.drive is not None:
                raise self.error(f"does not depend on t, so {self.drive} drives nothing; leave drive out")
            return None
        if self.drive is None:
            fits = [(key, d) for key in self.values for d in DRIVES if self.repeats(key, d)]
            example, about = '"omega"', "its parameter must be the angular frequency, the frequency or the period"
            if fits:
                key, found = fits[0]
                example, about = f'"{key}"', f"f repeats after {_period(found, key)}"
            raise self.error(f"depends on t: name the parameter of its drive, drive={example} ({about})")
        for found in DRIVES:
            if self.repeats(self.drive, found):
                return found
        periods = ", ".join(_period(d, self.drive) for d in DRIVES)
        raise self.error(
            f"does not repeat in t with the drive {self.drive}: after neither of {periods} are its rates the same. "
            "Every part in t needs this period, such as cos(n*omega*t) with a whole number n; a second drive that has "
            "none in common is written as two states that turn"
        )

    def write_phases(self, roots: Sequence[Traced], drive: Drive | None) -> None:
        """Write ``t % T``, with the drive's period T, and ``(omega*t) % (2*pi)`` as multiples of ``phase``, other
        remainders as ``mod``.
        """
        period = math.inf if drive is None or self.drive is None else drive.period(self.values[self.drive])
        for node in _nodes(roots):
            if node.op != "remainder":
                continue
            (text,), parts = spelled([Traced("quotient", node.args)], {}, ())
            known: dict[str, Any] = {**self.values, "pi": math.pi, "t": np.array([0.31, 1.7, 4.9])}
            try:
                turns = value_of(parse(text), known) if not parts else math.nan
            except KeyError:  # it changes with the state
                turns = math.nan
            if np.allclose(turns, known["t"] / period, rtol=1e-9, atol=0.0):
                node.op, node.args = "product", (name("phase"), node.args[1])
            else:
                node.op, node.value = "call", "mod"

    def repeats(self, key: str, drive: Drive) -> bool:
        """Return whether the rates are the same a period later, at trials at which they have values."""
        pairs = []
        for trial in self.trials[1:]:
            if not trial.values[key] > 0.0:
                return False
            period = drive.period(trial.values[key])
            start = trial.t % 1.0 * period
            now, then = self.rates(trial, start), self.rates(trial, start + period)
            pairs += [] if now is None or then is None else [(now, then)]
        return bool(pairs) and _differs(*map(np.array, zip(*pairs, strict=True))) is None

    def compare(self, table: Mapping[str, Any], drive: Drive | None) -> None:
        """Raise if the text has other rates than the function."""
        definition = _check({key: value for key, value in table.items() if key not in ("quantities", "impacts")})
        rows, found, expected = [], [], []
        for trial in self.trials:
            rates = self.rates(trial)
            if rates is None:
                continue
            frequency = 1.0 if drive is None or self.drive is None else 1.0 / drive.period(trial.values[self.drive])
            known = {"pi": math.pi, "f": frequency, "t": trial.t, "phase": trial.t * frequency % 1.0, **trial.values}
            by_text = rates_of(definition, known | dict(zip(self.states, trial.y, strict=True)))
            rows.append(trial)
            found.append([float(by_text[key]) for key in self.states])
            expected.append(rates)
        if found and (wrong := _differs(np.array(expected), np.array(found))) is not None:
            k, i = wrong
            text = definition.lines[self.states[i]].text
            raise self.error(
                f"at t = {rows[k].t:.3g} the rate of {self.states[i]} is {expected[k][i]:.6g}, and {found[k][i]:.6g} "
                f"by the text that was read from it, {text[:80]}. A function must depend on its arguments alone, and "
                "do the same steps for all of them"
            )


def _differs(a: np.ndarray, b: np.ndarray) -> tuple[int, int] | None:
    """Return the place (trial, state) of the largest difference of rates, if it is no rounding."""
    size = np.abs(a).max(axis=0) + 1e-300
    off = np.where(np.isfinite(b), np.abs(a - b) / size, np.inf)
    k, i = np.unravel_index(np.argmax(off), off.shape)
    return None if off[k, i] <= SAME else (int(k), int(i))


def _period(drive: Drive, key: str) -> str:
    return {"2*pi*f": f"2 pi/{key}", "f": f"1/{key}", "1/f": key}[drive.text]


def _needs_time(roots: Sequence[Traced]) -> bool:
    return any(node.op == "name" and node.value == "t" for node in _nodes(roots))


def _nodes(roots: Sequence[Traced]) -> Iterator[Traced]:
    """Yield all traced numbers that expressions consist of, once each."""
    seen: set[int] = set()
    pending = list(roots)
    while pending:
        node = pending.pop()
        if id(node) not in seen:
            seen.add(id(node))
            yield node
            pending += node.args


def _rename(roots: Sequence[Traced], old: str, new: str) -> None:
    for node in _nodes(roots):
        if node.op == "name" and node.value == old:
            node.value = new


# ---- the function with other numpy, math and built-in functions -----------------------------------


def _inner(function: Any) -> Any:
    while isinstance(function, functools.partial | MethodType):
        function = function.func if isinstance(function, functools.partial) else function.__func__
    return function


def _rebound(value: Any, made: dict[int, Any]) -> Any:
    """Return a function that calls `tracing.SUBSTITUTES` in place of functions of numpy and math, and so do those that
    it calls; other values unchanged. `made` keeps each function with its copy.
    """
    value = getattr(value, "py_func", value)  # of a function that numba compiles
    if id(value) in SUBSTITUTES:
        return SUBSTITUTES[id(value)]
    if isinstance(value, functools.partial):
        return functools.partial(_rebound(value.func, made), *value.args, **value.keywords)
    if isinstance(value, MethodType):
        return MethodType(_rebound(value.__func__, made), value.__self__)
    if not isinstance(value, FunctionType) or str(value.__module__).partition(".")[0] in ("numpy", "scipy"):
        return value
    if id(value) not in made:
        names, cells = dict(value.__globals__), tuple(CellType() for _ in value.__closure__ or ())
        copy = FunctionType(value.__code__, names, value.__name__, value.__defaults__, cells or None)
        copy.__kwdefaults__ = value.__kwdefaults__
        made[id(value)] = value, copy
        for key in _names_used(value.__code__):
            if key in names:
                names[key] = _rebound(names[key], made)
            elif key in BUILT_IN:
                names[key] = BUILT_IN[key]
        for old, new in zip(value.__closure__ or (), cells, strict=True):
            try:
                content = old.cell_contents
            except ValueError:  # no value yet
                continue
            new.cell_contents = _rebound(content, made)
    return made[id(value)][1]


def _names_used(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_used(constant)


def _source(functions: Sequence[Callable[..., Any]]) -> str:
    """Return the source of functions; empty where there is none."""
    try:
        return "\n\n".join(textwrap.dedent(inspect.getsource(function)).strip() for function in functions)
    except (OSError, TypeError):
        return ""


_OWN = tuple(str(pathlib.Path(module.__file__ or "").parent) for module in (np, sys.modules[__package__]))


def _place(error: BaseException) -> str:
    """Return the line of the user's code at which an error came up."""
    found = ""
    step: TracebackType | None = error.__traceback__
    while step is not None:
        file, line = step.tb_frame.f_code.co_filename, step.tb_lineno
        if not file.startswith(_OWN) and f"{os.sep}scipy{os.sep}" not in file:
            text = linecache.getline(file, line).strip()
            found = f", line {line}{f', `{text}`' if text else ''}"
        step = step.tb_next
    return found


def _said(error: BaseException) -> str:
    return str(error) if isinstance(error, UntraceableError) else f"{type(error).__name__}: {error}"
