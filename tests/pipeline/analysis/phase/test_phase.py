"""Phase responses of limit cycles against closed forms, and against trajectories that another integrator moves."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import magpend
from magpend_core.crossing import Crossing
from magpend_core.models import load_model
from magpend_core.models.sectioned import of_flow, sectioned
from pipeline.analysis.phase.analysis import needs_cycle, phase_table
from pipeline.analysis.phase.declaration import PhaseOptions
from pipeline.analysis.phase.phases import Cycle, cycle_of, gradient_at, phases_of, states_along

HOPF = {
    "name": "hopf-pushed",
    "states": {"x": {}, "y": {}, "z": {}},
    "parameters": {"a": 0.6, "shear": 0.7, "push": 0.4},
    # r' = a r - r^3, angle' = 3 - shear r^2 + push z, z' = -2 z
    "equations": {
        "x": "a*x - (3 + push*z)*y - (x*x + y*y)*(x - shear*y)",
        "y": "(3 + push*z)*x + a*y - (x*x + y*y)*(shear*x + y)",
        "z": "-2*z",
    },
}


def phase_of_hopf(states: np.ndarray) -> np.ndarray:
    """Return the phase of any states in closed form: (angle - shear ln(r/sqrt a) + push z/2) / 2 pi."""
    x, y, z = np.asarray(states).T
    return ((np.arctan2(y, x) - 0.7 * np.log(np.hypot(x, y) / np.sqrt(0.6)) + 0.2 * z) / (2.0 * np.pi)) % 1.0


def found_cycle(spec: dict, section: Crossing, state: list[float], period: int = 1) -> Cycle:
    model = sectioned(load_model(spec), section)
    cycle = cycle_of(model.load(), section.frequency_hz, np.array(state), period)
    assert cycle is not None
    return cycle


@pytest.fixture(scope="module")
def hopf() -> Cycle:
    return found_cycle(HOPF, Crossing("y", 0.0, "up", 20.0), [0.75, 0.0, 0.01])


def turned(difference: np.ndarray) -> np.ndarray:
    """Return differences of phases between -1/2 and 1/2."""
    return difference - np.round(difference)


def test_gradient__is_that_of_the_closed_form(hopf: Cycle) -> None:
    states = states_along(hopf, 40)
    found = gradient_at(of_flow(hopf.parameters), hopf.seconds, states)
    step = 1e-5
    exact = np.stack(
        [turned(phase_of_hopf(states + d) - phase_of_hopf(states - d)) / (2 * step) for d in step * np.eye(3)], axis=1
    )
    assert hopf.seconds == pytest.approx(2.0 * np.pi / (3.0 - 0.7 * 0.6), rel=1e-10)
    np.testing.assert_allclose(found.values, exact, atol=2e-9)
    # the error is one of the first order: the multiplier's deviation from 1 over its distance from exp(-2 a T)
    assert found.error < 1e-10
    assert found.contraction == pytest.approx(np.exp(-1.2 * hopf.seconds), rel=1e-6)


def test_phases__of_states_far_from_the_cycle_are_those_of_the_closed_form(hopf: Cycle) -> None:
    states = np.random.default_rng(3).uniform(-2.0, 2.0, (60, 3))
    np.testing.assert_allclose(turned(phases_of(hopf, states) - phase_of_hopf(states)), 0.0, atol=2e-7)


def test_phases__of_a_state_that_never_comes_back_are_not_known(hopf: Cycle) -> None:
    found = phases_of(hopf, np.array([[0.0, 0.0, 0.5], [1.0, 0.0, 0.0]]))
    assert np.isfinite(found).tolist() == [False, True]


@pytest.mark.slow
def test_gradient__of_the_theta_neuron() -> None:
    """Of the current the response is (1 - cos phi) / (2 sqrt I) in units of time, phi from the spike on.

    Ermentrout (Neural Comput. 8, 979, 1996); a jump dI for dt moves the angle by (1 + cos angle) dI dt.
    """
    current = 0.3
    model = {
        "name": "theta",
        "states": {"theta": {"unit": "rad", "on_circle": True}},
        "parameters": {"current": current},
        "equations": {"theta": "1 - cos(theta) + (1 + cos(theta))*current"},
    }
    cycle = found_cycle(model, Crossing("theta", 3.141592653589793, "up", 100.0), [np.pi])
    states = states_along(cycle, 64)
    found = gradient_at(of_flow(cycle.parameters), cycle.seconds, states)
    phi = 2.0 * np.pi * np.arange(64) / 64
    by_current = found.values[:, 0] * (1.0 + np.cos(states[:, 0])) * cycle.seconds
    assert cycle.seconds == pytest.approx(np.pi / np.sqrt(current), rel=1e-10)
    np.testing.assert_allclose(by_current, (1.0 - np.cos(phi)) / (2.0 * current), atol=1e-8)


@pytest.mark.slow
def test_gradient__of_the_van_der_pol_oscillator_is_what_jumps_do() -> None:
    """Small jumps of a state move late crossings of trajectories that scipy integrates."""
    model = {
        "name": "vdp-phase",
        "states": {"x": {}, "v": {}},
        "parameters": {"mu": 1.5},
        "equations": {"x": "v", "v": "mu*(1 - x**2)*v - x"},
    }
    cycle = found_cycle(model, Crossing("v", 0.0, "down", 50.0), [2.0, 0.0])
    states = states_along(cycle, 8)
    found = gradient_at(of_flow(cycle.parameters), cycle.seconds, states)

    def late(state: np.ndarray) -> float:
        def crossing(t: float, y: np.ndarray) -> float:
            return float(y[1])

        crossing.direction = -1.0  # type: ignore[attr-defined]
        rates = lambda t, y: [y[1], 1.5 * (1 - y[0] ** 2) * y[1] - y[0]]  # noqa: E731
        run = solve_ivp(rates, (0.0, 5.5 * cycle.seconds), state, "DOP853", rtol=1e-13, atol=1e-13, events=crossing)
        return float(run.t_events[0][-1])

    step = 1e-3
    for k, state in enumerate(states[1:6], 1):
        for i, d in enumerate(step * np.eye(2)):
            far, near = (turned(np.array(late(state - s) - late(state + s)) / cycle.seconds) for s in (2 * d, d))
            assert found.values[k, i] == pytest.approx((8.0 * near - far) / (12.0 * step), abs=1e-6)


def refusal(spec_of: dict, **options) -> str:
    run = SimpleNamespace(model=spec_of["model"], cube=dict)
    with pytest.raises(ValueError, match=r"\w") as caught:
        needs_cycle(run, PhaseOptions(**options))
    return str(caught.value)


def test_refused__before_anything_is_computed(hopf: Cycle) -> None:
    flow = {"model": hopf.parameters.model}
    assert "the drive sets the phase" in refusal({"model": load_model("duffing")})
    assert "need a section by crossing" in refusal({"model": hopf.parameters.model.flow})
    assert "--kick" in refusal(flow, kick={"q": 1.0})
    assert "flows with two states; this one has 3" in refusal(flow, grid=9)


@pytest.mark.slow
def test_run__rows_are_the_stable_cycles(tmp_path) -> None:
    spec = {
        "kind": "sweep",
        "model": HOPF,
        "section": {"of": "y", "value": 0.0, "direction": "up", "longest": 20.0},
        "axes": {"a": {"values": [-0.5, 0.6]}},
        "initial_conditions": {"kind": "list", "points": [[0.3, 0.1, 0.0], [1.2, 0.0, 0.1]]},
        "integration": {"n_transient": 10, "n_keep": 4},
    }
    run = magpend.run(spec, out=tmp_path / "run")
    ds = run.phase(kick={"x": 0.3}, phases=32)
    assert ds.sizes["cycle"] == 1
    assert ds["a"].values.tolist() == [0.6]
    orbit = ds["orbit"].values[0]
    exact = turned(phase_of_hopf(orbit + [0.3, 0.0, 0.0]) - phase_of_hopf(orbit))
    np.testing.assert_allclose(ds["shift"].values[0], exact, atol=1e-6)
    rows = phase_table(ds).rows
    assert [row["state"] for row in rows] == ["x", "y", "z"]
    # the response to z is push/2 / 2 pi everywhere
    assert rows[2]["least"] == pytest.approx(0.2 / (2 * np.pi), rel=1e-8) == rows[2]["largest"]
