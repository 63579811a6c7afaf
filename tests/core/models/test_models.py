"""The models that ship, each against something that shares no code with it."""

import numpy as np
import pytest
from scipy.optimize import brentq

from magpend_core import ParameterError, energy, evaluate, jacobian, load_model, model_names, rates, torques
from magpend_core.models import LIBRARY
from magpend_core.models.pendulum.sides import slowest_hz

FREQUENCY = 1.7
CASES = [(name, preset) for name in model_names() for preset in load_model(name).preset_names]


def states_of(model, n=12):
    return np.random.default_rng(5).normal(size=(n, len(model.states))) * model.scales


@pytest.mark.parametrize("name", model_names())
def test_model__describes_itself_as_its_system_is(name):
    model = load_model(name)
    system = model.system
    assert system.state_names == model.state_names
    assert system.is_angle == model.is_angle
    assert system.scales == model.scales
    assert system.parameter_names == model.parameter_names
    assert system.quantity_names == tuple(q.name for q in model.quantities)
    assert all(s.unit and s.meaning for s in model.states)
    assert all(q.unit and q.meaning for q in model.quantities)
    assert len(model.digest) == 16


def test_model__digests_tell_models_apart():
    rooms = {load_model(name).digest for name in model_names()}
    assert len(rooms) == 3 + len(list(LIBRARY.glob("*.toml")))  # the pendulum's kinds share their sources


def test_unknown_names__have_the_nearest_beside(preset):
    with pytest.raises(ParameterError, match="model 'dufing' does not exist; did you mean duffing"):
        load_model("dufing")
    with pytest.raises(ParameterError, match="'energie' is not a quantity of pendulum; did you mean energy"):
        evaluate(["energie"], 0.0, np.zeros(4), preset, 2.2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "preset"), CASES)
def test_jacobian__is_the_derivative_of_the_rates(name, preset):
    parameters = load_model(name).load(preset)
    model = parameters.model
    y, h = states_of(model), 1e-6
    close = 2e-4 if name.startswith("pendulum") else 1e-5  # layers of a width of 1e-3
    found = jacobian(0.21, y, parameters, FREQUENCY)
    for j in range(len(model.states)):
        step = np.eye(len(model.states))[j] * h * model.scales[j]
        ahead, behind = (rates(0.21, y + s, parameters, FREQUENCY) for s in (step, -step))
        by_differences = (ahead - behind) / (2.0 * step[j])
        np.testing.assert_allclose(found[..., j], by_differences, rtol=close, atol=close)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in model_names() if load_model(n).mirror])
def test_mirror__maps_rates_on_rates(name):
    model = load_model(name)
    even = {"duty_cycle": 0.5} if "duty_cycle" in model.parameter_names else {}
    parameters, y = model.load(**even), states_of(model)
    # the calibrated magnets are mirror images of each other: r1 = -r2, alpha1 = -alpha2
    signs = np.array(model.mirror.signs)
    here = rates(0.1 / FREQUENCY, y, parameters, FREQUENCY)
    there = rates(0.6 / FREQUENCY, signs * y, parameters, FREQUENCY)
    np.testing.assert_allclose(there, signs * here, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["", "-sine"])
def test_pendulum_free__is_the_pendulum_with_magnets_switched_off(drive):
    free = load_model(f"pendulum-free{drive}").load()
    off = load_model(f"pendulum{drive}").load(alpha1=0.0, alpha2=0.0)
    y = states_of(free.model)
    np.testing.assert_array_equal(rates(0.1, y, free, FREQUENCY), rates(0.1, y, off, FREQUENCY))
    assert (torques(0.1, y, free, FREQUENCY).magnet_torque == 0.0).all()


@pytest.mark.slow
def test_pendulum_sine__has_a_sinusoidal_torque():
    parameters = load_model("pendulum-sine").load(q=1.2)
    t = np.linspace(0.0, 1.0, 50)
    drive = torques(t, np.zeros((50, 4)), parameters, FREQUENCY).drive
    np.testing.assert_allclose(drive, 1.2 * np.sin(2 * np.pi * FREQUENCY * t), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "given", "h"), [("pendulum", "wojna2018", 1e-6), ("duffing", "twin-well", 1e-5)])
def test_evaluate__energy_changes_by_the_powers(name, given, h):
    parameters = load_model(name).load(given)
    y = states_of(parameters.model)
    rate = rates(0.1, y, parameters, FREQUENCY)
    ahead, behind = (evaluate(["energy"], 0.1, y + s * h * rate, parameters, FREQUENCY)[:, 0] for s in (1, -1))
    power_in, lost = evaluate(["power_in", "power_dissipated"], 0.1, y, parameters, FREQUENCY).T
    work = 0.0
    if name == "pendulum":
        e, q1, q2 = evaluate(["energy", "magnet_torque1", "magnet_torque2"], 0.1, y, parameters, FREQUENCY).T
        np.testing.assert_allclose(e, energy(y, parameters), rtol=1e-13)
        work = q1 * y[:, 2] + q2 * y[:, 3]
    np.testing.assert_allclose((ahead - behind) / (2 * h), power_in - lost + work, rtol=1e-6, atol=1e-6)


def test_drawing__magnet_is_where_the_quantities_say(preset):
    model = preset.model
    y = states_of(model)
    points = model.drawing.points(y, preset)
    expected = evaluate(["magnet_x", "magnet_y"], 0.0, y, preset, FREQUENCY)
    np.testing.assert_allclose(points[model.drawing.trace], expected, atol=1e-13)
    np.testing.assert_allclose(model.drawing.fixed(preset)["fixed magnet"], [0.0, -0.3742])


def test_slowest_hz__is_a_root_of_the_characteristic_polynomial(preset):
    assert slowest_hz(preset) == pytest.approx(0.926, abs=5e-4)
    p = preset.replace(l1=0.31, m2=2.0)
    b = np.array(
        [
            [p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"], p["m2"] * p["e2"] * p["l1"]],
            [p["m2"] * p["e2"] * p["l1"], p["J2"] + p["e2"] ** 2 * p["m2"]],
        ]
    )
    k = p["g"] * np.diag([p["m1"] * p["e1"] + p["m2"] * p["l1"], p["m2"] * p["e2"]])
    root = brentq(lambda f: np.linalg.det(k - (2 * np.pi * f) ** 2 * b), 0.1, 1.05 * float(slowest_hz(p)))
    assert slowest_hz(p) == pytest.approx(root, rel=1e-9)
