"""A model as text for other solvers: a scalar numba loop, numbalsoda, scipy and heyoka.

Everything is made from the text's expressions as they were read, by other code than the engine's: definitions
become local variables, parameters and the drive's frequency become numbers, which a compiler can fold.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from racing import Runner

from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.model import TextModel
from magpend_core.models.text.numeric import CALLS

_OPTIONS = {"error_model": "numpy", "fastmath": True, "nogil": True}
_NAMES = {"abs": "abs", "min": "min", "max": "max", "sign": "_sign", "square": "_square"}
_SIGNS = {"sum": " + ", "and": " and ", "or": " or "}
MAX_STEPS = 10_000_000


@njit(**_OPTIONS)
def _sign(x: float) -> float:
    return 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)


@njit(**_OPTIONS)
def _square(phase: float, duty: float) -> float:
    return 1.0 if phase - math.floor(phase) < duty else -1.0


def _python(tree: Tree) -> str:
    """An expression as Python for numba, with libm's functions."""
    if tree.kind == "number":
        return f"({tree.value!r})"
    if tree.kind == "name":
        return str(tree.value)
    if tree.kind == "power" and tree.args[1].kind == "number" and float(tree.args[1].value).is_integer():
        return f"({_python(tree.args[0])} ** {int(tree.args[1].value)})"
    args = [_python(arg) for arg in tree.args]
    if tree.kind == "call":
        if tree.value == "where":
            return f"({args[1]} if {args[0]} else {args[2]})"
        return f"{_NAMES.get(str(tree.value), f'math.{tree.value}')}({', '.join(args)})"
    if tree.kind == "product":
        return f"({' * '.join(args)})"
    if tree.kind == "inverse":
        return f"(1.0 / {args[0]})"
    if tree.kind == "negative":
        return f"(-{args[0]})"
    if tree.kind == "not":
        return f"(not {args[0]})"
    sign = _SIGNS.get(tree.kind) or {"power": " ** "}.get(tree.kind) or f" {tree.value} "
    return f"({sign.join(args)})"


def rhs_source(model: TextModel, values: Mapping[str, float], frequency: float, sizes: Sequence[float] = ()) -> str:
    """Source of ``rhs(t, *states)`` -> rates as a tuple, of states in units of their sizes if these are given."""
    definition = model.definition
    states = [s.name for s in model.states]
    known = {**{name: repr(float(v)) for name, v in values.items()}, "pi": repr(math.pi), "f": repr(frequency)}
    lines = [f"def rhs(t, {', '.join(states)}):"]
    lines += [f"    {name} = {name} * {size!r}" for name, size in zip(states, sizes, strict=False)]
    for name in definition.used(definition.equations.values()):
        if name == "phase":
            lines.append(f"    phase = t * {frequency!r}")
        elif name in definition.define:
            lines.append(f"    {name} = {_python(definition.define[name])}")
        elif name in known:
            lines.append(f"    {name} = {known[name]}")
    rates = [_python(tree) for tree in definition.equations.values()]
    rates = [f"({rate}) / {size!r}" for rate, size in zip(rates, sizes, strict=True)] if sizes else rates
    return "\n".join([*lines, f"    return ({', '.join(rates)},)"])


def scalar_rhs(model: TextModel, values: Mapping[str, float], frequency: float, sizes: Sequence[float] = ()) -> Any:
    """Compiled ``rhs(t, *states)`` -> rates as a tuple."""
    scope: dict[str, Any] = {"math": math, "_sign": _sign, "_square": _square}
    exec(rhs_source(model, values, frequency, sizes), scope)
    return njit(forceinline=True, **_OPTIONS)(scope["rhs"])


# Dormand-Prince 5(4)
_A = [
    [1 / 5],
    [3 / 40, 9 / 40],
    [44 / 45, -56 / 15, 32 / 9],
    [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729],
    [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656],
    [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
]
_C = [1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0]
_E = [71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40]


def _sum(row: list[float], i: int) -> str:
    return " + ".join(f"{a!r} * k{j}_{i}" for j, a in enumerate(row) if a != 0.0)


def _slopes(stage: int, n: int) -> str:
    return ", ".join(f"k{stage}_{i}" for i in range(n))


def _step_source(n: int) -> Iterator[str]:
    """One attempted step, written out; what one would write by hand for a system of two or four states."""
    for s, row in enumerate(_A, start=1):
        for i in range(n):
            yield f"z{i} = y{i} + h * ({_sum(row, i)})"
        yield f"{_slopes(s, n)}, = rhs(t + {_C[s - 1]!r} * h, {', '.join(f'z{i}' for i in range(n))})"
    yield "total = 0.0"
    for i in range(n):
        yield f"e = h * ({_sum(_E, i)}) / (tolerance + tolerance * max(abs(y{i}), abs(z{i})))"
        yield "total += e * e"
    yield f"error = math.sqrt(total / {n})"


def scalar_loop(rhs: Any, n: int, period: float) -> Callable[[float], Runner]:
    """Dormand-Prince 5(4) in a loop over trajectories, as one writes it in numba.

    Step control is the textbook's: Hairer, Norsett and Wanner, Solving ODEs I, II.4. The attribute `attempts` of a
    runner counts the steps of its last run.
    """
    ys, zs = (", ".join(f"{letter}{i}" for i in range(n)) for letter in "yz")
    body = "\n                ".join(_step_source(n))
    source = f"""
def loop(initial, n_periods, tolerance, out):
    attempts = 0
    for j in range(len(initial)):
        {ys}, = {", ".join(f"initial[j, {i}]" for i in range(n))},
        t, wish, rejected = 0.0, {1e-3 * period!r}, False
        {_slopes(0, n)}, = rhs(t, {ys})
        for i_period in range(n_periods):
            end = (i_period + 1) * {period!r}
            while t < end:
                last = wish >= end - t
                h = end - t if last else wish
                {body}
                attempts += 1
                grow = 0.9 * max(error, 1e-10) ** -0.2
                factor = min(5.0, max(0.2, grow))
                if error > 1.0:
                    wish, rejected = h * min(factor, 1.0), True
                    continue
                if not last:
                    wish = h * (min(factor, 1.0) if rejected else factor)
                rejected = False
                t = end if last else t + h
                {ys}, {_slopes(0, n)}, = {zs}, {_slopes(6, n)},
        {", ".join(f"out[j, {i}]" for i in range(n))}, = {ys},
    return attempts
"""
    scope: dict[str, Any] = {"rhs": rhs, "math": math}
    exec(source, scope)
    loop = njit(error_model="numpy", fastmath={"contract"}, nogil=True)(scope["loop"])

    def with_tolerance(tolerance: float) -> Runner:
        def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
            out = np.empty_like(initial)
            runner.attempts = loop(initial, n_periods, tolerance, out)
            return out

        return runner

    return with_tolerance


def scipy_runner(rhs: Any, period: float, tolerance: float, method: str) -> Runner:
    """Runner with scipy's `solve_ivp`, which shares nothing with the engine."""
    from scipy.integrate import solve_ivp

    function = array_function(rhs)

    def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
        options = {"method": method, "rtol": tolerance, "atol": tolerance}
        rows = [solve_ivp(function, (0.0, n_periods * period), y, **options).y[:, -1] for y in initial]
        return np.array(rows)

    return runner


@cache
def array_function(rhs: Any) -> Any:
    """Compile ``function(t, y)`` -> array, once for all tolerances."""
    n = rhs.py_func.__code__.co_argcount - 1
    fixed = tuple_of(n)

    @njit(error_model="numpy")
    def function(t: float, y: np.ndarray) -> np.ndarray:
        return np.array(rhs(t, *fixed(y, n)))

    return function


@cache
def tuple_of(n: int) -> Any:
    scope: dict[str, Any] = {}
    exec(f"def fixed(y, n): return ({', '.join(f'y[{i}]' for i in range(n))},)", scope)
    return njit(forceinline=True)(scope["fixed"])


def numbalsoda_loop(rhs: Any, n: int, period: float, method: str) -> Callable[[float], Runner]:
    """LSODA or DOP853 in C++ on the same compiled right-hand side; NaN where the solver gave up."""
    import numbalsoda
    from numba import carray, cfunc

    fixed = tuple_of(n)

    @cfunc(numbalsoda.lsoda_sig, fastmath=True, error_model="numpy")
    def callback(t: Any, y: Any, out: Any, data: Any) -> None:
        rates = rhs(t, *fixed(carray(y, (n,)), n))
        result = carray(out, (n,))
        for i in range(n):
            result[i] = rates[i]

    solve, address = getattr(numbalsoda, method), callback.address

    @njit
    def run(initial: Any, times: Any, tolerance: float, out: Any, data: Any) -> None:
        for j in range(len(initial)):
            solution, success = solve(address, initial[j], times, data, tolerance, tolerance, MAX_STEPS)
            for i in range(out.shape[1]):
                out[j, i] = solution[-1, i] if success else np.nan

    run.callback = callback  # the loop holds only its address

    def with_tolerance(tolerance: float) -> Runner:
        def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
            out = np.empty_like(initial)
            run(initial, np.array([0.0, n_periods * period]), tolerance, out, np.zeros(1))
            return out

        return runner

    return with_tolerance


def _heyoka_call(name: str, args: list[Any]) -> Any:
    import heyoka as hy

    def below(a: Any, b: Any) -> Any:
        return hy.lt(a, b)

    if all(isinstance(a, (float, int)) for a in args):
        return float(CALLS[name](*args))
    if name == "abs":
        return hy.select(below(args[0], 0.0), -args[0], args[0])
    if name == "sign":
        return hy.select(below(args[0], 0.0), -1.0, hy.select(below(0.0, args[0]), 1.0, 0.0))
    if name in ("min", "max"):
        found = args[0]
        for other in args[1:]:
            first, second = (found, other) if name == "min" else (other, found)
            found = hy.select(below(first, second), found, other)
        return found
    if name == "where":
        return hy.select(*args)
    return getattr(hy, name)(*args)


def _heyoka(tree: Tree, names: Mapping[str, Any]) -> Any:
    import heyoka as hy

    if tree.kind == "number":
        return float(tree.value)
    if tree.kind == "name":
        return names[str(tree.value)]
    if tree.kind == "product":
        value = _heyoka(tree.args[0], names)
        for part in tree.args[1:]:
            value = value / _heyoka(part.args[0], names) if part.kind == "inverse" else value * _heyoka(part, names)
        return value
    args = [_heyoka(arg, names) for arg in tree.args]
    if tree.kind == "call":
        return _heyoka_call(str(tree.value), args)
    if tree.kind == "compare":
        signs = {"<": hy.lt, "<=": hy.lte, ">": hy.gt, ">=": hy.gte}
        return signs[str(tree.value)](*args)
    if tree.kind == "sum":
        return sum(args[1:], start=args[0])
    if tree.kind == "negative":
        return -args[0]
    if tree.kind == "power":
        return args[0] ** args[1]
    joined = {"and": "logical_and", "or": "logical_or"}
    return getattr(hy, joined[tree.kind])(args)


def heyoka_equations(model: TextModel, values: Mapping[str, float], frequency: float) -> tuple[list[Any], list[Any]]:
    """State variables and the expressions of their rates, parameters folded in as numbers."""
    import heyoka as hy

    definition = model.definition
    variables = list(hy.make_vars(*[s.name for s in model.states]))
    names: dict[str, Any] = {s.name: v for s, v in zip(model.states, variables, strict=True)}
    names |= {**{k: float(v) for k, v in values.items()}, "pi": math.pi, "f": frequency, "t": hy.time}
    names["phase"] = hy.time * frequency
    for name in definition.used(definition.equations.values()):
        if name in definition.define:
            names[name] = _heyoka(definition.define[name], names)
    return variables, [_heyoka(tree, names) for tree in definition.equations.values()]


def heyoka_batch(
    model: TextModel, values: Mapping[str, float], frequency: float, tolerance: float, batch: int
) -> Runner:
    """heyoka's batch integrator on the model."""
    import heyoka as hy

    variables, right = heyoka_equations(model, values, frequency)
    integrator = hy.taylor_adaptive_batch(
        list(zip(variables, right, strict=True)),
        np.zeros((len(variables), batch)),
        tol=tolerance,
        compact_mode=False,
        fast_math=True,
        force_avx512=True,
    )

    def runner(initial: np.ndarray, n_periods: int) -> np.ndarray:
        out = np.empty_like(initial)
        for first in range(0, len(initial), batch):
            rows = slice(first, first + batch)
            integrator.set_time(0.0)
            integrator.state[:] = initial[rows].T
            integrator.propagate_until(n_periods / frequency)
            out[rows] = integrator.state.T
        return out

    return runner


def orders(first: int, last: int, step: int = 2) -> Iterator[tuple[int, float]]:
    """heyoka's orders with a tolerance that gives each: the step follows from the order alone."""
    for order in itertools.islice(itertools.count(first, step), (last - first) // step + 1):
        yield order, 1.0001 * math.exp(-2.0 * (order - 1))
