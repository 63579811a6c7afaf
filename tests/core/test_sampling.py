"""Sampling at a recording's instants, under a recorded drive, against closed forms and another integrator."""

import dataclasses

import numpy as np
import pytest

from magpend_core.engine.placeholders import no_forcing
from magpend_core.engine.variational import with_parameter_tangent
from magpend_core.engine.vecmath import TWO_PI
from magpend_core.models import load_model
from magpend_core.sampling import Drive, sample, with_recorded_drive
from magpend_core.status import Status

DUFFING = load_model("duffing")
LINEAR = DUFFING.load(damping=0.3, linear=4.0, cubic=0.0, amplitude=0.7)
PENDULUM = load_model("pendulum-free")


def some_states(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-2, 2, (n, 2)), rng.uniform(-4, 4, (n, 2))])


def test_sample__of_a_linear_oscillator_is_the_closed_form():
    frequency, times = 0.4, np.sort(np.random.default_rng(1).uniform(0, 9, 200))
    drive = Drive(np.full(5, 1 / frequency))
    found = sample(DUFFING.system, LINEAR.pack()[None], [[0.5, -0.2]], [times], drives=[drive], rtol=1e-11, atol=1e-11)
    omega, d = TWO_PI * frequency, 0.3
    a = 0.7 / complex(4.0 - omega**2, d * omega)  # amplitude of x = Re(a exp(i omega t))
    root = np.sqrt(4.0 - d**2 / 4)
    c1 = 0.5 - a.real
    c2 = (-0.2 - (1j * omega * a).real + d / 2 * c1) / root
    decay = np.exp(-d / 2 * times)
    x = (a * np.exp(1j * omega * times)).real + decay * (c1 * np.cos(root * times) + c2 * np.sin(root * times))
    np.testing.assert_allclose(found.states[0, :, 0], x, atol=2e-9)
    assert found.status[0] == Status.BOUNDED


@pytest.mark.parametrize("unit", [0.02, 1.0, 1e8])
def test_sample__ends_at_the_end_of_the_drive_in_any_unit_of_time(unit):
    """The last time may lie past the drive's end by rounding, and by no more."""
    frequency = 0.4
    linear = DUFFING.load(damping=0.3 / unit, linear=4.0 / unit**2, cubic=0.0, amplitude=0.0)
    times = unit * np.array([1.0, 5.0, 5.0 / frequency * (1.0 + 1e-13)])
    asked = {"rtol": 1e-11, "atol": 1e-25}
    drive = Drive(np.full(5, unit / frequency))
    found = sample(DUFFING.system, linear.pack()[None], [[0.5, 0.0]], [times], drives=[drive], **asked)
    root = np.sqrt(4.0 - 0.15**2)
    known = (
        0.5 * np.exp(-0.15 * times / unit) * (np.cos(root * times / unit) + 0.15 / root * np.sin(root * times / unit))
    )
    assert found.status[0] == Status.BOUNDED
    np.testing.assert_allclose(found.states[0, :, 0], known, atol=2e-9)
    with pytest.raises(ValueError, match=r"covers .* of a piece"):
        sample(DUFFING.system, linear.pack()[None], [[0.5, 0.0]], [times * (1.0 + 1e-9)], drives=[drive], **asked)


@pytest.mark.slow
def test_sample__does_not_depend_on_the_neighbours():
    """A trajectory has the same bits alone, among others and in any number of lanes."""
    states, times = some_states(37), [np.linspace(0, 3, 90), np.array([0.0, 0.1, 2.0])]
    packed = np.tile(PENDULUM.load().pack(), (37, 1))
    drives = [Drive(np.full(8, 1 / 2.3)), Drive(np.full(8, 0.5), start_s=0.2)]
    piece = np.arange(37) % 2
    among = sample(PENDULUM.system, packed, states, times, piece=piece, drives=drives)
    few = sample(PENDULUM.system, packed, states, times, piece=piece, drives=drives, n_lanes=3)
    np.testing.assert_array_equal(among.states, few.states)
    alone = sample(PENDULUM.system, packed[:1], states[5:6], times[1:], drives=drives[1:])
    np.testing.assert_array_equal(alone.states[0], among.states[5, :3])
    assert np.isnan(among.states[5, 3:]).all()


def test_drive__window_is_the_same_drive():
    """A stretch of a recorded drive, from a state on the way, goes on as the whole did."""
    rng = np.random.default_rng(3)
    rising = np.concatenate([[0.0], rng.uniform(0.3, 0.5, 9).cumsum()])
    drive = Drive.from_edges(rising, rising[:-1] + 0.49 * np.diff(rising), start_s=0.1)
    times = np.linspace(0, 3.0, 301)
    packed, start = PENDULUM.load(eps=40.0).pack()[None], some_states(1)
    tight = {"rtol": 1e-11, "atol": 1e-11}
    whole = sample(PENDULUM.system, packed, start, [times], drives=[drive], **tight).states[0]
    part = drive.window(0.1 + times[120], 0.1 + times[-1])
    assert len(part.durations_s) < len(drive.durations_s)
    rest = sample(PENDULUM.system, packed, whole[120:121], [times[120:] - times[120]], drives=[part], **tight)
    np.testing.assert_allclose(rest.states[0], whole[120:], atol=1e-7)


def test_sample__says_who_diverged():
    """What a trajectory did not reach stays NaN; its neighbour goes on."""
    runaway = DUFFING.load(damping=0.0, linear=-1.0, cubic=-1.0, amplitude=0.0).pack()
    packed = np.array([runaway, LINEAR.pack()])
    found = sample(DUFFING.system, packed, [[2.0, 1.0], [0.1, 0.0]], [np.linspace(0, 5, 51)], piece=np.zeros(2, int))
    assert found.status[0] in (Status.DIVERGED, Status.STEP_UNDERFLOW)
    assert found.status[1] == Status.BOUNDED
    assert np.isfinite(found.states[0, 0]).all()
    assert np.isnan(found.states[0, -1]).all()
    assert np.isfinite(found.states[1]).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"times": [np.array([0.0, 2.0, 1.0])]}, "times.0. must start at 0 or later and rise"),
        ({"drives": [Drive(np.array([0.5]))]}, "covers 0.5 s of a piece of 1 s"),
        ({"drives": [Drive(np.array([2.0]), ("dampin",), np.zeros((1, 1)))]}, "'dampin', which is no parameter"),
        ({"drives": [Drive(np.array([2.0, 0.0]))]}, "durations must be above 0"),
        ({"drives": []}, "0 drives for 1 pieces"),
        ({"piece": np.array([1])}, "piece must give one of 1 pieces"),
    ],
)
def test_sample__refuses(change, words):
    arguments = {"times": [np.linspace(0, 1, 5)], **change}
    with pytest.raises(ValueError, match=words):
        sample(DUFFING.system, LINEAR.pack()[None], [[0.1, 0.0]], **arguments)


def test_drive__refuses_edges_out_of_order():
    with pytest.raises(ValueError, match="between the rising edges"):
        Drive.from_edges(np.array([0.0, 1.0, 2.0]), np.array([0.5, 2.5]))
    alone = dataclasses.replace(DUFFING.system, name="alone", forcing=no_forcing)
    with pytest.raises(ValueError, match="has no drive"):
        with_recorded_drive(alone)


def test_with_parameter_tangent__of_a_linear_oscillator_is_the_closed_form():
    """By the drive's amplitude: the response over it; by the start: the free motion."""
    values = DUFFING.load(damping=0.3, linear=4.0, cubic=0.0, amplitude=0.7)
    names, times = list(values.names), np.linspace(0, 8, 41)
    packed = np.tile(values.pack(), (2, 3))
    per_step = np.zeros((2, 1))
    at = names.index("amplitude")
    packed[0, len(names) + at] += 1e-4
    packed[0, 2 * len(names) + at] -= 1e-4
    per_step[0] = 1 / 2e-4
    start = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    options = {"piece": np.zeros(2, int), "drives": [Drive(np.full(8, 1.1))], "rtol": 1e-10, "atol": 1e-10}
    extended = with_parameter_tangent(DUFFING.system)
    found = sample(extended, np.hstack([packed, per_step]), start, [times], **options)
    np.testing.assert_allclose(found.states[0, :, 2:], found.states[0, :, :2] / 0.7, atol=1e-8)
    root = np.sqrt(4.0 - 0.15**2)
    free = np.exp(-0.15 * times) * (np.cos(root * times) + 0.15 / root * np.sin(root * times))
    np.testing.assert_allclose(found.states[1, :, 2], free, atol=1e-7)
    np.testing.assert_array_equal(found.states[0, :, :2], found.states[1, :, :2])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["e1", "mu", "c0", "q", "duty_cycle"])
def test_with_parameter_tangent__is_that_of_differences(name):
    """Of the pendulum with load-dependent friction and a square wave: central differences, tightly."""
    values, times = PENDULUM.load(), np.linspace(0, 2, 101)
    drive, start = [Drive(np.full(8, 1 / 2.3))], np.array([0.6, -0.4, 1.0, -2.0])
    at, p = list(values.names).index(name), values.pack()
    h = 1e-4 * p[at]
    step = h * np.eye(len(p))[at]
    given = np.concatenate([p, p + step, p - step, [1 / (2 * h)]])
    extended, options = with_parameter_tangent(PENDULUM.system), {"piece": np.zeros(2, int), "drives": drive}
    tangent = sample(extended, given[None], [[*start, 0, 0, 0, 0]], [times], drives=drive).states[0, :, 4:]
    around = np.array([p + step, p - step])
    sides = sample(PENDULUM.system, around, [start, start], [times], rtol=1e-12, atol=1e-12, **options).states
    difference = (sides[0] - sides[1]) / (2 * h)
    np.testing.assert_allclose(tangent, difference, atol=1e-4 * np.abs(difference).max())


def test_sample__keeps_its_own_values_where_the_drive_gives_none():
    drive = Drive(np.array([1.0, 1.0]), ("amplitude", "damping"), np.array([[0.0, np.nan], [np.nan, 0.3]]))
    times = np.array([0.5, 1.0, 1.9])
    found = sample(DUFFING.system, LINEAR.pack()[None], [[0.2, 0.0]], [times], drives=[drive])
    same = Drive(np.array([1.0, 1.0]), ("amplitude",), np.array([[0.0], [0.7]]))
    other = sample(DUFFING.system, LINEAR.pack()[None], [[0.2, 0.0]], [times], drives=[same])
    np.testing.assert_array_equal(found.states, other.states)
    assert np.isfinite(found.states).all()
