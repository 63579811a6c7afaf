"""Slow spirals: cells near a bifurcation that take thousands of periods to close are their orbit's."""

import numpy as np
import pytest

from magpend_core import load_preset, sections
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.analysis.attractors.finding.requests import LEG
from pipeline.analysis.attractors.finding.spirals import Recurrence, SpiralSettings, leap, near_closed
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED_SET, NOT_SETTLED, PERIODIC_ORBIT
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.cubes import STATES, cube_of
from tests.pipeline.analysis.dense_sets import identify

LINE, PLANE = Geometry((False,), (1.0,)), Geometry((False, False), (1.0, 1.0))

# first of 60 sections that the quickstart keeps: frequency [Hz], state, and the period of the orbit on which
# the cell ends when 10 000 more periods are integrated at a tolerance of 1e-8
SLOW = [
    # towards an orbit of period 2 along its slow direction: multiplier 0.997
    (2.505, [-0.0740135763700914, -0.13444506329073483, -2.2551534509947695, 3.0206773392734942], 2),
    # away from the unstable orbit of period 1 that it doubled from: multiplier -1.0008
    (2.505, [-0.05211619995973748, -0.1435603005423484, -2.199973439776495, 2.9784102827417676], 2),
    # towards an orbit of period 1, alternating: multiplier -0.998
    (2.5, [0.018175705957897026, 0.2091639911954814, -2.115042946702441, 2.879141966307841], 1),
]


def cell(frequency, state):
    """One cell that did not close, as the quickstart keeps it."""
    found = sections(load_preset(), frequency, np.array([state]), n_transient=0, n_keep=60, rtol=1e-7, atol=1e-7)
    return cube_of(found, STATES, frequency=frequency).assign_attrs(rtol=1e-7, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "state", "period"), SLOW)
def test_identify__a_slow_spiral_is_its_orbits(frequency, state, period):
    ds = cell(frequency, state)
    assert ds["status"].values.tolist() == [2]
    found = identify(ds, parameters=load_preset())
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT]
    assert found["orbit_period"].values.tolist() == [period]
    assert found["stability"].values.tolist() == [ATTRACTS]


def test_identify__a_slow_spiral_is_no_attractor():
    """Where nothing is integrated, nothing is said of it."""
    ds = cell(*SLOW[0][:2])
    named = identify(ds, parameters=load_preset(), polish=False)
    assert named["kind"].values.tolist() == [BOUNDED_SET]
    assert named["stability"].values.tolist() == [NOT_SETTLED]


def test_recurrence__of_many_periods_as_by_definition():
    """The shortest period within 1.5 times the least distance over the younger half, where that is below 0.05."""
    rng, n = np.random.default_rng(3), np.arange(60)
    turns = rng.choice([0.25, 1 / 3, 0.4, 0.5, 0.618, 1 / 7], (200, 1)) + rng.normal(0.0, 3e-4, (200, 1))
    size = rng.uniform(0.02, 1.0, (200, 1)) * rng.uniform(0.97, 1.02, (200, 1)) ** n
    section = np.stack([size * np.cos(2 * np.pi * turns * n), size * np.sin(2 * np.pi * turns * n)], axis=-1)
    expected = []
    for path in section:
        far = []
        for p in range(1, 17):
            half = (60 - p) // 2
            far.append(np.abs(path[60 - half :] - path[60 - half - p : 60 - p]).max())
        near = [p for p, away in enumerate(far, 1) if away <= min(0.05, 1.5 * min(far))]
        expected.append(near[0] if near else 0)
    found = Recurrence.of(section, 16, PLANE)
    assert found.period.tolist() == expected
    assert len(set(expected)) >= 6
    last = [np.abs(path[-1] - path[-1 - p]).max() if p else np.inf for path, p in zip(section, expected, strict=True)]
    assert found.lag == pytest.approx(last)


def test_recurrence__a_rotating_spiral_contracts_to_its_centre():
    """Sections turn by an angle that no short period divides; their mean shows the orbit."""
    n = np.arange(64)
    radius, angle = 0.3 * 0.99**n, 2.39996 * n
    section = np.stack([1.0 + radius * np.cos(angle), 2.0 + radius * np.sin(angle)], axis=-1)[None]
    found = Recurrence.of(section, 4, PLANE)
    assert found.centred.tolist() == [1]
    assert found.centre[0] == pytest.approx([1.0, 2.0], abs=0.05)
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 64, 2))
    assert Recurrence.of(noise, 4, PLANE).is_near.mean() < 0.05
    # Not the shortest at which they lie near: half the period leads to the orbit that doubled
    n = np.arange(60)
    section = np.stack([0.02 * (-1.0) ** n + 1e-4 * 0.999**n, np.zeros(60)], axis=-1)[None]
    assert near_closed(section, 8, PLANE).period.tolist() == [2]
    assert Recurrence.of(section, 8, PLANE, SpiralSettings(same_lag=1e6)).period.tolist() == [1]


def test_leap__along_the_unstable_direction():
    """x' = -1.0005 x doubles in 1386 steps; what does not follow the linear map stays."""
    orbit = Orbit(np.zeros((1, 1)), np.array([-1.0005 + 0j]), 1e-12, np.array([[-1.0005]]))
    n = np.arange(LEG)
    follows = (1e-3 * (-1.0005) ** n)[:, None]
    settles = (1e-3 * (-0.9995) ** n)[:, None]
    states = leap(np.stack([follows, settles]), [orbit], LINE)
    assert states[0, 0] == pytest.approx(2.0 * follows[-1, 0], rel=1e-3)
    assert np.isnan(states[1, 0])
    # a fast orbit is left alone, and so is a stable one
    for multiplier in (-1.5, -0.9):
        other = Orbit(np.zeros((1, 1)), np.array([multiplier + 0j]), 1e-12, np.array([[multiplier]]))
        assert np.isnan(leap(follows[None], [other], LINE)).all()
    assert leap(follows[None], [orbit], LINE, SpiralSettings(leap=4.0))[0, 0] == pytest.approx(
        4.0 * follows[-1, 0], rel=1e-3
    )
