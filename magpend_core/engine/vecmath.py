"""Branch-free elementary functions, with the same bits on every CPU.

numba has no vector math library, so ``math.exp`` in a kernel is a call into libm for each number,
and its last bit depends on the machine. The functions here are made of additions, products, at most
one division and selects; they take a float64 or a group of lanes (see `simd`).

Accuracy: the largest errors, in units in the last place, are below 1 for `exp`, `exp2_falling` and
`log`, 1.6 for `sincos`, 2 for `sin` and `cos` and 3.5 for `atan` (between 0.41 and 0.55; 1.6
elsewhere), measured against 40-digit arithmetic in ``tests/core/engine/test_vecmath.py``. Next to their
zeros beyond the first the sines are off by up to 3e-27 times the argument, which there is more. The
polynomials interpolate in Chebyshev nodes, with errors below 2e-17.
"""

from __future__ import annotations

import math
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import (
    absolute,
    binary_exponent,
    copysign,
    mantissa,
    maximum,
    minimum,
    multiply_add,
    negate_if_bit,
    times_power_of_two,
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


@inline
def exp(x: Any) -> Any:
    """Exponential function; arguments below -700 count as -700, above 700 as 700."""
    x = minimum(maximum(x, -700.0), 700.0)
    shifted = x * LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    # r coth(r/2) is even in r and needs five coefficients; exp(r) = 1 + r + r c/(2 - c) (fdlibm).
    # The quotient costs less than the four products that it saves: dividers are idle here.
    u = r * r
    p = 4.1437544291331705e-08
    p = p * u - 1.653405978460107e-06
    p = p * u + 6.613756471462368e-05
    p = p * u - 0.002777777777756408
    p = p * u + 0.1666666666666666
    c = r - u * p
    return times_power_of_two(1.0 + (r + (r * c) / (2.0 - c)), shifted)


@inline
def exp2_falling(x: Any) -> Any:
    """Two to the power of `x`, which is at most 0; arguments below -1000 count as -1000."""
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
def sincos(x: Any) -> Any:
    """Sine and cosine, for ``|x| < 1e6``."""
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
    sine = negate_if_bit(where_odd(shifted, c, s), shifted, 1)
    cosine = negate_if_bit(where_odd(shifted, s, c), shifted + 1.0, 1)
    return sine, cosine


@inline
def _sine(r: Any) -> Any:
    """Sine between -pi/2 and pi/2."""
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
    """Sine alone, for ``|x| < 1e6``."""
    shifted = x * _INV_PI + _ROUND
    n = shifted - _ROUND
    return negate_if_bit(_sine((x - n * _PI_1) - n * _PI_2ND), shifted, 0)


@inline
def cos(x: Any) -> Any:
    """Cosine alone, for ``|x| < 1e6``."""
    # cos(x) = (-1)^n sin((n + 1/2) pi - x)
    shifted = (x * _INV_PI - 0.5) + _ROUND
    n = (shifted - _ROUND) + 0.5
    return negate_if_bit(_sine((n * _PI_1 - x) + n * _PI_2ND), shifted, 0)


@inline
def atan(x: Any) -> Any:
    """Inverse tangent, in [-pi/2, pi/2]."""
    a = absolute(x)
    # |x| is brought below tan(pi/8) by one quotient: (a - 1)/(a + 1) or -1/a
    top = where_less(a, _TAN_PI_8, a, where_less(a, _TAN_3PI_8, a - 1.0, -1.0))
    bottom = where_less(a, _TAN_PI_8, 1.0, where_less(a, _TAN_3PI_8, a + 1.0, a))
    base = where_less(a, _TAN_PI_8, 0.0, where_less(a, _TAN_3PI_8, _PI_4, _PI_2))
    w = top / bottom
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
    return copysign(base + (w + (w * u) * p), x)


@inline
def log(x: Any) -> Any:
    """Natural logarithm of a positive normal number."""
    m = mantissa(x)
    halve = where_less(_SQRT_2, m, 1.0, 0.0)
    k = binary_exponent(x) + halve
    f = m * (1.0 - 0.5 * halve) - 1.0
    # log(1 + f) = 2 artanh(s) with s = f/(2 + f); coefficients of fdlibm
    s = f / (2.0 + f)
    u = s * s
    p = 0.14798198605116586
    p = p * u + 0.15313837699209373
    p = p * u + 0.1818357216161805
    p = p * u + 0.22222198432149784
    p = p * u + 0.2857142874366239
    p = p * u + 0.3999999999940942
    p = p * u + 0.6666666666666735
    half = 0.5 * f * f
    return k * _LN2_HIGH - ((half - (s * (half + u * p) + k * _LN2_LOW)) - f)


@inline
def log2_rough(x: Any) -> Any:
    """Binary logarithm of a positive normal number to 5e-4: for step sizes, not for physics."""
    m = mantissa(x) - 1.0
    p = -0.10782146960672147 * m + 0.3673421951182853
    p = p * m - 0.7020775351811126
    p = p * m + 1.4421473582825293
    return binary_exponent(x) + m * p


@inline
def exp2_rough(x: Any) -> Any:
    """Power of two to 8e-4, for ``|x| < 1000``: for step sizes, not for physics."""
    shifted = x + _ROUND
    r = x - (shifted - _ROUND)
    p = 0.05550360297541146 * r + 0.2402265069591007
    p = p * r + 0.6931471805599453
    return times_power_of_two(1.0 + r * p, shifted)


@inline
def hypot_rough(x: Any, y: Any) -> Any:
    """Length of a hypotenuse with sides of at least 0, to 2.2 %: for step sizes, not for physics."""
    longer = maximum(x, y)
    return maximum(longer, multiply_add(0.898, longer, 0.486 * minimum(x, y)))


@inline
def wrapped(angle: Any) -> Any:
    """Angle brought to [-pi, pi] by whole turns."""
    turns = (angle * _INV_TWO_PI + _ROUND) - _ROUND
    return angle - turns * TWO_PI
