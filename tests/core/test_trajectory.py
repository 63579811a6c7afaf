"""Dense output against scipy and against the sections."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import accelerations, sections, trajectory

FREQUENCY = 2.2
START = [0.2, 0.2, 0.0, 0.0]


def by_scipy(parameters, frequency, start, times):
    """The same motion by DOP853, split at the drive's edges, accelerations evaluated one by one."""

    def rhs(t, y):
        return np.concatenate([y[2:], accelerations(t, y, parameters, frequency)])

    period = 1.0 / frequency
    duty = parameters["duty_cycle"]
    n_periods = int(np.ceil(times[-1] * frequency))
    edges = np.sort(np.concatenate([np.arange(n_periods + 1), np.arange(n_periods) + duty])) * period
    states, y = np.empty((len(times), 4)), np.array(start, dtype=float)
    for begin, end in itertools.pairwise(edges):
        inside = (times >= begin) & (times <= end)
        piece = solve_ivp(rhs, (begin, end), y, "DOP853", t_eval=np.append(times[inside], end), rtol=1e-10, atol=1e-10)
        states[inside], y = piece.y.T[:-1], piece.y[:, -1]
    return states


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n_periods", "n"), [("preset", 1.2, 60), ("dipoles", 0.6, 20)])
def test_trajectory__agrees_with_dop853(name, n_periods, n, request):
    parameters = request.getfixturevalue(name)
    times = np.sort(np.random.default_rng(0).uniform(0.0, n_periods / FREQUENCY, n))
    found = trajectory(parameters, FREQUENCY, START, times, rtol=1e-11, atol=1e-11)
    assert np.max(abs(found - by_scipy(parameters, FREQUENCY, START, times))) < 1e-7


@pytest.mark.parametrize("rtol", [1e-5, 1e-7, 1e-9])
def test_trajectory__between_steps_is_as_good_as_at_steps(preset, rtol):
    # the grid is not that of the steps; 500 points per period fall on both
    times = np.linspace(0.0, 3.0 / FREQUENCY, 1501)
    exact = trajectory(preset, FREQUENCY, START, times, rtol=1e-12, atol=1e-12)
    found = trajectory(preset, FREQUENCY, START, times, rtol=rtol, atol=rtol)
    at_sections = np.max(abs(found - exact)[500::500])
    everywhere = np.max(abs(found - exact))
    assert everywhere < 300.0 * rtol
    assert everywhere < 30.0 * at_sections


def test_trajectory__interpolant_has_order_4(bare):
    # smooth and free: the error between steps over the steps' own size, at tolerances a decade apart;
    # h goes with rtol^(1/5), so an order p interpolant's local error goes with rtol^((p + 1)/5)
    start, times = [1.0, -0.5, 2.0, 1.0], np.linspace(0.0, 2.0, 4001)
    exact = trajectory(bare, 1.0, start, times, rtol=1e-13, atol=1e-13)
    rtol = 10.0 ** np.arange(-5.0, -10.0, -1.0)
    errors = [np.max(abs(trajectory(bare, 1.0, start, times, rtol=r, atol=r) - exact)) for r in rtol]
    slope = np.polyfit(np.log(rtol), np.log(errors), 1)[0]
    # an interpolant of order 3 would give 4/5 at most
    assert slope > 0.87


def test_trajectory__meets_the_sections(preset):
    for start in (START, [3.0, -3.0, 40.0, -30.0]):
        kept = sections(preset, FREQUENCY, [start], n_transient=0, n_keep=6, rtol=1e-9, atol=1e-9)
        found = trajectory(preset, FREQUENCY, start, np.arange(1, 7) / FREQUENCY, rtol=1e-9, atol=1e-9)
        turns = (found - kept.section[0])[:, :2] / (2.0 * np.pi)
        assert np.max(abs(turns - np.round(turns))) < 1e-12
        assert np.max(abs(found - kept.section[0])[:, 2:]) < 1e-10
    fine = np.linspace(0.0, 4.3 / FREQUENCY, 1201)
    whole = trajectory(preset, FREQUENCY, START, fine)
    assert (trajectory(preset, FREQUENCY, START, fine[::7]) == whole[::7]).all()
    assert (trajectory(preset, FREQUENCY, START, fine[-1:]) == whole[-1:]).all()
    assert (whole[0] == START).all()
    start = np.array([0.2 + 4.0 * np.pi, 0.2 - 2.0 * np.pi, 0.0, 0.0])
    found = trajectory(preset, FREQUENCY, start, [0.0, 0.3])
    usual = trajectory(preset, FREQUENCY, START, [0.0, 0.3])
    assert found[0] == pytest.approx(start, abs=1e-14)
    assert found - usual == pytest.approx(np.tile(start - START, (2, 1)), abs=1e-10)
    assert trajectory(preset, FREQUENCY, START, []).shape == (0, 4)


def test_trajectory__says_that_it_ended_early(preset):
    with pytest.raises(ArithmeticError, match="max_steps_per_period; if the equations are stiff, set"):
        trajectory(preset, FREQUENCY, START, [1.0], max_steps_per_period=10)
    # the bound on the rates is 1e4 rad/s, looked at after each period
    with pytest.raises(ArithmeticError, match="left the bounds"):
        trajectory(preset, 1e5, [1.5, 0.5, 1.5e4, -1.5e4], [2e-5])
