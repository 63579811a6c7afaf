"""Attractors of flows: limit cycles and equilibria at crossings and at even times."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.crossing import Crossing
from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, EQUILIBRIUM, PERIODIC_ORBIT
from pipeline.runs.derive import derive
from tests.core.flows import BAUTIN, HOPF, table
from tests.pipeline.analysis.cubes import flow_cube, sweep
from tests.pipeline.analysis.dense_sets import identify

GRID = [[x, y] for x in np.linspace(-1.2, 1.2, 7) for y in np.linspace(-1.1, 1.1, 7)]


def kinds(found):
    return found["kind"].values.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 0.6])
def test_identify__cycle_beside_equilibrium(value):
    """At mu = -0.1 the origin and the cycle attract, whether the section runs through the origin or not.

    With s the squared radius, s' = 2 s (mu + s - s**2): the boundary is s = (1 - sqrt(1 + 4 mu))/2.
    """
    ds = flow_cube(BAUTIN, GRID, crossing=Crossing("y", value, longest=20.0), values={"mu": -0.1})
    found = identify(ds)
    assert sorted(kinds(found)) == [EQUILIBRIUM, PERIODIC_ORBIT]
    rest, orbit = kinds(found).index(EQUILIBRIUM), kinds(found).index(PERIODIC_ORBIT)
    squared = (np.array(GRID) ** 2).sum(axis=1)
    own = np.where(squared < 0.5 * (1.0 - np.sqrt(0.6)), rest, orbit)
    assert found["attractor_id"].values.tolist() == own.tolist()
    assert float(found["period_s"][orbit]) == pytest.approx(np.pi, rel=1e-9)
    assert np.isnan(found["period_s"][rest])
    radius = np.sqrt(0.5 * (1.0 + np.sqrt(0.6)))
    assert float(found["state_max"].sel(state="y")[orbit]) == pytest.approx(radius, rel=1e-3)  # of 256 samples
    np.testing.assert_allclose(found["attractor_points"].values[rest, 0], 0.0, atol=1e-10)
    np.testing.assert_allclose(found["eigenvalue_real"].values[rest], -0.1, atol=1e-10)
    np.testing.assert_allclose(np.sort(found["eigenvalue_imag"].values[rest]), [-2.0, 2.0], atol=1e-10)
    assert found["stability"].values.tolist() == [ATTRACTS] * 2
    assert float(found["lyapunov_max"][orbit]) == 0.0
    assert float(found["lyapunov_max"][rest]) == pytest.approx(-0.1, abs=1e-10)


@pytest.mark.slow
def test_identify__ranges_of_a_relaxation_oscillation():
    """A jump of van der Pol's oscillator takes 1/7000 of the period, and the velocity has its peak within."""
    mu = 100.0
    relaxing = table("relaxing", {"x": "v", "v": "mu*(1 - x**2)*v - x"}, {"mu": mu})
    found = identify(flow_cube(relaxing, [[1.5, 1.0]], crossing=Crossing("x", longest=400.0)))

    def rates(_, u):
        return [u[1], mu * (1.0 - u[0] ** 2) * u[1] - u[0]]

    tops = [lambda t, u, i=i: rates(t, u)[i] for i in (0, 1)]
    path = solve_ivp(rates, (0.0, 400.0), [2.0, 0.0], "Radau", rtol=1e-9, atol=1e-9, events=tops)
    highest = [max(abs(states[1:, i])) for i, states in enumerate(path.y_events)]
    for name, sign in (("state_max", 1.0), ("state_min", -1.0)):
        assert found[name].values[0] == pytest.approx(np.multiply(sign, highest), rel=2e-3), name


@pytest.mark.slow
@pytest.mark.parametrize("frequency_hz", [1.0 / np.pi, 2.0 / np.pi, 0.41])
def test_identify__strobed_cycle_is_one(frequency_hz):
    """A strobe of the cycle's period, of half of it and of another one: one limit cycle, not one per cell."""
    found = identify(flow_cube(HOPF, GRID, frequency_hz=frequency_hz))
    assert sorted(kinds(found)) == [EQUILIBRIUM, PERIODIC_ORBIT]
    orbit = kinds(found).index(PERIODIC_ORBIT)
    assert int(found["n_cells"][orbit]) == len(GRID) - 1
    assert float(found["period_s"][orbit]) == pytest.approx(np.pi, rel=1e-9)
    expected = [1.0, np.exp(-0.5 * np.pi)]
    np.testing.assert_allclose(found["multiplier_real"].values[orbit], expected, atol=1e-8)
    assert BOUNDED_SET not in kinds(found)


def test_identify__order_of_cells():
    """It does not matter which cell comes first."""
    ds = flow_cube(BAUTIN, GRID, crossing=Crossing("y", 0.0, longest=20.0), values={"mu": -0.1})
    order = np.random.default_rng(1).permutation(len(GRID))
    one, other = identify(ds), identify(ds.isel(initial_condition=order))
    np.testing.assert_array_equal(one["attractor_id"].values[order], other["attractor_id"].values)
    np.testing.assert_allclose(one["period_s"], other["period_s"], rtol=1e-9)


@pytest.mark.slow
def test_attractors_table__names_the_angle_by_which_cells_ran_away(computed):
    rates = {"th": "w", "w": "torque - 0.2*w - sin(th)"}
    turning = table("turning", rates, {"torque": 1.5}, states={"th": {"escape": 1e3}})
    spec = sweep(turning, [[0.0, 0.0]], frequency_hz=1.0)
    lines = attractors_table(derive(computed(spec), "attractors")).lines
    assert sum("th = { on_circle = true }" in line for line in lines) == 1


@pytest.mark.slow
def test_attractors_table__prints_the_largest_and_counts_the_others(computed):
    """x' = sin x rests at odd multiples of pi; 35 of them have one start each, the last has ten."""
    rests = [(2 * k + 1) * np.pi for k in range(35)]
    starts = [*(x + 0.5 for x in rests), *(rests[-1] - 0.1 * k for k in range(1, 10))]
    staircase = table("staircase", {"x": "sin(x)"}, states={"x": {"escape": 1e3}})
    spec = sweep(staircase, [[x] for x in starts], frequency_hz=1.0, lengths=(60, 16))
    found = attractors_table(derive(computed(spec), "attractors"))
    assert sorted(row["section_x"] for row in found.rows) == pytest.approx(rests, abs=1e-8)
    printed = [line for line in found.lines if "equilibrium  attracts" in line]
    assert len(printed) == 30
    assert sum("0.2273" in line for line in printed) == 1  # ten of 44 cells, though its id is the last
    (others,) = [line for line in found.lines if "smaller ones" in line]
    assert others.strip() == "and 5 smaller ones: 5 equilibrium; all are in --csv and --json"


@pytest.mark.slow
def test_identify__a_circle_without_equilibria_is_one_orbit():
    """The angle's rate is a - cos: below a = 1 rest, above it every start is on the orbit of 2 pi/sqrt(a**2 - 1)."""
    model = table("turning", {"u": "a - cos(u)"}, {"a": 1.3}, states={"u": {"on_circle": True}})
    seen = Crossing("u", 2.0, longest=60.0)
    ds = flow_cube(model, np.array([[-2.0], [0.4], [2.9]]), crossing=seen, n_transient=10, n_keep=8)
    found = identify(ds)
    assert (found["kind"].values.tolist(), found["stability"].values.tolist()) == ([PERIODIC_ORBIT], [ATTRACTS])
    assert found["n_cells"].values.tolist() == [3]
    assert found["period_s"].values[0] == pytest.approx(2.0 * np.pi / np.sqrt(0.69), rel=1e-9)
