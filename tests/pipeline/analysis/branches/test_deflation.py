"""Search of all periodic orbits at a parameter point, against scipy, published orbits and the sum of the indices."""

import numpy as np
import pytest

from magpend_core.models import load_model
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline.analysis.branches.deflation import (
    DeflationSettings,
    FoundOrbit,
    coverage,
    expected_index,
    index_sums,
    search_orbits,
    stays,
    stretch,
)
from tests.core.cells import scipy_end
from tests.core.flows import HOPF
from tests.core.test_flows import seen

DUFFING = load_model("duffing")
FREQUENCY = 1.0 / (2.0 * np.pi)


def found_of(rounds, n=600, longest=2):
    """Orbits of x'' + .15 x' - x + x^3 = .2 cos t."""
    packed = DUFFING.load(damping=0.15, linear=-1.0, cubic=1.0, amplitude=0.2).pack()
    starts = np.random.default_rng(1).uniform(-1.5, 1.5, (n, 2))
    periods = np.arange(1, longest + 1)
    starts, periods = np.tile(starts, (longest, 1)), np.repeat(periods, n)
    return search_orbits(starts, periods, FREQUENCY, packed, DUFFING.system, settings=DeflationSettings(rounds=rounds))


@pytest.fixture(scope="module")
def everything():
    return found_of(6)


@pytest.mark.slow
def test_search_orbits__each_is_an_orbit_and_is_found_once(everything):
    def rates(t, z):
        return [z[1], 0.2 * np.cos(t) - 0.15 * z[1] + z[0] - z[0] ** 3]

    seen = []
    for one in everything:
        assert not any(np.abs(one.points[0] - point).max() < 1e-5 for point in seen)
        for here, there in zip(one.points, np.roll(one.points, -1, axis=0), strict=True):
            np.testing.assert_allclose(scipy_end(rates, here, 2.0 * np.pi), there, atol=1e-8)
            seen.append(here)
    plain = found_of(0, n=60)
    more = found_of(6, n=60)
    assert len(more) > len(plain)
    assert any(one.search_round > 0 and one.n_hits == 0 for one in more)


@pytest.mark.slow
def test_search_orbits__has_the_edge_orbit(everything):
    """The saddle between the wells has the multipliers 324.501702 and .00120079844."""
    away = [np.abs(one.points[0] - [-0.099835710177, 0.007534227463]).max() for one in everything]
    edge = everything[int(np.argmin(away))]
    assert min(away) < 1e-9
    np.testing.assert_allclose(edge.multipliers, [324.501702, 0.00120079844], rtol=1e-6)
    # To 1 in the plane, only if no orbit is missing
    assert index_sums(everything, 1) == {1: 1}
    saddle = next(one for one in everything if one.index() == -1)
    assert index_sums([one for one in everything if one is not saddle], 1) == {1: 2}
    # a saddle whose multiplier is below -1 has the index 1, and -1 when it is run through twice
    turning = next(one for one in everything if one.multipliers[0].real < -1.0)
    assert (turning.index(), turning.index(2)) == (1, -1)
    assert coverage(everything) > 0.95


def test_search_orbits__an_equilibrium_on_the_section_is_none():
    """The normal form of Hopf's bifurcation seen at y = 0: its circle of radius .5 and pi seconds, about the rest."""
    parameters = seen(HOPF, "y")
    starts = np.array([[0.45, 0.0], [0.02, 0.0], [-0.03, 0.0], [0.55, 0.0]])
    one = np.ones(len(starts), int)
    (cycle,) = search_orbits(
        starts, one, 1.0 / 50.0, parameters.pack(), parameters.model.system, settings=DeflationSettings(rounds=2)
    )
    np.testing.assert_allclose(cycle.points, [[0.5, 0.0]], atol=1e-9)
    assert cycle.seconds == pytest.approx(np.pi, rel=1e-9)
    # a circle of radius .01 about a rest that is hardly unstable is one, too
    parameters = seen(HOPF, "y", mu=1e-4)
    (cycle,) = search_orbits(
        0.02 * starts, one, 1.0 / 50.0, parameters.pack(), parameters.model.system, settings=DeflationSettings(rounds=0)
    )
    np.testing.assert_allclose(cycle.points, [[1e-2, 0.0]], atol=1e-6)


def test_stays__by_rates_and_time():
    parameters = seen(HOPF, "y")
    packed, system = parameters.pack(), parameters.model.system
    assert stays(np.array([[1e-9, 0.0]]), 3.0, packed, system)  # the rates vanish
    assert stays(np.array([[0.5, 0.0]]), 1e-9, packed, system)  # it returns in no time
    assert not stays(np.array([[0.5, 0.0]]), 3.0, packed, system)
    assert not stays(np.zeros((1, 2)), 3.0, packed, DUFFING.system)  # a driven system's rest is an orbit


def test_stretch__is_newtons_method_for_the_deflated_function():
    """Against a solution of the deflated equations with a derivative by differences."""
    known = [FoundOrbit(np.array([[0.3, -0.2]]), np.eye(2), 1, 0), FoundOrbit(np.array([[1.0, 0.4]]), np.eye(2), 1, 0)]

    def plain(x):
        return np.array([x[0] ** 2 + x[1] - 0.7, np.sin(x[1]) + 0.5 * x[0]])

    def deflated(x):
        return plain(x) * np.prod([1.0 + 1.0 / np.sum((x - one.points[0]) ** 2) for one in known])

    def derivative(function, x, h=1e-6):
        return np.column_stack([(function(x + h * e) - function(x - h * e)) / (2.0 * h) for e in np.eye(2)])

    x = np.array([0.8, -0.6])
    step = -np.linalg.solve(derivative(plain, x), plain(x))
    expected = -np.linalg.solve(derivative(deflated, x), deflated(x))
    factor = stretch(x[None], np.array([1]), step[None], known, DUFFING.system)
    np.testing.assert_allclose(factor[0] * step, expected, rtol=1e-6)


def test_coverage_and_expected_index__on_paper():
    def one(n_hits):
        return FoundOrbit(np.zeros((1, 2)), np.eye(2), n_hits, 0)

    assert coverage([one(6), one(3), one(1)]) == pytest.approx(0.9)
    assert np.isnan(coverage([]))
    # 1 in the plane; 0 where an angle goes round, since the Euler characteristic of a circle is 0
    assert expected_index(DUFFING.system) == 1
    assert expected_index(PENDULUM_FITTED) == 0
