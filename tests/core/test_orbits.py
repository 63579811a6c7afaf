"""Polished periodic orbits and tangent vectors."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

from magpend_core import load_preset, polish_orbits
from magpend_core.engine.variational import with_tangents
from magpend_core.models.duffing.system import DUFFING
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.orbits import scaled_distance, section_map, wrap_angles
from tests.core.cells import run_cells, stroboscopic_map

# made by Newton's method on the stroboscopic map at rtol 1e-12 with other integrators: points agree
# among them to 3e-11, multipliers are good to 1e-6
ORBITS = json.loads((Path(__file__).parent / "data" / "orbits.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def reference():
    points = np.array([o["section"] for o in ORBITS])
    frequency = np.array([o["frequency_hz"] for o in ORBITS])
    multipliers = [np.array([complex(*z) for z in o["multipliers"]]) for o in ORBITS]
    return points, frequency, multipliers


@pytest.fixture(scope="module")
def packed(reference):
    return np.tile(load_preset().pack(), (len(reference[0]), 1))


@pytest.mark.parametrize("guessed_period", [1, 2])
def test_polish_orbits__reference(reference, packed, guessed_period):
    points, frequency, multipliers = reference
    found = polish_orbits(
        packed, frequency, points + 1e-3, np.full(len(points), guessed_period), system=PENDULUM_FITTED
    )
    assert found.converged.all()
    assert found.is_stable.all()
    assert (found.orbit_period == 1).all()
    assert (found.residual < 1e-12).all()
    assert np.abs(found.section - points).max() < 1e-9
    for own, known in zip(found.multipliers, multipliers, strict=True):
        # conjugate pairs: compare as sets
        assert np.abs(own[:, None] - known[None, :]).min(axis=1).max() < 1e-5
        assert np.abs(own[:, None] - known[None, :]).min(axis=0).max() < 1e-5


def test_polish_orbits__far_from_any(packed):
    found = polish_orbits(
        packed[:1],
        np.array([2.03]),
        [[2.0, -2.0, 15.0, -20.0]],
        np.array([1]),
        max_iterations=3,
        system=PENDULUM_FITTED,
    )
    assert not found.converged[0]
    assert np.isnan(found.multipliers).all()
    wrapped = wrap_angles(np.array([np.pi, -np.pi, 7.0, -7.0]), PENDULUM_FITTED)
    np.testing.assert_allclose(wrapped, [np.pi, np.pi, 7.0, -7.0])
    assert scaled_distance([np.pi - 1e-3, 0, 0, 0], [-np.pi + 1e-3, 0, 0, 0], PENDULUM_FITTED) == pytest.approx(2e-3)


@pytest.mark.parametrize(("periods", "message"), [([0], "1 or more"), ([1.5], "whole numbers"), ([1, 1], "must agree")])
def test_polish_orbits__bad_input(packed, periods, message):
    with pytest.raises(ValueError, match=message):
        polish_orbits(packed[:1], np.array([2.2]), np.zeros((1, 4)), np.array(periods), system=PENDULUM_FITTED)


def test_stroboscopic_map__derivatives(packed, reference):
    """Against central differences of sections of the plain system."""
    points, frequency, _ = reference
    _, derivatives = stroboscopic_map(packed[:1], frequency[:1], points[:1], 1, system=PENDULUM_FITTED)
    step = 1e-6 * np.array([1.0, 1.0, 10.0, 10.0])
    shifted = np.concatenate([points[0] + np.diag(step), points[0] - np.diag(step)])
    plain = run_cells(PENDULUM_FITTED, packed[0], frequency[0], shifted, rtol=1e-12).section[:, 0, 0]
    differences = (plain[:4] - plain[4:]).T / (2.0 * step)
    # integration error over the step, and the step's square
    assert np.abs(derivatives[0] - differences).max() < 1e-4 * np.abs(differences).max()


def test_section_map__a_number_of_periods_for_each_row(packed, reference):
    """Rows of one call have the bits that each has alone, and nothing beyond their own periods."""
    points, frequency, _ = reference
    periods = np.array([1, 3, 2])
    found = section_map(packed[:3], frequency[:3], points[:3] + 0.01, periods, rtol=1e-9, system=PENDULUM_FITTED)
    for row, n in enumerate(periods):
        one = slice(row, row + 1)
        alone = section_map(packed[one], frequency[one], points[one] + 0.01, int(n), rtol=1e-9, system=PENDULUM_FITTED)
        assert (found.images[row, :n] == alone.images[0]).all()
        assert np.isnan(found.images[row, n:]).all()
        assert (found.derivatives[row] == alone.derivatives[0]).all()


@pytest.mark.slow
def test_polish_orbits__points_and_derivative(packed, reference):
    """Orbits of several periods in one call, one of them from a multiple of its period."""
    points, frequency, _ = reference
    settled = run_cells(PENDULUM_FITTED, packed[0], 2.48, [[0.05, 0.1, 0.0, 0.0]], n_transient=600, rtol=1e-9)
    guesses, drives = np.vstack([settled.section[0, 0], points[:2]]), np.array([2.48, *frequency[:2]])
    found = polish_orbits(packed[:1].repeat(3, 0), drives, guesses, np.array([2, 1, 3]), system=PENDULUM_FITTED)
    assert found.orbit_period.tolist() == [2, 1, 1]
    for row, n in enumerate(found.orbit_period):
        one = slice(row, row + 1)
        images, derivatives = stroboscopic_map(packed[:1], drives[one], found.section[one], int(n))
        assert (
            scaled_distance(
                found.points[row, :n], np.vstack([found.section[one], images[0, :-1]]), PENDULUM_FITTED
            ).max()
            < 1e-9
        )
        assert np.isnan(found.points[row, n:]).all()
        assert np.abs(found.derivative[row] - derivatives[0]).max() < 1e-6


@pytest.mark.slow
def test_with_tangents__trajectory_unchanged():
    """Tangents stay out of the error control: same steps, same states."""
    values = [0.1, -1.0, 1.0, 0.3]
    plain = run_cells(DUFFING, values, 0.2, [[0.2, 0.2]], n_keep=5)
    result = run_cells(with_tangents(DUFFING, 1), values, 0.2, [[0.2, 0.2, 1.0, 0.0]], n_keep=5)
    assert result.n_steps[0, 0] == plain.n_steps[0, 0]
    # the compiler may order the same sums otherwise
    np.testing.assert_allclose(result.section[0, 0, :, :2], plain.section[0, 0], rtol=1e-11, atol=1e-12)
    with pytest.raises(ValueError, match="between 1 and 4"):
        with_tangents(PENDULUM_FITTED, 5)


@pytest.mark.parametrize("period", [10.0, 100.0])
def test_stroboscopic_map__derivative_at_rest(period):
    # x'' + c x' + k x = 0 at x = 0: the map is exp(A T), whatever the trajectory's step may be
    c, k = 0.02, 2.0
    image, derivative = stroboscopic_map(
        np.array([[c, k, 0.0, 0.0]]), np.array([1.0 / period]), np.zeros((1, 2)), 1, system=DUFFING
    )
    assert (image == 0.0).all()
    assert derivative[0] == pytest.approx(scipy.linalg.expm(np.array([[0.0, 1.0], [-k, -c]]) * period), abs=1e-8)
