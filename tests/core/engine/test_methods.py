"""The method of order 8 beside that of order 5: coefficients, accuracy, bits, cost in steps."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import DOP853, solve_ivp

from magpend_core import Crossing, load_model, run_branches
from magpend_core.engine.tableau import METHODS
from magpend_core.orbits import section_map

EIGHTH = METHODS["dop853"]
WEIGHTS = np.append(EIGHTH.stages[12], 0.0)
MATRIX = np.hstack([EIGHTH.stages, np.zeros((13, 1))])


def run(name, method, tolerance, n_periods, starts, **options):
    model = load_model(name)
    n = len(starts)
    packed = np.broadcast_to(model.load().pack(), (n, 1, len(model.parameters)))
    return run_branches(
        packed, np.full((n, 1), options.pop("frequency", 0.2)), starts, n_transient=n_periods - 1, n_keep=1,
        rtol=tolerance, atol=tolerance, system=model.system, method=method, **options,
    )  # fmt: skip


def lorenz_starts(n):
    return np.random.default_rng(3).uniform((-10.0, -10.0, 15.0), (10.0, 10.0, 35.0), (n, 3))


def test_methods__of_order_8_has_scipys_coefficients():
    np.testing.assert_array_equal(EIGHTH.stages[:12], DOP853.A)
    np.testing.assert_array_equal(EIGHTH.stages[12], DOP853.B)
    np.testing.assert_array_equal(EIGHTH.nodes[:12], DOP853.C)
    np.testing.assert_array_equal(EIGHTH.error, DOP853.E5)
    np.testing.assert_array_equal(EIGHTH.other_error, DOP853.E3)


def test_methods__of_order_8_meets_conditions_of_order_8():
    c = EIGHTH.nodes
    for k in range(8):
        assert WEIGHTS @ c**k == pytest.approx(1.0 / (k + 1.0), abs=2e-15)
    assert MATRIX.sum(axis=1) == pytest.approx(c, abs=3e-14)
    assert WEIGHTS @ (c * (MATRIX @ c**5)) == pytest.approx(1.0 / 48.0, abs=2e-15)
    assert WEIGHTS @ MATRIX @ c**6 == pytest.approx(1.0 / 56.0, abs=2e-15)
    for error in (EIGHTH.error, EIGHTH.other_error):
        assert error.sum() == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("name", ["lorenz", "duffing5"])
def test_run_branches__of_order_8_agrees_with_another_integrator(name):
    starts = lorenz_starts(3) if name == "lorenz" else np.array([[0.2, 0.1], [-0.5, 0.4], [1.0, 0.0]])
    found = run(name, "dop853", 1e-12, 1, starts).section[:, 0, 0]
    v = load_model(name).load()

    def rates(t, y):
        if name == "lorenz":
            x, y, z = y
            return v["sigma"] * (y - x), x * (v["rho"] - z) - y, x * y - v["beta"] * z
        return y[1], v["A"] * np.cos(2.0 * np.pi * 0.2 * t) - v["d"] * y[1] - y[0] ** 3

    for start, end in zip(starts, found, strict=True):
        other = solve_ivp(rates, (0.0, 5.0), start, method="Radau", rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(end, other.y[:, -1], atol=2e-5 if name == "lorenz" else 1e-8)


def test_run_branches__of_order_8_is_nearer_in_fewer_steps():
    starts = lorenz_starts(16)
    reference = run("lorenz", "dop853", 1e-13, 3, starts, frequency=2.0).section
    error, steps = {}, {}
    for method in METHODS:
        found = run("lorenz", method, 1e-9, 3, starts, frequency=2.0)
        error[method] = np.median(abs(found.section - reference).max(axis=-1))
        steps[method] = found.n_steps.sum()
    assert error["dop853"] < error["dopri5"] < 1e-6
    assert 4 * steps["dop853"] < steps["dopri5"]


def test_run_branches__of_order_8_error_falls_with_the_tolerance():
    starts = lorenz_starts(16)
    reference = run("lorenz", "dopri5", 1e-13, 3, starts, frequency=2.0).section
    tolerances = 10.0 ** -np.arange(5.0, 11.0)
    errors = [
        np.median(abs(run("lorenz", "dop853", t, 3, starts, frequency=2.0).section - reference).max(axis=-1))
        for t in tolerances
    ]
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert 0.85 < slope < 1.15


@pytest.mark.parametrize("name", ["lorenz", "pendulum-free"])
def test_run_branches__of_order_8_has_the_same_bits_alone_and_among_others(name):
    n = len(load_model(name).states)
    starts = np.random.default_rng(5).uniform(-1.0, 1.0, (35, n))
    among = run(name, "dop853", 1e-8, 3, starts, frequency=1.0)
    alone = run(name, "dop853", 1e-8, 3, starts[17:18], frequency=1.0)
    narrow = run(name, "dop853", 1e-8, 3, starts, frequency=1.0, n_lanes=16)
    np.testing.assert_array_equal(among.section[17:18], alone.section)
    np.testing.assert_array_equal(among.section, narrow.section)
    np.testing.assert_array_equal(among.n_steps, narrow.n_steps)


def test_run_branches__of_order_8_finds_crossings_and_carries_tangents():
    model = load_model("van-der-pol")
    system = dataclasses.replace(model.system, method="dop853")
    packed = model.load(mu=1.0).pack()
    found = run_branches(
        packed[None, None], None, [[2.0, 0.0]], n_transient=30, n_keep=1, rtol=1e-12, atol=1e-12,
        section=Crossing("v", 0.0, "down", longest=50.0), system=system,
    )  # fmt: skip
    assert found.return_time[0, 0, 0] == pytest.approx(6.663286859323, abs=1e-10)  # see test_flows
    sectioned = Crossing("v", 0.0, "down", longest=50.0).applied(packed[None], system)[0]
    derivatives = [
        section_map(
            np.append(packed, 0.0)[None], np.array([1.0 / 50.0]), found.section[0, 0], 1,
            system=dataclasses.replace(sectioned, method=method),
        ).derivatives
        for method in METHODS
    ]  # fmt: skip
    np.testing.assert_allclose(derivatives[0], derivatives[1], atol=1e-9)


def test_run_branches__refuses_an_unknown_method_and_quantities_with_order_8():
    with pytest.raises(ValueError, match=r"method = 'rk4': \w+ can be integrated by dopri5, dop853"):
        run("lorenz", "rk4", 1e-6, 1, lorenz_starts(1))
    with pytest.raises(ValueError, match="quantities are watched with method dopri5 alone"):
        run("duffing", "dop853", 1e-6, 1, [[0.1, 0.0]], quantities=["energy"])
