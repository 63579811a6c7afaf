"""Elementary functions against 40-digit arithmetic, for numbers and for groups of lanes."""

import math

import mpmath
import numpy as np
import pytest
from numba import njit

from magpend_core.engine import vecmath
from magpend_core.engine.jit import OPTIONS
from magpend_core.engine.simd import WIDTH, load, store

NAMES = (
    "exp",
    "sine of sincos",
    "cosine of sincos",
    "sin",
    "atan",
    "log2_rough",
    "exp2_rough",
    "wrapped",
    "log",
    "cos",
    "exp2_falling",
    "hypot_rough",
)
exp, sincos, sin, atan = vecmath.exp, vecmath.sincos, vecmath.sin, vecmath.atan
log, cos, exp2_falling, hypot_rough = vecmath.log, vecmath.cos, vecmath.exp2_falling, vecmath.hypot_rough
log2_rough, exp2_rough, wrapped = vecmath.log2_rough, vecmath.exp2_rough, vecmath.wrapped


@njit(**OPTIONS)
def _of_lanes(x, out):
    n = len(x)
    for i in range(0, n, WIDTH):
        v = load(x, i)
        sine, cosine = sincos(v)
        store(out, i, exp(v))
        store(out, n + i, sine)
        store(out, 2 * n + i, cosine)
        store(out, 3 * n + i, sin(v))
        store(out, 4 * n + i, atan(v))
        store(out, 5 * n + i, log2_rough(v))
        store(out, 6 * n + i, exp2_rough(v))
        store(out, 7 * n + i, wrapped(v))
        store(out, 8 * n + i, log(v))
        store(out, 9 * n + i, cos(v))
        store(out, 10 * n + i, exp2_falling(v))
        store(out, 11 * n + i, hypot_rough(v, 1.0))


@njit(**OPTIONS)
def _of_number(v):
    sine, cosine = sincos(v)
    return (
        exp(v), sine, cosine, sin(v), atan(v), log2_rough(v), exp2_rough(v), wrapped(v), log(v),
        cos(v), exp2_falling(v), hypot_rough(v, 1.0),
    )  # fmt: skip


def evaluate(x):
    """All functions at all points, from groups of lanes: name to values."""
    x = np.asarray(x, np.float64)
    padded = np.resize(x, -(-len(x) // WIDTH) * WIDTH)
    out = np.zeros(len(NAMES) * len(padded))
    _of_lanes(padded, out)
    return {name: row[: len(x)] for name, row in zip(NAMES, out.reshape(len(NAMES), -1), strict=True)}


def worst_ulps(x, values, function):
    """Largest error in units in the last place of the exact value."""
    worst = 0.0
    with mpmath.workdps(40):
        for argument, value in zip(x.tolist(), values.tolist(), strict=True):
            exact = function(mpmath.mpf(argument))
            error = abs(mpmath.mpf(value) - exact)
            worst = max(worst, float(error / mpmath.mpf(float(np.spacing(abs(float(exact)))))))
    return worst


def points(*ranges, n=3000):
    rng = np.random.default_rng(7)
    return np.concatenate([rng.uniform(low, high, n) for low, high in ranges])


# where the functions are worst: atan just above tan(pi/8), the sines where a reduction ends
SINE_RANGES = ((-0.79, 0.79), (-3.2, 3.2), (1.4, 1.8), (-30.0, 30.0), (-1e4, 1e4))
CASES = {
    "exp": (mpmath.exp, 1.0, ((-1.0, 1.0), (-20.0, 20.0), (-700.0, 700.0), (-1e-6, 1e-6))),
    "sine of sincos": (mpmath.sin, 1.6, SINE_RANGES),
    "cosine of sincos": (mpmath.cos, 1.6, SINE_RANGES),
    "sin": (mpmath.sin, 2.0, SINE_RANGES),
    "cos": (mpmath.cos, 2.0, SINE_RANGES),
    "exp2_falling": (
        lambda x: mpmath.mpf(2) ** x,
        1.0,
        ((-1.0, 0.0), (-20.0, 0.0), (-1000.0, 0.0), (-1e-6, 0.0)),
    ),
    "log": (mpmath.log, 1.0, ((0.5, 2.0), (0.99, 1.01), (1e-6, 1e6), (1e-300, 1e-290))),
    "atan": (
        mpmath.atan,
        3.5,
        (
            (-0.42, 0.42),
            (0.198, 0.21),
            (0.66, 0.7),
            (1.49, 1.55),
            (5.0, 5.1),
            (-3.0, 3.0),
            (-1e3, 1e3),
            (-1e-6, 1e-6),
        ),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_vecmath__errors_are_within_the_stated_bound(name):
    # the bounds are those of the module's docstring
    function, bound, ranges = CASES[name]
    x = points(*ranges)
    assert worst_ulps(x, evaluate(x)[name], function) < bound


def test_atan__over_all_magnitudes():
    x = 10.0 ** points((-300.0, 300.0))
    assert worst_ulps(x, evaluate(x)["atan"], mpmath.atan) < 3.5


@pytest.mark.parametrize(
    ("name", "function", "first"),
    [
        ("sine of sincos", mpmath.sin, 2),
        ("sin", mpmath.sin, 2),
        ("cosine of sincos", mpmath.cos, 1),
        ("cos", mpmath.cos, 1),
    ],
)
def test_sines__near_their_zeros_lose_only_the_rest_of_pi(name, function, first):
    # the two parts of pi/2 leave out 4e-27, so n of them n * 4e-27: at most 3e-27 |x|
    x = np.arange(first, 40_000, 2) * (np.pi / 2)
    values = evaluate(x)[name]
    with mpmath.workdps(40):
        for argument, value in zip(x[::7].tolist(), values[::7].tolist(), strict=True):
            assert abs(mpmath.mpf(value) - function(mpmath.mpf(argument))) < 3e-27 * argument + 1e-42


def test_vecmath__numbers_and_lanes_have_the_same_bits():
    x = np.concatenate([points((0.0, 1.0), (0.3, 3.0), (0.0, 700.0)), 10.0 ** points((-300.0, 2.8))])
    x = np.concatenate([x, -x])
    lanes = np.array(list(evaluate(x).values()))
    numbers = np.array([_of_number(v) for v in x]).T
    positive = x > 0.0
    assert (lanes[:, positive].view(np.int64) == numbers[:, positive].view(np.int64)).all()
    # logarithms are for positive numbers only
    rest = np.array([name not in ("log2_rough", "log") for name in NAMES])
    assert (lanes[rest][:, ~positive].view(np.int64) == numbers[rest][:, ~positive].view(np.int64)).all()


def test_exp__limits_and_special_values():
    x = np.array([0.0, -0.0, 1000.0, np.inf, 700.0, -1000.0, -np.inf, -700.0])
    values = evaluate(x)["exp"]
    assert (values[:2] == 1.0).all()
    assert (values[2:5] == values[4]).all()
    assert values[4] == pytest.approx(math.exp(700.0), rel=1e-15)
    assert (values[5:] == values[7]).all()
    assert values[7] == pytest.approx(math.exp(-700.0), rel=1e-15)


def test_odd_functions__keep_signs_and_zeros():
    x = np.concatenate([points((0.0, 10.0)), [0.0, 1e-310, 1e-20]])
    right, left = evaluate(x), evaluate(-x)
    for name in ("sin", "atan", "sine of sincos"):
        assert (right[name] == -left[name]).all(), name
    assert (right["cosine of sincos"] == left["cosine of sincos"]).all()
    assert (np.copysign(1.0, evaluate([-0.0])["atan"]) == -1.0).all()
    assert (right["sin"][-3:] == x[-3:]).all()
    assert (right["atan"][-3:] == x[-3:]).all()


def test_atan__ends_at_a_quarter_turn():
    values = evaluate([np.inf, -np.inf, 1e300, 1.0, -1.0])["atan"]
    assert values.tolist() == [math.pi / 2, -math.pi / 2, math.pi / 2, math.pi / 4, -math.pi / 4]


def test_sines__square_sum_and_quadrants():
    values = evaluate(points((-50.0, 50.0)))
    sine, cosine = values["sine of sincos"], values["cosine of sincos"]
    assert abs(sine**2 + cosine**2 - 1.0).max() < 1e-15
    at = evaluate(np.arange(-8, 9) * (np.pi / 2))
    quarter = np.arange(-8, 9) % 4
    assert np.allclose(at["sine of sincos"], np.array([0.0, 1.0, 0.0, -1.0])[quarter], atol=2e-15)
    assert np.allclose(at["cosine of sincos"], np.array([1.0, 0.0, -1.0, 0.0])[quarter], atol=2e-15)


def test_nan__stays_nan_in_sines_and_atan():
    values = evaluate([np.nan])
    for name in ("sine of sincos", "cosine of sincos", "sin", "cos", "atan", "wrapped"):
        assert np.isnan(values[name]).all(), name


def test_log__over_all_magnitudes():
    x = np.concatenate([10.0 ** points((-300.0, 300.0)), [1.0]])
    values = evaluate(x)["log"]
    assert worst_ulps(x[:-1], values[:-1], mpmath.log) < 1.0
    assert values[-1] == 0.0


def test_log2_rough__is_within_5e_4():
    x = np.concatenate([10.0 ** points((-300.0, 300.0)), points((0.5, 4.0))])
    error = abs(evaluate(x)["log2_rough"] - np.log2(x))
    assert error.max() < 5e-4
    # exact at powers of two, so that a tolerance met exactly is met
    powers = 2.0 ** np.arange(-1000, 1000, 37)
    assert (evaluate(powers)["log2_rough"] == np.log2(powers)).all()


def test_exp2_rough__is_within_8e_4():
    x = points((-999.0, 999.0), (-2.0, 2.0))
    assert abs(evaluate(x)["exp2_rough"] / np.exp2(x) - 1.0).max() < 8e-4
    whole = np.arange(-1000.0, 1001.0, 8.0)
    assert (evaluate(whole)["exp2_rough"] == np.exp2(whole)).all()


def test_hypot_rough__is_within_2_percent():
    x = np.concatenate([points((0.0, 1.0), (0.0, 20.0)), [0.0, np.inf]])
    values = evaluate(x)["hypot_rough"]
    assert abs(values[:-1] / np.hypot(x[:-1], 1.0) - 1.0).max() < 0.022
    assert values[-1] == np.inf


def test_exp2_falling__limits_and_special_values():
    values = evaluate([0.0, -0.0, -1000.0, -1e300, -np.inf, -3.0])["exp2_falling"]
    assert values.tolist() == [1.0, 1.0, *[2.0**-1000] * 3, 0.125]


def test_wrapped__takes_off_whole_turns():
    x = points((-4.0, 4.0), (-100.0, 100.0), (-1e4, 1e4))
    values = evaluate(x)["wrapped"]
    # 2 pi is taken as the nearest number, 2.5e-16 off; so are the ends of the interval
    assert abs(values).max() <= math.pi + 1e-15 * 1e4
    turns = (x - values) / (2.0 * math.pi)
    assert abs(turns - np.round(turns)).max() < 1e-12
    inside = abs(x) < math.pi
    assert (values[inside] == x[inside]).all()
