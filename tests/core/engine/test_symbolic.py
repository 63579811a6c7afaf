"""Derivatives of systems, derived by evaluation on symbols, beside differences of their functions."""

import dataclasses

import numpy as np
import pytest

from magpend_core.engine.jit import inline
from magpend_core.engine.plain_python import plain
from magpend_core.engine.symbolic import curved, implicit_problem, linearised
from magpend_core.engine.system import System
from magpend_core.engine.variational import with_tangents
from magpend_core.engine.vecmath import power, sincos, square_wave
from magpend_core.models import load_model, model_names
from tests.core.flows import model_of

FREQUENCY, TIME = 1.3, 0.123
DRIVEN = {"x": "v", "v": "cos(2*pi*f*t)*x**1.5 - exp(-v)*sqrt(1 + x**2) + atan2(v, x) + max(x, v)*abs(v)"}


class Evaluated:
    """Functions of a system on plain numbers, at a state and a time that do not lie on a corner."""

    def __init__(self, system, packed):
        c = np.zeros(system.n_constants + system.n_modes)
        plain(system.constants)(FREQUENCY, packed, c)
        c[system.n_constants :] = 1.0
        self.system, self.c = system, tuple(c)
        self.y = np.random.default_rng(3).uniform(0.2, 0.9, system.known) * np.array(system.units[: system.known])

    def rates(self, y, t=TIME):
        u = plain(self.system.forcing)(t, self.c)
        return np.array(plain(self.system.rhs)(tuple(y), u, self.c), np.float64)

    def of(self, found, *arguments):
        """Values of derivatives as a matrix by the states, and as a vector by time."""
        values = np.array(plain(found.function)(*arguments, TIME, self.c), np.float64)
        n = len(self.y) if self.system.tangents_of is None else self.system.tangents_of.n_states
        matrix, timed = np.zeros((self.system.known, n)), np.zeros(self.system.known)
        for (i, j), value in zip(found.entries, values, strict=False):
            matrix[i, j] = value
        for i, value in zip(found.timed, values[len(found.entries) :], strict=True):
            timed[i] = value
        return matrix, timed


def differences(function, x, sizes):
    """Central differences of order four, one column per entry of x."""
    columns = []
    for e in np.eye(len(x)) * 1e-3 * sizes:
        near, far = (function(x + k * e) - function(x - k * e) for k in (1, 2))
        columns.append((8.0 * near - far) / (12.0 * e.sum()))
    return np.array(columns).T


@pytest.mark.parametrize("name", [name for name in model_names() if name != "henon"])
def test_linearised__is_the_derivative_of_every_shipped_model(name):
    model = load_model(name)
    own = Evaluated(model.system, model.load().pack())
    matrix, timed = own.of(linearised(model.system), tuple(own.y))
    expected = differences(own.rates, own.y, np.array(model.system.units))
    np.testing.assert_allclose(matrix, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    by_time = differences(lambda t: own.rates(own.y, t[0]), np.array([TIME]), np.array([1e-3]))[:, 0]
    np.testing.assert_allclose(timed, by_time, rtol=1e-6, atol=1e-7 * (1.0 + np.abs(by_time).max()))


def test_linearised__has_derivatives_of_every_function():
    model = model_of(DRIVEN)
    own = Evaluated(model.system, model.load().pack())
    matrix, timed = own.of(linearised(model.system), tuple(own.y))
    np.testing.assert_allclose(matrix, differences(own.rates, own.y, np.ones(2)), atol=1e-8)
    assert timed[0] == 0.0
    assert timed[1] == pytest.approx(
        -2.0 * np.pi * FREQUENCY * np.sin(2.0 * np.pi * FREQUENCY * TIME) * own.y[0] ** 1.5
    )


def test_curved__is_the_derivative_of_the_jacobian_along_a_vector_and_of_the_trace():
    model = model_of(DRIVEN)
    system, v = with_tangents(model.system, 1, divergence=True, written_out=False), np.array([0.4, -0.7])
    own = Evaluated(system, model.load().pack())

    def jacobian(y):
        u = plain(model.system.forcing)(TIME, own.c)
        return np.array(plain(model.system.jacobian)(tuple(y), u, own.c), np.float64).reshape(2, 2)

    of_vector, of_trace = curved(system)
    matrix, _ = own.of(of_vector, tuple(own.y), tuple(v))
    np.testing.assert_allclose(matrix, differences(lambda y: jacobian(y) @ v, own.y, np.ones(2)), atol=1e-7)
    values = np.array(plain(of_trace.function)(tuple(own.y), TIME, own.c))
    slopes = differences(lambda y: np.array([np.trace(jacobian(y))]), own.y, np.ones(2))[0]
    found = np.zeros(2)
    for (_, j), value in zip(of_trace.entries, values, strict=False):
        found[j] = value
    np.testing.assert_allclose(found, slopes, atol=1e-7)


@inline
def constants(frequency, p, out):
    out[0] = p[0]


@inline
def choosing(y, u, c):
    return (-c[0] * y[0] if y[0] > 0.0 else y[0],)


@inline
def by_hand(y, u, c):
    s, k = sincos(y[0])
    return (power(c[0], y[0]) * s - k * square_wave(u, 0.5) * y[0],)


def hand_made(rhs):
    return System(
        name=rhs.__name__, state_names=("y",), parameter_names=("a",), n_constants=1, constants=constants, rhs=rhs
    )


def test_implicit_problem__names_an_if_and_the_way_out():
    found = implicit_problem(hand_made(choosing))
    assert "derivatives of the equations of choosing" in found
    assert "write simd.where_less; or choose dopri5" in found


def test_linearised__of_functions_without_a_jacobian_by_hand():
    system = hand_made(by_hand)
    assert implicit_problem(system) is None
    own = Evaluated(system, np.array([1.7]))
    matrix, _ = own.of(linearised(system), tuple(own.y))
    np.testing.assert_allclose(matrix, differences(own.rates, own.y, np.ones(1)), rtol=1e-9)
    assert dataclasses.replace(system, method="rodas5p").is_stiff
