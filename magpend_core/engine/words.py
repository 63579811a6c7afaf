"""Define operations on 32-bit words in SIMD lanes, for random numbers.

A word is an integer below 2**32, held as the bits of a float64: the engine's lanes have one type. Like the
primitives of `simd`, these take a float64 or a group of lanes, and run as plain Python on numpy arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from magpend_core.engine.simd import int_constant, int_type, ir_type, primitive

_WORD = 0xFFFFFFFF
_ONE = 0x3FF0000000000000
"""Bits of 1.0."""


def word(value: int) -> float:
    """Return an integer from 0 to 2**32 - 1 as a word."""
    return float(np.int64(value).view(np.float64))


def _bits(x: Any) -> Any:
    return np.asarray(x, np.float64).view(np.int64)


def word_product(a: Any, b: Any) -> Any:
    """Return the 64-bit product of two words, as the bits of a float."""
    return (_bits(a).view(np.uint64) * _bits(b).view(np.uint64)).view(np.float64)[()]


def upper_word(x: Any) -> Any:
    """Return the upper 32 bits of a float as a word."""
    return (_bits(x).view(np.uint64) >> np.uint64(32)).view(np.float64)[()]


def lower_word(x: Any) -> Any:
    """Return the lower 32 bits of a float as a word."""
    return (_bits(x) & np.int64(_WORD)).view(np.float64)[()]


def exclusive_or(a: Any, b: Any) -> Any:
    """Return the exclusive or of two words."""
    return (_bits(a) ^ _bits(b)).view(np.float64)[()]


def one_and_fraction(a: Any, b: Any) -> Any:
    """Return a number in [1, 2); its 52 binary digits are those of word `a` and the upper 20 of word `b`."""
    digits = (_bits(a) << np.int64(20)) | (_bits(b) >> np.int64(12))
    return (digits | np.int64(_ONE)).view(np.float64)[()]


def _bitwise(combine: Callable[..., Any]) -> Callable[..., Any]:
    """Return an emitter for `simd.primitive`: it reads floats as integers, combines them, and returns a float.

    `combine(builder, constant, *integers)` returns the LLVM value; ``constant(n)`` makes an integer.
    """

    def emit(builder: Any, numba_type: Any, *values: Any) -> Any:
        integers = [builder.bitcast(value, int_type(numba_type)) for value in values]
        bits = combine(builder, lambda value: int_constant(numba_type, value), *integers)
        return builder.bitcast(bits, ir_type(numba_type))

    return emit


def _product(builder: Any, constant: Any, a: Any, b: Any) -> Any:
    # the masks tell LLVM that 32 by 32 bits suffice, for which every CPU has a vector instruction
    return builder.mul(builder.and_(a, constant(_WORD)), builder.and_(b, constant(_WORD)))


def _one_and_fraction(builder: Any, constant: Any, a: Any, b: Any) -> Any:
    digits = builder.or_(builder.shl(a, constant(20)), builder.lshr(b, constant(12)))
    return builder.or_(digits, constant(_ONE))


primitive(word_product, _bitwise(_product))
primitive(upper_word, _bitwise(lambda builder, constant, x: builder.lshr(x, constant(32))))
primitive(lower_word, _bitwise(lambda builder, constant, x: builder.and_(x, constant(_WORD))))
primitive(exclusive_or, _bitwise(lambda builder, constant, a, b: builder.xor(a, b)))
primitive(one_and_fraction, _bitwise(_one_and_fraction))
