"""Events that a trajectory passes: against closed forms, and another integrator that restarts after each event."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import Status, load_model
from magpend_core.orbits import section_map
from tests.core.cells import run_cells
from tests.core.flows import table

# one engine for all: a damped oscillator or a ball under a force, with two surfaces that count, kick and move it
NAMES = ("k", "c", "force", "a", "r", "kick", "shift", "b", "s", "push", "onto")
KICKED = load_model(
    table(
        "kicked",
        {"x": "v", "v": "force - k*x - c*v", "n": "0"},
        dict.fromkeys(NAMES, 0.0),
        impacts=[
            {"of": "x - a", "direction": "up", "set": {"v": "r*v + kick", "x": "x + shift", "n": "n + 1"}},
            {"of": "x - b", "direction": "up", "set": {"v": "s*v + push", "x": "x + onto*(a - b)", "n": "n + 100"}},
        ],
    )
).system
FAR = 1e9  # beyond what is reached


def given(**values):
    """Parameters of `KICKED`: by default its impacts change the number `n` alone, and the second is out of reach."""
    return [{"r": 1.0, "b": FAR, "s": 1.0, **values}.get(name, 0.0) for name in NAMES]


def ends(parameters, starts, time, system=KICKED, **options):
    """States at a time."""
    found = run_cells(system, parameters, 1.0 / time, starts, rtol=1e-10, **options)
    assert set(found.status.ravel()) <= {Status.PERIODIC, Status.BOUNDED}
    return found.section[:, 0, -1]


def event_by_event(parameters, start, time):
    """State at a time by DOP853, which begins again after each event on the side to which the state then moves."""
    p = dict(zip(NAMES, parameters, strict=True))

    def rhs(t, y):
        return [y[1], p["force"] - p["k"] * y[0] - p["c"] * y[1], 0.0]

    def surface(level):
        def event(t, y):
            return y[0] - level

        event.terminal, event.direction = True, 1.0
        return event

    t, y, left = 0.0, np.array(start, float), None
    while True:
        events = [surface(p["a"]), surface(p["b"])]
        if left is not None:
            # until it has left the surface: a short way without an event
            ahead = solve_ivp(rhs, (t, min(t + 1e-6, time)), y, "DOP853", rtol=1e-13, atol=1e-13)
            t, y = ahead.t[-1], ahead.y[:, -1]
        found = solve_ivp(rhs, (t, time), y, "DOP853", rtol=1e-13, atol=1e-13, events=events)
        t, y = found.t[-1], found.y[:, -1]
        if t >= time:
            return y
        left = 0 if len(found.t_events[0]) else 1
        x, v, n = y
        if left == 0:
            y = np.array([x + p["shift"], p["r"] * v + p["kick"], n + 1.0])
        else:
            y = np.array([x + p["onto"] * (p["a"] - p["b"]), p["s"] * v + p["push"], n + 100.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        {"k": 1.0, "c": 0.1, "a": 0.0},  # a counter
        {"k": 1.0, "c": 0.1, "a": 0.2, "kick": 0.3},  # along the motion
        {"k": 1.0, "c": 0.1, "a": 0.2, "kick": -0.05},  # against it, and it passes
        {"k": 1.0, "c": 0.02, "a": 0.2, "r": -0.8},  # thrown back
        {"k": 1.0, "c": 0.05, "a": -0.3, "shift": 0.1},  # put beyond the surface
        {"k": 1.0, "c": 0.0, "a": -0.1, "kick": 0.05, "b": 0.4, "s": -1.0},  # passed, then thrown back
        {"k": 1.0, "c": 0.0, "a": 0.5, "kick": 0.05, "b": 0.2, "onto": 1.0},  # from one surface onto the other
    ],
)
def test_passed__is_that_of_an_integration_from_event_to_event(values):
    parameters, starts = given(**values), [[-1.0, 0.3, 0.0], [-0.7, -0.4, 0.0]]
    found = ends(parameters, starts, 21.3)
    for start, state in zip(starts, found, strict=True):
        expected = event_by_event(parameters, start, 21.3)
        assert expected[2] >= 2.0
        assert state == pytest.approx(expected, abs=2e-8)


@pytest.mark.slow
def test_passed__counts_each_passage_once_at_any_size():
    # cos(t + phase) passes 0 upwards at 3 pi/2 - phase and each turn later; the scale of x is free
    for size in (1e-6, 1.0, 1e6):
        starts = [[size, 0.0, 0.0], [0.0, -size, 0.0]]
        assert ends(given(k=1.0), starts, 20.0)[:, 2] == pytest.approx([3.0, 3.0])


def test_passed__two_surfaces_reached_at_one_instant_act_once_each():
    # both on one surface: a counter, and a counter that also throws back or kicks on
    for level in (0.0, 0.3, 1.0 / 3.0):
        found = ends(given(k=1.0, a=level, b=level), [[-1.0, 0.0, 0.0]], 20.0)
        assert found[:, 2] == pytest.approx(303.0)
        found = ends(given(k=1.0, a=level, b=level, s=-1.0), [[-1.0, 0.0, 0.0]], 5.0)
        expected = math.floor((5.0 + math.acos(level)) / (2.0 * math.acos(-level)))
        assert found[:, 2] == pytest.approx(101.0 * expected)


def test_passed__one_that_lands_on_a_surface_leaves_it_without_its_impact():
    # from the first surface onto the second, on which rounding puts it on either side
    for a, b in ((0.1, 0.7), (0.3, 0.9), (1.0 / 3.0, 0.7), (-0.7, 1.1)):
        values = given(a=a, shift=b - a, b=b)
        found = ends(values, [[a - 1.0, 1.0, 0.0]], 3.0)
        assert found[0] == pytest.approx([a + 2.0 + (b - a), 1.0, 1.0], abs=1e-12)
        # thrown back from there it meets neither again
        found = ends(given(a=a, shift=b - a, b=b, r=-1.0), [[a - 1.0, 1.0, 0.0]], 3.0)
        assert found[0] == pytest.approx([b - 2.0, -1.0, 1.0], abs=1e-12)


def test_passed__escapement_runs_as_in_closed_form():
    # x'' + c x' + x = 0 with a push at each passage of 0 upwards: v -> d (v + push), d the damping of a turn
    c, push = 0.1, 0.2
    turn = 2.0 * math.pi / math.sqrt(1.0 - 0.25 * c * c)
    d = math.exp(-0.5 * c * turn)
    # half a turn to the first push, nine to the tenth, and half a one to the end
    speed = 0.5 * math.exp(-0.25 * c * turn) + push
    for _ in range(9):
        speed = d * speed + push
    found = ends(given(k=1.0, c=c, kick=push), [[0.0, -0.5, 0.0]], 10.0 * turn)
    assert found[0] == pytest.approx([0.0, -speed * math.exp(-0.25 * c * turn), 10.0], abs=1e-8)


@pytest.mark.slow
def test_passed__orbit_of_the_escapement_and_its_multiplier():
    c, push = 0.1, 0.2
    turn = 2.0 * math.pi / math.sqrt(1.0 - 0.25 * c * c)
    d = math.exp(-0.5 * c * turn)
    packed, hertz = np.array([given(k=1.0, c=c, kick=push)]), np.array([1.0 / turn])
    # sections at each turn: any phase is that of an orbit, so one multiplier is 1; the counter has another
    speed = push / (1.0 - d)
    start = np.array([[0.0, -speed * math.exp(-0.25 * c * turn), 0.0]])
    found = section_map(packed, hertz, start, 1, system=KICKED)
    assert found.images[0, 0, :2] == pytest.approx(start[0, :2], abs=1e-10)
    values = np.sort(np.linalg.eigvals(found.derivatives[0][:2, :2]).real)
    assert values == pytest.approx([d, 1.0], abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        {"k": 1.0, "c": 0.1, "a": 0.2, "kick": 0.3},
        {"k": 1.0, "c": 0.1, "a": 0.2, "kick": -0.05, "r": 0.9},
        {"k": 1.0, "c": 0.0, "a": -0.1, "kick": 0.05, "b": 0.4, "s": -1.0},
        {"k": 1.0, "c": 0.05, "a": -0.3, "shift": 0.1},
    ],
)
def test_passed__derivative_is_that_of_differences(values):
    packed, hertz, start = np.array([given(**values)]), np.array([1.0 / 15.0]), np.array([-1.0, 0.3, 0.0])
    found = section_map(packed, hertz, start[None], 1, system=KICKED).derivatives[0]
    h = 1e-5
    for j in range(3):
        step = h * np.eye(3)[j]
        far = event_by_event(packed[0], start + step, 15.0) - event_by_event(packed[0], start - step, 15.0)
        assert found[:, j] == pytest.approx(far / (2.0 * h), abs=1e-6)
