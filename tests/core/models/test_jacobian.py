"""The analytic Jacobian against differences of order 8."""

import numpy as np
import pytest

from magpend_core import accelerations, jacobian, load_preset

# central differences of order 8, for steps 1 to 4
WEIGHTS = np.array([4 / 5, -1 / 5, 4 / 105, -1 / 280])
FREQUENCY = 2.2


def by_differences(t, y, parameters, steps):
    """Derivatives of the accelerations by the four states, with the largest terms of the sums."""
    columns = []
    for i in range(4):
        shifts = np.zeros((8, 4))
        shifts[:, i] = np.array([1, -1, 2, -2, 3, -3, 4, -4]) * steps[i]
        values = accelerations(t, y + shifts, parameters, FREQUENCY)
        columns.append(WEIGHTS @ (values[0::2] - values[1::2]) / steps[i])
    return np.stack(columns, axis=1)


def states(n, seed, spread, slowest):
    """States with both relative velocities away from 0 by `slowest`."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(-1.0, 1.0, (20 * n, 4)) * spread
    away = np.minimum(abs(y[:, 2]), abs(y[:, 3] - y[:, 2])) > slowest
    return y[away][:n]


def assert_slopes(parameters, y, steps, bound):
    worst = 0.0
    for t, state in zip(np.linspace(0.0, 0.4, len(y)), y, strict=True):
        expected = by_differences(t, state, parameters, steps)
        value = jacobian(t, state, parameters, FREQUENCY)
        assert (value[:2] == [[0, 0, 1, 0], [0, 0, 0, 1]]).all()
        worst = max(worst, np.max(abs(value[2:] - expected)) / (1.0 + np.max(abs(expected))))
    assert worst < bound


@pytest.fixture(params=["fitted", "dipole"])
def parameters(request, preset, dipoles):
    return {"fitted": preset, "dipole": dipoles}[request.param]


@pytest.mark.parametrize(
    ("seed", "spread", "slowest", "steps"),
    [
        # ordinary states: the rates' layers are 1e-3 wide and 0.5 away, the magnet's layer is 1e-2 wide
        (1, [np.pi, np.pi, 20.0, 20.0], 0.5, [5e-4, 5e-4, 0.02, 0.02]),
        # near the magnet
        (2, [0.15, 0.3, 3.0, 3.0], 0.3, [2e-4, 2e-4, 0.01, 0.01]),
        # inside the friction layers: rates of their width, 1e-3 rad/s, where slopes are a thousand times steeper
        (3, [0.15, 0.3, 3e-3, 3e-3], 6e-4, [2e-4, 2e-4, 2e-5, 2e-5]),
    ],
)
def test_jacobian__equals_differences(parameters, seed, spread, slowest, steps):
    assert_slopes(parameters, states(60, seed, spread, slowest), steps, 1e-10)


@pytest.mark.parametrize(
    "overrides", [{"mu": 2e-3, "T1": 0.0, "T2": 0.0}, {"mu": 0.0, "c": 0.5}, {"delta": 0.05, "beta1": 0.2, "r2": 0.1}]
)
def test_jacobian__equals_differences_with_other_weights_of_the_terms(overrides):
    # in the first the loads are all of the friction, and four times what they are in the preset
    y = states(40, 4, [0.2, 0.4, 5.0, 5.0], 0.3)
    assert_slopes(load_preset(**overrides), y, [2e-4, 2e-4, 0.01, 0.01], 2e-9)
