"""The search for the smallest shock that leads away, on basins whose boundary is known on paper."""

import numpy as np
import pytest

from pipeline.analysis.attractors.destinations import UNDECIDED
from pipeline.analysis.resilience.declaration import ResilienceOptions
from pipeline.analysis.resilience.shocks import ShockSearch, Trials

OWN, OTHER = 0, 4
NORMAL = np.array([0.36, -0.48, 0.8])


def found(label_of, dim, n_bases=1, seeds=None, **changes):
    """Result of a search whose trials a function of base and shock labels; and all shocks that were tried."""
    options = ResilienceOptions(**{"directions": 32, "confirmations": 128, **changes})
    search, tried = ShockSearch(OWN, n_bases, dim, options, seeds).run(), []
    trials = next(search)
    while True:
        tried.append(trials)
        try:
            trials = search.send(label_of(trials.base, trials.shock))
        except StopIteration as stop:
            return stop.value, tried


def beyond(distance, normal=NORMAL):
    """Label of shocks that leave by a plane, whose distance may depend on the base state."""
    return lambda base, shock: np.where(shock @ normal > np.broadcast_to(distance, 1000)[base], OTHER, OWN)


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_shock_search__finds_the_nearest_point_of_a_plane(dim):
    normal = np.ones(dim) / np.sqrt(dim)
    one, _ = found(beyond(0.37, normal), dim)
    # a descent ends at an angle of 2e-3, where the cosine is off by 2e-6
    assert one.high == pytest.approx(0.37, rel=5e-6)
    assert one.high - one.low <= 1.1e-6 * one.high
    assert one.shock == pytest.approx(0.37 * normal, abs=3e-3)
    assert one.to == OTHER
    assert one.n_undecided == 0


def test_shock_search__largest_jump_of_a_state():
    """In the largest jump the plane is at its distance over the sum of the normal's entries, and at a corner."""
    one, _ = found(beyond(0.37), 3, norm="largest")
    least = 0.37 / np.abs(NORMAL).sum()
    assert one.high == pytest.approx(least, rel=2e-3)
    assert np.abs(one.shock) == pytest.approx(np.full(3, least), rel=1e-2)
    # The distance is least at the eleventh of 16 base states
    distance = 0.5 - 0.2 * np.cos(2.0 * np.pi * (np.arange(1000) - 11) / 16)
    one, _ = found(beyond(distance), 3, n_bases=16)
    assert one.base == 11
    assert one.high == pytest.approx(0.3, rel=5e-6)


def test_shock_search__takes_the_smaller_of_two_ways_out():
    """A ball of another basin, thinner than the directions of a shell, comes closer than a plane."""

    def label_of(base, shock):
        inside = np.linalg.norm(shock - [0.2, 0.15, 0.0], axis=1) < 0.05
        return np.where(inside, 7, beyond(0.6)(base, shock))

    one, tried = found(label_of, 3, confirmations=4000)
    assert one.to == 7
    assert one.high == pytest.approx(0.2, rel=5e-6)
    sizes = np.linalg.norm(np.concatenate([t.shock for t in tried]), axis=1)
    assert one.n_below == (sizes <= one.low).sum()


def test_shock_search__starts_from_seeds():
    """The same ball without confirmation is found from a known state in it."""

    def label_of(base, shock):
        return np.where(np.linalg.norm(shock - [0.2, 0.15, 0.0], axis=1) < 0.05, 7, OWN)

    seeds = Trials(np.zeros(1, np.int64), np.array([[0.21, 0.14, 0.0]])), np.array([7])
    one, _ = found(label_of, 3, seeds=seeds, confirmations=0, directions=8)
    assert one.high == pytest.approx(0.2, rel=5e-6)
    assert np.isinf(found(label_of, 3, confirmations=0, directions=8)[0].high)


def test_shock_search__undecided_shocks_make_an_interval():
    """Between .3 and .4 nothing is known."""

    def label_of(base, shock):
        along = shock @ NORMAL
        return np.where(along > 0.4, OTHER, np.where(along > 0.3, UNDECIDED, OWN))

    one, _ = found(label_of, 3)
    assert one.high == pytest.approx(0.4, rel=1e-5)
    # a sample: the least undecided shock is a bit longer than the nearest
    assert 0.3 <= one.low <= 0.31
    assert one.n_undecided > 0


def test_shock_search__nothing_leads_away():
    one, tried = found(lambda base, shock: np.full(len(base), OWN), 2, n_bases=3)
    assert (one.low, one.high, one.base, one.to) == (2.0, np.inf, -1, UNDECIDED)
    assert one.safe == pytest.approx(2.0)
    assert np.isnan(one.shock).all()
    assert one.n_below == sum(len(t.base) for t in tried)
    one, tried = found(beyond(0.37), 3)
    assert one.safe < one.low
    shells = np.linalg.norm(np.concatenate([t.shock for t in tried]), axis=1)
    assert np.isclose(shells, one.safe).sum() == 32
    # the next shell has a shock that leads away, or is larger than the smallest
    assert one.safe * 2.0 ** (1.0 / 3.0) > one.low * 0.99
    a, b = (found(beyond(0.37), 3)[0] for _ in range(2))
    assert a.high == b.high
    assert (a.shock == b.shock).all()
