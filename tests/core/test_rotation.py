"""Rotation numbers against closed forms."""

import numpy as np
import pytest

from magpend_core import Status
from magpend_core.models import load_model
from magpend_core.rotation import CLOSED_TURNS, TurningState, rotation_numbers
from tests.core.flows import table

ADLER = load_model(
    table(
        "adler", {"th": "bias - sin(th) + A*cos(2*pi*f*t)"}, {"bias": 1.2, "A": 0.0}, states={"th": {"on_circle": True}}
    )
)

# a point that turns counterclockwise at the rate w on a circle around (1, 0), and feels no drive
CIRCLE = load_model(
    table(
        "circle",
        {"x": "growth*u - w*y + A*cos(2*pi*f*t)", "y": "growth*y + w*u"},
        {"w": 1.7, "radius": 0.5, "A": 0.0},
        define={"u": "x - 1", "growth": "radius^2 - u^2 - y^2"},
    )
)


def rotation(model, states, turning, frequency, n_periods=200, orbit_period=None, **parameters):
    """Compute the rotation numbers of trajectories from given states."""
    states = np.asarray(states, float)
    n, orbit = len(states), None if orbit_period is None else np.full(len(states), orbit_period)
    cells = np.tile(model.load(**parameters).pack(), (n, 1)), np.full(n, frequency), states
    options = {"turning": turning, "n_periods": n_periods, "orbit_period": orbit, "rtol": 1e-11, "atol": 1e-11}
    return rotation_numbers(*cells, system=model.system, **options)


@pytest.mark.slow
def test_angle__mean_rate():
    """th' = b - sin(th) turns at the mean rate sqrt(b^2 - 1), and backwards with -b."""
    for sign in (1.0, -1.0):
        found = rotation(ADLER, [[0.3], [2.0]], TurningState((0,)), 0.4, 1000, bias=1.2 * sign)
        np.testing.assert_allclose(found.rotation, sign * np.sqrt(1.2**2 - 1.0) / (0.8 * np.pi), atol=1e-9)
        assert (found.error < 1e-7).all()
        assert (found.status == Status.BOUNDED).all()
    # The average over 200 periods is better than 1/200 of a turn, the error of a plain mean, by far
    exact = np.sqrt(1.2**2 - 1.0) / (0.8 * np.pi)
    short, long = (rotation(ADLER, [[0.3]], TurningState((0,)), 0.4, n_periods=n) for n in (25, 200))
    errors = [abs(found.rotation[0] - exact) for found in (short, long)]
    assert errors[1] < 1e-3 * errors[0]
    assert errors[1] < 1e-6
    assert abs(short.rotation[0] - exact) < short.error[0]


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [0.02, 0.5, 3.1])
def test_plane__turns_of_the_trajectory(frequency):
    """Turns about the centre of the circle: w / (2 pi f), clockwise; at .02 Hz there are many in a drive period."""
    turning = TurningState((1, 0), (0.0, 1.0))
    found = rotation(CIRCLE, [[1.5, 0.0], [1.0, -0.5]], turning, frequency)
    np.testing.assert_allclose(found.rotation, 1.7 / (2.0 * np.pi * frequency), rtol=1e-9)
    backwards = rotation(CIRCLE, [[1.5, 0.0]], TurningState((0, 1), (1.0, 0.0)), frequency)
    np.testing.assert_allclose(backwards.rotation, -1.7 / (2.0 * np.pi * frequency), rtol=1e-9)


def test_plane__outside_of_the_circle_and_of_a_failed_trajectory():
    """A centre outside of the circle: no turns."""
    found = rotation(CIRCLE, [[1.5, 0.0]], TurningState((0, 1)), 0.5)
    assert abs(found.rotation[0]) < 1e-9
    # A trajectory that fails has no rotation number
    found = rotation(CIRCLE, [[1e200, 0.0]], TurningState((0, 1)), 0.5)
    assert found.status[0] != Status.BOUNDED
    assert np.isnan(found.rotation[0])


@pytest.mark.parametrize("rate", [1.7, 3.0, 3.3, 6.1])
def test_section_points(rate):
    """Section points turn by w / f, of which the fraction of a full turn is known; also near half a turn."""
    turning = TurningState((1, 0), of_section=True)
    found = rotation(CIRCLE, [[1.5, 0.0]], turning, 0.5, w=rate, n_periods=400)
    np.testing.assert_allclose(found.rotation, (rate / np.pi) % 1.0, atol=1e-6)


def test_closed_orbit():
    """A closed orbit makes a whole number of turns: three in two periods, to the last digit."""
    turning = TurningState((1, 0), (0.0, 1.0))
    found = rotation(CIRCLE, [[1.5, 0.0]], turning, 0.5, w=1.5 * np.pi, orbit_period=2)
    assert found.rotation[0] == 1.5
    assert found.error[0] < 1e-9
    wrong = rotation(CIRCLE, [[1.5, 0.0]], turning, 0.5, w=1.3 * np.pi, orbit_period=2)
    assert wrong.rotation[0] == pytest.approx(1.3)
    assert wrong.error[0] > CLOSED_TURNS
