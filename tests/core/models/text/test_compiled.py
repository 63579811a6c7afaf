"""What the engine is told of a text: whether layers fade; and quotients by roots without divisions."""

import numpy as np
import pytest

from magpend_core.models.text import read_model
from magpend_core.pointwise import rates


def oscillator(force):
    states, parameters = {"x": {}, "v": {}}, {"k": 1e3, "e": 0.01}
    return read_model({"name": "one", "states": states, "parameters": parameters, "equations": {"x": "v", "v": force}})


@pytest.mark.parametrize(
    ("force", "fades"),
    [
        ("-x - tanh(k*v)", True),
        ("-x - 1/(1 + exp(-k*v))", True),
        ("-x - atan(k*v)", False),
        ("-x - v/sqrt(v**2 + e**2)", False),
        ("-x - tanh(k*v) - atan(k*x)", False),
    ],
)
def test_system_of__layers_fade_if_all_of_them_do(force, fades):
    system = oscillator(force).system
    assert system.has_layers
    assert system.layers_fade is fades


def test_source__quotients_by_roots_have_no_divisions():
    force = "-x/(1 + v**2)**1.5 - v/sqrt(2 + x**2) + (3 + x*x)**-2.5 + 2/(4 + x*x)**2.5"
    model = oscillator(force)
    rhs = model.source.text.split("def rhs")[1].split("def ")[0]
    assert rhs.count("inverse_sqrt") == 4
    assert " / " not in rhs
    assert "sqrt(" not in rhs.replace("inverse_sqrt(", "")
    states = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 2))
    x, v = states.T
    wanted = -x / (1 + v**2) ** 1.5 - v / np.sqrt(2 + x**2) + (3 + x * x) ** -2.5 + 2 / (4 + x * x) ** 2.5
    # a handful of roundings
    assert np.allclose(rates(0.0, states, model.load(), 1.0)[:, 1], wanted, rtol=5e-15, atol=1e-15)


def test_source__root_that_is_zero_shows():
    model = oscillator("-x/sqrt(x**2)")
    assert not np.isfinite(rates(0.0, [[0.0, 1.0]], model.load(), 1.0)[0, 1])
