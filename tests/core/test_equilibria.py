"""Equilibria of flows, against closed forms."""

import numpy as np
import pytest

from magpend_core.crossing import Crossing
from magpend_core.equilibria import find_equilibria, newton_steps
from magpend_core.models.sectioned import sectioned
from tests.core.flows import LORENZ, VAN_DER_POL, flow


def test_find_equilibria__lorenz():
    """Two at x = y = +-sqrt(beta (rho - 1)), z = rho - 1, and the origin, with their eigenvalues."""
    parameters = flow(LORENZ).load(rho=20.0)
    guesses = np.array([[6.0, 8.0, 18.0], [-8.0, -6.0, 20.0], [0.1, -0.1, 0.2]])
    found = find_equilibria(parameters.model.system, guesses, parameters.pack())
    assert found.converged.all()
    x = np.sqrt(8.0 / 3.0 * 19.0)
    np.testing.assert_allclose(found.states, [[x, x, 19.0], [-x, -x, 19.0], [0.0, 0.0, 0.0]], atol=1e-9)
    assert found.is_stable.tolist() == [True, True, False]
    # the origin: -beta, and the roots of l**2 + (sigma + 1) l + sigma (1 - rho)
    root = np.sqrt(11.0**2 + 4.0 * 10.0 * 19.0)
    expected = [0.5 * (-11.0 + root), -8.0 / 3.0, 0.5 * (-11.0 - root)]
    np.testing.assert_allclose(found.eigenvalues[2], expected, atol=1e-10)
    # the others: l**3 + (sigma + beta + 1) l**2 + beta (sigma + rho) l + 2 sigma beta (rho - 1)
    beta = 8.0 / 3.0
    cubic = np.roots([1.0, 11.0 + beta, beta * 30.0, 20.0 * beta * 19.0])
    for own in found.eigenvalues[:2]:
        assert np.abs(own[:, None] - cubic).min(axis=1).max() < 1e-9


@pytest.mark.slow
def test_find_equilibria__not_finite():
    """A state that is not known stays so, and takes nothing from the others."""
    parameters = flow(VAN_DER_POL).load()
    guesses = np.array([[np.nan, 0.0], [0.3, -0.2]])
    found = find_equilibria(parameters.model.system, guesses, parameters.pack())
    assert found.converged.tolist() == [False, True]
    np.testing.assert_allclose(found.states[1], 0.0, atol=1e-12)
    # The section changes nothing: the level is one more parameter, of which the rates know nothing
    model = flow(VAN_DER_POL)
    seen = sectioned(model, Crossing("x", 0.7)).load(mu=2.0)
    states = np.array([[0.4, -0.3], [2.0, 1.0]])
    steps, jacobians, _ = newton_steps(seen.model.system, states, seen.pack())
    plain, same, _ = newton_steps(model.system, states, model.load(mu=2.0).pack())
    np.testing.assert_array_equal(steps, plain)
    np.testing.assert_array_equal(jacobians, same)
    x, v = states.T
    ones, zeros = np.ones(2), np.zeros(2)
    known = np.stack([[zeros, ones], [-4.0 * x * v - 1.0, 2.0 * (1.0 - x**2)]]).transpose(2, 0, 1)
    np.testing.assert_allclose(jacobians, known, rtol=1e-14)
