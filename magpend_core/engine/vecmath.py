"""Branch-free elementary functions, with the same bits on every CPU.

numba has no vector math library, so ``math.exp`` in a kernel calls libm for each number, and its last bit depends on
the machine. The functions here consist of sums, products, `where_less` and at most one division; their arguments are
float64 numbers or groups of lanes (see `simd`).

Accuracy: the largest errors, in units in the last place, are below 1 for `exp`, `exp2_falling` and
`log`, 1.5 for `cosh`, `acos` and
`inverse_sqrt`, 1.6 for `sincos`, 2 for `sin`, `cos` and `expm1`, 2.5 for `asin` and
`sinh`, 3 for `tan` and `atan2`, 3.5 for `atan` (between 0.41 and 0.55; 1.6 elsewhere), 4 for `tanh`. That
of ``power(x, y)`` grows with y: 1 for y = 1.5 and 2.5 for y = 17.3, at any x. Measured against 40-digit
arithmetic in ``tests/core/engine/test_vecmath.py``. Near a zero at x = k pi (k not 0), the sines have an absolute error
of up to 3e-27 |x|, which may be larger than these limits. The polynomials interpolate in Chebyshev nodes, with errors
below 2e-17, or come from fdlibm. NaN gives NaN.
"""

from __future__ import annotations

import math
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import (
    absolute,
    binary_exponent,
    copysign,
    floor,
    inverse_sqrt_rough,
    mantissa,
    maximum,
    minimum,
    multiply_add,
    negate_if_bit,
    sqrt,
    times_power_of_two,
    upper,
    where_less,
    where_odd,
)

TWO_PI = 2.0 * math.pi
TWO_OVER_PI = 2.0 / math.pi
LN2 = 0.6931471805599453
LOG2_E = 1.4426950408889634
_INV_TWO_PI = 1.0 / TWO_PI
_INV_PI = 1.0 / math.pi

_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it leaves the nearest integer in the low bits
_LN2_HIGH = 0.6931471803691238  # upper 33 bits of ln 2, so that k * _LN2_HIGH is exact
_LN2_LOW = 1.9082149292705877e-10
# pi/2 as a sum of a number of 33 bits, so that n times it is exact for |n| < 2**20, and a rest that
# is good to 4e-27
_PIO2_1 = 1.5707963267341256
_PIO2_2 = 6.077100506506192e-11
_PI_1 = 2.0 * _PIO2_1
_PI_2ND = 2.0 * _PIO2_2
_TAN_PI_8 = 0.41421356237309503
_TAN_3PI_8 = 2.414213562373095
_SQRT_2 = math.sqrt(2.0)
_PI_2 = math.pi / 2
_PI_4 = math.pi / 4
_INFINITE, _NAN = math.inf, math.nan
_LEAST_NORMAL = 2.2250738585072014e-308


@inline
def _exp_rest(r: Any) -> Any:
    """Compute c in exp(r) = 1 + r + r c/(2 - c) = 1 + 2 r/(2 - c), for |r| < 0.35 (fdlibm)."""
    # r coth(r/2) is even in r and needs five coefficients.
    # The quotient costs less than the four products that it saves: dividers are idle here.
    u = r * r
    p = 4.1437544291331705e-08
    p = p * u - 1.653405978460107e-06
    p = p * u + 6.613756471462368e-05
    p = p * u - 0.002777777777756408
    p = p * u + 0.1666666666666666
    return r - u * p


@inline
def exp(x: Any) -> Any:
    """Compute the exponential function; arguments beyond +-700 count as +-700."""
    x = minimum(700.0, maximum(-700.0, x))
    shifted = x * LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    c = _exp_rest(r)
    return times_power_of_two(1.0 + (r + (r * c) / (2.0 - c)), shifted)


@inline
def expm1(x: Any) -> Any:
    """Compute exp(x) - 1 without cancellation near 0; arguments beyond +-700 count as +-700."""
    x = minimum(700.0, maximum(-700.0, x))
    shifted = x * LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    c = _exp_rest(r)
    scale = times_power_of_two(1.0, shifted)
    return multiply_add(scale, r + (r * c) / (2.0 - c), scale - 1.0)


@inline
def sinh(x: Any) -> Any:
    """Compute the hyperbolic sine; arguments beyond +-700 count as +-700."""
    t = expm1(absolute(x))
    return copysign(0.5 * (t + t / (t + 1.0)), x)


@inline
def cosh(x: Any) -> Any:
    """Compute the hyperbolic cosine; arguments beyond +-700 count as +-700."""
    e = exp(absolute(x))
    return 0.5 * e + 0.5 / e


@inline
def tanh(x: Any) -> Any:
    """Compute the hyperbolic tangent."""
    a = maximum(-700.0, -2.0 * absolute(x))
    shifted = a * LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (a - k * _LN2_HIGH) - k * _LN2_LOW
    # t = exp(-2|x|) - 1 = n/d with n = 2**k 2 r + (2**k - 1) d; tanh|x| = -t/(2 + t) = -n/(2 d + n)
    d = 2.0 - _exp_rest(r)
    scale = times_power_of_two(1.0, shifted)
    n = multiply_add(scale, 2.0 * r, (scale - 1.0) * d)
    return copysign(n / multiply_add(2.0, d, n), x)


@inline
def exp2_falling(x: Any) -> Any:
    """Compute 2 to the power of `x`, which is at most 0; arguments below -1000 count as -1000."""
    x = maximum(x, -1000.0)
    shifted = x + _ROUND
    r = x - (shifted - _ROUND)
    p = 4.4549605981865186e-10
    p = p * r + 7.072585949269223e-09
    p = p * r + 1.0178062445845774e-07
    p = p * r + 1.321544258792169e-06
    p = p * r + 1.525273382983612e-05
    p = p * r + 0.0001540353044173605
    p = p * r + 0.0013333558146416936
    p = p * r + 0.009618129107606888
    p = p * r + 0.0555041086648216
    p = p * r + 0.24022650695910097
    p = p * r + 0.6931471805599453
    return times_power_of_two(1.0 + r * p, shifted)


@inline
def _quarter_turns(x: Any) -> Any:
    """Reduce an angle `x` by quarter turns: return sine and cosine of the rest, and a float that holds the number of
    turns.
    """
    shifted = x * TWO_OVER_PI + _ROUND
    n = shifted - _ROUND
    r = (x - n * _PIO2_1) - n * _PIO2_2
    u = r * r
    s = 1.5918129294866608e-10
    s = s * u - 2.5051131845003624e-08
    s = s * u + 2.755731610255244e-06
    s = s * u - 0.00019841269836758574
    s = s * u + 0.008333333333330948
    s = s * u - 0.16666666666666666
    s = r + (r * u) * s
    c = -1.1382632425521717e-11
    c = c * u + 2.08761462684032e-09
    c = c * u - 2.7557317271729793e-07
    c = c * u + 2.480158729876569e-05
    c = c * u - 0.0013888888888887398
    c = c * u + 0.041666666666666664
    c = (1.0 - 0.5 * u) + (u * u) * c
    return s, c, shifted


@inline
def sincos(x: Any) -> Any:
    """Compute sine and cosine, for ``|x| < 1e6``."""
    s, c, shifted = _quarter_turns(x)
    sine = negate_if_bit(where_odd(shifted, c, s), shifted, 1)
    cosine = negate_if_bit(where_odd(shifted, s, c), shifted + 1.0, 1)
    return sine, cosine


@inline
def tan(x: Any) -> Any:
    """Compute the tangent, for ``|x| < 1e6``."""
    s, c, shifted = _quarter_turns(x)
    return where_odd(shifted, -c, s) / where_odd(shifted, s, c)


@inline
def _sine(r: Any) -> Any:
    """Compute the sine of an argument between -pi/2 and pi/2."""
    u = r * r
    s = 2.731444766986399e-15
    s = s * u - 7.643970296798572e-13
    s = s * u + 1.6058977312464087e-10
    s = s * u - 2.5052107616996182e-08
    s = s * u + 2.7557319219163234e-06
    s = s * u - 0.00019841269841254974
    s = s * u + 0.008333333333333316
    s = s * u - 0.16666666666666666
    return r + (r * u) * s


@inline
def sin(x: Any) -> Any:
    """Compute the sine alone, for ``|x| < 1e6``."""
    shifted = x * _INV_PI + _ROUND
    n = shifted - _ROUND
    return negate_if_bit(_sine((x - n * _PI_1) - n * _PI_2ND), shifted, 0)


@inline
def cos(x: Any) -> Any:
    """Compute the cosine alone, for ``|x| < 1e6``."""
    # cos(x) = (-1)^n sin((n + 1/2) pi - x)
    shifted = (x * _INV_PI - 0.5) + _ROUND
    n = (shifted - _ROUND) + 0.5
    return negate_if_bit(_sine((n * _PI_1 - x) + n * _PI_2ND), shifted, 0)


@inline
def _atan_core(w: Any) -> Any:
    """Compute the inverse tangent of an argument between -tan(pi/8) and tan(pi/8)."""
    u = w * w
    p = 0.02275052699336167
    p = p * u - 0.04483334622272886
    p = p * u + 0.05736332165907643
    p = p * u - 0.06649613695291669
    p = p * u + 0.0769105515839315
    p = p * u - 0.09090852557176049
    p = p * u + 0.11111109636534361
    p = p * u - 0.1428571426609662
    p = p * u + 0.19999999999898407
    p = p * u - 0.3333333333333325
    return w + (w * u) * p


@inline
def atan(x: Any) -> Any:
    """Compute the inverse tangent, in [-pi/2, pi/2]."""
    a = absolute(x)
    # |x| is brought below tan(pi/8) by one quotient: (a - 1)/(a + 1) or -1/a
    top = where_less(a, _TAN_PI_8, a, where_less(a, _TAN_3PI_8, a - 1.0, -1.0))
    bottom = where_less(a, _TAN_PI_8, 1.0, where_less(a, _TAN_3PI_8, a + 1.0, a))
    base = where_less(a, _TAN_PI_8, 0.0, where_less(a, _TAN_3PI_8, _PI_4, _PI_2))
    return copysign(base + _atan_core(top / bottom), x)


@inline
def atan2(y: Any, x: Any) -> Any:
    """Compute the angle of the point (x, y), in [-pi, pi], for finite coordinates below 8e307; 0 at the origin."""
    a, b = absolute(x), absolute(y)
    longer, shorter = maximum(a, b), minimum(b, a)  # a NaN is in one of them
    near = shorter - _TAN_PI_8 * longer
    top = where_less(near, 0.0, shorter, shorter - longer)
    bottom = where_less(near, 0.0, longer, shorter + longer)
    # no quotient of zeros at the origin; a NaN stays one
    bottom = where_less(0.0, bottom, bottom, bottom + 1.0)
    angle = where_less(near, 0.0, 0.0, where_less(0.0, longer, _PI_4, 0.0)) + _atan_core(top / bottom)
    angle = where_less(a, b, _PI_2 - angle, angle)
    return copysign(where_less(copysign(1.0, x), 0.0, math.pi - angle, angle), y)


@inline
def _asin_rest(u: Any) -> Any:
    """Compute R(z) in asin(s) = s + s R(z) with z = s**2 up to 1/4 (fdlibm)."""
    p = 3.479331075960212e-05
    p = p * u + 0.0007915349942898145
    p = p * u - 0.04005553450067941
    p = p * u + 0.20121253213486293
    p = p * u - 0.3255658186224009
    p = p * u + 0.16666666666666666
    q = 0.07703815055590194
    q = q * u - 0.6882839716054533
    q = q * u + 2.0209457602335057
    q = q * u - 2.403394911734414
    return (u * p) / (q * u + 1.0)


@inline
def asin(x: Any) -> Any:
    """Compute the inverse sine, in [-pi/2, pi/2]; NaN if the argument's absolute value exceeds 1."""
    a = absolute(x)
    # asin(a) = pi/2 - 2 asin(sqrt((1 - a)/2))
    u = where_less(a, 0.5, a * a, 0.5 * (1.0 - a))
    s = where_less(a, 0.5, a, sqrt(u))
    angle = s + s * _asin_rest(u)
    return copysign(where_less(a, 0.5, angle, _PI_2 - 2.0 * angle), x)


@inline
def acos(x: Any) -> Any:
    """Compute the inverse cosine, in [0, pi]; NaN if the argument's absolute value exceeds 1."""
    a = absolute(x)
    u = where_less(a, 0.5, a * a, 0.5 * (1.0 - a))
    s = where_less(a, 0.5, a, sqrt(u))
    angle = s + s * _asin_rest(u)
    outer = where_less(x, 0.0, math.pi - 2.0 * angle, 2.0 * angle)
    return where_less(a, 0.5, _PI_2 - copysign(angle, x), outer)


@inline
def _fraction_and_exponent(x: Any) -> Any:
    """Return f and k with x = (1 + f) 2**k and 1 + f between sqrt(1/2) and sqrt(2).

    Both are 0 where `x` is not positive or not finite.
    """
    scaled = where_less(x, _LEAST_NORMAL, 1.8014398509481984e16 * x, x)
    scaled = where_less(0.0, x, where_less(x, _INFINITE, scaled, 1.0), 1.0)
    m = mantissa(scaled)
    halve = where_less(_SQRT_2, m, 1.0, 0.0)
    k = binary_exponent(scaled) + (halve - where_less(x, _LEAST_NORMAL, where_less(0.0, x, 54.0, 0.0), 0.0))
    return m * (1.0 - 0.5 * halve) - 1.0, k


@inline
def _artanh_rest(u: Any) -> Any:
    """Compute P(u) in log(1 + f) = 2 s + s u P(u) with s = f/(2 + f), u = s**2 (fdlibm)."""
    p = 0.14798198605116586
    p = p * u + 0.15313837699209373
    p = p * u + 0.1818357216161805
    p = p * u + 0.22222198432149784
    p = p * u + 0.2857142874366239
    p = p * u + 0.3999999999940942
    return p * u + 0.6666666666666735


@inline
def log(x: Any) -> Any:
    """Compute the natural logarithm: minus infinity for 0, NaN for a negative number."""
    f, k = _fraction_and_exponent(x)
    s = f / (2.0 + f)
    u = s * s
    half = 0.5 * f * f
    rest = multiply_add(s, half + u * _artanh_rest(u), k * _LN2_LOW)
    value = k * _LN2_HIGH - ((half - rest) - f)
    value = where_less(0.0, x, value, where_less(x, 0.0, _NAN, -_INFINITE))
    return where_less(x, _INFINITE, value, x)


@inline
def power(x: Any, y: Any) -> Any:
    """Compute `x` to the real power `y`. A negative `x` gives NaN; 0 to a positive power gives 0.

    Results beyond exp(+-700) count as these. For whole powers products are better.
    """
    f, k = _fraction_and_exponent(x)
    # The logarithm as a sum of two numbers: its error grows with the size of the result's exponent.
    # s = s_upper + s_rest is f/(2 + f) to twice the digits
    t = 2.0 + f
    per_t = 1.0 / t
    s = f * per_t
    s_upper, t_upper = upper(s), upper(t)
    t_rest = f - (t_upper - 2.0)
    s_rest = ((f - s_upper * t_upper) - s_upper * t_rest) * per_t
    u = s * s
    whole = k * _LN2_HIGH  # exact
    high = whole + 2.0 * s_upper
    low = multiply_add(k, _LN2_LOW, multiply_add(s, u * _artanh_rest(u), 2.0 * s_rest))
    low = low + (2.0 * s_upper - (high - whole))
    first, y_upper = upper(high), upper(y)
    exponent = y_upper * first  # exact
    rest = multiply_add(y, low + (high - first), (y - y_upper) * first)
    rest = where_less(absolute(exponent), 700.0, rest, 0.0)
    exponent = minimum(700.0, maximum(-700.0, exponent))
    shifted = exponent * LOG2_E + _ROUND
    n = shifted - _ROUND
    r = (exponent - n * _LN2_HIGH) + (rest - n * _LN2_LOW)
    c = _exp_rest(r)
    value = times_power_of_two(1.0 + (r + (r * c) / (2.0 - c)), shifted)
    of_zero = where_less(0.0, y, 0.0, where_less(y, 0.0, _INFINITE, 1.0 + y))
    value = where_less(0.0, x, value, where_less(x, 0.0, _NAN, of_zero))
    of_infinity = where_less(y, 0.0, where_less(0.0, x, 0.0, x), x)
    return where_less(x, _INFINITE, value, of_infinity)


@inline
def inverse_sqrt(x: Any) -> Any:
    """Compute the inverse square root. The result is NaN below 2.2e-308, also for 0, and not finite for infinity.

    A dozen products, where a root and a division keep the dividers busy for several times as long.
    """
    y = inverse_sqrt_rough(x)
    # 1/sqrt(x) = y/sqrt(1 - e): by a cubic in e, good to 8e-7; then by its series
    e = 1.0 - (x * y) * y
    p = multiply_add(0.3127981123538511, e, 0.3762781373507123)
    p = multiply_add(p, e, 0.5000013185082491)
    y = y * multiply_add(p, e, 0.9999992549645753)
    e = 1.0 - (x * y) * y
    y = multiply_add(y * e, multiply_add(0.375, e, 0.5), y)
    return where_less(x, _LEAST_NORMAL, _NAN, y)


@inline
def sign(x: Any) -> Any:
    """Return the sign of `x`: -1, 0 or 1; NaN for NaN."""
    return where_less(0.0, x, 1.0, where_less(x, 0.0, -1.0, x))


@inline
def square_wave(phase: Any, duty: Any) -> Any:
    """Return 1 for the first fraction `duty` of each unit of `phase`, then -1."""
    return where_less(phase - floor(phase), duty, 1.0, -1.0)


@inline
def log2_rough(x: Any) -> Any:
    """Compute the binary logarithm of a positive normal number to 5e-4: for step sizes, not for physics."""
    m = mantissa(x) - 1.0
    p = -0.10782146960672147 * m + 0.3673421951182853
    p = p * m - 0.7020775351811126
    p = p * m + 1.4421473582825293
    return binary_exponent(x) + m * p


@inline
def exp2_rough(x: Any) -> Any:
    """Compute a power of two to 8e-4, for ``|x| < 1000``: for step sizes, not for physics."""
    shifted = x + _ROUND
    r = x - (shifted - _ROUND)
    p = 0.05550360297541146 * r + 0.2402265069591007
    p = p * r + 0.6931471805599453
    return times_power_of_two(1.0 + r * p, shifted)


@inline
def hypot_rough(x: Any, y: Any) -> Any:
    """Compute sqrt(x**2 + y**2) for non-negative `x` and `y`, to 2.2 %: for step sizes, not for physics."""
    longer = maximum(x, y)
    return maximum(longer, multiply_add(0.898, longer, 0.486 * minimum(x, y)))


@inline
def wrapped(angle: Any) -> Any:
    """Return an angle brought to [-pi, pi] by whole turns."""
    turns = (angle * _INV_TWO_PI + _ROUND) - _ROUND
    return angle - turns * TWO_PI
