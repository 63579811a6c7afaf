"""Clocks: how models count time, in words and numbers."""

from __future__ import annotations

import math

import numpy as np

from magpend_core import load_model
from magpend_core.crossing import Crossing
from magpend_core.models.clock import DRIVEN, MAP, STROBED, returns
from magpend_core.models.drift.model import drifting
from magpend_core.models.drift.ramps import Ramp
from magpend_core.models.sectioned import sectioned
from tests.core.flows import VAN_DER_POL, flow

RETURNS = returns(Crossing("v", 0.5, "down", 20.0))
ALL = (DRIVEN, STROBED, RETURNS, MAP)


def test_clock__of_each_kind_of_model():
    whole = flow(VAN_DER_POL)
    crossed = sectioned(whole, Crossing("v", 0.5, "down", 20.0))
    assert [m.clock for m in (load_model("duffing"), whole, crossed, load_model("henon"))] == list(ALL)
    assert crossed.flow.clock == STROBED
    assert drifting(whole, (Ramp("mu", "linear", (("to", 1.0),)),)).clock == STROBED


def test_words():
    assert [c.periods for c in ALL] == ["drive periods", "strobe periods", "returns", "iterations"]
    assert [c.once for c in ALL[1:]] == [
        "once per strobe period",
        "crossing of v = 0.5 going down",
        "once per iteration",
    ]
    assert [c.unit for c in ALL] == ["s", "s", "s", "iteration"]


def test_hertz__what_the_engine_takes_where_a_user_gives_nothing():
    assert [c.hertz for c in ALL] == [None, None, 1.0 / 20.0, 1.0]


def test_n_neutral__time_may_be_shifted_along_a_flow_at_even_times():
    assert [c.has_equilibria for c in ALL] == [False, True, True, False]
    assert [c.n_neutral for c in ALL] == [0, 1, 0, 0]


def test_orbit_seconds__of_cycles_with_a_period_of_their_own():
    drive, strobe, own, iterated = (c.orbit_seconds(3, 0.3) for c in ALL)
    assert drive == iterated == 3 / 0.3
    assert math.isnan(strobe)
    assert math.isnan(own)


def test_instants__of_a_map_its_iterations():
    assert DRIVEN.samples(8) == 8
    assert MAP.samples(8) == 1
    np.testing.assert_array_equal(DRIVEN.instants(4.0, 3), [0.0, 2.0, 4.0])
    np.testing.assert_array_equal(MAP.instants(4.0, 3), [0.0, 1.0, 2.0, 3.0, 4.0])
