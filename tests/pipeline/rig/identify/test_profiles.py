"""Profiles on criteria whose profiles are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pipeline.rig.identify.identifiability import Curvature, following, interval_of, profile

INFORMATION = np.array([[4.0, 3.0], [3.0, 9.0]])
ESTIMATE = np.array([1.0, 2.0])


def problem(lower=-np.inf, upper=np.inf):
    free = [SimpleNamespace(name=n, lower=lower, upper=upper) for n in ("a", "b")]
    return SimpleNamespace(free=free)


def local(cost):
    """A fit of the second parameter with the first held."""

    def fit_local(_, theta0, *, starts, fixed, tolerance):
        a = fixed["a"]
        found = minimize_scalar(lambda b: cost(np.array([a, b])), bracket=(theta0[1], theta0[1] + 0.1))
        return SimpleNamespace(
            theta=np.array([a, found.x]), starts=starts, cost=found.fun, converged=bool(np.isfinite(found.fun))
        )

    return fit_local


def quadratic(theta):
    return 0.5 * (theta - ESTIMATE) @ INFORMATION @ (theta - ESTIMATE)


def curvature(error, plain, critical, size):
    return Curvature(error, plain, critical, size, following(INFORMATION, 0), np.zeros((1, 2)))


BEST = SimpleNamespace(theta=ESTIMATE, starts=np.zeros((1, 2)), cost=0.0)
PLAIN = float(np.sqrt(np.linalg.inv(INFORMATION)[0, 0]))


@pytest.mark.parametrize("inflation", [1.0, 3.0])
def test_profile__of_a_quadratic_is_the_interval_of_the_standard_error(inflation):
    about = curvature(inflation * PLAIN, PLAIN, 2.0, 1.0)
    found = profile(problem(), BEST, "a", about, local(quadratic))
    half = 2.0 * inflation * PLAIN
    np.testing.assert_allclose(found.interval, (1.0 - half, 1.0 + half), rtol=1e-6)
    np.testing.assert_allclose(found.growth, ((found.values - 1.0) / about.error) ** 2, atol=1e-9)


def test_profile__stops_at_the_bounds_and_leaves_the_interval_open():
    about = curvature(PLAIN, PLAIN, 2.0, 1.0)
    found = profile(problem(lower=0.9), BEST, "a", about, local(quadratic))
    assert found.values.min() == 0.9
    assert found.interval[0] == -np.inf
    assert found.interval[1] == pytest.approx(1.0 + 2.0 * PLAIN)


def test_profile__of_a_skewed_criterion_is_skewed():
    """Cost (log a)^2/2 / s^2: the interval is that of log a."""
    s = 0.3

    def cost(theta):
        return 0.5 * (np.log(theta[0]) / s) ** 2 + 0.5 * (theta[1] - 2.0) ** 2

    found = profile(problem(lower=0.01), BEST, "a", curvature(s, s, 1.96, 1.0), local(cost))
    np.testing.assert_allclose(found.interval, np.exp([-1.96 * s, 1.96 * s]), rtol=0.02)


def test_profile__shows_a_better_fit_than_the_best():
    def cost(theta):
        return quadratic(theta) - 5.0 * (theta[0] > 1.2)

    found = profile(problem(), BEST, "a", curvature(PLAIN, PLAIN, 2.0, 1.0), local(cost))
    assert found.lowest < 0


def test_interval_of__leaves_out_what_did_not_converge():
    values = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    growth = np.array([4.0, np.nan, 0.0, 1.0, 4.0])
    np.testing.assert_allclose(interval_of(values, growth, 0.0, 1.5), (-1.5, 1.5))


def test_following__is_where_the_optimum_goes():
    """The least of a quadratic with one parameter held: b moves by -S_ba/S_bb."""
    np.testing.assert_allclose(following(INFORMATION, 0), [1.0, -3.0 / 9.0])
    np.testing.assert_allclose(following(INFORMATION * np.outer([1, 1e-6], [1, 1e-6]), 0), [1.0, -3e6 / 9.0])
