"""When does an orbit count as closed? `closed_period` on sections made by hand, without compiling."""

import types

import numpy as np
import pytest

from magpend_core.engine import observers
from magpend_core.engine.observers import Settings

WINDOW = 64
TOLERANCE = 1e-6


def plain(is_angle, scales):
    """`closed_period` with its helpers as plain Python, bound to a system's sizes."""
    names = {**vars(observers), "N": len(is_angle), "IS_ANGLE": is_angle, "SCALES": scales}
    for name in observers.HELPERS:
        names[name] = types.FunctionType(getattr(observers, name).__code__, names)
    return names["closed_period"]


def closed(sections, *, is_angle=(True, False), scales=(1.0, 10.0), max_orbit_period=16):
    """Period found after the last of `sections` (n, n_states), which have come one by one."""
    window = max(WINDOW, 4 * max_orbit_period)
    settings = Settings(0, 1, max_orbit_period, TOLERANCE, window)
    ring = np.zeros(window * len(is_angle))
    for i, section in enumerate(sections):
        slot = (i % window) * len(is_angle)
        ring[slot : slot + len(is_angle)] = section
    return plain(is_angle, scales)(ring, len(sections), settings)


def spiral(n, modulus, angle, size=0.1):
    """Sections that approach (0.3, -2) on a spiral; in scaled units the multipliers' modulus holds."""
    z = size * (modulus * np.exp(1j * angle)) ** np.arange(n)
    return np.stack([0.3 + z.real, -2.0 + 10.0 * z.imag], axis=1), np.abs(z)


@pytest.mark.parametrize("period", [1, 2, 3, 5, 12, 16])
def test_closed_period__finds_the_least_period(period):
    points = np.random.default_rng(period).normal(size=(period, 2))
    for n in (64, 77, 150):
        assert closed(np.tile(points, (n // period + 1, 1))[:n]) == period


def test_closed_period__looks_no_further_than_it_is_told():
    points = np.random.default_rng(0).normal(size=(5, 2))
    orbit = np.tile(points, (20, 1))
    assert closed(orbit, max_orbit_period=4) == 0
    assert closed(orbit, max_orbit_period=5) == 5
    # the longest needs four of its periods
    points = np.random.default_rng(1).normal(size=(20, 2))
    assert closed(np.tile(points, (5, 1)), max_orbit_period=20) == 20


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [0.5, 0.9, 0.96, 0.99])
@pytest.mark.parametrize("angle", [0.0, np.pi, 2.2, 0.3])
def test_closed_period__a_spiral_is_not_closed_before_it_is_near(modulus, angle):
    # started so that one window later it is still far off; looked at every period
    sections, distance = spiral(4000, modulus, angle, size=0.1 / modulus**WINDOW if modulus < 0.9 else 0.1)
    first = next(n for n in range(WINDOW, 4000, 4) if closed(sections[:n]) > 0)
    assert distance[first - 1] <= TOLERANCE
    # nor long after: what is looked at is as old as half a window, and a turn hides some of the decay
    assert first <= np.argmax(distance <= TOLERANCE) + (1 if modulus < 0.99 else 5) * WINDOW
    assert closed(sections[:first]) == 1


def test_closed_period__of_small_steps_and_of_rounding():
    # neighbours differ by half of the tolerance, the orbit is 25 tolerances away
    sections, distance = spiral(200, 0.98, 0.0, size=25.0 * TOLERANCE / 0.98**199)
    assert np.max(abs(np.diff(sections[-2:, 0]))) < 0.6 * TOLERANCE
    assert distance[-1] > 20.0 * TOLERANCE
    assert closed(sections) == 0
    # an orbit reached to the integration's accuracy goes on to shake by a hundredth of the tolerance
    noise = np.random.default_rng(3).uniform(-1.0, 1.0, (200, 2)) * TOLERANCE * [0.004, 0.04]
    assert closed([0.3, -2.0] + noise) == 1
    # ten times more cannot be told from a slow drift
    assert closed([0.3, -2.0] + 10.0 * noise) in (0, 1)


def test_closed_period__no_decay_chaos_noise_or_a_near_miss_is_no_orbit():
    # a drift of a tenth of the tolerance a period goes on for ever
    n = np.arange(200)
    drift = np.stack([0.3 + 0.1 * TOLERANCE * n, np.full(200, -2.0)], axis=1)
    assert closed(drift) == 0
    # a slow rotation with a small step
    sections, _ = spiral(200, 1.0, 1e-4, size=1e-3)
    assert closed(sections) == 0
    rng = np.random.default_rng(4)
    assert closed(rng.normal(size=(300, 2))) == 0
    logistic = [0.4]
    for _ in range(300):
        logistic.append(4.0 * logistic[-1] * (1.0 - logistic[-1]))
    assert closed(np.stack([logistic, logistic], axis=1)) == 0
    # one large difference within the window is enough
    orbit = np.tile([0.3, -2.0], (100, 1))
    orbit[80, 0] += 1e-3
    assert closed(orbit) == 0
    orbit[80, 0] -= 1e-3
    assert closed(orbit) == 1


def test_closed_period__angles_are_on_the_circle_and_rates_scaled():
    # an orbit at the cut: the sections alternate between both ends of the interval
    n = np.arange(100)
    sections = np.stack([np.where(n % 2 == 0, np.pi - 1e-10, -np.pi + 1e-10), np.full(100, 5.0)], axis=1)
    assert closed(sections) == 1
    assert closed(sections, is_angle=(False, False)) == 2
    # 2e-7 rad/s is a fiftieth of the tolerance in units of 10 rad/s, twenty times it in units of 0.01
    n = np.arange(200)
    shake = np.stack([np.full(200, 0.3), 2.0 + 2e-7 * (n % 2)], axis=1)
    assert closed(shake) == 1
    assert closed(shake, scales=(1.0, 0.01)) == 2


def test_closed_period__of_a_pair_of_spirals_and_of_one_that_alternates():
    for n, expected in ((100, 0), (200, 2)):
        around, distance = spiral(n, 0.9, 1.0, size=1.0)
        sections = np.empty((2 * n, 2))
        sections[0::2], sections[1::2] = around, around + [0.5, 3.0]
        assert closed(sections) == expected
        assert (distance[-1] < TOLERANCE) == (expected == 2)
    # multipliers near -1: sections two apart settle first, the orbit's period is 1
    for modulus in (0.9, 0.97):
        sections, _ = spiral(2000, modulus, np.pi - 0.05, size=0.1)
        found = {closed(sections[:n]) for n in range(WINDOW, 2000, 16)}
        assert found == {0, 1}
