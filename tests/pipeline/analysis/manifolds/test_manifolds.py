"""Manifolds of saddle orbits and their first tangency, against scipy's integrator and Melnikov's function."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.analysis.manifolds.analysis import first_tangency
from pipeline.analysis.manifolds.growing import Resolution, Saddle, stable_manifold, unstable_manifold
from tests.core.cells import polish, scipy_end

DUFFING = load_model("duffing")
FREQUENCY = 1.0 / (2.0 * np.pi)


def saddle_of(damping, amplitude, guess):
    """A saddle orbit of x'' + d x' - x + x^3 = g cos t."""
    parameters = DUFFING.load(damping=damping, linear=-1.0, cubic=1.0, amplitude=amplitude)
    orbit = polish(parameters, [guess], frequency=FREQUENCY)
    assert orbit.converged[0]
    return Saddle(DUFFING.system, FREQUENCY, parameters.pack(), orbit.section[0], 1, orbit.derivative[0])


EDGE = (-0.099835710177, 0.007534227463)


def image(state, damping, amplitude, n_periods):
    def rates(t, z):
        return [z[1], amplitude * np.cos(t) - damping * z[1] + z[0] - z[0] ** 3]

    return scipy_end(rates, state, 2.0 * np.pi * n_periods, 1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_stable_manifold__leads_to_the_orbit(side):
    """By scipy; an error of the point would grow by 324 per period."""
    saddle = saddle_of(0.15, 0.2, EDGE)
    curve = stable_manifold(saddle, side, Resolution(chord=0.05, length=5.0))
    assert curve.end == "length"
    assert np.linalg.norm(curve.points[-1] - saddle.state) > 0.4
    for share in (0.5, 0.8, 1.0):
        k = int(share * (len(curve.points) - 1))
        n = int(curve.time[k])
        there = image(curve.points[k], 0.15, 0.2, n)
        expected = curve.points[int(np.argmin(np.abs(curve.time - (curve.time[k] - n))))]
        assert np.linalg.norm(there - EDGE) < 5e-3
        # on the first segment, whose points lie on a line
        _, direction = saddle.direction(stable=True)
        off = there - EDGE - (there - EDGE) @ direction * direction
        assert np.linalg.norm(off) < 1e-6
        assert np.linalg.norm(expected - EDGE) < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_unstable_manifold__maps_to_itself(side):
    """The image of a point lies on the curve, one generation later; chords are as short as asked for."""
    saddle = saddle_of(0.15, 0.2, EDGE)
    curve = unstable_manifold(saddle, side, Resolution(chord=0.02, length=6.0))
    chords = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
    assert chords.max() <= 0.02
    assert chords.sum() == pytest.approx(6.0, abs=0.05)
    for k in np.flatnonzero(curve.time < curve.time[-1] - 1.05)[-40::10]:
        there = image(curve.points[k], 0.15, 0.2, 1)
        near = np.argsort(np.linalg.norm(curve.points - there, axis=1))[0]
        a, b = curve.points[max(near - 1, 0)], curve.points[min(near + 1, len(curve.points) - 1)]
        chord = (b - a) / np.linalg.norm(b - a)
        off = (there - a) - (there - a) @ chord * chord
        # the sagitta of a chord of .04
        assert np.linalg.norm(off) < 1e-3
        assert abs(curve.time[near] - curve.time[k] - 1.0) < 0.05


def test_manifold__needs_one_direction():
    sink = saddle_of(0.15, 0.2, (1.210091, 0.055295))
    with pytest.raises(ValueError, match="0 unstable directions"):
        unstable_manifold(sink, 1.0)
    with pytest.raises(ValueError, match="2 stable directions"):
        stable_manifold(sink, 1.0)
    saddle = saddle_of(0.15, 0.2, (0.165496, 0.155508))
    assert saddle.direction(stable=False)[0] < -1.0
    curve = unstable_manifold(saddle, 1.0, Resolution(chord=0.05, length=0.5))
    _, direction = saddle.direction(stable=False)
    assert ((curve.points[1:20] - saddle.state) @ direction > 0.0).all()


@pytest.mark.slow
def test_first_tangency__tends_to_that_of_melnikov():
    """x'' + d x' - x + x^3 = g cos t: g/d = 4 cosh(pi/2)/(3 sqrt(2) pi) = .7530181 as d goes to 0, from d^2 terms."""
    coarse = Resolution(chord=0.015, length=6.0)
    ratios = [
        first_tangency(lambda g, d=d: saddle_of(d, g, (-0.5 * g, 0.0)), 0.7525 * d, 0.754 * d, (1.0, 1.0), coarse, 1e-9)
        / d
        for d in (0.08, 0.04)
    ]
    assert ratios[0] > ratios[1] > 0.7530181
    assert (4.0 * ratios[1] - ratios[0]) / 3.0 == pytest.approx(0.7530181, abs=1e-6)
    with pytest.raises(ValueError, match=r"are apart at both 0\.05 and 0\.055"):
        first_tangency(lambda g: saddle_of(0.08, g, (-0.5 * g, 0.0)), 0.05, 0.055, (1.0, 1.0), Resolution(0.05, 6.0))
