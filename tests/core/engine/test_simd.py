"""Each primitive has three forms: plain Python on arrays, compiled for a number, compiled for lanes."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple

from magpend_core.engine import simd
from magpend_core.engine.jit import OPTIONS
from magpend_core.engine.simd import WIDTH, load, load_rows, negate_if_bit, store, store_rows, where_less

ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it leaves an integer in the low bits
ORDINARY = [0.0, -0.0, 1.0, -1.0, 1.5, -2.25, 3e-308, -7e250, 0.1, np.pi]
SPECIAL = [np.nan, np.inf, -np.inf]


def on_lanes(primitive, n_arguments):
    """Compile a primitive for groups of lanes; the result maps 1-D arrays to an array."""

    @njit(**OPTIONS)
    def apply(rows, out):
        for i in range(len(out) // WIDTH):
            store(out, i * WIDTH, primitive(*load_rows(rows, i * n_arguments * WIDTH, n_arguments)))

    def call(*arguments):
        n = len(arguments[0])
        groups = np.zeros((-(-n // WIDTH), n_arguments, WIDTH))
        for k, values in enumerate(arguments):
            groups[:, k].flat[:n] = values
        out = np.zeros(len(groups) * WIDTH)
        apply(groups.ravel(), out)
        return out[:n]

    return call


def on_numbers(primitive, n_arguments):
    """Compile a primitive for a float64; the result maps 1-D arrays to an array."""

    @njit(**OPTIONS)
    def apply(arguments, out):
        for i in range(len(out)):
            out[i] = primitive(*to_fixed_tuple(arguments[i], n_arguments))

    def call(*arguments):
        out = np.zeros(len(arguments[0]))
        apply(np.stack(arguments, axis=1), out)
        return out

    return call


def same_bits(a, b):
    """Equal bit for bit, the sign of zeros included; one NaN is as good as another."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    nan = np.isnan(a) & np.isnan(b)
    return bool(np.all(nan | (a.view(np.int64) == b.view(np.int64))))


def combinations(*choices):
    return [np.array(column) for column in zip(*itertools.product(*choices), strict=True)]


POSITIVE = [1.0, 1.9999999999999998, 2.0, 0.3, 2.2250738585072014e-308, 1.7e308, 1e-30, 12345.678]
INTEGERS = [ROUND + k for k in (-9, -2, -1, 0, 1, 2, 3, 4, 7, 1000)]
CASES = {
    "sqrt": [[0.0, 2.0, 1e-300, 3e307, np.inf, np.nan, -1.0]],
    "absolute": [ORDINARY + SPECIAL],
    "copysign": [ORDINARY, [1.0, -1.0, 0.0, -0.0, np.inf]],
    "minimum": [ORDINARY + SPECIAL, ORDINARY + SPECIAL],
    "maximum": [ORDINARY + SPECIAL, ORDINARY + SPECIAL],
    "where_less": [[0.0, 1.0, -1.0, *SPECIAL], [-0.0, 1.0, 2.0, *SPECIAL], [7.0, np.nan], [-3.0, np.inf]],
    "times_power_of_two": [[1.0, -1.7, 1e10], INTEGERS[:-1] + [ROUND + 300.0]],
    "where_odd": [INTEGERS, [5.0, np.nan], [-6.0, np.inf]],
    "binary_exponent": [POSITIVE],
    "mantissa": [POSITIVE],
    "floor": [[*ORDINARY, *SPECIAL, 2.5, -2.5, 1e300]],
    "inverse_sqrt_rough": [POSITIVE],
    "upper": [[*ORDINARY, np.inf, -np.inf, 1.0 + 2.0**-25, 1.0 + 2.0**-26]],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
def test_primitives__all_forms_agree(name):
    primitive, arguments = getattr(simd, name), combinations(*CASES[name])
    plain = primitive(*arguments)
    # plain Python on single numbers
    assert same_bits(plain, [primitive(*numbers) for numbers in zip(*arguments, strict=True)])
    assert same_bits(plain, on_numbers(primitive, len(arguments))(*arguments))
    assert same_bits(plain, on_lanes(primitive, len(arguments))(*arguments))


@pytest.mark.parametrize("bit", [0, 1, 5])
def test_negate_if_bit__all_forms_agree(bit):
    @njit(**OPTIONS)
    def of_lanes(rows, out):
        for i in range(0, len(out), WIDTH):
            store(out, i, negate_if_bit(load(rows, i), load(rows, len(out) + i), bit))

    @njit(**OPTIONS)
    def of_number(x, shifted):
        return negate_if_bit(x, shifted, bit)

    x, shifted = combinations([1.5, -2.0, 0.0, -0.0, np.inf, np.nan], [ROUND + k for k in range(-20, 44)])
    assert len(x) % WIDTH == 0
    expected = np.where((shifted - ROUND).astype(int) >> bit & 1, -x, x)
    lanes = np.zeros(len(x))
    of_lanes(np.concatenate([x, shifted]), lanes)
    assert same_bits(negate_if_bit(x, shifted, bit), expected)
    assert same_bits(lanes, expected)
    assert same_bits([of_number(*pair) for pair in zip(x, shifted, strict=True)], expected)
    assert same_bits([negate_if_bit(*pair, bit) for pair in zip(x, shifted, strict=True)], expected)


def test_upper_and_load_rows__in_plain_python():
    x, y = simd.upper(np.random.default_rng(2).normal(size=(2, 1000)))
    exact = [Fraction(a) * Fraction(b) for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    assert [Fraction(v) for v in (x * y).tolist()] == exact
    rows = np.arange(3.0 * WIDTH)
    first, second = load_rows(rows, WIDTH, 2)
    assert (first[0], second[-1]) == (WIDTH, 3 * WIDTH - 1)
    store_rows(rows, 0, (second, 0.5))
    assert rows[0] == 2 * WIDTH
    assert (rows[WIDTH : 2 * WIDTH] == 0.5).all()
    # a copy, not a view: what is loaded does not change with the array
    assert first[0] == WIDTH


def test_primitives__mean_what_they_say():
    nan = np.nan
    assert where_less(1.0, 2.0, 3.0, 4.0) == 3.0
    assert [where_less(*pair, 3.0, 4.0) for pair in ((2.0, 2.0), (nan, 1.0), (1.0, nan))] == [4.0] * 3
    assert (simd.minimum(1.0, 2.0), simd.maximum(1.0, 2.0)) == (1.0, 2.0)
    # a NaN gives the second argument
    assert (simd.minimum(nan, 2.0), simd.maximum(nan, 2.0)) == (2.0, 2.0)
    assert np.isnan([simd.minimum(1.0, nan), simd.maximum(1.0, nan)]).all()
    assert simd.times_power_of_two(1.5, ROUND + 4.0) == 24.0
    assert simd.times_power_of_two(1.5, ROUND - 4.0) == 1.5 / 16
    assert (simd.where_odd(ROUND + 3.0, 1.0, 2.0), simd.where_odd(ROUND - 2.0, 1.0, 2.0)) == (1.0, 2.0)
    assert (simd.binary_exponent(0.75), simd.mantissa(0.75)) == (-1.0, 1.5)
    assert (simd.binary_exponent(8.0), simd.mantissa(8.0)) == (3.0, 1.0)


def test_multiply_add__forms_agree_within_one_rounding():
    rng = np.random.default_rng(1)
    a, b, c = rng.normal(size=(3, 1000))
    lanes, compiled = on_lanes(simd.multiply_add, 3)(a, b, c), on_numbers(simd.multiply_add, 3)(a, b, c)
    assert same_bits(lanes, compiled)
    # plain Python rounds twice
    assert np.max(abs(lanes - simd.multiply_add(a, b, c)) / (abs(a * b) + abs(c))) < 2.3e-16
    # exact products leave no room for a difference
    whole = np.round(100.0 * a)
    assert same_bits(on_lanes(simd.multiply_add, 3)(whole, whole, c), whole * whole + c)
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, WIDTH))
    b[0], a[1] = 0.0, -0.0
    out = np.zeros(12 * WIDTH)
    _arithmetic(np.concatenate([a, b]), out)
    with np.errstate(divide="ignore"):
        expected = [a + b, a - b, a * b, a / b, -a, 2 + a, a - 2, 2 * a, 2 / a, a, 0 * a + 5, 0 * a + 7]
    assert same_bits(out.reshape(12, WIDTH), expected)


@njit(**OPTIONS)
def _arithmetic(rows, out):
    a, b = load_rows(rows, 0, 2)
    values = (a + b, a - b, a * b, a / b, -a, 2.0 + a, a - 2.0, 2.0 * a, 2.0 / a)
    store_rows(out, 0, values)
    store_rows(out, 9 * WIDTH, (a, 5.0))
    store(out, 11 * WIDTH, 7.0)
