"""Solvers of stiff equations that race with magpend: scipy, numbalsoda, SUNDIALS' CVODE, diffrax.

The equations come from the text by `solvers.rhs_source`, their Jacobian by sympy from the same source. States are in
units of their sizes, so that one absolute tolerance suits all of them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from importlib.metadata import files
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from racing import Runner
from solvers import MAX_STEPS, array_function, tuple_of


def jacobian_of(source: str, n: int) -> Any:
    """Compile ``jacobian(t, y, out)``, which fills `out` of shape (n, n)."""
    import sympy

    time, states = sympy.Symbol("t"), sympy.symbols(f"y:{n}")
    scope: dict[str, Any] = {"math": sympy}
    exec(source, scope)
    matrix = sympy.Matrix(scope["rhs"](time, *states)).jacobian(states)
    parts, (found,) = sympy.cse(matrix)
    lines = ["def jacobian(t, y, out):", *(f"    y{i} = y[{i}]" for i in range(n))]
    lines += [f"    {name} = {sympy.pycode(part)}" for name, part in parts]
    lines += [f"    out[{i}, {j}] = {sympy.pycode(found[i, j])}" for i in range(n) for j in range(n)]
    scope = {"math": __import__("math")}
    exec("\n".join(lines), scope)
    return njit(error_model="numpy")(scope["jacobian"])


def scipy_loop(rhs: Any, jacobian: Any, time: float, method: str) -> Callable[[float], Runner]:
    """`solve_ivp` on the compiled right-hand side and Jacobian."""
    from scipy.integrate import solve_ivp

    function = array_function(rhs)

    def matrix(t: float, y: np.ndarray) -> np.ndarray:
        out = np.empty((len(y), len(y)))
        jacobian(t, y, out)
        return out

    def with_tolerance(tolerance: float) -> Runner:
        options = {"method": method, "rtol": tolerance, "atol": tolerance, "jac": matrix}

        def runner(initial: np.ndarray, _: int) -> np.ndarray:
            return np.array([solve_ivp(function, (0.0, time), y, **options).y[:, -1] for y in initial])

        return runner

    return with_tolerance


@cache
def _library(name: str) -> Any:
    """Load a library of SUNDIALS from the wheel of scikit-sundae, which calls Python for each evaluation itself."""
    import sksundae.cvode  # noqa: F401, loads what the libraries need

    (path,) = (file for file in files("scikit-sundae") or () if f"sundials_{name}-" in file.name)
    return ctypes.CDLL(str(path.locate()))


def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(_library(library), name)
    function.restype, function.argtypes = result, list(arguments)
    return function


_POINTER, _REAL, _INT = ctypes.c_void_p, ctypes.c_double, ctypes.c_int
BDF, NORMAL = 2, 1
"""Figures of cvode.h."""


def cvode_loop(rhs: Any, jacobian: Any, n: int, time: float) -> Callable[[float], Runner]:
    """CVODE's BDF with a dense matrix, all of it called from compiled code; NaN where the solver gave up."""
    fixed = tuple_of(n)
    of_vector = _function("core", "N_VGetArrayPointer", ctypes.POINTER(_REAL), _POINTER)
    of_matrix = _function("sunmatrixdense", "SUNDenseMatrix_Data", ctypes.POINTER(_REAL), _POINTER)

    @cfunc(types.int32(types.float64, *[types.voidptr] * 3), error_model="numpy", fastmath=True)
    def rates(t: Any, y: Any, out: Any, data: Any) -> Any:
        values, result = rhs(t, *fixed(carray(of_vector(y), (n,)), n)), carray(of_vector(out), (n,))
        for i in range(n):
            result[i] = values[i]
        return 0

    @cfunc(types.int32(types.float64, *[types.voidptr] * 7), error_model="numpy")
    def matrix(t: Any, y: Any, rate: Any, out: Any, data: Any, a: Any, b: Any, c: Any) -> Any:
        jacobian(t, carray(of_vector(y), (n,)), carray(of_matrix(out), (n, n)).T)  # by columns
        return 0

    context = _POINTER()
    _function("core", "SUNContext_Create", _INT, _INT, _POINTER)(0, ctypes.byref(context))
    _function("core", "SUNContext_ClearErrHandlers", _INT, _POINTER)(context)
    numbers = np.zeros(n)
    vector = _function("nvecserial", "N_VMake_Serial", _POINTER, _INT, _POINTER, _POINTER)(
        n, numbers.ctypes.data, context
    )
    dense = _function("sunmatrixdense", "SUNDenseMatrix", _POINTER, _INT, _INT, _POINTER)(n, n, context)
    linear = _function("sunlinsoldense", "SUNLinSol_Dense", _POINTER, _POINTER, _POINTER, _POINTER)(
        vector, dense, context
    )
    memory = _function("cvode", "CVodeCreate", _POINTER, _INT, _POINTER)(BDF, context)
    _function("cvode", "CVodeInit", _INT, _POINTER, _POINTER, _REAL, _POINTER)(memory, rates.address, 0.0, vector)
    _function("cvode", "CVodeSStolerances", _INT, _POINTER, _REAL, _REAL)(memory, 1e-4, 1e-4)
    _function("cvode", "CVodeSetLinearSolver", _INT, _POINTER, _POINTER, _POINTER)(memory, linear, dense)
    _function("cvode", "CVodeSetJacFn", _INT, _POINTER, _POINTER)(memory, matrix.address)
    _function("cvode", "CVodeSetMaxNumSteps", _INT, _POINTER, ctypes.c_long)(memory, MAX_STEPS)
    again = _function("cvode", "CVodeReInit", _INT, _POINTER, _REAL, _POINTER)
    stop = _function("cvode", "CVodeSetStopTime", _INT, _POINTER, _REAL)
    solve = _function("cvode", "CVode", _INT, _POINTER, _REAL, _POINTER, _POINTER, _INT)
    tolerances = _function("cvode", "CVodeSStolerances", _INT, _POINTER, _REAL, _REAL)

    @njit
    def run(initial: Any, out: Any, numbers: Any, reached: Any) -> None:
        for j in range(len(initial)):
            numbers[:] = initial[j]
            again(memory, 0.0, vector)
            stop(memory, time)
            if solve(memory, time, vector, reached.ctypes, NORMAL) < 0:
                numbers[:] = np.nan
            out[j] = numbers

    def with_tolerance(tolerance: float) -> Runner:
        def runner(initial: np.ndarray, _: int) -> np.ndarray:
            out = np.empty_like(initial)
            tolerances(memory, tolerance, tolerance)
            run(initial, out, numbers, np.zeros(1))
            return out

        runner.callbacks = rates, matrix  # the memory holds only their addresses
        return runner

    return with_tolerance


def diffrax_batch(source: str, time: float) -> Callable[[float], Runner]:
    """Kvaerno's method of order 5 of diffrax on all trajectories at once, compiled; NaN where the solver gave up."""
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    scope: dict[str, Any] = {"math": jnp}
    exec(source, scope)

    def solve(y: Any, tolerance: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: jnp.stack(scope["rhs"](t, *y))),
            diffrax.Kvaerno5(),
            0.0,
            time,
            1e-6,  # with its own first step it accepts no attempt on van der Pol's oscillator
            y,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=100_000,
            throw=False,
        )
        return jnp.where(found.result == diffrax.RESULTS.successful, found.ys[0], jnp.nan)

    batch = jax.jit(jax.vmap(solve, in_axes=(0, None)))

    def with_tolerance(tolerance: float) -> Runner:
        return lambda initial, _: np.asarray(batch(initial, tolerance))

    return with_tolerance
