"""Trajectories that advance by legs, against one integration."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.models import load_model
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.extension.courses import Course
from pipeline.analysis.attractors.flight import Flight

HOW = {"rtol": 1e-8, "atol": 1e-8}
CLOSURE, LONGEST, PERIODS = 1e-5, 4, 96


@pytest.mark.slow
def test_flight__legs_have_the_bits_of_one_integration():
    parameters = load_model("duffing").load("hardening")
    system, packed, frequency = parameters.model.system, parameters.pack(), 0.2
    starts = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2))
    whole = run_branches(
        np.tile(packed, (5, 1, 1)),
        np.full((5, 1), frequency),
        starts,
        n_transient=0,
        n_keep=PERIODS,
        closure_tolerance=CLOSURE,
        max_orbit_period=LONGEST,
        system=system,
        **HOW,
    )

    def fly(states, step=None):
        limits = {"max_steps": 10_000, "closure": CLOSURE, "longest": LONGEST, "most": PERIODS}
        return Flight(system, packed, frequency, states, step=step, **limits, **HOW)

    flight = fly(starts)
    first = flight.advance(32)
    # another flight goes on from the block of the first
    again = fly(first.state, first.step).advance(64)
    legs = fly(starts).legs(3, 32)
    np.testing.assert_array_equal(legs.section.reshape(5, 96, 2), whole.section[:, 0])
    np.testing.assert_array_equal(legs.orbit_period, fly(legs.state).closed(legs.section))
    np.testing.assert_array_equal(legs.state[2::3], whole.section[:, 0, -1])
    flight.keep(np.arange(5) != 2)
    flight.advance(64)
    rows = [0, 1, 3, 4]
    np.testing.assert_array_equal(first.section, whole.section[:, 0, :32])
    np.testing.assert_array_equal(again.section, whole.section[:, 0, 32:])
    assert flight.rows.tolist() == rows
    np.testing.assert_array_equal(flight.section, whole.section[rows, 0])
    np.testing.assert_array_equal(flight.closed(flight.section), whole.orbit_period[rows, 0])
    assert (whole.orbit_period > 0).any()


def test_flight__legs_in_which_all_trajectories_fail():
    square = load_model({"name": "square", "kind": "map", "states": {"x": {}}, "equations": {"x": "x**2"}})
    limits = {"max_steps": 100, "closure": CLOSURE, "longest": LONGEST, "most": 8}
    flight = Flight(square.system, np.zeros(0), 1.0, np.full((2, 1), 1e200), **limits, **HOW)
    legs = flight.legs(2, 4)
    assert (legs.status == Status.DIVERGED).all()
    assert (legs.orbit_period == 0).all()
    assert np.isnan(legs.section).all()


def test_course__fails_in_its_first_leg():
    course = Course(0, 0, np.zeros((3, 2)), np.zeros(2))
    course.add(np.zeros((0, 8, 2)), np.zeros(0), np.ones(2), 0.1)
    assert course.extension.shape == (0, 2)
    course.add(np.full((1, 8, 2), 7.0), np.ones(1), np.ones(2), 0.1)
    np.testing.assert_array_equal(course.extension, np.full((8, 2), 7.0))
