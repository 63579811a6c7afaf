"""Evaluate the rates of a system on truncated power series of several variables: exact derivatives of any order.

A series replaces each state; the functions of `engine.simd` and `engine.vecmath` that the rates are made of are
replaced by those of series. Coefficients are complex, the constant ones real. Where rates have a corner (``abs``,
``where``, a switch), the series is that of the side on which its constant coefficient lies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from magpend_core.engine import simd, vecmath
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System


@dataclass(frozen=True, eq=False)
class Monomials:
    """Monomials of several variables up to an order, by rising degree, with the table of their products."""

    exponents: np.ndarray  # (n, n_variables)
    left: np.ndarray  # (n_products,): positions of the factors of all products up to the order
    right: np.ndarray
    target: np.ndarray  # and of the product

    @property
    def degrees(self) -> np.ndarray:
        """Degree of each monomial."""
        return np.asarray(self.exponents.sum(axis=1))

    def position(self, exponents: Sequence[int]) -> int:
        """Return the position of the monomial with given exponents."""
        return int(np.flatnonzero((self.exponents == np.asarray(exponents)).all(axis=1))[0])

    def times(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the coefficients of the product of two series, over the last axis, truncated at the order."""
        terms = a[..., self.left] * b[..., self.right]
        found = np.zeros((*terms.shape[:-1], len(self.exponents)), complex)
        np.add.at(np.moveaxis(found, -1, 0), self.target, np.moveaxis(terms, -1, 0))
        return found


@cache
def monomials(n_variables: int, order: int) -> Monomials:
    """Return the monomials of some variables up to an order."""
    every = [e for e in product(range(order + 1), repeat=n_variables) if sum(e) <= order]
    every.sort(key=lambda e: (sum(e), [-k for k in e]))
    at = {e: i for i, e in enumerate(every)}
    sums = [(i, j, tuple(np.add(a, b).tolist())) for i, a in enumerate(every) for j, b in enumerate(every)]
    table = np.array([(i, j, at[e]) for i, j, e in sums if e in at])
    return Monomials(np.array(every).reshape(len(every), n_variables), *table.T)


class Series:
    """Truncated power series: coefficients of `Monomials`."""

    __slots__ = ("of", "values")
    __array_ufunc__ = None  # numpy's numbers leave the arithmetic to this class

    def __init__(self, of: Monomials, values: np.ndarray) -> None:
        self.of, self.values = of, values

    @property
    def base(self) -> float:
        """Constant coefficient."""
        return float(self.values[0].real)

    def _with(self, other: Any) -> np.ndarray:
        if isinstance(other, Series):
            return other.values
        values = np.zeros(len(self.values), complex)
        values[0] = other
        return values

    def __add__(self, other: Any) -> Series:
        return Series(self.of, self.values + self._with(other))

    def __neg__(self) -> Series:
        return Series(self.of, -self.values)

    def __sub__(self, other: Any) -> Series:
        return Series(self.of, self.values - self._with(other))

    def __rsub__(self, other: Any) -> Series:
        return Series(self.of, self._with(other) - self.values)

    def __mul__(self, other: Any) -> Series:
        if isinstance(other, Series):
            return Series(self.of, self.of.times(self.values, other.values))
        return Series(self.of, self.values * other)

    def __truediv__(self, other: Any) -> Series:
        inverse = power(other, -1.0) if isinstance(other, Series) else 1.0 / other
        return self.__mul__(inverse)

    def __rtruediv__(self, other: Any) -> Series:
        inverse: Series = power(self, -1.0)
        return inverse.__mul__(other)

    def __pow__(self, exponent: Any) -> Series:
        if exponent == int(exponent) and exponent >= 0:
            found = Series(self.of, self._with(1.0))
            for _ in range(int(exponent)):
                found = found * self
            return found
        root: Series = power(self, exponent)
        return root

    __radd__, __rmul__ = __add__, __mul__


# ---- functions ---------------------------------------------------------------------------------


def _composed(x: Series, taylor: Sequence[float]) -> Series:
    """Return a function of a series from the function's Taylor coefficients at the constant coefficient."""
    away = x - x.base
    found = Series(x.of, away._with(taylor[-1]))
    for value in taylor[-2::-1]:
        found = found * away + value
    return found


def _order(x: Series) -> int:
    return int(x.of.degrees[-1])


def _by_slope(x: Series, value: float, slope: Callable[[Series], Any]) -> Series:
    """Return a function of a series from its value at the constant coefficient, and its derivative as a function of
    series.
    """
    line = monomials(1, _order(x))
    own = Series(line, np.zeros(len(line.exponents), complex))
    own.values[:2] = x.base, 1.0
    slopes = slope(own).values.real
    return _composed(x, [value, *(slopes[:-1] / np.arange(1.0, len(slopes)))])


def power(x: Any, exponent: Any) -> Any:
    """Return a power of a number or series."""
    if isinstance(exponent, Series):
        return exp(exponent * log(x))
    if not isinstance(x, Series):
        return np.power(float(x), exponent)
    taylor = [float(np.power(x.base, exponent))]
    for k in range(_order(x)):
        taylor.append(taylor[-1] * (exponent - k) / ((k + 1.0) * x.base))
    return _composed(x, taylor)


def exp(x: Any) -> Any:
    """Return the exponential of a number or series."""
    if not isinstance(x, Series):
        return np.exp(x)
    value, factorials = np.exp(x.base), np.cumprod([1.0, *range(1, _order(x) + 1)])
    return _composed(x, list(value / factorials))


def log(x: Any) -> Any:
    """Return the logarithm of a number or series."""
    return _by_slope(x, np.log(x.base), lambda z: 1.0 / z) if isinstance(x, Series) else np.log(x)


def sincos(x: Any) -> tuple[Any, Any]:
    """Return the sine and the cosine of a number or series."""
    if not isinstance(x, Series):
        return np.sin(x), np.cos(x)
    k = np.arange(_order(x) + 1)
    factorials = np.cumprod([1.0, *k[1:]])
    sine, cosine = (list(np.sin(x.base + shift + k * np.pi / 2.0) / factorials) for shift in (0.0, np.pi / 2.0))
    sine[0], cosine[0] = np.sin(x.base), np.cos(x.base)
    return _composed(x, sine), _composed(x, cosine)


def _tan(x: Any) -> Any:
    sine, cosine = sincos(x)
    return sine / cosine


def _tanh(x: Any) -> Any:
    if not isinstance(x, Series):
        return np.tanh(x)
    small = exp(-2.0 * absolute(x))
    return sign(x) * ((1.0 - small) / (1.0 + small))


def _atan2(y: Any, x: Any) -> Any:
    y0, x0 = (v.base if isinstance(v, Series) else v for v in (y, x))
    if not isinstance(y, Series) and not isinstance(x, Series):
        return np.arctan2(y, x)
    return np.arctan2(y0, x0) + _atan((x0 * y - y0 * x) / (x0 * x + y0 * y))


def _atan(x: Any) -> Any:
    return _by_slope(x, np.arctan(x.base), lambda z: 1.0 / (1.0 + z * z)) if isinstance(x, Series) else np.arctan(x)


def _asin(x: Any) -> Any:
    if not isinstance(x, Series):
        return np.arcsin(x)
    return _by_slope(x, np.arcsin(x.base), lambda z: power(1.0 - z * z, -0.5))


def _base(x: Any) -> float:
    return x.base if isinstance(x, Series) else float(x)


def sign(x: Any) -> float:
    """Return the sign of a number or of a series' constant coefficient; 1 at 0."""
    return float(np.copysign(1.0, _base(x)))


def absolute(x: Any) -> Any:
    """Return the absolute value of a number or series."""
    return x * sign(x)


SUBSTITUTES: dict[Callable[..., Any], Callable[..., Any]] = {
    simd.sqrt: lambda x: power(x, 0.5),
    simd.absolute: absolute,
    simd.multiply_add: lambda a, b, c: a * b + c,
    simd.copysign: lambda x, s: absolute(x) * sign(s),
    simd.floor: lambda x: float(np.floor(_base(x))),
    simd.where_less: lambda a, b, yes, no: yes if _base(a) < _base(b) else no,
    simd.minimum: lambda a, b: a if _base(a) < _base(b) else b,
    simd.maximum: lambda a, b: b if _base(a) < _base(b) else a,
    vecmath.exp: exp,
    vecmath.expm1: lambda x: exp(x) - 1.0,
    vecmath.log: log,
    vecmath.power: power,
    vecmath.inverse_sqrt: lambda x: power(x, -0.5),
    vecmath.sincos: sincos,
    vecmath.sin: lambda x: sincos(x)[0],
    vecmath.cos: lambda x: sincos(x)[1],
    vecmath.tan: _tan,
    vecmath.sinh: lambda x: 0.5 * (exp(x) - exp(-x)),
    vecmath.cosh: lambda x: 0.5 * (exp(x) + exp(-x)),
    vecmath.tanh: _tanh,
    vecmath.atan: _atan,
    vecmath.atan2: _atan2,
    vecmath.asin: _asin,
    vecmath.acos: lambda x: np.pi / 2.0 - _asin(x),
    vecmath.sign: sign,
    vecmath.square_wave: lambda phase, duty: 1.0 if _base(phase) - np.floor(_base(phase)) < duty else -1.0,
}
"""Functions of numbers and series in place of the engine's functions of SIMD vectors."""


@cache
def _functions(system: System) -> tuple[Callable[..., Any], ...]:
    wanted = system.constants, system.forcing, system.rhs, system.switches
    return tuple(plain(function, SUBSTITUTES) if function is not None else None for function in wanted)  # type: ignore[misc]


def rates_on(system: System, packed: np.ndarray, of: Monomials, states: np.ndarray) -> np.ndarray:
    """Return the rates of an autonomous system whose states are power series.

    Parameters
    ----------
    system
        Without a drive.
    packed
        Parameters, shape (n_parameters,).
    of
        Monomials of the series.
    states
        Coefficients, shape (n_states, len(of.exponents)), complex; those of the constant are real.

    Returns
    -------
    ndarray, (n_states, len(of.exponents))
        Coefficients of the rates; NaN where a function has no derivative.
    """
    constants, forcing, rhs, switches = _functions(system)
    c = np.ones(system.n_constants + system.n_modes)
    with np.errstate(all="ignore"):
        constants(1.0, packed, c)
        if switches is not None:
            at = tuple(states[:, 0].real.tolist())
            for k, (value, _) in enumerate(switches(0.0, at, at, c)):
                c[system.n_constants + k] = -1.0 if value < 0.0 else 1.0
        found = rhs(tuple(Series(of, row) for row in states), forcing(0.0, c), c)
    series = [rate if isinstance(rate, Series) else Series(of, states[0] * 0.0) + rate for rate in found]
    return np.array([one.values for one in series])
