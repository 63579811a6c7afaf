"""Periods of measured motions among noise, transients and chaos."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.measured.diagram import find_period


def noisy(points, sigma, seed=0):
    points = np.asarray(points, np.float64)
    points = points[:, None] if points.ndim == 1 else points
    return points + np.random.default_rng(seed).normal(0, sigma, points.shape), np.full(points.shape, sigma)


def logistic(r, n, skip=1000):
    x, out = 0.3, []
    for _ in range(skip + n):
        x = r * x * (1 - x)
        out.append(x)
    return np.array(out[skip:])


@pytest.mark.slow
@pytest.mark.parametrize("period", [1, 2, 3, 4, 5, 6, 8])
@pytest.mark.parametrize("seed", range(5))
def test_find_period__cycles_among_noise(period, seed):
    """Points of a cycle 20 standard deviations apart on average: the period, and sure of it."""
    cycle = np.random.default_rng(100 + seed).normal(0, 20e-3, (period, 3))
    found = find_period(*noisy(np.tile(cycle, (60 // period + 1, 1))[:60], 1e-3, seed))
    assert found.orbit_period == period
    assert found.confidence > 0.9
    assert found.closure == pytest.approx(1.0, abs=0.35)


N = np.arange(60)
CYCLE = np.tile([[0.0, 1.0], [0.3, 0.2], [0.9, 0.4]], (20, 1))
ON_PAPER = {2.9: 1, 3.2: 2, 3.5: 4, 3.83: 3, 3.74: 5, 3.9: 0, 3.6: 0}
KNOWN = {
    **{f"logistic map, r = {r}": (logistic(r, 64), period) for r, period in ON_PAPER.items()},
    "a turn per period is no motion of its own": (2 * np.pi * N + 0.1, 1),
    "a missing section does not shift the others": (np.where((N == 17)[:, None], np.nan, CYCLE), 3),
}


@pytest.mark.parametrize("name", KNOWN)
def test_find_period__of_known_motions(name):
    points, period = KNOWN[name]
    found = find_period(*noisy(points, 1e-3))
    assert found.orbit_period == period
    assert found.confidence > 0.9


@pytest.mark.slow
def test_find_period__chaos_is_unclosed_for_many_starts():
    wrong = sum(find_period(*noisy(logistic(4.0, 60, 1000 + k), 1e-3)).orbit_period > 0 for k in range(100))
    assert wrong == 0


@pytest.mark.parametrize("factor", [0.96, -0.96, 0.9])
def test_find_period__what_is_left_of_a_transient_is_no_period(factor):
    """A spiral that starts 10 standard deviations off and shrinks by 4 % a period: period 1."""
    n = np.arange(60)
    found = find_period(*noisy(np.stack([0.3 + 0.01 * factor**n, 0.1 + 0 * n], axis=1), 1e-3))
    # a shrinking alternation is period 2 until it has gone; its confidence must then be low
    assert found.orbit_period == 1 or found.confidence < 0.8


def test_find_period__noise_that_was_misjudged_lowers_the_confidence():
    points, noise = noisy(np.full((60, 2), 0.2), 1e-3)
    sure, unsure = find_period(points, noise), find_period(points, noise / 3.0)
    assert sure.confidence == 1.0
    assert unsure.confidence < 0.8


@pytest.mark.slow
def test_find_period__where_it_is_sure_it_is_right():
    """Over splits from none to ten deviations: sure at both ends, unsure between, never sure of the wrong."""
    rng, sure = np.random.default_rng(7), []
    for seed in range(200):
        split = rng.uniform(0, 10e-3)
        alternating = 0.5 * split * np.where(np.arange(60) % 2, 1.0, -1.0)
        found = find_period(*noisy(np.stack([alternating, 0 * alternating], axis=1), 1e-3, seed))
        if found.confidence >= 0.9:
            sure.append((split, found.orbit_period))
    # up to three deviations, points that are noise in one component of two cannot be told from one
    assert all(period == (1 if split < 3e-3 else 2) for split, period in sure)
    assert sum(period == 1 for _, period in sure) > 25
    assert sum(period == 2 for _, period in sure) > 25


def test_find_period__too_few_sections_say_nothing():
    found = find_period(*noisy(np.zeros((7, 2)), 1e-3))
    assert (found.orbit_period, found.confidence, found.max_period) == (0, 0.0, 0)
    assert find_period(*noisy(np.zeros((20, 2)), 1e-3)).max_period == 7
