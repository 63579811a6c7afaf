"""Rates and Jacobians in numpy against those of the compiled code."""

import numpy as np
import pytest

from magpend_core.plain_rates import plain_rates
from magpend_core.pointwise import jacobian_at, rates_at
from tests.core.flows import model_of
from tests.core.test_jets import TEXTS


@pytest.mark.parametrize("name", TEXTS)
def test_plain_rates__compiled(name):
    """All functions of texts, at states that each have their own parameters."""
    model = model_of({"x": TEXTS[name], "y": "x"}, {"a": 1.3})
    states = np.array([0.43, -0.61]) + 0.1 * np.arange(6.0).reshape(3, 2)
    packed = np.array([model.load(a=a).pack() for a in (1.3, -0.4, 0.7)])
    rates, jacobians = plain_rates(model.system, states, packed)
    for k in range(3):
        one = states[k : k + 1]
        np.testing.assert_allclose(rates[k], rates_at(model.system, one, packed[k])[0], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(jacobians[k], jacobian_at(model.system, one, packed[k])[0], rtol=1e-12, atol=1e-13)


def test_plain_rates__sides_of_a_switch():
    """Coulomb friction: each state is on its own side of the switch."""
    model = model_of({"x": "v", "v": "-x - mu*sign(v)"}, {"mu": 0.3})
    states = np.array([[0.1, 0.5], [0.1, -0.5]])
    rates, jacobians = plain_rates(model.system, states, np.tile(model.load().pack(), (2, 1)))
    np.testing.assert_allclose(rates, [[0.5, -0.4], [-0.5, 0.2]], rtol=1e-15)
    np.testing.assert_allclose(jacobians, np.tile([[0.0, 1.0], [-1.0, 0.0]], (2, 1, 1)), rtol=1e-15)
