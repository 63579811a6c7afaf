"""Growth of directions under products of matrices, against the decompositions of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.stretching import stretched


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


def test_stretched__a_direction_that_vanishes_comes_back():
    """A section by crossing has a row and a column of zeros; a critical point has a zero derivative once."""
    crossing = np.diag([2.0, 0.0, 0.5])
    np.testing.assert_array_equal(stretched(np.tile(crossing, (1, 9, 1, 1)))[0, :, :], [[2.0, 0.0, 0.5]] * 9)
    turned = np.array([[0.0, 1.0], [1.0, 0.0]])
    found = stretched(np.array([[np.zeros((2, 2)), 3.0 * turned, np.diag([2.0, 5.0])]]))[0]
    np.testing.assert_array_equal(found[:2], [[0.0, 0.0], [3.0, 3.0]])
    assert np.prod(found[2]) == pytest.approx(10.0)
