"""Products are fused by a rule of our own: bits against an interpreter that knows nothing of compilers.

The interpreter runs the same Python with numbers that remember the product they come from, and with the C
library's fused operation. Elementary functions are compared with it in test_vecmath.
"""

import ctypes
from types import FunctionType

import numpy as np
import pytest
from numba import njit
from numba.np.unsafe.ndarray import to_fixed_tuple

from magpend_core import load_model
from magpend_core.engine import simd
from magpend_core.engine.jit import OPTIONS, inline
from magpend_core.engine.simd import WIDTH, load_rows, maximum, multiply_add, store_rows, where_less

C_FMA = ctypes.CDLL(None).fma
C_FMA.restype, C_FMA.argtypes = ctypes.c_double, [ctypes.c_double] * 3


class Number(float):
    """A float64 that remembers whether it is a product."""

    factors = None

    def __new__(cls, value, factors=None):
        number = super().__new__(cls, value)
        number.factors = factors
        return number

    def __mul__(self, other):
        return Number(float(self) * float(other), (float(self), float(other)))

    def __rmul__(self, other):
        return Number(float(other) * float(self), (float(other), float(self)))

    def __neg__(self):
        return Number(-float(self), self.factors and (-self.factors[0], self.factors[1]))

    def __add__(self, other):
        return add(self, other)

    def __radd__(self, other):
        return add(other, self)

    def __sub__(self, other):
        return add(self, -Number(other, getattr(other, "factors", None)))

    def __rsub__(self, other):
        return add(other, -self)

    def __truediv__(self, other):
        with np.errstate(all="ignore"):
            return Number(np.float64(self) / np.float64(other))

    def __rtruediv__(self, other):
        return Number(other) / self


def add(left, right):
    for product, rest in ((left, right), (right, left)):
        factors = getattr(product, "factors", None)
        if factors is not None:
            return Number(C_FMA(*factors, float(rest)))
    return Number(float(left) + float(right))


def forget(value):
    """Numbers as they pass a function's door."""
    if isinstance(value, tuple):
        parts = [forget(x) for x in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return Number(value) if isinstance(value, float) else value


def at_the_door(function):
    def call(*arguments):
        with np.errstate(all="ignore"):
            return forget(function(*map(forget, arguments)))

    return call


PRIMITIVES = [
    "sqrt",
    "inverse_sqrt_rough",
    "floor",
    "upper",
    "absolute",
    "copysign",
    "where_less",
    "minimum",
    "maximum",
    "times_power_of_two",
    "where_odd",
    "binary_exponent",
    "mantissa",
    "negate_if_bit",
]
KNOWN = {getattr(simd, name): at_the_door(getattr(simd, name)) for name in PRIMITIVES}
KNOWN[simd.multiply_add] = lambda a, b, c: Number(C_FMA(a, b, c))


def interpreted(value, known=None):
    """A compiled function as Python that computes with `Number`; other values as they are."""
    known = {**KNOWN} if known is None else known
    source = getattr(value, "py_func", None)
    if isinstance(value, float):
        return Number(value)
    if isinstance(source, FunctionType) and value not in known:
        scope = dict(source.__globals__)
        function = FunctionType(source.__code__, scope, source.__name__, source.__defaults__, source.__closure__)
        known[value] = at_the_door(function)
        for name in source.__code__.co_names:
            if name in scope:
                scope[name] = interpreted(scope[name], known)
    try:
        return known.get(value, value)
    except TypeError:
        return value


def same_bits(a, b):
    a, b = np.asarray(a), np.asarray(b)
    return (a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))


def assert_follows_the_rule(function, columns):
    """Compiled for numbers and for lanes, a function of a tuple gives what the interpreter gives."""
    columns = np.resize(columns, (-(-len(columns) // WIDTH) * WIDTH, columns.shape[1]))
    n = columns.shape[1]

    @njit(**OPTIONS)
    def numbers(columns, out):
        for i in range(len(columns)):
            results = function(to_fixed_tuple(columns[i], n))
            for k in range(len(results)):
                out[i, k] = results[k]

    @njit(**OPTIONS)
    def lanes(rows, out, n_out):
        for i in range(rows.size // (n * WIDTH)):
            store_rows(out, i * n_out * WIDTH, function(load_rows(rows, i * n * WIDTH, n)))

    expected = np.array([interpreted(function)(tuple(map(float, column))) for column in columns])
    alone = np.zeros(expected.shape)
    numbers(columns, alone)
    groups = columns.reshape(-1, WIDTH, n).transpose(0, 2, 1).copy()
    among = np.zeros((len(groups), expected.shape[1], WIDTH))
    lanes(groups.ravel(), among.reshape(-1), expected.shape[1])
    among = among.transpose(0, 2, 1).reshape(expected.shape)
    for found in among, alone:
        wrong = ~same_bits(found, expected)
        assert not wrong.any(), f"results {np.unique(np.nonzero(wrong)[1])} in {wrong.any(axis=1).sum()} columns"


@inline
def _product(a, b):
    return a * b


@inline
def _sums(v):
    a, b, c, d = v
    named = a * b
    twice = c * d
    return (
        a * b + c,
        c + a * b,
        a * b - c,
        c - a * b,
        a * b + c * d,
        a * b - c * d,
        (a + b) * (c - d) + a * b,
        -(a * b) + c,
        c - -(a * b),
        named + c,
        twice + twice,
        named * c + twice,
        twice * twice - named,
        _product(a, b) + c,
        c - _product(a, b) * d,
        multiply_add(a, b, c) + c * d,
        (a * b) / c + d,
        where_less(a, b, a * b, c) + d,
        maximum(a, b) * c + d,
        a * b * c * d + a,
        a + b * c + d * a,
        2.0 * a + b,
        3.0 * (a - b) * c - 2.5 * d,
    )


@pytest.mark.slow
def test_rule__sums_and_differences():
    rng = np.random.default_rng(5)
    assert_follows_the_rule(_sums, rng.normal(size=(400, 4)))


def test_rule__is_for_float64_alone_and_ends_at_branches_and_loops():
    @njit(**OPTIONS)
    def of(a, b, c):
        return a * b + c

    # the square is 1 + 2**-11 + 2**-24, of which a float32 drops the last: fused that would be left
    a, c = np.float32(1.0 + 2.0**-12), np.float32(-1.0 - 2.0**-11)
    assert of(a, a, c) == 0.0
    assert of(1, 2, 3) == 5

    @njit(**OPTIONS)
    def of(a, b, c, n):
        here = a * b
        used_here = here + c
        there, looped = b * a, a * b
        used_there = used_in_loop = 1.0
        if n > 0:
            used_there = there + c
        for _ in range(n):
            used_in_loop = looped + c
        return used_here, used_there, used_in_loop

    # the square is 1 + 2**-29 + 2**-60, of which a float64 drops the last
    a, c = 1.0 + 2.0**-30, -1.0 - 2.0**-29
    assert of(a, a, c, 1) == (2.0**-60, 0.0, 0.0)


MODELS = ["pendulum", "pendulum-dipole-sine", "double-pendulum", "duffing", "pendulum-text", "impact"]


def rates_of(system):
    """Forcing and rates as a function of one tuple: states, time, constants."""
    n, m = system.n_states, system.n_constants + system.n_modes
    y, c = (f"({', '.join(f'v[{i}]' for i in range(*ends))},)" for ends in ((n,), (n + 1, n + 1 + m)))
    scope = {"forcing": system.forcing, "rhs": system.rhs}
    exec(f"def rates(v):\n    c = {c}\n    u = forcing(v[{n}], c)\n    return (u, *rhs({y}, u, c))", scope)
    return inline(scope["rates"])


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_rule__constants_forcing_and_rates(name):
    model = load_model(name)
    system, n, m = model.system, model.system.n_states, model.system.n_constants + model.system.n_modes
    constants = system.constants

    @njit(**OPTIONS)
    def derive(frequency, p, out):
        constants(frequency, p, out)

    packed = model.load().pack()
    c, expected = np.zeros(m), [0.0] * m
    derive(1.7, packed, c)
    interpreted(constants)(1.7, [Number(x) for x in packed], expected)
    assert same_bits(c, expected).all(), c - expected
    rng = np.random.default_rng(7)
    states = rng.uniform(-3.0, 3.0, (200, n)) * system.scales
    columns = np.hstack([states, rng.uniform(0.0, 0.5, (200, 1)), np.tile(c, (200, 1))])
    assert_follows_the_rule(rates_of(system), columns)
