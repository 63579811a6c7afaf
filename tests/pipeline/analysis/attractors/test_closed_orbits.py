"""Guesses of closed orbits: each orbit is polished once, with its least period."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.analysis.attractors.finding import closed_orbits
from pipeline.analysis.attractors.finding.closed_orbits import polish
from pipeline.results.sets import Geometry
from tests.core.cells import scipy_end

pytestmark = pytest.mark.slow

DUFFING = load_model("duffing")
OMEGA = 1.2
FREQUENCY = OMEGA / (2.0 * np.pi)
# the orbit in one well doubles its period at 0.2656
SINGLE, DOUBLED = (DUFFING.load("twin-well", damping=0.3, amplitude=a) for a in (0.2, 0.28))


def settled(parameters):
    """Section point after 400 periods from the right well, by scipy."""

    def rates(t, y):
        return [y[1], -0.3 * y[1] + y[0] - y[0] ** 3 + parameters["amplitude"] * np.cos(OMEGA * t)]

    return scipy_end(rates, [1.2, 0.0], 400 * 2.0 * np.pi / OMEGA, 1e-10)


def polished(parameters, points, periods, known=None):
    n, system = len(points), DUFFING.system
    guesses = np.tile(parameters.pack(), (n, 1)), np.full(n, FREQUENCY), np.array(points), np.array(periods)
    return polish(*guesses, geometry=Geometry.of(system), system=system, tolerance=1e-10, known=known)


def test_polish__guesses_of_several_periods_are_one_orbit(monkeypatch):
    point, known, asked = settled(SINGLE), {}, []
    whole = closed_orbits._polished
    monkeypatch.setattr(closed_orbits, "_polished", lambda *rows: asked.append(len(rows[0])) or whole(*rows))
    found = polished(SINGLE, [point, point + 1e-4, point + 1e-3], [1, 2, 4], known)
    assert asked == [1]
    assert [one.period for one in found] == [1, 1, 1]
    assert found[0].points[0] == pytest.approx(point, abs=1e-7)
    # a later call finds it again and polishes nothing
    (again,) = polished(SINGLE, [point - 1e-3], [2], known)
    assert asked == [1, 0]
    assert again is found[0]
    (alone,) = polished(SINGLE, [point - 1e-3], [2])
    assert alone.points.tobytes() == again.points.tobytes()


def test_polish__a_doubled_orbit_keeps_its_period():
    """Beside it lies the single one, which is unstable."""
    point = settled(DOUBLED)
    double, single = polished(DOUBLED, [point, point + [0.0, 1e-3]], [2, 1])
    assert (double.period, single.period) == (2, 1)
    assert np.abs(double.points - point).max(axis=1).min() < 1e-7
    assert double.is_stable
    assert not single.is_stable
