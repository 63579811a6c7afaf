"""Symbols of states that are named as the rate of another."""

from __future__ import annotations

import pytest

from magpend_core.models.text.reading import read_definition


def symbols(states, equations):
    definition, problems = read_definition({"name": "one", "states": states, "equations": equations})
    assert problems == []
    return [s.symbol for s in definition.states]


@pytest.mark.parametrize(
    ("state", "rate", "symbol"),
    [
        ("x", "x_dot", r"\dot{x}"),
        ("x", "xdot", r"\dot{x}"),
        ("x", "dx", r"\dot{x}"),
        ("x", "v", r"\dot{x}"),
        ("theta1", "theta1_dot", r"\dot{\theta}_{1}"),
        ("x", "y", ""),  # a name of its own
    ],
)
def test_symbol__of_a_state_that_is_a_rate(state, rate, symbol):
    assert symbols({state: "m", rate: "m/s"}, {state: rate, rate: f"-{state}"}) == ["", symbol]


def test_symbol__that_is_given_stays():
    states = {"x": {"symbol": "q"}, "v": {"symbol": "u"}}
    assert symbols(states, {"x": "v", "v": "-x"}) == ["q", "u"]
    assert symbols({"x": {"symbol": "q"}, "v": "1"}, {"x": "v", "v": "-x"}) == ["q", r"\dot{q}"]
    assert symbols({"x": "m", "v": "m/s"}, {"x": "-x + v", "v": "-x"}) == ["", ""]  # v is not the rate of x
