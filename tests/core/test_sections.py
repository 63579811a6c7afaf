"""Stroboscopic sections against independent integrations; early stops; messages."""

from functools import partial

import numpy as np
import pytest

from magpend_core import Status, run_branches, sections
from magpend_core.engine.lanes import engine_of
from magpend_core.engine.observers import RECORD
from magpend_core.models.pendulum.systems import PENDULUM_FITTED

run_pendulum = partial(run_branches, system=PENDULUM_FITTED)

TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def distance(a, b):
    """Largest difference of states, angles on the circle and rates in units of 10 rad/s."""
    d = np.abs(np.asarray(a) - np.asarray(b))
    d[..., :2] = np.minimum(d[..., :2], np.abs(2.0 * np.pi - d[..., :2]))
    d[..., 2:] /= 10.0
    return d.max(axis=-1)


@pytest.mark.parametrize("k", range(4))
def test_sections__agree_with_dop853_and_radau(preset, reference, k):
    row = reference("trajectories")[k]
    expected = np.array(row["sections"])
    n = len(expected)
    found = sections(preset, row["frequency_hz"], [row["y0"]], n_transient=0, n_keep=n, **TIGHT)
    difference = found.section[0] - expected
    difference[:, :2] -= 2.0 * np.pi * np.round(difference[:, :2] / (2.0 * np.pi))
    assert np.max(abs(difference)) < 1e-8


@pytest.mark.slow
def test_sections__settle_on_the_orbits(preset, reference):
    # multipliers of modulus 0.96: 800 periods take 0.01 far below the tolerance
    orbits = reference("orbits")
    points = np.array([orbit["section"] for orbit in orbits])
    frequencies = [orbit["frequency_hz"] for orbit in orbits]
    found = sections(preset, frequencies, points + 0.01, n_transient=800, n_keep=2, **TIGHT)
    assert np.max(abs(found.section - points[:, None])) < 1e-9
    assert (found.orbit_period == 1).all()
    assert (found.status == Status.PERIODIC).all()
    assert (found.turns == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-4, 1e-6, 1e-8])
def test_sections__stop_when_closed_is_within_the_tolerance_of_the_orbit(preset, reference, tolerance):
    orbits = reference("orbits")
    points = np.array([orbit["section"] for orbit in orbits])
    frequencies = [orbit["frequency_hz"] for orbit in orbits]
    options = {"stop_when_closed": True, "closure_tolerance": tolerance, "rtol": 1e-10, "atol": 1e-10}
    found = sections(preset, frequencies, points + 0.01, n_transient=2000, n_keep=3, **options)
    # slow spirals, of moduli 0.93 to 0.96
    assert (distance(found.section, points[:, None]) <= tolerance).all()
    assert (found.orbit_period == 1).all()
    assert (found.status == Status.PERIODIC).all()
    assert (found.n_periods < 600).all()
    # it is the early part of the straight run, taken sooner
    n = int(found.n_periods[0])
    straight = sections(preset, frequencies[:1], points[:1] + 0.01, n_transient=n - 3, n_keep=3, rtol=1e-10, atol=1e-10)
    assert straight.section.tobytes() == found.section[:1].tobytes()


def closed_at(preset, frequency, **options):
    starts = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 4))
    settings = {"n_transient": 700, "n_keep": 4, "stop_when_closed": True, **options}
    return sections(preset, frequency, starts, **settings)


@pytest.mark.slow
def test_sections__period_2_at_2_48_hz(preset):
    # chaotic transients before some of them last hundreds of periods, and depend on the last bit
    found = closed_at(preset, 2.48, n_transient=3000)
    assert (found.orbit_period == 2).all()
    two = found.section
    assert (distance(two[:, :2], two[:, 2:]) < 1e-5).all()
    assert (distance(two[:, 0], two[:, 1]) > 1e-2).all()
    # an orbit twice as long as looked for is not closed
    assert (closed_at(preset, 2.48, max_orbit_period=1).orbit_period == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("frequency", [2.03, 2.40])
def test_sections__chaos_does_not_close(preset, frequency):
    found = closed_at(preset, frequency)
    assert (found.orbit_period == 0).all()
    assert (found.status == Status.BOUNDED).all()
    # the whole transient, then the kept periods
    assert (found.n_periods == 704).all()
    assert np.ptp(found.section[..., 0]) > 0.05
    late = closed_at(preset, frequency, stop_when_closed=False)
    assert found.section.tobytes() == late.section.tobytes()


def test_sections__one_frequency_serves_all(preset):
    starts = np.array([[0.1, 0.1, 0.0, 0.0], [0.3, -0.2, 1.0, 2.0]])
    one = sections(preset, 2.2, starts, n_transient=1, n_keep=2)
    many = sections(preset, [2.2, 2.2], starts, n_transient=1, n_keep=2)
    assert one.section.tobytes() == many.section.tobytes()
    assert one.section.shape == (2, 2, 4)
    assert one.turns.shape == (2, 2)
    assert one.final_state.shape == (2, 4)
    for name in ("status", "orbit_period", "n_periods", "n_steps", "n_rejected", "step_size"):
        assert getattr(one, name).shape == (2,), name
    assert (one.section[:, -1] == one.final_state).all()
    # to numba such an array is of another type, and an engine takes 10 s
    packed, start = preset.pack()[None, None], np.zeros((1, 4))
    frequency = np.array([[2.2]])
    settings = {"n_transient": 0, "n_keep": 1, "rtol": 1e-5, "atol": 1e-5}
    found = run_pendulum(packed, frequency, start, **settings)
    for array in (packed, frequency, start):
        array.flags.writeable = False
    frozen = run_pendulum(packed, frequency, start, **settings)
    assert frozen.section.tobytes() == found.section.tobytes()
    assert len(engine_of(PENDULUM_FITTED, RECORD).__wrapped__.signatures) == 1
