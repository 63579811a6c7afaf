"""numbalsoda and scipy on a compiled right-hand side, one trajectory at a time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from problem import Runner
from scalar_model import scalar_rhs

import magpend_core

MAX_STEPS = 1_000_000
"""Steps per drive period that LSODA and DOP853 may take."""


def _numbalsoda_loop(parameters: magpend_core.Parameters, method: str) -> Any:
    """Compiled loop over trajectories; NaN where the solver gave up."""
    import numbalsoda
    from numba import carray, cfunc

    rhs = scalar_rhs(parameters.as_dict())

    @cfunc(numbalsoda.lsoda_sig, fastmath=True, error_model="numpy")
    def callback(t: Any, y: Any, out: Any, omega: Any) -> None:
        result = carray(out, (4,))
        result[0], result[1], result[2], result[3] = rhs(t, carray(y, (4,)), omega[0])

    solve, address = getattr(numbalsoda, method), callback.address

    @njit
    def run(initial: Any, times: Any, omega: Any, tolerance: float) -> Any:
        section = np.full((len(initial), times.shape[1] - 1, 4), np.nan)
        for i in range(len(initial)):
            solution, success = solve(address, initial[i], times[i], omega[i], tolerance, tolerance, MAX_STEPS)
            if success:
                section[i] = solution[1:]
        return section

    # the callback must outlive the loop, which holds only its address
    run.callback = callback
    return run


def numbalsoda_runner(parameters: magpend_core.Parameters, method: str) -> Callable[[float], Runner]:
    """Return a function from a tolerance to a runner; `method` is ``"lsoda"`` or ``"dop853"``."""
    loop = _numbalsoda_loop(parameters, method)

    def with_tolerance(tolerance: float) -> Runner:
        def runner(frequency_hz: np.ndarray, initial: np.ndarray, n_periods: int) -> np.ndarray:
            times = np.arange(n_periods + 1) / frequency_hz[:, None]
            return loop(initial, times, 2.0 * math.pi * frequency_hz[:, None], tolerance)

        return runner

    with_tolerance(1e-3)(np.array([2.0]), np.full((1, 4), 0.1), 1)  # compile
    return with_tolerance


def _scipy_function(parameters: magpend_core.Parameters, frequency_hz: float) -> Callable[..., Any]:
    """Right-hand side as `solve_ivp` calls it, with as little as possible on Python's side."""
    return _compiled_function(tuple(parameters.as_dict().items()), frequency_hz)


@cache
def _compiled_function(parameters: tuple[tuple[str, float], ...], frequency_hz: float) -> Callable[..., Any]:
    """Once for all trajectories: each would compile it anew."""
    rhs, omega = scalar_rhs(dict(parameters)), 2.0 * math.pi * frequency_hz

    @njit(error_model="numpy")
    def function(t: float, y: np.ndarray) -> np.ndarray:
        return np.array(rhs(t, y, omega))

    function(0.0, np.full(4, 0.1))  # compile
    return function


def scipy_runner(parameters: magpend_core.Parameters, method: str) -> Callable[[float], Runner]:
    """Return a function from a tolerance to a runner with scipy's ``solve_ivp``."""
    from scipy.integrate import solve_ivp

    functions: dict[float, Callable[..., Any]] = {}

    def with_tolerance(tolerance: float) -> Runner:
        def runner(frequency_hz: np.ndarray, initial: np.ndarray, n_periods: int) -> np.ndarray:
            section = np.empty((len(initial), n_periods, 4))
            for i, f in enumerate(frequency_hz.tolist()):
                if f not in functions:
                    functions[f] = _scipy_function(parameters, f)
                times = np.arange(n_periods + 1) / f
                solution = solve_ivp(
                    functions[f], (0.0, times[-1]), initial[i], method, times, rtol=tolerance, atol=tolerance
                )
                section[i] = solution.y.T[1:]
            return section

        return runner

    return with_tolerance


def split_solution(
    parameters: magpend_core.Parameters,
    frequency_hz: float,
    initial_state: np.ndarray,
    n_periods: int,
    tolerance: float,
) -> np.ndarray:
    """Sections (n_periods, 4) by scipy's DOP853 that starts anew at each switch of the drive."""
    from scipy.integrate import solve_ivp

    function = _scipy_function(parameters, frequency_hz)
    duty = parameters["duty_cycle"]
    section = np.empty((n_periods, 4))
    y = initial_state
    for i in range(n_periods):
        ends = (i / frequency_hz, (i + duty) / frequency_hz, (i + 1) / frequency_hz)
        for span in itertools.pairwise(ends):
            y = solve_ivp(function, span, y, "DOP853", rtol=tolerance, atol=tolerance).y[:, -1]
        section[i] = y
    return section
