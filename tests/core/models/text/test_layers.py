"""Steep places, corners and jumps: what is found, what the engine is told, and what it then does with it."""

import dataclasses
import itertools
import math

import mpmath
import numpy as np
import pytest

from magpend_core import jacobian, load_model, rates, sections
from magpend_core.engine.plain_python import plain
from magpend_core.engine.variational import with_tangents
from tests.core.cells import run_cells, scipy_end
from tests.core.flows import model_of

KEPT = {"n_transient": 0, "n_keep": 1, "rtol": 1e-10, "atol": 1e-10}


def declared(model, y, frequency=1.7, **values):
    """Edges and layers of a system, as plain numbers."""
    system, p = model.system, model.load(**values).pack()
    c, edges = np.zeros(system.n_constants), np.zeros((3, system.n_edges))
    plain(system.constants)(frequency, p, c)
    plain(system.edges)(frequency, p, *edges)
    u = plain(system.forcing)(0.13, tuple(c))
    dy = plain(system.rhs)(tuple(y), u, tuple(c))
    return edges, np.array(plain(system.layers)(tuple(y), dy, tuple(c)), float)


def test_pendulum__has_the_edges_and_layers_that_were_declared_by_hand():
    """Half-widths and jumps of friction and drive, from the text alone."""
    text, hand = load_model("pendulum-text"), load_model("pendulum-free")
    y = np.array([0.4, -0.3, 0.7, -0.2])
    for values in ({}, {"mu": 0.0, "T2": 0.1, "eps": 200.0, "duty_cycle": 0.3, "eps_drive": 20.0}):
        own = {n: v for n, v in text.load(**values).items() if n in hand.parameter_names}
        for found, wanted in zip(declared(text, y, **values), declared(hand, y, **own), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "value", "half_width", "jump"),
    [
        ("-a*atan(50*v)", 0.2, 1 / 50, 0.6 * math.pi),
        ("-a*2/pi*atan(b*(v - 1))", 0.8, 1 / 200, 1.2),
        ("-a*tanh(v/0.01)", 0.2, 0.01 * math.pi / 2, 1.2),
        ("a/(1 + exp(-b*x))", 0.3, math.pi / 200, 0.6),
        ("a/(exp(b*x) + 1)", 0.3, math.pi / 200, 0.6),
        ("a*v/sqrt(v**2 + 1e-4)", 0.2, 0.01, 1.2),
        ("a*v/sqrt(1/b**2 + v**2)", 0.2, 1 / 200, 1.2),
        ("-(a + x**2)*atan(50*v)", 0.2, 1 / 50, (0.6 + 0.09) * math.pi),
        ("-a*atan(-50*(v + 2*x))", 0.8, 1 / 50, 0.6 * math.pi),
    ],
)
def test_layers__have_the_width_and_the_jump_of_their_form(text, value, half_width, jump):
    model = model_of({"x": "v", "v": f"{text} - x"}, {"a": 0.6, "b": 200.0})
    (layer,) = model.derived.layers
    _, found = declared(model, [0.3, 0.2])
    (row,) = found
    assert abs(row[0]) == pytest.approx(value)
    assert row[2] == pytest.approx(half_width)
    assert row[3] == pytest.approx(1.0 / (half_width * jump))
    assert layer.steep.form
    # the rate of the value along the motion
    h = 1e-6
    x, v = 0.3, 0.2
    acceleration = rates(0.13, [[x, v]], model.load(), 1.7)[0, 1]
    _, ahead = declared(model, [x + h * v, v + h * acceleration])
    assert (ahead[0, 0] - row[0]) / h == pytest.approx(row[1], rel=1e-4)


@pytest.mark.parametrize(
    "text", ["atan(1 + x**2)", "tanh(exp(x))", "atan(a)", "tanh(cosh(v) + a)", "atan(a*sqrt(2 + x**2)/a)"]
)
def test_layers__are_not_where_the_argument_cannot_pass_zero(text):
    bound = {"a": {"value": 0.5, "bound": "positive"}}
    derived = model_of({"x": "v", "v": f"{text} - x"}, bound).derived
    assert (derived.layers, derived.waves, derived.switches) == ((), (), ())


@pytest.fixture(scope="module")
def shaken():
    """Friction on a shaken table: the layer is where the velocities are the same."""
    return model_of({"x": "v", "v": "-0.3*atan(k*(v - cos(2*pi*f*t))) - x"}, {"k": 2e3})


@pytest.mark.slow
def test_layers__may_move_with_time(shaken):
    system = shaken.system
    assert (len(shaken.derived.layers), shaken.derived.missed, system.timed_layers) == (1, (), True)
    c = np.zeros(system.n_constants)
    plain(system.constants)(0.4, shaken.load().pack(), c)
    ((value, rate, width, _),) = plain(system.layers)((0.1, 0.5), (0.5, -0.2, 0.7), tuple(c))
    omega = 2 * math.pi * 0.4
    assert value == pytest.approx(0.5 - math.cos(omega * 0.7))
    assert rate == pytest.approx(-0.2 + omega * math.sin(omega * 0.7))
    assert width == pytest.approx(1 / 2e3)
    y0, hidden = (
        np.random.default_rng(2).normal(size=(8, 2)),
        dataclasses.replace(system, name="hidden", has_layers=False),
    )
    found = [run_cells(s, shaken.load().pack(), 0.4, y0, n_transient=6) for s in (system, hidden)]
    np.testing.assert_allclose(found[0].section, found[1].section, atol=1e-5)
    with_layer, without = (int(f.n_rejected.sum()) for f in found)
    assert with_layer < 0.2 * without


@pytest.mark.slow
def test_layers__that_move_with_time_carry_tangents(shaken):
    extended = with_tangents(shaken.system, 2)
    start, packed, h = np.array([0.3, 0.2]), shaken.load(k=50.0).pack(), 1e-5
    whole = [[*start, 1.0, 0.0, 0.0, 1.0]]
    carried = run_cells(extended, packed, 0.4, whole, rtol=1e-10).section[0, 0, 0, 2:].reshape(2, 2)
    steps = h * np.array([[1.0, 0.0], [0.0, 1.0]])
    ends = run_cells(shaken.system, packed, 0.4, [*(start + steps), *(start - steps)], rtol=1e-10).section[:, 0, 0]
    np.testing.assert_allclose(carried, (ends[:2] - ends[2:]) / (2.0 * h), atol=1e-5)


def test_edges__of_a_smooth_wave_are_its_zeros():
    model = model_of({"x": "a*tanh(40*(cos(2*pi*f*t) - 0.3)) - x"}, {"a": 2.0})
    edges, _ = declared(model, [0.1], frequency=0.5)
    first = math.acos(0.3) / (2 * math.pi * 0.5)
    np.testing.assert_allclose(edges[0], [first, 2.0 - first], rtol=1e-12)
    slope = 40 * math.sin(math.acos(0.3)) * math.pi
    np.testing.assert_allclose(edges[1], math.pi / 2 / slope, rtol=1e-9)
    np.testing.assert_allclose(edges[2], 4.0)


# ---- jumps in time -------------------------------------------------------------------------------


def piecewise(levels, x):
    """Exact end of x' = level - x over stretches (length, level)."""
    for length, level in levels:
        x = level + (x - level) * math.exp(-length)
    return x


JUMPS = (
    "2*square(3*t*f + s, d) - square(t*f - s, e)*(1 + k)"
    " + where(phase < d, 0.5, where(phase <= e and phase > 0.1, -1, 4))"
)


@pytest.fixture(scope="module")
def jumping():
    """All that jumps in time, and time in two numbers, each times a parameter: one engine has it all."""
    tones = "tones*(cos(2*pi*f*t) + x*sin(2*pi*f*t))"
    text = f"jumps*({JUMPS}) + wave*square(t*f, duty) + saw*phase + {tones} - k*x"
    weights = dict.fromkeys(("jumps", "wave", "saw", "tones"), 0.0)
    return model_of({"x": text}, {"d": 0.3, "e": 0.6, "s": 0.37, "k": 1.0, "duty": 0.3, **weights})


@pytest.mark.slow
@pytest.mark.parametrize("duty", [0.3, 0.5, 0.9])
def test_square__is_followed_exactly(duty, jumping):
    assert model_of({"x": "square(t*f, d) - x"}, {"d": 0.3}).derived.missed == ()
    found = sections(jumping.load(duty=duty, wave=1.0), [0.7], [[0.2]], **KEPT)
    wanted = piecewise([(duty / 0.7, 1.0), ((1 - duty) / 0.7, -1.0)], 0.2)
    assert found.section[0, 0, 0] == pytest.approx(wanted, abs=1e-9)
    assert found.n_rejected[0] <= 2


@pytest.mark.slow
@pytest.mark.parametrize(("d", "e", "s"), [(0.3, 0.6, 0.37), (0.7, 0.2, -0.9), (0.5, 0.5, 2.6), (0.1, 0.95, 0.0)])
def test_jumps_in_time__are_followed_in_whatever_order_the_parameters_put_them(d, e, s, jumping):
    alone = model_of({"x": f"{JUMPS} - k*x"}, {"d": 0.3, "e": 0.6, "s": 0.37, "k": 1.0})
    assert alone.derived.n_edges == 12
    frequency = 0.7

    def level(share):
        def square(phase, duty):
            return 1.0 if phase % 1.0 < duty else -1.0

        third = 0.5 if share < d else (-1.0 if 0.1 < share <= e else 4.0)
        return 2 * square(3 * share + s, d) - 2 * square(share - s, e) + third

    turns = np.arange(-4, 8)
    breaks = np.concatenate([(turns - s) / 3, (turns + d - s) / 3, turns + s, turns + e + s, [0.0, 1.0, d, e, 0.1]])
    breaks = np.unique(breaks[(breaks >= 0.0) & (breaks <= 1.0)])
    levels = [((b - a) / frequency, level(0.5 * (a + b))) for a, b in itertools.pairwise(breaks)]
    found = sections(jumping.load(d=d, e=e, s=s, jumps=1.0), [frequency], [[0.2]], **KEPT)
    assert found.section[0, 0, 0] == pytest.approx(piecewise(levels, 0.2), abs=2e-9)


@pytest.mark.slow
def test_sawtooth__jumps_where_the_period_begins(jumping):
    """x' = phase - x: at time t exactly f (t - 1) + (x0 + f) exp(-t), anew in each period."""
    found = sections(jumping.load(saw=1.0), [0.5], [[0.2]], **{**KEPT, "n_transient": 2})
    wanted = 0.2
    for _ in range(3):
        wanted = 0.5 * (2.0 - 1.0) + (wanted + 0.5) * math.exp(-2.0)
    assert found.section[0, 0, 0] == pytest.approx(wanted, abs=1e-9)
    # x' = -x + cos(wt) + x sin(wt) by an exact integrating factor on a fine grid
    assert jumping.derived.forcing.op == "time"
    found = sections(jumping.load(tones=1.0), [1.0], [[0.5]], n_transient=0, n_keep=1, rtol=1e-11, atol=1e-11)
    with mpmath.workdps(20):
        w = 2 * mpmath.pi

        def factor(t):
            return mpmath.exp(t + (mpmath.cos(w * t) - 1) / w)

        wanted = (0.5 + mpmath.quad(lambda t: factor(t) * mpmath.cos(w * t), [0, 0.5, 1])) / factor(1)
    assert found.section[0, 0, 0] == pytest.approx(float(wanted), abs=1e-10)


# ---- corners and jumps on the state ----------------------------------------------------------------


CORNERS = {
    "abs(x)": abs,
    "max(x, 0.2)": lambda x: max(x, 0.2),
    "min(x, 0.2, -0.1)": lambda x: min(x, -0.1),
    "where(x > 0.3, 3*(x - 0.3), 0)": lambda x: max(3 * (x - 0.3), 0.0),
    "where(x > 0.3, x**1.5, 0.3**1.5)": lambda x: max(x, 0.3) ** 1.5,
    "where(x < -0.1 or x > 0.5, 1 + x, -2)": lambda x: 1 + x if x < -0.1 or x > 0.5 else -2.0,
    "sign(x)*x**2": lambda x: abs(x) * x,
}


@pytest.fixture(scope="module")
def cornered():
    """An oscillator with all corners, each times a parameter, and a ball on a floor, in one engine.

    It can rub in a layer, too, with functions besides: then the engine has all three to land on.
    """
    terms = [f"p{i}*({text})" for i, text in enumerate(CORNERS)]
    weights = {**{f"p{i}": 0.0 for i in range(len(CORNERS))}, "rub": 1e-9}
    layer = "rub*(tanh(20*v) + atan(3*v)*exp(-x**2)/(1 + log(2 + v**2)))"
    oscillator = {"x": "v", "v": f"cos(2*pi*f*t) - 0.1*v - {layer} - x - ({' + '.join(terms)})"}
    impacts = [{"of": "h", "direction": "down", "set": {"w": "-r*w", "n": "n + 1"}}]
    return model_of({**oscillator, "h": "w", "w": "-g", "n": "0"}, {**weights, "g": 0.0, "r": 0.5}, impacts=impacts)


@pytest.mark.slow
@pytest.mark.parametrize("text", CORNERS)
def test_corners__are_stepped_on(text, cornered):
    assert model_of({"x": "v", "v": f"cos(2*pi*f*t) - 0.1*v - x - {text}"}).derived.switches
    weight = {f"p{list(CORNERS).index(text)}": 1.0}
    found = sections(cornered.load(**weight), [0.2], [[0.5, -0.3, 1.0, 0.0, 0.0]], **KEPT)
    omega = 2 * math.pi * 0.2

    def rates(t, y):
        return [y[1], math.cos(omega * t) - 0.1 * y[1] - y[0] - CORNERS[text](y[0])]

    # independent: short stretches of DOP853, which finds the corners by its step control
    wanted = scipy_end(rates, [0.5, -0.3], 5.0, max_step=2e-3)
    np.testing.assert_allclose(found.section[0, 0, :2], wanted, atol=3e-5 if "or" in text else 2e-7)
    # no corner is found by trial: hardly a step is rejected but to land
    assert found.n_rejected[0] < 60


def test_switches__are_one_where_they_can_be():
    derived = model_of({"x": "v", "v": "-sign(v) - abs(-v) - max(2*v, 0) + where(v < 0, 1, 2)"}).derived
    assert len(derived.switches) == 1
    assert derived.sliding.slides == (True,)
    narrow = model_of({"x": "v", "v": "-atan(1000*v)*exp(-abs(v)) - x"}).derived
    assert (len(narrow.layers), len(narrow.switches)) == (1, 0)
    wide = model_of({"x": "v", "v": "-atan(v)*exp(-abs(v)) - x"}).derived
    assert (len(wide.layers), len(wide.switches)) == (1, 1)
    assert model_of({"x": "square(a*t*f, 0.5) - x"}, {"a": 2.0}).derived.missed == ("square",)


@pytest.fixture(scope="module")
def rubbing():
    """A body that lies on another one, on a spring and on a belt: one engine for all that sticks."""
    rubbed = "mu1*sign(v1 - v2)"
    ground = "mu2*sign(v2 - belt - where(phase < 0.5, jump, -jump))"
    # as strong as this, the upper body goes with the lower one, which doubles the mass
    rest = {"p": 0.0, "q": 0.0, "mu1": 5.0, "mu2": 1.0, "m": 1.0, "k": 0.0, "belt": 0.0, "jump": 0.0}
    model = model_of({"x": "v2", "v1": f"p - {rubbed}", "v2": f"(q - k*x + {rubbed} - {ground})/m"}, rest)
    assert model.derived.sliding.slides == (True, True)
    return model


@pytest.mark.slow
def test_switch__whose_surface_jumps_with_time_is_on_the_right_side_of_it(rubbing):
    """A body rubbed by a belt that runs forth and back: v' = mu towards the belt's velocity."""
    start = [[0.0, 0.0, 0.0], [0.0, -0.3, -0.3]]
    found = sections(rubbing.load(mu2=2 * 0.5, jump=1.0), [0.5, 0.5], start, **KEPT)
    np.testing.assert_allclose(found.section[:, 0, 1:], [[0.0, 0.0], [-0.3, -0.3]], atol=1e-10)
    # with more friction it gets to the belt's velocity and sticks to it, both times
    stuck = sections(rubbing.load(mu2=2 * 3.0, jump=1.0), [0.5], [[0.0, 0.1, 0.1]], **KEPT)
    np.testing.assert_allclose(stuck.section[0, 0, 1:], -1.0, atol=1e-10)


@pytest.mark.slow
def test_sticking__is_exact(rubbing):
    """A mass on a belt, stuck until the spring pulls as hard as friction: x = x0 + belt t, then slipping."""
    alone = model_of({"x": "v", "v": "-x - mu*sign(v - belt)"}, {"mu": 0.4, "belt": 0.1})
    assert alone.derived.sliding.slides == (True,)
    pulled, start = rubbing.load(k=2 * 1.0, mu2=2 * 0.4, belt=0.1), [[-0.1, 0.1, 0.1]]
    stuck = sections(pulled, [1 / 3.0], start, **KEPT)
    np.testing.assert_allclose(stuck.section[0, 0], [-0.1 + 0.3, 0.1, 0.1], atol=1e-12)
    # it lets go at x = mu, after 5 s, with velocity belt; then x = mu + belt sin(t - 5)
    slipped = sections(pulled, [1 / 6.0], start, **KEPT)
    x, v = 0.4 + 0.1 * math.sin(1.0), 0.1 * math.cos(1.0)
    np.testing.assert_allclose(slipped.section[0, 0], [x, v, v], atol=1e-9)


@pytest.mark.slow
def test_sticking__of_two_bodies_on_one_another_is_exact(rubbing):
    """Two masses pulled apart with less than friction can hold move as one: a = (p + q)/(m1 + m2).

    Both surfaces at once, each acting on the other: the lower one stands on the ground.
    """
    bodies = rubbing.load(p=0.3, mu1=0.5, mu2=0.6, m=2.0)
    at_rest = sections(bodies, [1.0], [[0.0, 0.0, 0.0]], **KEPT)
    np.testing.assert_allclose(at_rest.section[0, 0], 0.0, atol=1e-12)
    # pulled harder the two slide on the ground together
    together = sections(bodies.replace(q=0.6), [1.0], [[0.0, 0.2, 0.2]], **KEPT)
    np.testing.assert_allclose(together.section[0, 0, 1:], 0.2 + (0.3 + 0.6 - 0.6) / 3.0, atol=1e-12)


@pytest.mark.parametrize(
    ("mu1", "mu2", "start", "end"),
    [
        (0.0, 0.0, [0.0, 0.5, -0.4], [-0.4 + 0.05, 0.5 + 0.3, -0.4 + 0.1]),
        (0.0, 0.6, [0.0, -0.1, 0.0], [0.0, -0.1 + 0.3, 0.0]),  # the lower one sticks to the ground
        (5.0, 0.0, [0.0, 0.0, 0.0], [0.25 / 3.0, 0.5 / 3.0, 0.5 / 3.0]),  # the two are one
    ],
)
def test_sticking__without_friction_there_is_none(rubbing, mu1, mu2, start, end):
    slippery = rubbing.load(p=0.3, q=0.2, mu1=mu1, mu2=mu2, m=2.0)
    found = sections(slippery, [1.0], [start], **KEPT)
    np.testing.assert_allclose(found.section[0, 0], end, atol=1e-12)


@pytest.mark.slow
def test_impacts__set_what_the_text_sets(cornered):
    """A ball on the floor: the time of flight after each bounce is r times that before."""
    assert len(cornered.derived.impacts) == 1
    first = math.sqrt(2.0 / 9.81)
    speed = 9.81 * first
    end = first + 2 * 0.5 * speed / 9.81 + 0.1  # after two bounces
    found = sections(cornered.load(g=9.81), [1.0 / end], [[0.5, -0.3, 1.0, 0.0, 0.0]], **KEPT)
    w = 0.25 * speed
    wanted = [w * 0.1 - 0.5 * 9.81 * 0.01, w - 0.981, 2.0]
    np.testing.assert_allclose(found.section[0, 0, 2:], wanted, atol=1e-9)


@pytest.mark.slow
def test_jacobian__beside_a_corner_is_that_of_its_side():
    model = model_of({"x": "v", "v": "-x*abs(x) - v*where(v > 0, 2, 3) - 0.1*sign(v)"})
    found = jacobian(0.0, [[0.5, 0.2], [-0.5, -0.2]], model.load(), 1.0)
    np.testing.assert_allclose(found[:, 1], [[-1.0, -2.0], [-1.0, -3.0]])


EVERYTHING = {
    "cornered": {**{f"p{i}": 1.0 for i in range(len(CORNERS))}, "rub": 0.1, "g": 0.5, "r": 1.0},
    "rubbing": {"p": 0.3, "q": 0.6, "mu1": 0.5, "mu2": 0.6, "m": 2.0, "k": 1.0, "belt": 0.1, "jump": 0.3},
    "jumping": {"jumps": 1.0, "wave": 1.0, "saw": 1.0, "tones": 0.5},
    "shaken": {},
}
"""Parameters with which all that a model here has takes part."""


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERYTHING)
def test_sections__of_a_text_are_the_same_bits_alone_and_among_others(name, request):
    parameters = request.getfixturevalue(name).load(**EVERYTHING[name])
    y0 = np.random.default_rng(8).normal(size=(41, len(parameters.model.states)))
    y0[:, 2:3] = np.abs(y0[:, 2:3])  # the ball begins above the floor
    frequency = np.linspace(0.1, 0.4, 41)
    keywords = {"n_transient": 5, "n_keep": 3, "rtol": 1e-8, "atol": 1e-8}
    together = sections(parameters, frequency, y0, **keywords)
    assert np.isfinite(together.section).all()
    for i in (0, 7, 40):
        alone = sections(parameters, frequency[[i]], y0[[i]], n_lanes=1, **keywords)
        np.testing.assert_array_equal(alone.section[0], together.section[i])
        assert alone.n_steps[0] == together.n_steps[i]
    if name == "cornered":  # one engine more
        watched = sections(parameters, frequency, y0, quantities=["x"], **keywords)
        np.testing.assert_array_equal(watched.section, together.section)


# ---- what the engine is told: whether layers fade; quotients by roots without divisions


def oscillator(force):
    return model_of({"x": "v", "v": force}, {"k": 1e3, "e": 0.01})


@pytest.mark.parametrize(
    ("force", "fades"),
    [
        ("-x - tanh(k*v)", True),
        ("-x - 1/(1 + exp(-k*v))", True),
        ("-x - atan(k*v)", False),
        ("-x - v/sqrt(v**2 + e**2)", False),
        ("-x - tanh(k*v) - atan(k*x)", False),
    ],
)
def test_system_of__layers_fade_if_all_of_them_do(force, fades):
    system = oscillator(force).system
    assert system.has_layers
    assert system.layers_fade is fades


def test_source__quotients_by_roots_have_no_divisions():
    force = "-x/(1 + v**2)**1.5 - v/sqrt(2 + x**2) + (3 + x*x)**-2.5 + 2/(4 + x*x)**2.5"
    model = oscillator(force)
    rhs = model.source.text.split("def rhs")[1].split("def ")[0]
    assert rhs.count("inverse_sqrt") == 4
    assert " / " not in rhs
    assert "sqrt(" not in rhs.replace("inverse_sqrt(", "")
    states = np.random.default_rng(0).uniform(-2.0, 2.0, (50, 2))
    x, v = states.T
    wanted = -x / (1 + v**2) ** 1.5 - v / np.sqrt(2 + x**2) + (3 + x * x) ** -2.5 + 2 / (4 + x * x) ** 2.5
    # a handful of roundings
    assert np.allclose(rates(0.0, states, model.load(), 1.0)[:, 1], wanted, rtol=5e-15, atol=1e-15)
    model = oscillator("-x/sqrt(x**2)")
    assert not np.isfinite(rates(0.0, [[0.0, 1.0]], model.load(), 1.0)[0, 1])
