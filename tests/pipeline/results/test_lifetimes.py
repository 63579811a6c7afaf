"""Intervals of lifetimes: published values, and how often they cover the truth."""

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.results.intervals import lifetime_interval

# ---- intervals ---------------------------------------------------------------------------------


def test_lifetime_interval__published_poisson_limits():
    """Garwood's 95 % limits of a Poisson mean: 1 seen, 0.0253 to 5.572; 10 seen, 4.795 to 18.39."""
    assert lifetime_interval(1, 100.0) == pytest.approx((100 / 5.572, 100 / 0.02532), rel=1e-3)
    assert lifetime_interval(10, 100.0) == pytest.approx((100 / 18.390, 100 / 4.795), rel=1e-3)
    low, high = lifetime_interval(0, 100.0)
    assert low == pytest.approx(100 / 2.9957, rel=1e-4)  # the rule of three
    assert high == np.inf
    with pytest.raises(ValueError, match="confidence"):
        lifetime_interval(1, 1.0, 1.0)


@pytest.mark.parametrize("n_left", [1, 2, 9, 300])
def test_lifetime_interval__quantiles_of_chi_squared(n_left):
    expected = 20.0 / chi2.isf(0.05, 2 * n_left + 2), 20.0 / chi2.ppf(0.05, 2 * n_left)
    assert lifetime_interval(n_left, 10.0, 0.9) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("lifetime", [0.2, 1.0, 4.0, 20.0, 200.0])
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_lifetime_interval__covers(lifetime, confidence):
    """Exponential lifetimes of 24 cells, looked at for a unit of time."""
    n = 4000
    lived = np.random.default_rng(7).exponential(lifetime, (n, 24))
    left, at_risk = (lived < 1.0).sum(axis=1), np.minimum(lived, 1.0).sum(axis=1)
    bounds = np.array([lifetime_interval(int(r), 1.0, confidence) for r in range(25)])[left]
    covered = (bounds[:, 0] * at_risk <= lifetime) & (lifetime <= bounds[:, 1] * at_risk)
    assert covered.mean() >= confidence - 3.0 * np.sqrt(confidence * (1.0 - confidence) / n)
    # and it is no wider than counts allow: none of many escapes seen is impossible
    if lifetime < 2.0:
        assert covered.mean() <= confidence + 0.04
