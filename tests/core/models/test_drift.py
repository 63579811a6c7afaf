"""Parameters that move, against closed forms and another integrator."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import load_model, load_preset, rates
from magpend_core.models.drift.ramps import STEEPNESS, TABLE, Ramp, motions_of
from magpend_core.models.drift.sections import Drift, drifting_sections
from magpend_core.models.drift.structure import DriftError
from magpend_core.models.drift.system import AFFINE, DEGREE
from magpend_core.status import Status
from tests.core.cells import run_cells, scipy_end
from tests.core.flows import table

OSCILLATOR = load_model(
    table(
        "driven-oscillator",
        {"x": "v", "v": "A*cos(2*pi*f*t) - d*v - k*x"},
        {"k": 1.0, "d": 0.1, "A": 0.5},
        quantities={"force": "A*cos(2*pi*f*t)", "size": "A"},
    )
)
SWITCHED = load_model(
    table(
        "switched-oscillator",
        {"x": "v", "v": "A*square(t*f, duty) - d*v - x - 0.2*sign(v - w)"},
        {"d": 0.1, "A": 0.5, "duty": 0.3, "w": 0.0},
    )
)
HZ = 0.3
START = np.array([0.3, 0.1])
RAMP = (("from", 0.5), ("to", 2.0), ("start_s", 7.3), ("duration_s", 21.7))


def linear(name, first, last, **times):
    """Ramp of a parameter from one value to another."""
    return Ramp(name, "linear", (("from", first), ("to", last), *times.items()))


def drifted(model, ramps, cells, *, hz=HZ, start=START, n_transient=0, n_keep=20, rtol=1e-10, **more):
    """Sections of cells, each given by the parameters in which it differs."""
    numbers = {n: v for ramp in ramps for n, (_, v) in zip(ramp.names, ramp.numbers, strict=True)}
    base = {**model.load().as_dict(), **numbers}
    packed = np.array([list({**base, **cell}.values()) for cell in cells])
    frequency = np.full(len(cells), hz)
    drift = Drift.of(model.system, ramps, tuple(base), packed, frequency)
    options = {"max_steps_per_period": 100_000, "closure_tolerance": 1e-5, "max_orbit_period": 8, "atol": rtol} | more
    states = np.broadcast_to(start, (len(cells), len(start))).copy()
    found = drifting_sections(
        model.system, drift, packed, frequency, states, n_transient=n_transient, n_keep=n_keep, rtol=rtol, **options
    )
    return drift, found


def by_scipy(rhs, marks, start, breaks, wanted):
    """States at the marks by DOP853, restarted at every break."""
    y, found = np.asarray(start, float), []
    times = sorted({0.0, *marks, *(b for b in breaks if 0.0 < b < marks[-1])})
    for a, b in itertools.pairwise(times):
        y = scipy_end(rhs, y, b, wanted, begin=a)
        if b in marks:
            found.append(y)
    return np.array(found)


def value(t, a, b, start, duration, smooth):
    share = np.clip((t - start) / duration, 0.0, 1.0)
    if smooth:
        share = 0.5 + 0.5 * np.tanh(STEEPNESS * (2.0 * share - 1.0)) / np.tanh(STEEPNESS)
    return a + (b - a) * share


def linear_response(t0, t1, y, a, b, k=1.0, d=0.1, w=2.0 * np.pi * HZ):
    """State at t1 of x'' + d x' + k x = (a + b t) cos(w t), from the state y at t0."""
    h = 1.0 / (k - w * w + 1j * d * w)
    beta = b * h
    alpha = a * h - beta * (2j * w + d) * h

    def particular(t):
        e = np.exp(1j * w * t)
        return np.array([((alpha + beta * t) * e).real, ((beta + 1j * w * (alpha + beta * t)) * e).real])

    s, r = -0.5 * d, np.sqrt(k - 0.25 * d * d)
    rest = y - particular(t0)
    one = rest[0] - 1j * (rest[1] - s * rest[0]) / r
    e = one * np.exp((s + 1j * r) * (t1 - t0))
    return particular(t1) + np.array([e.real, ((s + 1j * r) * e).real])


def closed_form(n, start_s, duration_s, a, b):
    slope = (b - a) / duration_s
    pieces = [(0.0, start_s, a, 0.0), (start_s, start_s + duration_s, a - slope * start_s, slope)]
    y = START
    for t0, t1, level, rate in pieces:
        y = linear_response(t0, t1, y, level, rate)
    return linear_response(start_s + duration_s, n / HZ, y, b, 0.0)


@pytest.mark.slow
def test_drifting_sections__keeps_the_order_across_the_corners_of_a_ramp():
    """Of a force's amplitude, by the closed form of the linear oscillator: order 5 with both corners within a step."""
    ramp = linear("A", 0.5, 9.0, start_s=7.3, duration_s=1.7)
    expected = closed_form(6, 7.3, 1.7, 0.5, 9.0)
    errors, steps = [], []
    for rtol in (1e-5, 1e-10):
        drift, found = drifted(OSCILLATOR, [ramp], [{}], n_keep=6, rtol=rtol)
        errors.append(np.abs(found.section[0, 0, -1] - expected).max())
        steps.append(int(found.n_steps[0, 0]))
    assert drift.moving.degree == AFFINE
    assert errors[1] < 2e-9
    order = np.log(errors[0] / errors[1]) / np.log(steps[1] / steps[0])
    assert 4.5 < order < 6.0, (errors, steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["A", "k"])
def test_drifting_sections__against_another_integrator(name):
    """Smooth ramps; linear ones of both are in the closed form above and the table below."""
    drift, found = drifted(OSCILLATOR, [Ramp(name, "tanh", RAMP)], [{}])

    def rhs(t, y):
        p = {"k": 1.0, "d": 0.1, "A": 0.5, name: value(t, 0.5, 2.0, 7.3, 21.7, True)}
        return [y[1], p["A"] * np.cos(2 * np.pi * HZ * t) - p["d"] * y[1] - p["k"] * y[0]]

    marks = list(np.arange(1, 21) / HZ)
    expected = by_scipy(rhs, marks, START, (7.3, 29.0), 1e-12)
    assert drift.moving.degree == DEGREE
    np.testing.assert_allclose(found.section[0, 0], expected, atol=3e-9)


@pytest.mark.slow
def test_drifting_sections__of_two_parameters_and_a_table():
    """Stiffness by lines between samples, damping by a ramp: both at once."""
    times, values = (0.0, 4.0, 9.0, 9.5, 30.0), (1.0, 2.0, 1.5, 3.0, 1.0)
    ramps = [
        Ramp("k", TABLE, (("start_s", 3.0),), times, values),
        Ramp("d", "linear", (("to", 0.4), ("rate_per_s", 0.02))),
    ]
    _, found = drifted(OSCILLATOR, ramps, [{}])

    def rhs(t, y):
        k, d = np.interp(t - 3.0, times, values), 0.1 + 0.3 * np.clip(t / 15.0, 0.0, 1.0)
        return [y[1], 0.5 * np.cos(2 * np.pi * HZ * t) - d * y[1] - k * y[0]]

    marks = list(np.arange(1, 21) / HZ)
    expected = by_scipy(rhs, marks, START, (*(t + 3.0 for t in times), 15.0), 1e-12)
    np.testing.assert_allclose(found.section[0, 0], expected, atol=3e-9)


@pytest.mark.parametrize("shape", ["linear", "tanh"])
def test_motion__goes_there_and_back(shape):
    numbers = {"from": 0.5, "to": 2.0, "start_s": 7.3, "duration_s": 11.7, "hold_periods": 1.5}
    ramp = Ramp("A", shape, tuple(numbers.items()))
    packed = np.array([[1.0, 0.1, 1.0, *numbers.values()]])
    (motion,) = motions_of([ramp], ("k", "d", "A", *ramp.names), packed, np.array([HZ]))
    assert (motion.end[0], motion.final[0], motion.end_s[0]) == (2.0, 0.5, pytest.approx(7.3 + 2 * 11.7 + 5.0))
    t = np.linspace(0.0, 50.0, 401)
    one_way, mirrored = (value(at, 0.5, 2.0, 7.3, 11.7, shape == "tanh") for at in (t, 43.0 - t))
    np.testing.assert_allclose(motion.at(0, t), np.minimum(one_way, mirrored), atol=1e-12)
    assert motion.at(0, np.array([99.0]))[0] == 0.5
    corners = [7.3, 13.15, 19.0, 24.0, 29.85, 35.7]
    np.testing.assert_allclose(np.unique(motion.corners(0, 2).round(9)), corners)
    (out,) = motions_of([ramp.way_out], ("k", "d", "A", *ramp.names), packed, np.array([HZ]))
    assert (out.final[0], out.end_s[0]) == (2.0, 19.0)


def test_way_out__of_a_table_ends_at_its_farthest_value():
    out = Ramp("A", TABLE, (), (0.0, 1.0, 2.0, 5.0), (1.0, 1.5, -1.0, 1.0)).way_out
    assert (out.times_s, out.values) == ((0.0, 1.0, 2.0), (1.0, 1.5, -1.0))


@pytest.mark.slow
@pytest.mark.parametrize("hold", [0.0, 5.3])
@pytest.mark.parametrize("shape", ["linear", "tanh"])
def test_drifting_sections__there_and_back_against_another_integrator(shape, hold):
    ramp = Ramp("k", shape, (("from", 0.5), ("to", 2.0), ("start_s", 7.3), ("duration_s", 11.7), ("hold_s", hold)))
    _, found = drifted(OSCILLATOR, [ramp], [{}])

    def rhs(t, y):
        there = [value(at, 0.5, 2.0, 7.3, 11.7, shape == "tanh") for at in (t, 2 * 19.0 + hold - t)]
        return [y[1], 0.5 * np.cos(2 * np.pi * HZ * t) - 0.1 * y[1] - min(there) * y[0]]

    marks = list(np.arange(1, 21) / HZ)
    expected = by_scipy(rhs, marks, START, (7.3, 19.0, 19.0 + hold, 30.7 + hold), 1e-12)
    np.testing.assert_allclose(found.section[0, 0], expected, atol=3e-9)


@pytest.mark.slow
def test_drifting_sections__of_a_switched_drive():
    """True jumps of the drive and of friction: corners lie between the edges of a period, and on one of them."""
    ramp = linear("A", 0.5, 2.0, start_periods=1.0 + 0.3, duration_periods=2.45)
    _, found = drifted(SWITCHED, [ramp], [{}], n_keep=6)

    def force(t, middle):
        return value(t, 0.5, 2.0, 1.3 / HZ, 2.45 / HZ, False) * (1.0 if (middle * HZ) % 1.0 < 0.3 else -1.0)

    def turning(t, y, _):
        return y[1]

    y, out, t = START, [], 0.0
    breaks = sorted({*np.arange(1, 7) / HZ, *(np.arange(0, 6) + 0.3) / HZ, 1.3 / HZ, 3.75 / HZ})
    for b in breaks:
        while t < b - 1e-12:
            side = np.sign(y[1]) if abs(y[1]) > 1e-9 else np.sign(force(t, 0.5 * (t + b)) - y[0])

            def smooth(t, y, middle, side=side):
                return [y[1], force(t, middle) - 0.1 * y[1] - y[0] - 0.2 * side]

            turning.terminal, turning.direction = True, -side
            s = solve_ivp(
                smooth, (t, b), y, args=(0.5 * (t + b),), events=turning, method="DOP853", rtol=1e-12, atol=1e-13
            )
            t, y = s.t[-1], s.y[:, -1].copy()
            if s.status == 1:
                y[1] = 0.0
        t = b
        if abs(b * HZ - round(b * HZ)) < 1e-9:
            out.append(y)
    np.testing.assert_allclose(found.section[0, 0], out, atol=1e-8)


@pytest.mark.slow
def test_drifting_sections__of_the_pendulum():
    """A parameter by which its constants are divided."""
    base, name = load_preset(), "J2"
    a, b = base[name], 1.4 * base[name]
    ramp = linear(name, a, b, start_s=0.3, duration_s=1.0)
    start = np.array([0.2, -0.1, 0.5, 1.0])
    drift, found = drifted(base.model, [ramp], [{}], hz=2.0, start=start, n_keep=4)

    def rhs(t, y):
        p = base.replace(**{name: value(t, a, b, 0.3, 1.0, False)})
        return rates(np.array([t]), y[None], p, 2.0)[0]

    marks = [0.5, 1.0, 1.5, 2.0]
    expected = by_scipy(rhs, marks, start, (0.3, 1.3, *(np.arange(4) / 2 + 0.49 / 2)), 1e-10)
    assert drift.moving.degree == DEGREE
    np.testing.assert_allclose(found.section[0, 0], expected, atol=2e-7)


@pytest.mark.slow
def test_drifting_sections__of_a_ramp_to_the_same_value_are_those_of_an_ordinary_run():
    ramp = linear("A", 0.5, 0.5, start_s=0.0, duration_s=1.0)
    _, found = drifted(OSCILLATOR, [ramp], [{}], n_transient=300, n_keep=80)
    options = {"n_transient": 300, "n_keep": 80, "rtol": 1e-10}
    plain = run_cells(OSCILLATOR.system, OSCILLATOR.load().pack(), HZ, START, **options)
    np.testing.assert_allclose(found.section, plain.section, atol=1e-9)
    assert found.status[0, 0] == plain.status[0, 0] == Status.PERIODIC
    assert found.orbit_period[0, 0] == 1
    # A slow ramp looks closed while it lasts; of a run that ends within it nothing is said
    slow = linear("A", 0.5, 0.5 + 1e-7, start_s=0.0, duration_periods=399.0)
    _, during = drifted(OSCILLATOR, [slow], [{}], n_transient=340, n_keep=20)
    _, after = drifted(OSCILLATOR, [slow], [{}], n_transient=440, n_keep=20)
    assert during.status[0, 0] == Status.BOUNDED
    assert after.status[0, 0] == Status.PERIODIC


@pytest.mark.slow
def test_drifting_sections__same_bits_in_any_company():
    """Other cells, lanes and chunks; corners of some cells lie among the kept sections."""
    ramp = Ramp("A", "linear", RAMP)
    cells = [{"A_duration_s": d} for d in (1.0, 5.0, 21.7, 60.0, 90.0)]
    options = {"n_transient": 6, "n_keep": 12, "quantities": ["size"]}
    _, whole = drifted(OSCILLATOR, [ramp], cells, **options)
    names = ("section", "status", "n_steps", "n_rejected", "n_periods", "final_state", "step_size", "extremes")
    for one in (1, 4):
        _, alone = drifted(OSCILLATOR, [ramp], [cells[one]], **options)
        for name in names:
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(whole, name)[one], err_msg=name)
    _, other = drifted(OSCILLATOR, [ramp], cells, n_lanes=3, chunk_numbers=600, **options)
    for name in names:
        np.testing.assert_array_equal(getattr(other, name), getattr(whole, name), err_msg=name)


@pytest.mark.slow
def test_drifting_sections__turns_of_angles_with_corners_among_the_kept_sections():
    """A rotor under a torque that grows: turns are those of its closed form, per cell alone."""
    rates = {"a": "w", "w": "m + 0*sin(a)"}
    rotor = load_model(table("rotor", rates, {"m": 0.0}, states={"a": {"on_circle": True}}))
    ramp = linear("m", 0.0, 2.0, start_s=2.5, duration_s=4.0)
    cells = [{"m_duration_s": d} for d in (1.0, 4.0, 40.0)]
    _, found = drifted(rotor, [ramp], cells, hz=1.0, start=np.array([0.0, 1.0]), n_transient=2, n_keep=8)

    def angle(t, d):
        s, rest = min(max(t - 2.5, 0.0), d), max(t - 2.5 - d, 0.0)
        speed = 1.0 + s * s / d
        return t + s**3 / (3.0 * d) + rest * (speed - 1.0) + rest**2

    for row, d in zip(found.section[:, 0, -1, 0] + 2 * np.pi * found.turns[:, 0, 0], (1.0, 4.0, 40.0), strict=True):
        first = angle(3.0, d)
        wrapped = (first + np.pi) % (2 * np.pi) - np.pi
        assert row == pytest.approx(angle(10.0, d) - (first - wrapped), abs=1e-7)


@pytest.mark.slow
def test_drifting_sections__extremes_of_a_moving_parameter():
    """The parameter itself, as a quantity: exact at both ends of each period and between."""
    ramp = linear("A", 0.5, 2.0, start_s=4.0, duration_s=10.0)
    _, found = drifted(OSCILLATOR, [ramp], [{}], n_keep=6, n_transient=1, quantities=["size"])
    ends = [value(np.array([k, k + 1]) / HZ, 0.5, 2.0, 4.0, 10.0, False) for k in range(1, 7)]
    np.testing.assert_allclose(found.extremes[0, 0, :, 0, 0], [e.min() for e in ends], atol=1e-12)
    np.testing.assert_allclose(found.extremes[0, 0, :, 0, 1], [e.max() for e in ends], atol=1e-12)
    # of the period with the first corner: from 1/HZ to 4 s constant, then a line
    length, up = 1.0 / HZ, 2.0 / HZ - 4.0
    mean = 0.5 + 0.5 * up * (ends[0][1] - 0.5) / length
    assert found.extremes[0, 0, 0, 0, 2] == pytest.approx(mean, abs=1e-12)
    ramp = Ramp("A", "linear", (("to", 2.0), ("rate_per_period", 0.5), ("start_periods", 3.0)))
    names = ("k", "d", "A", *ramp.names)
    packed = np.array([[1.0, 0.1, 1.0, 2.0, 0.5, 3.0]])
    (motion,) = motions_of([ramp], names, packed, np.array([0.25]))
    assert motion.start_s[0] == 12.0
    assert motion.duration_s[0] == 8.0
    np.testing.assert_allclose(motion.at(0, np.array([0.0, 12.0, 16.0, 20.0, 99.0])), [1.0, 1.0, 1.5, 2.0, 2.0])


@pytest.mark.parametrize("name", ["duty", "w"])
def test_drift__refuses_what_moves_edges_or_surfaces(name):
    ramp = Ramp(name, "linear", (("from", 0.3), ("to", 0.4), ("duration_s", 1.0)))
    with pytest.raises(DriftError, match=name):
        drifted(SWITCHED, [ramp], [{}])
