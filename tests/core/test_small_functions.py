"""Nearest neighbours, growth under products of matrices, stiffness and natural sizes, against numpy and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from magpend_core.neighbours import n_nearer, nearest_distances
from magpend_core.sizes import natural_size
from magpend_core.stiffness import fastest_contraction
from magpend_core.stretching import stretched
from tests.core.flows import model_of

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


# ---- growth of directions, against the decompositions of numpy


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_stretched__as_numpy(n):
    paths = np.random.default_rng(n).normal(size=(2, 40, n, n))
    found = stretched(paths)
    for path, own in zip(paths, found, strict=True):
        basis = np.eye(n)
        for matrix, sizes in zip(path, own, strict=True):
            basis, factors = np.linalg.qr(matrix @ basis)
            np.testing.assert_allclose(sizes, np.abs(np.diagonal(factors)), rtol=1e-10)


def test_stretched__the_product_of_the_sizes_is_the_determinant():
    paths = np.random.default_rng(0).normal(size=(3, 50, 4, 4))
    np.testing.assert_allclose(np.log(stretched(paths)).sum(axis=2), np.linalg.slogdet(paths)[1], rtol=1e-9, atol=1e-9)
    # A section by crossing has a row and a column of zeros; a critical point has a zero derivative once
    crossing = np.diag([2.0, 0.0, 0.5])
    np.testing.assert_array_equal(stretched(np.tile(crossing, (1, 9, 1, 1)))[0, :, :], [[2.0, 0.0, 0.5]] * 9)
    turned = np.array([[0.0, 1.0], [1.0, 0.0]])
    found = stretched(np.array([[np.zeros((2, 2)), 3.0 * turned, np.diag([2.0, 5.0])]]))[0]
    np.testing.assert_array_equal(found[:2], [[0.0, 0.0], [3.0, 3.0]])
    assert np.prod(found[2]) == pytest.approx(10.0)


# ---- the fastest contraction of equations, in their layers too


def test_fastest_contraction__of_a_linear_system_is_its_eigenvalue() -> None:
    model = model_of({"x": "-3*x", "y": "x - 40*y"})
    packed = model.load().pack()[None]
    assert fastest_contraction(model.system, packed, np.ones(1), np.zeros((1, 2))) == pytest.approx(40.0)


def test_fastest_contraction__finds_a_layer_away_from_the_state() -> None:
    model = model_of({"x": "v", "v": "-x - tanh(1000*(v - u))"}, {"u": 0.3})
    # at v = u the friction's slope is 1000 /s; at the state itself it is nothing
    found = fastest_contraction(model.system, model.load().pack()[None], np.ones(1), np.array([[0.5, -2.0]]))
    assert found == pytest.approx(1000.0, rel=1e-3)


@pytest.mark.parametrize(
    ("bounds", "size"),
    [
        ((3e-9,), 1e-9),
        ((0.1,), 1.0),
        ((100.0,), 1.0),
        ((0.09,), 0.1),
        ((4e8,), 1e9),
        ((1e-5, 1e-3), 1e-4),
        ((0.03, 0.3), 1.0),
        ((90.0, 900.0), 1.0),
        ((0.0,), 1.0),
        ((math.nan,), 1.0),
        ((math.inf,), 1.0),
    ],
)
def test_natural_size__a_power_of_ten_or_1(bounds, size):
    assert natural_size(*bounds) == size
