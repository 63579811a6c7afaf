"""Events: sections by crossing against other integrators and published periods."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from magpend_core import Crossing, Status, load_model, lyapunov_exponents, rates, run_branches, trajectory
from magpend_core.engine.checks import SystemCheckError, check_system
from magpend_core.engine.crossing import with_section
from magpend_core.engine.events import cubic_dip, cubic_root, may_dip
from magpend_core.engine.jit import inline
from magpend_core.engine.simd import absolute
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import sincos
from magpend_core.orbits import polish_orbits
from magpend_core.sampling import sample
from tests.core.cells import run_cells, stroboscopic_map
from tests.core.flows import table
from tests.zoo.nonsmooth import coulomb_map, linear_motion

# an engine for each direction and choice of quantities: of the library's, which others compile too, those
# where v falls; where it rises it is watched
VAN_DER_POL = load_model("van-der-pol").system
RISING = {"quantities": ("v",)}
CIRCLE = [0.0]  # its parameter at which it turns on circles, with angular velocity 1
ROTOR = load_model(
    table(
        "rotor",
        {"th": "w", "w": "torque - d*w - sin(th)"},
        {"torque": 1.0, "d": 1.0},
        states={"th": {"on_circle": True}},
    )
).system


def returns(system, parameters, starts, section, *, rtol=1e-10, **options):
    return run_cells(system, parameters, None, starts, rtol=rtol, section=section, **options)


def crossings_of(rhs, start, level, of, direction, time):
    """Times and states of crossings by another integrator and its own search for zeros."""

    def event(t, y):
        return y[of] - level

    event.direction = direction
    found = solve_ivp(rhs, (0.0, time), start, "DOP853", rtol=1e-13, atol=1e-13, events=event)
    return found.t_events[0], found.y_events[0]


# mu = 1: Amore, J. Comput. Appl. Math. 2022, and many before; checked here by DOP853 to 1e-11
VAN_DER_POL_PERIOD = 6.6632868593231301


@pytest.mark.slow
@pytest.mark.parametrize("direction", ["up", "down"])
def test_section__of_van_der_pol_has_the_published_period(direction):
    options = {"n_transient": 8, "n_keep": 6, "rtol": 1e-12, **(RISING if direction == "up" else {})}
    section = Crossing("v", 0.0, direction, 20.0)
    found = returns(VAN_DER_POL, [1.0], [[0.5, 0.1], [2.0, 3.0]], section, **options)
    assert found.status.tolist() == [[Status.PERIODIC]] * 2
    assert found.orbit_period.tolist() == [[1]] * 2
    assert abs(found.return_time - VAN_DER_POL_PERIOD).max() < 2e-11
    # the amplitude of the cycle, on the side at which v falls through zero
    side = 1.0 if direction == "down" else -1.0
    assert found.section[..., 0] == pytest.approx(side * 2.00861986087, abs=1e-9)
    # the step ends on the section, to the last digits of terms that are about 1
    assert abs(found.section[..., 1]).max() < 1e-14


def rossler(t, y, a=0.2, b=0.2, c=5.7):
    return -y[1] - y[2], y[0] + a * y[1], b + y[2] * (y[0] - c)


def lorenz(t, y, sigma=10.0, rho=28.0, beta=8.0 / 3.0):
    return sigma * (y[1] - y[0]), y[0] * (rho - y[2]) - y[1], y[0] * y[1] - beta * y[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rhs", "start", "of", "level", "direction"),
    [(rossler, [-3.0, -4.0, 0.1], 0, 0.0, -1), (lorenz, [-3.0, -4.0, 20.0], 2, 27.0, 1)],
)
def test_section__of_a_chaotic_flow_is_that_of_another_integrator(rhs, start, of, level, direction):
    n = 8
    times, states = crossings_of(rhs, start, level, of, direction, 80.0 if rhs is rossler else 10.0)
    section = Crossing("xyz"[of], level, "up" if direction > 0 else "down", 50.0)
    found = returns(load_model(rhs.__name__).system, rhs.__defaults__, start, section, n_keep=n, rtol=1e-13)
    # chaos doubles an error with each return or so
    assert found.section[0, 0] == pytest.approx(states[:n], abs=1e-8)
    assert np.cumsum(found.return_time[0, 0]) == pytest.approx(times[:n], abs=1e-8)
    assert abs(found.section[0, 0, :, of] - level).max() < 1e-14


@pytest.mark.slow
def test_section__of_an_angle_is_crossed_modulo_a_turn_and_one_way():
    # a rotor that turns over: th passes every level once a turn, backwards never
    torque, d, start, level = 1.6, 0.5, [0.3, 2.0], 2.5

    def rhs(t, y):
        return y[1], torque - d * y[1] - math.sin(y[0])

    found = returns(ROTOR, [torque, d], start, Crossing("th", level, "up", 30.0), n_keep=5, rtol=1e-12)
    for i in range(5):
        times, states = crossings_of(rhs, start, level + 2.0 * np.pi * i, 0, 1, 40.0)
        assert np.cumsum(found.return_time[0, 0])[i] == pytest.approx(times[0], abs=1e-10)
        assert found.section[0, 0, i] == pytest.approx([level, states[0, 1]], abs=1e-10)
    assert found.turns[0, 0, 0] == 4
    backwards = returns(ROTOR, [torque, d], start, Crossing("th", level, "down", 30.0))
    assert backwards.status[0, 0] == Status.NO_RETURN
    # mirrored, it turns backwards, and past the zero of the sine half a turn away the rising way
    mirrored = returns(ROTOR, [-torque, d], [-0.3, -2.0], Crossing("th", -level, "down", 30.0), n_keep=5)
    assert mirrored.return_time == pytest.approx(found.return_time, abs=1e-8)
    backwards = returns(ROTOR, [-torque, d], [-0.3, -2.0], Crossing("th", -level, "up", 30.0))
    assert backwards.status[0, 0] == Status.NO_RETURN


@pytest.mark.slow
@pytest.mark.parametrize("speed", [1e3, 1e5, 1e7])
def test_section__of_an_angle_sees_each_turn_where_steps_could_be_longer(speed):
    # so fast that the weight changes less than the tolerance: nothing else bounds the steps
    section = Crossing("th", 1.0, "up", 1.0)
    found = returns(ROTOR, [0.0, 0.0], [0.5, speed], section, n_transient=20, n_keep=40, rtol=1e-5)
    assert found.return_time == pytest.approx(2.0 * math.pi / speed, rel=1e-4)


@pytest.mark.slow
def test_section__counts_a_pair_within_a_step_and_not_the_crossing_at_the_start():
    # x = cos t, v = -sin t falls through v = 0 at the start and a period later
    section = Crossing("v", 0.0, "down")
    for v in (0.0, 1e-13, -1e-13):
        found = returns(VAN_DER_POL, CIRCLE, [[1.0, v]], section, rtol=1e-12)
        assert found.return_time[0, 0, 0] == pytest.approx(2.0 * np.pi, abs=1e-10)
    # a start before the section is another matter
    found = returns(VAN_DER_POL, CIRCLE, [[np.cos(0.01), np.sin(0.01)]], section, rtol=1e-12)
    assert found.return_time[0, 0, 0] == pytest.approx(0.01, abs=1e-12)
    # the top of a circle of radius 1 reaches beyond the level by 5e-5, for 0.02 s; steps are ten times longer
    for depth in (1e-3, 5e-5, 1e-6):
        section = Crossing("v", 1.0 - depth, "up", 20.0)
        options = {"n_transient": 1, "n_keep": 3, "rtol": 1e-9}
        found = returns(VAN_DER_POL, CIRCLE, [[-1.0, 0.0]], section, **options, **RISING)
        assert found.return_time[0, 0] == pytest.approx(2.0 * np.pi, abs=1e-5)
        assert found.section[0, 0, :, 1] == pytest.approx(1.0 - depth, abs=1e-12)
        section = Crossing("v", 1.0 - depth, "down", 20.0)
        found = returns(VAN_DER_POL, CIRCLE, [[-1.0, 0.0]], section, **options)
        assert found.return_time[0, 0] == pytest.approx(2.0 * np.pi, abs=1e-5)


def test_section__no_return_ends_the_cell_and_the_walk_goes_on():
    # mu < 0: to rest; then mu = 1 at the second point
    packed, section = np.array([[[-1.0], [1.0]]]), Crossing("v", -0.5, "down", 60.0)
    options = {"n_transient": 0, "n_keep": 2, "rtol": 1e-9, "atol": 1e-9, "section": section}
    found = run_branches(packed, None, [[-1.0, -0.3]], system=VAN_DER_POL, **options)
    assert found.status[0].tolist() == [Status.NO_RETURN, Status.BOUNDED]
    assert np.isnan(found.section[0, 0]).all()
    assert np.isnan(found.return_time[0, 0]).all()
    assert np.isfinite(found.section[0, 1]).all()
    assert "section.longest" in Status.NO_RETURN.sentence


@pytest.mark.slow
def test_section__continues_and_watches_over_a_return():
    section = Crossing("v", 0.0, "down", 40.0)
    whole = returns(VAN_DER_POL, [1.0], [[0.5, 0.1]], section, n_keep=6, rtol=1e-8)
    first = returns(VAN_DER_POL, [1.0], [[0.5, 0.1]], section, n_keep=2, rtol=1e-8)
    state, step = first.final_state[:, 0], first.step_size[:, 0]
    second = returns(VAN_DER_POL, [1.0], state, section, n_keep=4, rtol=1e-8, step_size=step)
    together = np.concatenate([first.section, second.section], axis=2)
    assert together.tobytes() == whole.section.tobytes()
    # over a turn of the circle v is 0 in the mean, its extremes are 1
    found = returns(
        VAN_DER_POL, CIRCLE, [[-0.8, 0.6]], Crossing("v", 0.6), n_transient=1, n_keep=2, rtol=1e-10, **RISING
    )
    assert found.extremes[0, 0, :, 0] == pytest.approx(np.tile([-1.0, 1.0, 0.0], (2, 1)), abs=1e-5)


@pytest.mark.parametrize("steps", [1, 20])
def test_section__too_many_steps_end_it(steps):
    section = Crossing("v", 0.0, "down")
    found = returns(VAN_DER_POL, [1.0], [[-0.5, -0.1]], section, max_steps_per_period=steps)
    assert found.status[0, 0] == Status.STEP_LIMIT
    found = returns(VAN_DER_POL, [1.0], [[0.0, 0.0]], Crossing("v", 0.0, "down", 30.0))
    assert found.status[0, 0] == Status.NO_RETURN


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"of": "v", "direction": "left"}, "direction = 'left'"),
        ({"of": "v", "longest": 0.0}, "longest = 0.0"),
        ({"of": "v", "value": np.nan}, "value of a section"),
    ],
)
def test_crossing__refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        Crossing(**arguments)


def test_with_section__refuses(duffing):
    with pytest.raises(ValueError, match="no such state; it has x, v"):
        with_section(VAN_DER_POL, "w", 1)
    with pytest.raises(ValueError, match="depends on time"):
        with_section(duffing, "x", 1)
    with pytest.raises(ValueError, match="has a section already"):
        with_section(with_section(VAN_DER_POL, "x", 1), "v", 1)
    with pytest.raises(ValueError, match="frequency_hz must be None"):
        run_cells(VAN_DER_POL, [1.0], 1.0, [[1.0, 0.0]], section=Crossing("v"))


@pytest.mark.slow
def test_cubic__root_and_dip_are_those_of_numpy():
    rng = np.random.default_rng(8)
    a, b = rng.uniform(0.0, 1.0, 4000), rng.uniform(-1.0, 1.0, 4000)
    da, db = rng.normal(0.0, 3.0, (2, 4000))
    with np.errstate(all="ignore"):
        dips, expected, errors = cubic_dip(a, da, b, db), [], []
        possible = may_dip(a, da, b, db)
        roots = cubic_root(a, da, b, db, np.minimum(dips, 1.0))
    for i in range(4000):
        c3, c2 = 2.0 * (a[i] - b[i]) + da[i] + db[i], 3.0 * (b[i] - a[i]) - 2.0 * da[i] - db[i]
        cubic = np.polynomial.Polynomial([a[i], da[i], c2, c3])
        low = [x.real for x in cubic.deriv().roots() if abs(x.imag) < 1e-12 and 0 < x.real < 1]
        low = [x for x in low if cubic.deriv(2)(x) > 0.0 and cubic(x) < 0.0]
        expected.append(low[0] if low else 2.0)
        if b[i] < 0.0 or low:
            zeros = [x.real for x in cubic.roots() if abs(x.imag) < 1e-9 and 0.0 <= x.real <= 1.0]
            errors.append(abs(roots[i] - min(zeros)))
    # what the few steps of Newton's method leave, the next attempt finds
    assert np.median(errors) < 1e-7
    assert np.mean(np.array(errors) < 1e-2) > 0.9
    assert (possible[dips < 1.0] == 1.0).all()
    assert dips == pytest.approx(expected, abs=1e-9)


# --- switches, segments, dry friction --------------------------------------------------------------------


@inline
def _stick_constants(frequency, p, out):
    for i in range(5):
        out[i] = p[i]
    out[5] = 2.0 * math.pi * frequency


@inline
def _stick_forcing(t, c):
    # pushes between the two edges
    return c[0] * sincos(c[5] * t)[1] + c[1] * c[7] * (2.0 - c[7])


@inline
def _stick_rhs(y, u, c):
    # x'' = force - k x - mu sign(v), or sign(x); in mode 0 the mass sticks
    slipping = absolute(c[6])
    return y[1], slipping * (u - c[2] * y[0]) - c[3] * c[6]


@inline
def _stick_switches(t, y, dy, c):
    sine, cosine = sincos(c[5] * t)
    sigma = (c[0] * cosine + c[1] * c[7] * (2.0 - c[7]) - c[2] * y[0]) / c[3]
    change = (-c[0] * c[5] * sine - c[2] * dy[0]) / c[3]
    slipping, of_v = absolute(c[6]), 1.0 - c[4]
    return (
        (
            slipping * (of_v * y[1] + c[4] * y[0]) + (1.0 - slipping) * (1.0 - sigma * sigma),
            slipping * (of_v * dy[1] + c[4] * dy[0]) - (1.0 - slipping) * (2.0 * sigma * change),
        ),
    )


@inline
def _stick_jacobian(y, u, c):
    zero = 0.0 * y[0]
    return zero, zero + 1.0, zero - absolute(c[6]) * c[2], zero


@inline
def _two_edges(frequency, p, times, half_widths, jumps):
    times[0], times[1] = 0.25 / frequency, 0.7 / frequency
    for i in range(2):
        half_widths[i] = math.inf
        jumps[i] = 1.0


# one system for dry friction, a push between two edges, and a relay: each engine is compiled once
STICK = System(
    name="stick",
    state_names=("x", "v"),
    parameter_names=("force", "push", "k", "mu", "of_x"),
    n_constants=6,
    constants=_stick_constants,
    forcing=_stick_forcing,
    rhs=_stick_rhs,
    jacobian=_stick_jacobian,
    n_modes=2,
    n_switches=1,
    switches=_stick_switches,
    slides=(True,),
    has_segments=True,
    n_edges=2,
    edges=_two_edges,
)
RELAY = [0.0, 0.0, 0.0, 1.0, 1.0]
"""Parameters of x'' = -sign(x)."""


def dry(force, mu):
    """Parameters of x'' = force cos(w t) - x - mu sign(x')."""
    return [force, 0.0, 1.0, mu, 0.0]


def pushed(push, k, mu, of_x=0.0):
    """Those of a mass on a spring that is pushed between the two edges."""
    return [0.0, push, k, mu, of_x]


def relay_exactly(amplitude, time):
    """x'' = -sign(x) from rest at `amplitude`: four parabolas."""
    quarter = math.sqrt(2.0 * amplitude)
    n, rest = divmod(time, 2.0 * quarter)
    s = rest - quarter
    sign = 1.0 if n % 2 == 0 else -1.0
    if s < 0.0:
        return sign * (amplitude - 0.5 * rest**2), -sign * rest
    return sign * (-quarter * s + 0.5 * s**2), sign * (-quarter + s)


@pytest.mark.slow
def test_switch__of_a_relay_gives_parabolas():
    amplitudes = np.linspace(0.3, 2.0, 21)
    found = run_cells(STICK, RELAY, 1.0, np.c_[amplitudes, 0.0 * amplitudes], n_keep=6, rtol=1e-6)
    for a, sections in zip(amplitudes, found.section[:, 0], strict=True):
        exact = [relay_exactly(a, i + 1.0) for i in range(6)]
        assert sections == pytest.approx(np.array(exact), abs=3e-12)
    # one attempt passes the switch, one or two aim at it
    n_crossings = sum(int((6.0 + q) / (2.0 * q)) for q in np.sqrt(2.0 * amplitudes))
    assert found.n_rejected.sum() < 3 * n_crossings


@pytest.mark.slow
def test_segments__of_a_square_drive_turn_about_two_centres():
    # right of x = 0 the relay pulls by 1/2 to one side: x'' = push - 1/2 - k x
    k, frequency = 1.7, 0.8
    w, starts = math.sqrt(k), [[1.5, 0.2], [2.0, -0.5]]
    found = run_cells(STICK, pushed(6.0, k, 0.5, 1.0), frequency, starts, n_keep=5, rtol=1e-11)
    for start, sections in zip(starts, found.section[:, 0], strict=True):
        z = complex(start[0], start[1] / w)
        for x, v in sections:
            for share, push in ((0.25, 0.0), (0.45, 6.0), (0.3, 0.0)):
                centre = (push - 0.5) / k
                z = centre + (z - centre) * np.exp(-1j * w * share / frequency)
            assert (x, v) == pytest.approx((z.real, w * z.imag), abs=1e-10)
    # no attempt has an edge within it, which would cost a dozen rejections
    assert found.n_rejected.max() <= 3 * 5


@pytest.mark.slow
@pytest.mark.parametrize(("force", "mu", "frequency"), [(1.0, 0.6, 0.05), (1.0, 0.3, 0.07), (2.0, 0.4, 0.11)])
def test_switch__of_dry_friction_sticks_and_slips_as_in_closed_form(force, mu, frequency):
    starts = [[0.3, 0.0], [0.9, 0.0]]
    found = run_cells(STICK, dry(force, mu), frequency, starts, n_keep=12, rtol=1e-12)
    assert (found.status != Status.STEP_LIMIT).all()
    for state, sections in zip(starts, found.section[:, 0], strict=True):
        stops = 0
        for section in sections:
            state, n = coulomb_map(state, 2.0 * np.pi * frequency, force, mu)
            stops += n
            assert section == pytest.approx(state, abs=2e-10)
        # it does stick, or never does
        assert (stops > 0) == (force < 2.0)


@pytest.mark.slow
def test_switch__sticks_for_ever_under_a_weak_force():
    found = run_cells(STICK, dry(0.2, 0.5), 0.1, [[0.1, 0.0], [0.0, 1.0]], n_keep=3, n_transient=3)
    assert found.section[0, 0] == pytest.approx(np.tile([0.1, 0.0], (3, 1)), abs=1e-13)
    assert abs(found.section[1, 0, :, 1]).max() < 1e-13
    assert found.orbit_period.tolist() == [[1], [1]]


@pytest.mark.slow
def test_switch__that_sticks_is_torn_off_by_an_edge():
    # at rest, pushed to 2 (F - mu) in half a swing, let go and back in another; edges at 5 s and 14 s
    times = np.arange(1, 60) * 0.97
    found = trajectory(given(STICK, *pushed(1.0, 1.0, 0.5)), 0.05, [0.0, 0.0], times, rtol=1e-10, atol=1e-10)
    for t, state in zip(np.mod(times, 20.0), found, strict=True):
        there = 0.5 - 0.5 * np.cos(np.clip(t - 5.0, 0.0, np.pi))
        back = 0.5 - 0.5 * np.cos(np.clip(t - 14.0, 0.0, np.pi))
        speed = 0.5 * np.sin(np.clip(t - 5.0, 0.0, np.pi)) - 0.5 * np.sin(np.clip(t - 14.0, 0.0, np.pi))
        assert state == pytest.approx([there - back, speed], abs=1e-8)


# --- impacts ----------------------------------------------------------------------------------------------


# at the floor it is thrown back, or put down below
TOSS = load_model(
    table(
        "toss",
        {"x": "v", "v": "-g - k*sign(x - level)"},
        dict.fromkeys(("g", "k", "level", "ground", "r", "down"), 0.0),
        impacts=[{"of": "x - ground", "direction": "down", "set": {"x": "x - down", "v": "-r*v"}}],
    )
).system


def ball(g, r, down=0.0):
    """Parameters of a ball above a floor at 0."""
    return [g, 0.0, -1e3, 0.0, r, down]


def ball_exactly(height, g, r, time):
    """Height and velocity of a ball dropped from rest, and how often it has bounced."""
    v, t, n = math.sqrt(2.0 * g * height), math.sqrt(2.0 * height / g), 0
    if time < t:
        return height - 0.5 * g * time**2, -g * time, 0
    while True:
        v, n = r * v, n + 1
        if time < t + 2.0 * v / g:
            s = time - t
            return v * s - 0.5 * g * s**2, v - g * s, n
        t += 2.0 * v / g


# what is thrown back is seen where it falls: one engine does
FLOOR = Crossing("x", 0.0, "down")


@pytest.mark.slow
def test_impact__of_a_bouncing_ball_is_the_closed_form():
    g, r, heights, times = 9.81, 0.9, np.linspace(0.4, 2.0, 17), 0.5 * np.arange(1, 9)
    starts = np.c_[heights, 0.0 * heights]
    found = sample(TOSS, np.tile(ball(g, r), (17, 1)), starts, [times], piece=np.zeros(17, int), rtol=1e-9)
    for h, states in zip(heights, found.states, strict=True):
        exact = [ball_exactly(h, g, r, t)[:2] for t in times]
        assert states == pytest.approx(np.array(exact), abs=1e-11)
    assert {ball_exactly(h, g, r, 4.0)[2] for h in heights} >= {6, 8, 10}
    # it is thrown back ever more slowly
    found = returns(TOSS, ball(g, r), starts, FLOOR, n_keep=8, rtol=1e-9)
    speeds = np.sqrt(2.0 * g * heights)[:, None] * r ** np.arange(1, 9)
    assert found.section[:, 0, :, 1] == pytest.approx(speeds, abs=1e-11)
    assert found.return_time[:, 0, 1:] == pytest.approx(2.0 * speeds[:, :-1] / g, abs=1e-11)


@pytest.mark.slow
def test_section__of_a_flow_with_switches_or_impacts():
    a, g, height = 0.7, 2.0, 0.9
    relay = [0.0, 1.0, 0.0, -1e3, 1.0, 0.0]
    for level in (0.0, 0.1):  # on the switch, and beside it
        found = returns(TOSS, relay, [[a, 0.0]], Crossing("x", level, "down"), n_keep=4, rtol=1e-8)
        first, turn = math.sqrt(2.0 * (a - level)), 4.0 * math.sqrt(2.0 * a)
        assert found.return_time[0, 0] == pytest.approx([first, *[turn] * 3], abs=1e-11)
    flight = 2.0 * math.sqrt(2.0 * height / g)
    # half the way down; and on the floor itself, where the section is taken after the impact
    half = Crossing("x", 0.5 * height, "down")
    found = returns(TOSS, ball(g, 1.0), [[height, 0.0]], half, n_keep=4, rtol=1e-8)
    assert found.return_time[0, 0] == pytest.approx([math.sqrt(0.125) * flight, *[flight] * 3], abs=1e-11)
    found = returns(TOSS, ball(g, 1.0), [[height, 0.0]], FLOOR, n_keep=4, rtol=1e-8)
    assert found.return_time[0, 0] == pytest.approx([0.5 * flight, *[flight] * 3], abs=1e-11)
    assert found.section[0, 0, :, 1] == pytest.approx(math.sqrt(2.0 * g * height), abs=1e-11)
    # a jump over the level is no crossing of it: put down below the floor, it rises past the level, and again
    below = Crossing("x", -0.2, "down", 20.0)
    found = returns(TOSS, ball(g, 1.0, 0.4), [[height, 0.0]], below, rtol=1e-8)
    assert found.status[0, 0] == Status.NO_RETURN


@pytest.mark.slow
@pytest.mark.parametrize("r", [0.5, 0.0])
def test_impact__endless_ones_end_in_a_status(r):
    # bounces add up in finite time; without rebound it is at rest at once
    deep = Crossing("x", -1.0, "down")
    found = returns(TOSS, ball(9.81, r), [[1.0, 0.0]], deep, n_keep=3, rtol=1e-8, max_steps_per_period=3000)
    assert found.status[0, 0] == Status.CHATTER


# --- tangents through events --------------------------------------------------------------------------------


# x'' + 2 zeta x' + x = force cos(w t) left of a wall; parameters zeta, force, gap, r
STRUCK = load_model("impact").system
IMPACTS, IMPACT_HZ = [0.05, 1.0, 0.4, 0.8], 0.13


class ImpactOscillator:
    """x'' + 2 zeta x' + x = force cos(w t) left of a wall, from impact to impact in closed form."""

    def __init__(self, zeta, force, gap, r, frequency):
        self.gap, self.r, self.w = gap, r, 2.0 * np.pi * frequency
        self.force, self.zeta = force, zeta
        self.matrix = np.array([[0.0, 1.0], [-1.0, -2.0 * zeta]])

    def flight(self, t0, y0):
        """State at a time, or states at several."""
        motion = linear_motion(t0, *y0, self.w, self.force, self.zeta)
        return lambda t: np.array(motion(t))

    def after(self, y, time):
        """State and derivative by the start after `time`, and the number of impacts."""
        t, y, derivative, n = 0.0, np.array(y, float), np.eye(2), 0
        while True:
            at = self.flight(t, y)
            grid = np.arange(t + 1e-6, time + 5e-3, 5e-3)
            beyond = np.flatnonzero(at(grid)[0] > self.gap)
            hit = time
            if len(beyond):
                i = int(beyond[0])
                low = t + 1e-9 if i == 0 else grid[i - 1]
                hit = brentq(lambda s, at=at: at(s)[0] - self.gap, low, grid[i], xtol=1e-15, rtol=1e-14)
            if hit >= time:
                return at(time), expm(self.matrix * (time - t)) @ derivative, n
            x, v = at(hit)
            push = self.force * np.cos(self.w * hit) - self.gap
            before = push - 2.0 * self.zeta * v
            after = push + 2.0 * self.zeta * self.r * v
            # R' + (f+ - R' f-) grad g / (grad g . f-)
            jump = np.array([[-self.r, 0.0], [(after + self.r * before) / v, -self.r]])
            derivative = jump @ expm(self.matrix * (hit - t)) @ derivative
            t, y, n = hit, np.array([x, -self.r * v]), n + 1


@pytest.mark.slow
def test_impact__oscillator_follows_its_exact_map_and_its_derivative():
    exact = ImpactOscillator(*IMPACTS, IMPACT_HZ)
    starts = np.array([[0.1, 0.0], [-0.7, 0.5], [-2.0, 1.0], [0.2, -1.5]])
    images, derivatives = stroboscopic_map(np.tile(IMPACTS, (4, 1)), np.full(4, IMPACT_HZ), starts, 3, system=STRUCK)
    counts = []
    for start, image, derivative in zip(starts, images[:, -1], derivatives, strict=True):
        state, matrix, count = exact.after(start, 3 / IMPACT_HZ)
        assert image == pytest.approx(state, abs=1e-9)
        assert derivative == pytest.approx(matrix, abs=1e-8 * abs(matrix).max())
        counts.append(count)
    assert min(counts) >= 3


@pytest.mark.slow
def test_impact__multipliers_of_an_orbit_are_those_of_the_exact_map():
    packed, frequency = np.array([IMPACTS]), IMPACT_HZ
    settled = run_cells(STRUCK, packed, frequency, [[-0.7, 0.5]], n_transient=60, rtol=1e-10)
    assert settled.orbit_period[0, 0] in (0, 1)
    orbit = polish_orbits(packed, np.array([frequency]), settled.section[0, :, 0], np.array([1]), system=STRUCK)
    assert orbit.converged[0]
    image, matrix, count = ImpactOscillator(*IMPACTS, frequency).after(orbit.section[0], 1 / frequency)
    assert count >= 1
    assert image == pytest.approx(orbit.section[0], abs=1e-9)
    exact = np.linalg.eigvals(matrix)
    assert np.sort_complex(orbit.multipliers[0]) == pytest.approx(np.sort_complex(exact), abs=1e-9)
    # each impact shrinks areas by r^2, the flow by exp(-2 zeta T)
    area = IMPACTS[3] ** (2 * count) * math.exp(-2.0 * IMPACTS[0] / frequency)
    assert orbit.multipliers[0].prod() == pytest.approx(area, rel=1e-8)


@pytest.mark.slow
def test_switch__derivative_of_a_relay_is_that_of_its_period():
    # from rest at a: after time T the derivative by a follows from the closed form
    a, time, step = 0.7, 3.0, 1e-5
    packed, start = np.array([RELAY]), np.array([[a, 0.0]])
    _, derivative = stroboscopic_map(packed, np.array([1.0 / time]), start, 1, system=STICK)
    above, below = (np.array(relay_exactly(a + s, time)) for s in (step, -step))
    assert derivative[0, :, 0] == pytest.approx((above - below) / (2.0 * step), abs=1e-8)
    # a Hamiltonian flow keeps areas, across the switch as well
    assert np.linalg.det(derivative[0]) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.slow
def test_switch__sliding_forgets_the_velocity():
    # once it has stuck, the section depends on where it stuck alone: one multiplier is 0
    force, mu, frequency = 1.0, 0.6, 0.05
    starts = np.array([[0.3, 0.2], [0.5, -0.1]])
    packed = np.tile(dry(force, mu), (2, 1))
    _, derivatives = stroboscopic_map(packed, np.full(2, frequency), starts, 1, system=STICK)
    step = 1e-5
    for i in range(2):
        shifted = starts[:, None, :] + step * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        found = run_cells(STICK, packed[0], frequency, shifted[i], rtol=1e-13).section[:, 0, 0]
        differences = np.array([found[0] - found[1], found[2] - found[3]]).T / (2.0 * step)
        assert derivatives[i] == pytest.approx(differences, abs=1e-6)
        assert abs(np.linalg.det(derivatives[i])) < 1e-10


@pytest.mark.slow
def test_lyapunov__through_impacts_and_sticking():
    (zeta, _, _, r), frequency = IMPACTS, IMPACT_HZ
    packed, starts = np.tile(IMPACTS, (2, 1)), np.array([[-0.7, 0.5], [0.2, 0.1]])
    options = {"n_transient": 40, "n_periods": 64, "rtol": 1e-9, "atol": 1e-9}
    found = lyapunov_exponents(packed, np.full(2, frequency), starts, system=STRUCK, **options)
    assert found.exponents.sum(axis=1) == pytest.approx(found.divergence, abs=1e-6)
    # volumes shrink by exp(-2 zeta T) in the flow, by r^2 at each impact
    settled = run_cells(STRUCK, packed[:1], frequency, [[-0.7, 0.5]], n_transient=40, rtol=1e-10)
    _, _, count = ImpactOscillator(*IMPACTS, frequency).after(settled.section[0, 0, 0], 64 / frequency)
    area = -2.0 * zeta + 2.0 * count * math.log(r) * frequency / 64
    assert found.divergence[0] == pytest.approx(area, abs=0.05 * frequency)
    assert count >= 64
    # sticking forgets the velocity: the second exponent is none, the first is that of where it stuck
    force, mu, frequency = 1.0, 0.6, 0.05
    packed, hertz, start = np.array([dry(force, mu)]), np.array([frequency]), np.array([[0.3, 0.2]])
    options = {"n_exponents": 2, "n_transient": 8, "n_periods": 32, "rtol": 1e-9, "atol": 1e-9}
    found = lyapunov_exponents(packed, hertz, start, system=STICK, **options)
    assert found.status[0] == Status.BOUNDED
    assert found.loss[0] > 1e14
    assert found.exponents[0, 1] < -1.0
    settled = run_cells(STICK, packed, frequency, start, n_transient=8).section[0, 0]
    _, derivative = stroboscopic_map(packed, hertz, settled, 1, system=STICK)
    largest = abs(np.linalg.eigvals(derivative[0])).max()
    expected = math.log(largest) * frequency if largest > 1e-9 else -1.0
    assert found.exponents[0, 0] == pytest.approx(expected, abs=1e-6) or found.exponents[0, 0] < expected


# --- the other doors ----------------------------------------------------------------------------------------


def given(system, *values):
    """What doors for parameters of a model ask of them."""
    return SimpleNamespace(model=SimpleNamespace(system=system), pack=lambda: np.array(values, float))


@pytest.mark.slow
def test_rates__take_switches_by_their_signs_and_segments_by_time():
    states = np.array([[0.5, 1.0], [0.5, -2.0], [-0.5, 0.0]])
    found = rates(0.0, states, given(STICK, *dry(1.0, 0.3)), 0.1)
    assert found[:, 1] == pytest.approx([1.0 - 0.5 - 0.3, 1.0 - 0.5 + 0.3, 1.0 + 0.5 - 0.3])
    frequency = 0.8
    at = np.array([0.1, 0.25, 0.5, 0.69, 0.71, 0.99, 1.1]) / frequency
    found = rates(at, np.zeros((7, 2)), given(STICK, *pushed(2.0, 1.0, 1.0)), frequency)
    assert found[:, 1].tolist() == [-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0]


# --- checks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"n_modes": 0}, "n_modes = 0; it must be 1: one for each of the 1 switches"),
        ({"switches": None}, "switches is missing"),
        ({"slides": (True, False)}, "slides has 2 entries; it must have one for each of the 1 switches"),
        ({"switches": inline(lambda t, y, dy, c: ((y[0], 2.0 * dy[0]),))}, "switches: the rate of number 0"),
        ({"switches": inline(lambda t, y, dy, c: (y[0], dy[0]))}, "switches must return a tuple of 1 pairs"),
        ({"has_segments": True, "n_modes": 2}, "there is no edge"),
        ({"reset": None}, "reset is missing"),
        ({"impact_directions": (0,)}, "impact_directions: 0 must be 1"),
        ({"reset": inline(lambda k, t, y, c: (y[0],))}, "reset returns 1 numbers; it must return a tuple of 2"),
    ],
)
def test_check_system__names_what_is_wrong_with_events(fields, message):
    system = dataclasses.replace(TOSS, **fields)
    with pytest.raises(SystemCheckError) as error:
        check_system(system, np.ones((1, 6)), np.ones(1), np.ones((1, 2)))
    assert message in str(error.value)


def test_events__bits_depend_on_the_lane_alone():
    rng, n = np.random.default_rng(5), 45
    returned = {"section": Crossing("v", 0.3, "down", 40.0)}
    cases = (
        (STICK, dry(1.0, 0.4), 0.1, {}),
        (STRUCK, [0.05, 1.0, 0.4, 0.8], 0.1, {}),
        (VAN_DER_POL, [1.0], None, returned),
    )
    for system, parameters, frequency, options in cases:
        options |= {"n_transient": 4, "n_keep": 2, "rtol": 1e-7}
        starts = rng.uniform(-0.4, 0.4, (n, 2)) * (5.0 if frequency is None else 1.0)
        whole = run_cells(system, parameters, frequency, starts, **options)
        for rows, n_lanes in ((rng.permutation(n), 24), (np.arange(n), 1), (np.arange(5), 1000), (np.array([40]), 64)):
            part = run_cells(system, parameters, frequency, starts[rows], n_lanes=n_lanes, **options)
            for name in ("section", "return_time", "n_steps", "n_rejected", "final_state", "step_size"):
                if getattr(whole, name) is not None:
                    assert getattr(part, name).tobytes() == getattr(whole, name)[rows].tobytes(), name
