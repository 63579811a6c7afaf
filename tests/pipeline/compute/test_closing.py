"""Whether a motion has closed, on sections whose approach is known on paper, and on the pendulum."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.compute.simulate import TOLERANCE, closing_of, simulate

PLANE = SimpleNamespace(is_angle=(True, False), scales=(1.0, 10.0))
ORBITS = json.loads((Path(__file__).parents[2] / "core" / "data" / "orbits.json").read_text("utf-8"))


def approach(multiplier, n=129, start=1e-2, period=1):
    """Sections that come closer to an orbit by a factor in each period, from `start`."""
    k = np.arange(n)
    orbit = 0.3 * (k % period)
    return np.stack([3.1 + orbit + start * multiplier**k, np.zeros(n)], axis=1)


@pytest.mark.parametrize("period", [1, 2, 3])
@pytest.mark.parametrize("multiplier", [0.97, 0.99])
def test_closing_of__the_periods_to_go_are_those_of_the_multiplier(multiplier, period):
    """From 0.01 the distance is `TOLERANCE` after log(1e-4)/log(multiplier) periods."""
    n = 129
    found = closing_of(approach(multiplier, n, period=period), PLANE)
    expected = math.log(TOLERANCE / 1e-2) / math.log(multiplier) - (n - 1)
    assert found.period == period
    assert not found.is_closed
    # the bound is that of the last quarter's first pair: its age is what the time is too long by, at most
    assert expected - 1 <= found.to_go <= expected + n / 4 + period
    assert f"--transient {300 + math.ceil(found.to_go)}" in found.sentence(300)


@pytest.mark.parametrize("period", [1, 2, 6])
def test_closing_of__a_closed_motion_has_its_smallest_period(period):
    for sections in (approach(0.8, period=period), approach(-0.85, start=0.1, period=period)):
        found = closing_of(sections, PLANE)
        assert found.is_closed
        assert found.period == period
        assert "closed: the motion repeats after" in found.sentence(0)


def test_closing_of__angles_are_on_the_circle():
    turning = approach(0.5)
    turning[:, 0] += 2 * np.pi * np.arange(len(turning))
    assert closing_of(turning, PLANE).is_closed


def test_closing_of__neither_chaos_nor_a_torus_is_given_a_time():
    k = np.arange(129)
    torus = np.stack([np.cos(k), np.sin(k)], axis=1)
    logistic = [0.4]
    for _ in range(5000):
        logistic.append(4.0 * logistic[-1] * (1.0 - logistic[-1]))
    clouds = [np.stack([logistic[i : i + 129], np.zeros(129)], axis=1) for i in range(0, 4800, 100)]
    for sections in (torus, *clouds):
        found = closing_of(sections, PLANE)
        assert math.isinf(found.to_go)
        assert "does not shrink steadily" in found.sentence(0)


def test_closing_of__nothing_is_said_of_too_few_sections():
    assert closing_of(approach(0.5, n=7), PLANE) is None


def test_simulate__says_that_the_left_orbit_is_closed():
    """The orbit comes from another integrator (tests/core/data); a start on it has closed at once."""
    orbit = next(o for o in ORBITS if o["frequency_hz"] == 2.2 and o["section"][0] < 0.0)
    ds = simulate(2.2, orbit["section"], n_transient=100, n_periods=2, samples_per_period=20)
    assert ds.attrs["orbit_period"] == 1
    assert ds.attrs["closing"].startswith("closed: the motion repeats after 1 drive period (")


@pytest.mark.slow
def test_simulate__says_that_300_periods_are_too_few_and_that_1000_will_do():
    start = (0.0, math.radians(20.0), 0.0, 0.0)
    early, late = (simulate(2.48, start, n_transient=n, n_periods=4, samples_per_period=20) for n in (300, 1000))
    assert early.attrs["orbit_period"] == 0
    assert early.attrs["closing"].startswith("not closed")
    assert late.attrs["orbit_period"] == 2
    # independent of the sentence: two periods later the last section is there again
    last = np.stack([late[name].values[::20] for name in ("psi1", "psi2")])
    assert np.abs(last[:, 4] - last[:, 2]).max() < TOLERANCE < np.abs(last[:, 4] - last[:, 3]).max()
