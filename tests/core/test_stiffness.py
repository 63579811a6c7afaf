"""The fastest contraction of equations, in their layers too."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core import load_model
from magpend_core.stiffness import fastest_contraction


def test_fastest_contraction__of_a_linear_system_is_its_eigenvalue() -> None:
    model = load_model({"name": "two", "states": {"x": {}, "y": {}}, "equations": {"x": "-3*x", "y": "x - 40*y"}})
    packed = model.load().pack()[None]
    assert fastest_contraction(model.system, packed, np.ones(1), np.zeros((1, 2))) == pytest.approx(40.0)


def test_fastest_contraction__finds_a_layer_away_from_the_state() -> None:
    table = {
        "name": "dry",
        "states": {"x": {}, "v": {}},
        "parameters": {"u": 0.3},
        "equations": {"x": "v", "v": "-x - tanh(1000*(v - u))"},
    }
    model = load_model(table)
    # at v = u the friction's slope is 1000 /s; at the state itself it is nothing
    found = fastest_contraction(model.system, model.load().pack()[None], np.ones(1), np.array([[0.5, -2.0]]))
    assert found == pytest.approx(1000.0, rel=1e-3)
