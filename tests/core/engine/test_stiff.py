"""The method for stiff equations on problems with known ends: order, errors and steps, linear invariants."""

import numpy as np
import pytest

from tests.core.cells import run_cells
from tests.core.flows import VAN_DER_POL, flow, table
from tests.core.stiff import CONTACT, HIRES, HODGKIN_HUXLEY, PROBLEMS, ROBER

METHOD = "rodas5p"
LOOSE = 0.99
"""A tolerance that no step below misses."""


def end_of(problem, tolerance, method=METHOD):
    """Return the end of a problem by the engine, and the numbers of accepted and rejected steps."""
    found = run_cells(
        problem.model.system,
        problem.model.load().pack(),
        1.0 / problem.time,
        [problem.start],
        rtol=tolerance,
        method=method,
        max_steps_per_period=1_000_000,
    )
    return found.section[0, 0, 0], int(found.n_steps[0, 0]), int(found.n_rejected[0, 0])


def equal_steps(model, start, time, n, **values):
    """Return the end after `n` equal steps: each is a period of the clock."""
    step, packed = time / n, model.load(**values).pack()
    options = {"n_transient": n - 1, "rtol": LOOSE, "step_size": np.array([step]), "method": METHOD}
    found = run_cells(model.system, packed, 1.0 / step, [start], **options)
    assert (found.n_steps[0, 0], found.n_rejected[0, 0]) == (n, 0)
    return found.section[0, 0, 0]


def order(errors, steps):
    """Slope of the errors' logarithm."""
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_stiff__order_is_5_where_nothing_is_stiff():
    model, start = flow(VAN_DER_POL), [2.0, 0.0]
    exact = run_cells(model.system, model.load().pack(), 0.5, [start], rtol=1e-13, method="dop853").section[0, 0, 0]
    steps = np.array([20, 40, 80, 160])
    errors = [np.abs(equal_steps(model, start, 2.0, n) - exact).max() for n in steps]
    assert order(errors, steps) == pytest.approx(5.0, abs=0.2)


def test_stiff__order_falls_to_3_on_prothero_and_robinsons_problem():
    """Where steps are far longer than 1/lamda; with the time `s` as a state, so that the steps need no drive."""
    rates = {"y": "cos(s) - lamda*(y - sin(s))", "s": "1"}
    model = flow(table("prothero_robinson_with_time", rates, {"lamda": 1.0}))
    steps = np.array([10, 20, 40, 80])

    def errors(lamda):
        ends = [equal_steps(model, [0.0, 0.0], 2.0, n, lamda=lamda)[0] for n in steps]
        return np.abs(np.array(ends) - np.sin(2.0))

    assert order(errors(1.0), steps) == pytest.approx(5.0, abs=0.3)
    assert order(errors(1e6), steps) == pytest.approx(3.0, abs=0.2)
    np.testing.assert_allclose(errors(1e6)[0] / errors(1e5)[0], 0.1, rtol=0.05)


REACHED = {
    "hires": ([3e-4, 7e-6, 2e-9, 2e-11], 730),
    # rounding decides at the last two: at t = 1e11 elements of the matrix are 1e13
    "rober": ([2e-5, 1e-6, 3e-7, 3e-8], 930),
    "orego": ([4e-5, 2e-6, 5e-9, 4e-11], 3000),
    "van der pol": ([4e-5, 2e-6, 2e-8, 2e-10], 2500),
    "hodgkin-huxley": ([1e-3, 5e-5, 2e-7, 6e-10], 1500),
    "prothero-robinson": ([1e-7, 3e-9, 3e-9, 2e-11], 15),
    "contact": ([2e-4, 3e-6, 2e-8, 2e-10], 250),
}
"""Errors at the tolerances, some twice those of today, and attempted steps at 1e-8, with a fifth more than today."""
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_stiff__errors_fall_with_the_tolerance(name):
    problem, (bounds, most) = PROBLEMS[name], REACHED[name]
    ends = {tolerance: end_of(problem, tolerance) for tolerance in TOLERANCES}
    unit = np.maximum(np.abs(problem.end), problem.sizes)
    errors = [np.max(np.abs(found - problem.end) / unit) for found, *_ in ends.values()]
    assert (np.array(errors) < bounds).all(), errors
    assert sum(ends[1e-8][1:]) < most, ends[1e-8]


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_stiff__linear_invariants_are_kept(tolerance):
    assert abs(end_of(ROBER, tolerance)[0].sum() - 1.0) < 1e-13
    assert abs(end_of(HIRES, tolerance)[0][6:].sum() - 0.0057) < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("problem", [HIRES, HODGKIN_HUXLEY, CONTACT], ids=lambda p: p.table["name"])
def test_stiff__ends_are_those_of_an_explicit_method(problem):
    found, *_ = end_of(problem, 1e-12, "dopri5")
    np.testing.assert_allclose(found, problem.end, rtol=1e-10, atol=1e-12)
