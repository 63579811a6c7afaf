"""The torque laws in numpy against the compiled model, differences and statics written another way."""

import numpy as np
import pytest

from magpend_core import evaluate, load_model
from magpend_core.models.pendulum import magnet_torque as laws

RNG = np.random.default_rng(3)
PSI1, PSI_REL = RNG.uniform(-0.6, 0.6, 200), RNG.uniform(-0.7, 0.7, 200)
STATES = np.stack([PSI1, PSI1 + PSI_REL, 0 * PSI1, 0 * PSI1], axis=-1)


def uneven():
    changes = {"alpha2": -1.3, "beta1": 0.05, "beta2": -0.02, "gamma2": 0.4, "p2": 0.55, "c2": 0.06, "r2": 0.05}
    return load_model("pendulum").load(**changes)


@pytest.mark.slow
def test_magnet_moment__is_that_of_the_model():
    p = uneven()
    turned = STATES + 2 * np.pi * RNG.integers(-2, 3, (200, 1)) * [1, 1, 0, 0]
    expected = evaluate(["magnet_moment"], 0.0, turned, p, 2.0)[:, 0]
    np.testing.assert_allclose(laws.magnet_moment(PSI1, PSI_REL, p), expected, rtol=0, atol=1e-12)
    p, h = uneven(), 1e-6
    up, down = (evaluate(["energy"], 0.0, STATES + s * np.array([h, h, 0, 0]), p, 2.0)[:, 0] for s in (1, -1))
    np.testing.assert_allclose(laws.weight_torque(PSI1, PSI_REL, p), -(up - down) / (2 * h), atol=1e-8)
    p = load_model("pendulum-dipole").load(pole1=150.0)
    expected = evaluate(["magnet_moment"], 0.0, STATES, p, 2.0)[:, 0]
    np.testing.assert_allclose(laws.dipole_moment(PSI1, PSI_REL, p), expected, rtol=1e-9, atol=1e-13)


def test_moment_slopes__are_those_of_the_law():
    p = uneven()
    slopes = laws.moment_slopes(PSI1, PSI_REL, p)
    assert slopes.shape == (200, len(laws.FITTED))
    for i, name in enumerate(laws.FITTED):
        step = 1e-5 * max(abs(p[name]), 0.01)
        up, down = (laws.magnet_moment(PSI1, PSI_REL, p.replace(**{name: p[name] + s})) for s in (step, -step))
        # second order of the differences, about 1e-10 of the third derivative's size
        np.testing.assert_allclose(slopes[:, i], (up - down) / (2 * step), rtol=1e-6, atol=1e-7, err_msg=name)
    at = np.array([1.2, -0.06, 0.055])
    slopes = laws.bump_slopes(PSI1, *at)
    for i in range(3):
        step = np.eye(3)[i] * 1e-6
        expected = (laws.bump(PSI1, *(at + step)) - laws.bump(PSI1, *(at - step))) / 2e-6
        np.testing.assert_allclose(slopes[:, i], expected, rtol=1e-5, atol=1e-7)


def test_transition__is_where_the_two_bumps_have_equal_shares():
    p = uneven().replace(alpha2=-1.1306, alpha1=1.1306)
    line = laws.transition(p)
    at = line.slope * 0.3 + line.offset
    peaks = [-(p[f"p{i}"] * 0.3 + p[f"r{i}"]) for i in (1, 2)]
    assert at == pytest.approx(np.mean(peaks), abs=1e-15)
