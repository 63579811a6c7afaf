"""The method of order 8 beside that of order 5: coefficients, accuracy, bits, cost in steps."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import DOP853, solve_ivp

from magpend_core import Crossing, load_model
from magpend_core.engine.tableau import METHODS
from magpend_core.orbits import polish_orbits, section_map
from tests.core.cells import run_cells

EIGHTH = METHODS["dop853"]
# smooth, so that an order shows, and without load-dependent friction, which `pendulum_rhs` does not know
SMOOTH = {"mu": 0.0, "mu0": 1.0, "eps": 2.0, "eps_drive": 2.0}
FORCED = {"damping": 0.1, "linear": -1.0, "cubic": 1.0, "amplitude": 0.4}


def run(name, method, tolerance, n_periods, starts, values=None, **options):
    model, frequency = load_model(name), options.pop("frequency", 0.2)
    options |= {"n_transient": n_periods - 1, "rtol": tolerance, "method": method}
    return run_cells(model.system, model.load(**values or {}).pack(), frequency, starts, **options)


def some_starts(n):
    return np.random.default_rng(3).uniform(-1.0, 1.0, (n, 2))


def test_methods__of_order_8_has_scipys_coefficients():
    np.testing.assert_array_equal(EIGHTH.stages[:12], DOP853.A)
    np.testing.assert_array_equal(EIGHTH.stages[12], DOP853.B)
    np.testing.assert_array_equal(EIGHTH.nodes[:12], DOP853.C)
    np.testing.assert_array_equal(EIGHTH.error, DOP853.E5)
    np.testing.assert_array_equal(EIGHTH.other_error, DOP853.E3)


@pytest.mark.slow
def test_run_branches__of_order_8_agrees_with_another_integrator(pendulum_rhs):
    v = load_model("pendulum-free").load(**SMOOTH).as_dict()
    phase = np.pi / 2.0 - np.pi * v["duty_cycle"]

    def torque(t):
        wave = np.sin(2.0 * np.pi * t + phase) - np.sin(phase)
        return v["q"] * 2.0 / np.pi * np.arctan(v["eps_drive"] * wave)

    def duffing(t, y):
        drive = FORCED["amplitude"] * np.cos(0.4 * np.pi * t)
        return y[1], drive - FORCED["damping"] * y[1] + y[0] - y[0] ** 3

    pendulum_starts = np.random.default_rng(5).uniform(-1.0, 1.0, (2, 4))
    for name, values, starts, rates, frequency in (
        ("duffing", FORCED, some_starts(3), duffing, 0.2),
        ("pendulum-free", SMOOTH, pendulum_starts, pendulum_rhs(v, torque), 1.0),
    ):
        found = run(name, "dop853", 1e-12, 1, starts, values, frequency=frequency).section[:, 0, 0]
        for start, end in zip(starts, found, strict=True):
            other = solve_ivp(rates, (0.0, 1.0 / frequency), start, "LSODA", rtol=1e-11, atol=1e-12)
            np.testing.assert_allclose(end, other.y[:, -1], atol=1e-8)


def test_run_branches__of_order_8_error_falls_with_the_tolerance():
    starts = some_starts(16)
    reference = run("duffing", "dopri5", 1e-13, 1, starts, FORCED).section
    tolerances = 10.0 ** -np.arange(5.0, 11.0)
    errors = [
        np.median(abs(run("duffing", "dop853", t, 1, starts, FORCED).section - reference).max(axis=-1))
        for t in tolerances
    ]
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert 0.85 < slope < 1.15


@pytest.mark.parametrize("name", ["duffing", "pendulum-free"])
def test_run_branches__of_order_8_has_the_same_bits_alone_and_among_others(name):
    n = len(load_model(name).states)
    starts = np.random.default_rng(5).uniform(-1.0, 1.0, (35, n))
    values = FORCED if name == "duffing" else None
    among = run(name, "dop853", 1e-8, 3, starts, values, frequency=1.0)
    alone = run(name, "dop853", 1e-8, 3, starts[17:18], values, frequency=1.0)
    narrow = run(name, "dop853", 1e-8, 3, starts, values, frequency=1.0, n_lanes=16)
    np.testing.assert_array_equal(among.section[17:18], alone.section)
    np.testing.assert_array_equal(among.section, narrow.section)
    np.testing.assert_array_equal(among.n_steps, narrow.n_steps)


@pytest.mark.slow
def test_run_branches__of_order_8_finds_crossings_and_carries_tangents():
    model = load_model("van-der-pol")
    section = Crossing("v", 0.0, "down", longest=50.0)
    packed, longest = np.append(model.load(mu=1.0).pack(), 0.0)[None], np.array([1.0 / 50.0])
    sectioned = section.applied(packed[:, :1], dataclasses.replace(model.system, method="dop853"))[0]
    orbit = polish_orbits(packed, longest, [[2.0, 0.0]], np.array([1]), system=sectioned)
    assert orbit.converged.all()
    assert orbit.seconds[0] == pytest.approx(6.663286859323, abs=1e-10)  # see test_flows
    derivatives = []
    for method in METHODS:
        system = dataclasses.replace(sectioned, method=method)
        found = section_map(packed, longest, orbit.section, 1, system=system)
        assert found.times[0, 0] == pytest.approx(6.663286859323, abs=1e-10)
        derivatives.append(found.derivatives)
    np.testing.assert_allclose(derivatives[0], derivatives[1], atol=1e-9)
    with pytest.raises(ValueError, match=r"method = 'rk4': \w+ can be integrated by dopri5, dop853"):
        run("duffing", "rk4", 1e-6, 1, some_starts(1))
    with pytest.raises(ValueError, match="quantities are not watched with method 'dop853'; choose dopri5 or rodas5p"):
        run("duffing", "dop853", 1e-6, 1, [[0.1, 0.0]], quantities=["energy"])
