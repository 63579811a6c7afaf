"""What is said of parameters that the data do not determine."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.identify import identifiability as idf
from pipeline.rig.identify.statistics import Covariance

NAMES = ("mass", "stiffness", "friction")
NONE = np.full(3, np.nan)


def covariance(matrix) -> Covariance:
    return Covariance(np.asarray(matrix, float), "white", "", 1.96, 100.0, 1.0)


def slopes() -> np.ndarray:
    """Residuals that see mass and stiffness as their ratio alone, and friction."""
    rng = np.random.default_rng(2)
    ratio, friction = rng.normal(size=(2, 400))
    return np.stack([ratio, -ratio, friction], axis=1)


def test_directions_of__are_singular_values_of_the_scaled_slopes():
    rng = np.random.default_rng(3)
    j, scale = rng.normal(size=(50, 3)), np.array([2.0, 0.1, 30.0])
    found = idf.directions_of(j.T @ j, scale, inflation=2.0)
    _, values, vectors = np.linalg.svd(j * scale)
    np.testing.assert_allclose([d.singular_value for d in found], values, rtol=1e-9)
    np.testing.assert_allclose(np.abs([d.vector @ v for d, v in zip(found, vectors, strict=True)]), 1.0)
    np.testing.assert_allclose([d.error for d in found], 2.0 / values, rtol=1e-9)


def test_warnings_of__a_combination_that_is_not_determined():
    j = slopes()
    directions = idf.directions_of(j.T @ j, np.ones(3), 1.0)
    matrix = np.diag([np.nan, np.nan, 1e-4])
    (found,) = idf.warnings_of(NAMES, directions, covariance(matrix), NONE, ("", "", ""))
    assert "do not determine mass and stiffness apart" in found
    assert "mass +10 % and stiffness +10 % leave the fit as it is" in found
    assert "give one a prior" in found


def test_warnings_of__one_parameter_hardly_seen():
    j = slopes()[:, [0, 2]] * [1.0, 1e-3]
    directions = idf.directions_of(j.T @ j, np.ones(2), 1.0)
    found = idf.warnings_of(("mass", "friction"), directions, covariance(np.eye(2)), NONE[:2], ("", ""))
    assert len(found) == 1
    assert found[0].startswith("the data do not determine friction (standard error")


def test_warnings_of__a_prior_decides():
    j = slopes()
    directions = idf.directions_of(j.T @ j, np.ones(3), 1.0)
    prior = np.array([0.01, np.nan, np.nan])
    matrix = np.diag([0.01**2, 0.02**2, 1e-4])
    found = idf.warnings_of(NAMES, directions, covariance(matrix), prior, ("", "", ""))
    assert any("prior of mass decides" in w for w in found)
    assert any("mass is as its prior says" in w for w in found)


def test_warnings_of__a_bound_and_two_that_move_together():
    matrix = np.array([[1.0, 0.999, 0], [0.999, 1.0, 0], [0, 0, 1.0]])
    found = idf.warnings_of(NAMES, [], covariance(matrix), NONE, ("", "", "lower"))
    assert any("friction ended at its lower bound" in w for w in found)
    assert any("mass and stiffness" in w and "+0.9990" in w for w in found)


def test_warnings_of__nothing_to_warn_of():
    j = np.random.default_rng(4).normal(size=(400, 3))
    directions = idf.directions_of(j.T @ j, np.ones(3), 1.0)
    assert idf.warnings_of(NAMES, directions, covariance(np.eye(3) * 0.0025), NONE, ("", "", "")) == []


@pytest.mark.parametrize(
    ("theta", "start", "sensed", "size"),
    [(2.0, 1.0, np.nan, 2.0), (0.0, 1.0, np.nan, 1.0), (0.0, 0.0, np.nan, 3.0), (1e-3, 0.0, 1.0, 1.0)],
)
def test_sizes_of__never_zero(theta, start, sensed, size):
    found = idf.sizes_of(*(np.array([v]) for v in (theta, start, -1.0, 2.0, sensed)))
    assert found[0] == size
