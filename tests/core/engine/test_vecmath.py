"""Elementary functions against 40-digit arithmetic, for numbers and for groups of lanes."""

import math

import mpmath
import numpy as np
import pytest
from numba import njit

from magpend_core.engine import vecmath
from magpend_core.engine.jit import OPTIONS
from magpend_core.engine.plain_python import plain
from magpend_core.engine.simd import WIDTH, load, store_rows
from tests.core.engine.test_fusing import interpreted, same_bits

EXPRESSIONS = {
    **{name: f"{name}(v)" for name in ("exp", "sin", "cos", "tan", "atan", "asin", "acos", "tanh", "sinh", "cosh")},
    **{name: f"{name}(v)" for name in ("log", "expm1", "sign", "wrapped", "inverse_sqrt")},
    **{name: f"{name}(v)" for name in ("log2_rough", "exp2_rough", "exp2_falling")},
    "sine of sincos": "sincos(v)[0]",
    "cosine of sincos": "sincos(v)[1]",
    "hypot_rough": "hypot_rough(v, 1.0)",
    "square_wave": "square_wave(v, 0.3)",
    "power 1.5": "power(v, 1.5)",
    "power -0.3": "power(v, -0.3)",
    "power 17.3": "power(v, 17.3)",
    "atan2 of 0.7": "atan2(0.7, v)",
    "atan2 by -0.4": "atan2(v, -0.4)",
}
NAMES = tuple(EXPRESSIONS)
power, atan2, sign, square_wave = vecmath.power, vecmath.atan2, vecmath.sign, vecmath.square_wave
_SCOPE = dict(vars(vecmath))
exec(f"def of_number(v):\n    return {', '.join(EXPRESSIONS.values())}", _SCOPE)
_of_number = njit(**OPTIONS)(_SCOPE["of_number"])


@njit(**OPTIONS)
def _of_lanes(x, out):
    n = len(x)
    for i in range(0, n, WIDTH):
        store_rows(out, i * len(NAMES), _of_number(load(x, i)))


def evaluate(x):
    """All functions at all points, from groups of lanes: name to values."""
    x = np.asarray(x, np.float64)
    padded = np.resize(x, -(-len(x) // WIDTH) * WIDTH)
    out = np.zeros(len(NAMES) * len(padded))
    _of_lanes(padded, out)
    rows = out.reshape(-1, len(NAMES), WIDTH).transpose(1, 0, 2).reshape(len(NAMES), -1)
    return {name: row[: len(x)] for name, row in zip(NAMES, rows, strict=True)}


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
EXP_RANGES = ((-1e-6, 1e-6), (-0.4, 0.4), (0.0, 1.0), (-3.0, 3.0), (-20.0, 20.0), (-700.0, 700.0))
ARC_RANGES = ((-1e-6, 1e-6), (-0.5, 0.5), (0.49, 0.53), (-1.0, 1.0), (0.99, 1.0), (-1.0, -0.99))
POWER_RANGES = ((1e-6, 1.0), (0.5, 2.0), (0.7, 0.72), (1.35, 1.45), (0.99, 1.01), (0.0, 100.0), (1e16, 1e17))
CASES = {
    "tan": (mpmath.tan, 3.0, SINE_RANGES),
    "tanh": (mpmath.tanh, 4.0, EXP_RANGES),
    "sinh": (mpmath.sinh, 2.5, EXP_RANGES),
    "cosh": (mpmath.cosh, 1.5, EXP_RANGES),
    "expm1": (mpmath.expm1, 2.0, EXP_RANGES),
    "asin": (mpmath.asin, 2.5, ARC_RANGES),
    "acos": (mpmath.acos, 1.5, ARC_RANGES),
    "power 1.5": (lambda x: x ** mpmath.mpf(1.5), 1.0, (*POWER_RANGES, (1e-200, 1e-190))),
    "power -0.3": (lambda x: x ** mpmath.mpf(-0.3), 1.0, (*POWER_RANGES, (1e-300, 1e-290))),
    "power 17.3": (lambda x: x ** mpmath.mpf(17.3), 2.5, (*POWER_RANGES, (1e-17, 1e-16))),
    "atan2 of 0.7": (
        lambda x: mpmath.atan2(mpmath.mpf(0.7), x),
        3.0,
        ((-1e-6, 1e-6), (-1.0, 1.0), (0.2, 0.4), (1.6, 1.8), (-10.0, 10.0), (-1e5, 1e5)),
    ),
    "atan2 by -0.4": (
        lambda x: mpmath.atan2(x, mpmath.mpf(-0.4)),
        1.6,
        ((-1e-6, 1e-6), (-1.0, 1.0), (0.1, 0.2), (-10.0, 10.0), (-1e5, 1e5)),
    ),
    "inverse_sqrt": (
        lambda x: 1 / mpmath.sqrt(x),
        1.5,
        ((1e-6, 1.0), (0.5, 2.0), (1.0, 4.0), (0.0, 100.0), (1e-300, 1e-290), (1e290, 1e300)),
    ),
    "exp": (mpmath.exp, 1.0, ((-1.0, 1.0), (-20.0, 20.0), (-700.0, 700.0), (-1e-6, 1e-6))),
    "sine of sincos": (mpmath.sin, 1.6, SINE_RANGES),
    "cosine of sincos": (mpmath.cos, 1.6, SINE_RANGES),
    "sin": (mpmath.sin, 2.0, SINE_RANGES),
    "cos": (mpmath.cos, 2.0, SINE_RANGES),
    "exp2_falling": (lambda x: mpmath.mpf(2) ** x, 1.0, ((-1.0, 0.0), (-20.0, 0.0), (-1000.0, 0.0), (-1e-6, 0.0))),
    "log": (mpmath.log, 1.0, ((0.5, 2.0), (0.99, 1.01), (1e-6, 1e6), (1e-300, 1e-290), (5e-324, 2e-308))),
    "atan": (
        mpmath.atan,
        3.5,
        ((-0.42, 0.42), (0.198, 0.21), (0.66, 0.7), (1.49, 1.55), (5.0, 5.1), (-3.0, 3.0), (-1e3, 1e3), (-1e-6, 1e-6)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_vecmath__errors_are_within_the_stated_bound(name):
    # the bounds are those of the module's docstring
    function, bound, ranges = CASES[name]
    x = points(*ranges)
    assert worst_ulps(x, evaluate(x)[name], function) < bound


@pytest.mark.parametrize("name", ["atan", "log"])
def test_vecmath__over_all_magnitudes(name):
    x, (function, bound, _) = 10.0 ** points((-300.0, 300.0)), CASES[name]
    assert worst_ulps(x, evaluate(x)[name], function) < bound


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


@pytest.mark.slow
def test_vecmath__numbers_lanes_and_an_interpreter_have_the_same_bits():
    x = np.concatenate([points((0.0, 1.0), (0.3, 3.0), (0.0, 700.0)), 10.0 ** points((-300.0, 2.8))])
    x = np.concatenate([x, -x])
    x = np.concatenate([x, [0.0, -0.0, 0.5, -0.5, 1.0, -1.0, 5e-324, np.inf, -np.inf]])
    lanes = np.array(list(evaluate(x).values()))
    numbers = np.array([_of_number(v) for v in x]).T
    same = (lanes.view(np.int64) == numbers.view(np.int64)) | (np.isnan(lanes) & np.isnan(numbers))
    # the rough logarithm is for positive numbers only
    rough = np.array([name == "log2_rough" for name in NAMES])
    positive = (x > 0.0) & np.isfinite(x)
    assert same[~rough].all()
    assert same[rough][:, positive].all()
    # products are fused by the rule: an interpreter knows no compiler
    some = np.random.default_rng(6).permutation(len(x))[:700]
    expected = np.array([interpreted(_of_number)(v) for v in x[some].tolist()]).T
    follows = same_bits(lanes[:, some], expected)
    assert follows[~rough].all(), np.array(NAMES)[~follows.all(axis=1)]
    assert follows[rough][:, positive[some]].all()


@pytest.mark.parametrize("name", ["tan", "tanh", "sinh", "cosh", "expm1", "asin", "acos", "log", "exp"])
def test_vecmath__in_plain_python_is_the_same_function(name):
    # products and sums round twice there
    x = points((0.0, 1.0))
    values = plain(getattr(vecmath, name))(x)
    assert np.allclose(values, evaluate(x)[name], rtol=1e-14, atol=0.0)
    number = plain(getattr(vecmath, name))(x[0])
    assert np.ndim(number) == 0


@pytest.mark.parametrize("x", [np.array([0.7, 0.0, -1.0, np.inf, np.nan, 1e-310, 30.0])])
def test_plain_python__of_powers_signs_and_angles(x):
    at = evaluate(x)
    plain_power, plain_atan2 = plain(power), plain(atan2)
    for y in (1.5, -0.3, 17.3):
        assert np.allclose(plain_power(x, y), at[f"power {y}"], rtol=1e-13, atol=0.0, equal_nan=True)
    finite = x[np.isfinite(x)]
    assert np.allclose(plain_atan2(0.7, finite), np.arctan2(0.7, finite), rtol=1e-14)
    assert plain(sign)(x)[:3].tolist() == [1.0, 0.0, -1.0]
    assert plain(square_wave)(np.array([0.1, 0.3, 0.9, 1.1, -0.8, -0.1]), 0.3).tolist() == [1, -1, -1, 1, 1, -1]


HALF, BEYOND, INF, NAN = math.pi / 2, 1.0000000000000002, math.inf, math.nan
ENDS = {
    "atan": ([INF, -INF, 1e300, 1.0, -1.0], [HALF, -HALF, HALF, HALF / 2, -HALF / 2]),
    "log": ([0.0, -0.0, -1.0, -INF, INF, 1.0], [-INF, -INF, NAN, NAN, INF, 0.0]),
    "power 1.5": ([0.0, -0.0, -2.0, INF, 1.0], [0.0, 0.0, NAN, INF, 1.0]),
    "power -0.3": ([0.0, -0.0, -2.0, INF, 1.0], [INF, INF, NAN, 0.0, 1.0]),
    "asin": ([1.0, -1.0, 0.0, BEYOND, -7.0], [HALF, -HALF, 0.0, NAN, NAN]),
    "acos": ([1.0, -1.0, 0.0, BEYOND, -7.0], [0.0, math.pi, HALF, NAN, NAN]),
    "tanh": ([0.0, 800.0, -800.0, 1e-310, INF], [0.0, 1.0, -1.0, 1e-310, 1.0]),
    "sinh": ([0.0, 1e-310], [0.0, 1e-310]),
    "exp": ([0.0, -0.0], [1.0, 1.0]),
    "exp2_falling": ([0.0, -0.0, -1000.0, -1e300, -INF, -3.0], [1.0, 1.0, *[2.0**-1000] * 3, 0.125]),
    "inverse_sqrt": ([0.0, -0.0, -1.0, 1e-310], [NAN] * 4),
    "sign": ([0.0, -0.0, 3.0, -1e-320, INF], [0.0, 0.0, 1.0, -1.0, 1.0]),
    "square_wave": ([0.0, 0.29, 0.3, 0.9999, 1.0, -0.75, -0.5, 12.2], [1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0]),
}


@pytest.mark.parametrize("name", ENDS)
def test_vecmath__ends_and_domain(name):
    x, expected = ENDS[name]
    np.testing.assert_array_equal(evaluate(x)[name], expected)


def test_vecmath__limits():
    exp, log, huge = (evaluate([1000.0, INF, 700.0, -1000.0, -INF, -700.0, v]) for v in (0.0, 5e-324, 1e300))
    assert (exp["exp"][:3] == exp["exp"][2]).all()
    assert (exp["exp"][3:6] == exp["exp"][5]).all()
    assert exp["exp"][[2, 5]] == pytest.approx([math.exp(700.0), math.exp(-700.0)], rel=1e-15)
    assert log["log"][-1] == pytest.approx(-1074.0 * math.log(2.0), rel=1e-15)
    assert huge["power 1.5"][-1] == exp["exp"][0]
    assert exp["sinh"][0] == -exp["sinh"][3] == exp["cosh"][0] == exp["cosh"][1]
    assert not np.isfinite(exp["inverse_sqrt"][1])
    for name in ("tanh", "sinh", "asin", "atan"):
        assert math.copysign(1.0, evaluate([-0.0])[name][0]) == -1.0, name
    ends = [(0.0, 1.0), (0.0, -1.0), (-0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 0.0), (1e-300, 1e-300)]

    @njit(**OPTIONS)
    def of_pairs(y, x):
        return [atan2(y[i], x[i]) for i in range(len(x))]

    y, x = np.array(ends).T
    assert of_pairs(y, x) == [math.atan2(*pair) for pair in ends]


def test_vecmath__signs_zeros_and_nan():
    x = np.concatenate([points((0.0, 10.0)), [0.0, 1e-310, 1e-20]])
    right, left = evaluate(x), evaluate(-x)
    for name in ("sin", "atan", "sine of sincos", "tan", "tanh", "sinh"):
        assert (right[name] == -left[name]).all(), name
    for name in ("cosine of sincos", "cosh"):
        assert (right[name] == left[name]).all(), name
    assert (right["sin"][-3:] == x[-3:]).all()
    assert (right["atan"][-3:] == x[-3:]).all()
    values = evaluate([np.nan])
    for name in set(NAMES) - {"log2_rough", "exp2_rough", "exp2_falling", "hypot_rough", "square_wave"}:
        assert np.isnan(values[name]).all(), name


def test_rough_functions__are_within_their_bounds():
    x = np.concatenate([10.0 ** points((-300.0, 300.0)), points((0.5, 4.0))])
    error = abs(evaluate(x)["log2_rough"] - np.log2(x))
    assert error.max() < 5e-4
    # exact at powers of two, so that a tolerance met exactly is met
    powers = 2.0 ** np.arange(-1000, 1000, 37)
    assert (evaluate(powers)["log2_rough"] == np.log2(powers)).all()
    x = points((-999.0, 999.0), (-2.0, 2.0))
    assert abs(evaluate(x)["exp2_rough"] / np.exp2(x) - 1.0).max() < 8e-4
    whole = np.arange(-1000.0, 1001.0, 8.0)
    assert (evaluate(whole)["exp2_rough"] == np.exp2(whole)).all()
    x = np.concatenate([points((0.0, 1.0), (0.0, 20.0)), [0.0, np.inf]])
    values = evaluate(x)["hypot_rough"]
    assert abs(values[:-1] / np.hypot(x[:-1], 1.0) - 1.0).max() < 0.022
    assert values[-1] == np.inf


def test_wrapped__takes_off_whole_turns():
    x = points((-4.0, 4.0), (-100.0, 100.0), (-1e4, 1e4))
    values = evaluate(x)["wrapped"]
    # 2 pi is taken as the nearest number, 2.5e-16 off; so are the ends of the interval
    assert abs(values).max() <= math.pi + 1e-15 * 1e4
    turns = (x - values) / (2.0 * math.pi)
    assert abs(turns - np.round(turns)).max() < 1e-12
    inside = abs(x) < math.pi
    assert (values[inside] == x[inside]).all()
