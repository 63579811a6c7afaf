"""Wasserstein-1 of section points, and its noise floor."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from pipeline.results.sets import Geometry
from pipeline.rig.measured.comparison import Cloud, cloud_of, distance_to, floor_of, wasserstein
from pipeline.rig.measured.computed import Candidate

LINE = Geometry((False,), (2.0,))
CIRCLE = Geometry((True, False), (1.0, 10.0))


def cloud(points, sigma, period, seed=0):
    points = np.asarray(points, np.float64)
    noise = np.random.default_rng(seed).normal(0, 1, points.shape) * sigma
    return Cloud(points + noise, np.broadcast_to(np.asarray(sigma, np.float64), points.shape).copy(), period)


@pytest.mark.parametrize("sizes", [(20, 20), (12, 8), (30, 1), (7, 5), (97, 112)])
def test_wasserstein__on_a_line_it_is_that_of_sorted_points(sizes):
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(sizes[0], 1)), rng.normal(0.4, 1.5, (sizes[1], 1))
    assert wasserstein(a, b, LINE) == pytest.approx(wasserstein_distance(a[:, 0], b[:, 0]) / 2.0, rel=1e-9)


@pytest.mark.slow
def test_wasserstein__unequal_numbers_take_little_memory():
    """97 and 112 points: not 10,864 squared, which is 0.9 GB."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(97, 2)), rng.normal(size=(112, 2))
    tracemalloc.start()
    wasserstein(a, b, CIRCLE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e7


def test_wasserstein__angles_go_the_short_way_and_rates_are_scaled():
    a, b = np.array([[np.pi - 0.1, 0.0]]), np.array([[-np.pi + 0.2, 1.0]])
    assert wasserstein(a, b, CIRCLE) == pytest.approx(0.3)
    assert wasserstein(a, a + [2 * np.pi, 5.0], CIRCLE) == pytest.approx(0.5)


def test_wasserstein__the_pairing_is_the_cheapest_of_all():
    """Against all pairings of five points in the plane."""
    from itertools import permutations

    rng = np.random.default_rng(4)
    a, b = rng.normal(size=(2, 5, 2))
    best = min(np.mean(CIRCLE.distance(a, b[list(p)])) for p in permutations(range(5)))
    assert wasserstein(a, b, CIRCLE) == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("n", [58, 59, 60, 61])
def test_floor_of__halves_hold_whole_cycles(n):
    """Unequal numbers of an orbit's points would cost a way of 1 between them."""
    points = np.tile([[0.0, 0.0], [1.0, 0.0], [2.0, 3.0]], (21, 1))[:n]
    assert floor_of(cloud(points, 1e-3, 3), CIRCLE, np.random.default_rng(0)) < 5e-3


def test_cloud_of__a_cycle_with_a_gap_is_left_out_whole():
    """Without its neighbours of the same cycle, so that each point of the orbit weighs alike."""
    points = np.tile([[0.0, 0.0], [1.0, 0.0], [2.0, 3.0]], (20, 1))
    points[[7, 58, 59]] = np.nan
    found = cloud_of(points, np.full(points.shape, 1e-3), 3)
    assert len(found.points) == 54
    assert (found.points[::3] == 0.0).all()
    assert floor_of(found, CIRCLE, np.random.default_rng(0)) < 1e-12
    assert len(cloud_of(points, points, 0).points) == 57


def test_distance_to__the_true_attractor_is_one_floor_away():
    """For many recordings the ratio is 1 in the mean: the model's points are blurred as the rig's are."""
    orbit = np.array([[0.1, 0.5], [0.7, -2.0]])
    ratios = []
    for seed in range(60):
        one = cloud(np.tile(orbit, (30, 1)), [3e-4, 4e-2], 2, seed)
        rng = np.random.default_rng(1000 + seed)
        far = distance_to(Candidate(0, 2, 0, orbit), one, CIRCLE, rng)
        ratios.append(far / floor_of(one, CIRCLE, rng))
    # the floor is the larger of two estimates, which takes some per cent off
    assert np.mean(ratios) == pytest.approx(0.93, abs=0.06)


@pytest.mark.parametrize(
    ("orbit", "model", "far"),
    [
        ([[0.1, 0.5], [0.7, -2.0]], [[0.15, 0.5], [0.75, -2.0]], 0.05),  # as far as it is off
        ([[0.1, 0.5]], [[0.08, 0.5], [0.12, 0.5]], 0.02),  # a doubled period costs half its split
    ],
)
def test_distance_to__another_orbit(orbit, model, far):
    one = cloud(np.tile(orbit, (60 // len(orbit), 1)), [1e-4, 1e-3], len(orbit))
    candidate = Candidate(0, 2, 0, np.array(model))
    assert distance_to(candidate, one, CIRCLE, np.random.default_rng(0)) == pytest.approx(far, rel=0.02)


def test_distance_to__samples_of_one_bounded_set_are_a_floor_apart():
    rng = np.random.default_rng(5)
    one = Cloud(rng.uniform(0, 1, (60, 2)) * [1, 10], np.full((60, 2), 1e-4), 0)
    same = Candidate(0, 0, 0, rng.uniform(0, 1, (2000, 2)) * [1, 10])
    floor = floor_of(one, CIRCLE, rng)
    assert 0.6 < distance_to(same, one, CIRCLE, rng) / floor < 1.3
    few = Candidate(0, 0, 0, same.points[:10])
    assert np.isfinite(distance_to(few, one, CIRCLE, rng))
