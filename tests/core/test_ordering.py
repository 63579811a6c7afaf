"""Orders do not depend on last digits."""

import numpy as np

from magpend_core.orbits import _by_modulus
from magpend_core.ordering import canonical_order

EDGES = np.array(
    [
        [0.5e-6, 3.0],
        [0.5e-6, 1.0],  # at the edge of a grid of 1e-6
        [2.0, 1.0],
        [2.0, -1.0],  # mirror images
        [-1.0, np.nan],
        [-1.0, 0.0],
    ]
)


def noisy(values, seed, size=1e-12):
    rng = np.random.default_rng(seed)
    return values * (1.0 + size * rng.standard_normal(np.shape(values))) + 1e-13 * rng.standard_normal(np.shape(values))


def test_canonical_order__last_digits_do_not_decide():
    plain = canonical_order(EDGES).tolist()
    assert plain == [5, 4, 1, 0, 3, 2]
    assert all(canonical_order(noisy(EDGES, seed)).tolist() == plain for seed in range(200))
    # rows that are equal stay in the given order
    assert canonical_order(noisy(np.ones((4, 2)), 0)).tolist() == [0, 1, 2, 3]
    assert canonical_order(np.zeros((0, 2))).tolist() == []


def test_by_modulus__multipliers_of_one_modulus():
    values = np.array([-0.5, 0.5, 0.3 - 0.4j, 0.3 + 0.4j, 2.0, 0.0, 1e-12])
    plain = _by_modulus(values[None])[0].tolist()
    assert plain == [2.0, 0.5, 0.3 + 0.4j, 0.3 - 0.4j, -0.5, 1e-12, 0.0]
    rng = np.random.default_rng(1)
    for _ in range(50):
        shaken = rng.permutation(values) * (1.0 + 1e-13 * rng.standard_normal(7))
        assert np.allclose(_by_modulus(np.stack([values, shaken]))[1], plain, rtol=1e-11, atol=0.0)
