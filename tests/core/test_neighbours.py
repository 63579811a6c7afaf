"""Nearest neighbours by compiled loops, against the search trees of scipy: the same numbers, also on circles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from magpend_core.neighbours import n_nearer, nearest_distances

TWO_PI = 2.0 * np.pi


@pytest.fixture(params=[(1, 1, 0), (3, 2, 1), (200, 2, 0), (200, 2, 2), (100, 4, 2), (60, 1, 1)], ids=str)
def samples(request):
    n, n_states, n_angles = request.param
    random = np.random.default_rng(n + n_states)
    own, other, asked = (random.uniform(0.0, TWO_PI, (m, n_states)) for m in (n, n + 3, n + 5))
    asked[:2] = own[0]  # at a point, and twice
    return own, other, asked, np.where(np.arange(n_states) < n_angles, TWO_PI, 0.0)


def by_scipy(points, asked, circumference):
    return cKDTree(points, boxsize=circumference).query(asked, p=np.inf)[0]


def test_nearest_distances__as_scipy(samples):
    own, _, asked, circumference = samples
    np.testing.assert_array_equal(nearest_distances(own, asked, circumference), by_scipy(own, asked, circumference))


@pytest.mark.parametrize("least", [0.0, 0.1, 10.0])
def test_n_nearer__as_scipy(samples, least):
    own, other, asked, circumference = samples
    here, there = (np.maximum(by_scipy(points, asked, circumference), least) for points in (own, other))
    count = (there < here).sum() + 0.5 * (there == here).sum()
    assert n_nearer(own, other, asked, circumference, least, np.inf) == count
    early = n_nearer(own, other, asked, circumference, least, 0.5 * count)
    assert 0.5 * count <= early <= count
