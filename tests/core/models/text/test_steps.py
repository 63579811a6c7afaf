"""``floor``, ``ceil``, ``mod`` and ``heaviside``: their jumps end steps, and the motion is that of the equations."""

import math

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import sections
from magpend_core.lyapunov import lyapunov_exponents
from magpend_core.models.text.detected import found_in
from tests.core.flows import model_of

KEPT = {"n_transient": 0, "n_keep": 1, "rtol": 1e-11, "atol": 1e-11}
OMEGA = 2 * math.pi * 0.2


@pytest.fixture(scope="module")
def stepped():
    """An oscillator with four sorts of steps, of which each has a weight."""
    steps = "k*floor(3*x + 0.2) - 0.7*k*ceil(2*v) + m*mod(x - 0.1, b) + h*heaviside(v - 0.2)"
    return model_of({"x": "v", "v": f"cos(2*pi*f*t) - 0.1*v - x - ({steps})"}, {"k": 0.0, "m": 0.0, "h": 0.0, "b": 0.3})


def by_scipy(start, time, k, m, h, b):
    """State at a time: smooth stretches between the steps, each with the whole numbers of its middle."""
    surfaces = [
        lambda t, y: math.sin(math.pi * (3 * y[0] + 0.2)),
        lambda t, y: math.sin(2 * math.pi * y[1]),
        lambda t, y: math.sin(math.pi * (y[0] - 0.1) / b),
        lambda t, y: y[1] - 0.2,
    ]
    for surface in surfaces:
        surface.terminal = True
    t, y = 0.0, np.array(start)
    while t < time:

        def smooth(t, y):
            return math.cos(OMEGA * t) - 0.1 * y[1] - y[0]

        def frozen(x, v):
            return k * math.floor(3 * x + 0.2) - 0.7 * k * math.ceil(2 * v), m * b * math.floor((x - 0.1) / b), v > 0.2

        # a little later, after the step on which the stretch begins
        level, whole, above = frozen(y[0] + 1e-9 * y[1], y[1] + 1e-9 * (smooth(t, y) - sum(frozen(*y))))

        def rates(t, y, level=level, whole=whole, above=above):
            return [y[1], smooth(t, y) - level - (m * (y[0] - 0.1) - whole) - h * above]

        y = y + 1e-12 * np.array(rates(t, y))
        found = solve_ivp(rates, (t + 1e-12, time), y, "DOP853", rtol=1e-12, atol=1e-13, events=surfaces)
        t, y = found.t[-1], found.y[:, -1]
    return y


@pytest.mark.slow
@pytest.mark.parametrize("weights", [{"k": 0.15}, {"m": 0.8}, {"h": 0.4}, {"k": 0.1, "m": -0.3, "h": 0.2}])
def test_steps__of_states_are_followed_exactly(weights, stepped):
    assert len(stepped.derived.switches) == 4
    values = {"k": 0.0, "m": 0.0, "h": 0.0, "b": 0.3} | weights
    found = sections(stepped.load(**values), [0.2], [[0.55, -0.37]], **KEPT)
    np.testing.assert_allclose(found.section[0, 0], by_scipy([0.55, -0.37], 5.0, **values), atol=1e-8)
    assert found.n_rejected[0] < 300


@pytest.mark.slow
def test_steps__carry_tangents_across(stepped):
    """The exponents add up to the change of area between neighbours."""
    parameters = stepped.load(k=0.15, m=0.8)
    start = np.array([0.55, -0.37])
    cell = parameters.pack()[None], np.array([0.2]), start[None]
    one = lyapunov_exponents(*cell, n_transient=0, n_periods=2, n_blocks=2, system=stepped.system)
    rows = [start + d for d in (0.0, [1e-7, 0.0], [0.0, 1e-7])]
    ends = sections(parameters, np.full(3, 0.2), rows, **{**KEPT, "n_transient": 1}).section[:, 0]
    matrix = (ends[1:] - ends[0]).T / 1e-7
    assert one.exponents[0].sum() == pytest.approx(math.log(abs(np.linalg.det(matrix))) / 10.0, abs=1e-5)


@pytest.mark.slow
def test_floor__slides_where_both_sides_point_to_a_whole_number():
    """x' = -floor(x) - 0.5 falls by 1.5 to 1, by 0.5 to 0, and stays there; y does likewise with ceil, from below."""
    model = model_of({"x": "-floor(x) - 0.5 + 0*f", "y": "0.5 - ceil(y)"})
    assert model.derived.sliding.slides == (True, True)
    for time, x in ((0.1, 1.15), (0.2, 1.0), (1.2, 0.5), (3.0, 0.0)):
        found = sections(model.load(), [1 / time], [[1.3, -1.3]], **KEPT)
        np.testing.assert_allclose(found.section[0, 0], [x, -x], atol=1e-12)


@pytest.fixture(scope="module")
def timed():
    return model_of(
        {"x": "a*mod(3*f*t + s, 1) + b*mod(s - 2*t*f, 1) + c*mod(t, 1/f) + d*mod(t, 1/(3*f)) + ceil(s)/8 - x"},
        {"a": 1.0, "b": 0.0, "c": 0.0, "d": 0.0, "s": 0.37},
    )


@pytest.mark.slow
@pytest.mark.parametrize("s", [0.37, 0.0, -1.2, 1e-12, -1e-12, 2.0])
@pytest.mark.parametrize("weights", [{}, {"a": -0.5, "b": 1.0, "c": 0.3, "d": 0.7}])
def test_steps__in_time_are_edges(weights, s, timed):
    assert timed.derived.n_edges == 8
    values = {"a": 1.0, "b": 0.0, "c": 0.0, "d": 0.0} | weights
    frequency = 0.5
    found = sections(timed.load(s=s, **values), [frequency], [[0.2]], **KEPT).section[0, 0, 0]

    def level(t):
        saws = ((3 * frequency * t + s, "a"), (s - 2 * frequency * t, "b"))
        own = sum(values[name] * (u - mpmath.floor(u)) for u, name in saws)
        third = t - mpmath.floor(3 * frequency * t) / (3 * frequency)
        return own + values["c"] * t + values["d"] * third + math.ceil(s) / 8

    breaks = {0.0, 2.0, 2 / 3, 4 / 3} | {(j - s) % 3 / 1.5 for j in range(3)} | {(s - j) % 2 for j in range(2)}
    with mpmath.workdps(20):
        part = mpmath.quad(lambda t: mpmath.exp(t) * level(t), sorted(breaks))
        wanted = float(mpmath.exp(-2) * (0.2 + part))
    assert found == pytest.approx(wanted, abs=1e-9)


def test_found_in__says_where_a_floor_jumps(stepped):
    sentences = list(found_in(stepped, stepped.load().as_dict(), 0.2, (0.1, 0.2)))
    assert "switch: a jump where 0.2 + 3*x passes a whole number; a step ends there" in sentences
    assert any("-0.2 + v passes 0" in one or "v - 0.2 passes 0" in one for one in sentences)


def test_floor__of_what_jumps_alone_needs_no_surface():
    model = model_of({"x": "floor(1.5*sign(x)) - 0.3*x"})
    assert len(model.derived.switches) == 1


def test_map__mod_is_the_doubling_map():
    model = model_of({"x": "mod(2*x, 1)"}, kind="map")
    found = sections(model.load(), None, [[1 / 7]], n_transient=0, n_keep=3).section[0, :, 0]
    np.testing.assert_allclose(found, [2 / 7, 4 / 7, 1 / 7], rtol=1e-14)
