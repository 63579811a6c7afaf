"""Define a numba type for a group of SIMD lanes: WIDTH float64 numbers that each operation processes together.

The kernels advance many trajectories at the same time. They do not rely on the compiler to turn a loop over
trajectories into vector instructions. Instead they compute with values of the type `Lanes`, a vector type of LLVM: each
operation becomes one vector instruction, or a few where the CPU's registers are narrower. The same source also compiles
for a single float64, and runs as plain Python on numpy arrays if numba is switched off, because each primitive here
has all three forms.

No code branches on the value of a lane; a choice between two values is `where_less`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

# Two vectors of AVX-512, four of AVX2: enough independent work to hide the latency of a division.
WIDTH = 16
"""Lanes in a group."""

# the difference of this constant and half of a number's bits approximates its inverse square root (Lomont 2003)
_INVERSE_ROOT = 0x5FE6EB50C7B537A9

_DOUBLE = ir.DoubleType()
_INT64 = ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, WIDTH)


class LanesType(types.Type):
    """Numba type of a group of SIMD lanes."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{WIDTH}")


lanes_type = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _is_number(x: Any) -> bool:
    return isinstance(x, LanesType | types.Float)


def _splat(builder: Any, scalar: Any) -> Any:
    index = ir.IntType(32)
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    vector = builder.insert_element(undefined, scalar, ir.Constant(index, 0))
    return builder.shuffle_vector(vector, undefined, ir.Constant(ir.VectorType(index, WIDTH), [0] * WIDTH))


def _as(builder: Any, value: Any, numba_type: Any, target: Any) -> Any:
    if isinstance(target, LanesType) and not isinstance(numba_type, LanesType):
        return _splat(builder, value)
    return value


def _register_operator(op: Callable[..., Any], method: str) -> None:
    @type_callable(op)
    def type_op(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            if _is_number(a) and _is_number(b) and (isinstance(a, LanesType) or isinstance(b, LanesType)):
                return lanes_type
            return None

        return typer

    for args in ((LanesType, LanesType), (LanesType, types.Float), (types.Float, LanesType)):

        @lower_builtin(op, *args)
        def lower_op(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            a, b = (_as(builder, v, t, lanes_type) for v, t in zip(values, sig.args, strict=True))
            return getattr(builder, method)(a, b)


for _op, _method in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register_operator(_op, _method)


@type_callable(operator.neg)
def _type_neg(context: Any) -> Any:
    return lambda a: lanes_type if isinstance(a, LanesType) else None


@lower_builtin(operator.neg, LanesType)
def _lower_neg(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    return builder.fneg(values[0])


def ir_type(numba_type: Any) -> Any:
    """Return the LLVM type of a float64 or of a group of SIMD lanes."""
    return _VECTOR if isinstance(numba_type, LanesType) else _DOUBLE


def int_type(numba_type: Any) -> Any:
    """Return the LLVM type of the bits of a float64, or of each float64 of a group, as integers."""
    return ir.VectorType(_INT64, WIDTH) if isinstance(numba_type, LanesType) else _INT64


def int_constant(numba_type: Any, value: int) -> Any:
    """Return an LLVM constant of `int_type`, the same integer in every lane."""
    kind = int_type(numba_type)
    return ir.Constant(kind, [value] * WIDTH if isinstance(numba_type, LanesType) else value)


def _common(*numba_types: Any) -> Any:
    return lanes_type if any(isinstance(t, LanesType) for t in numba_types) else types.float64


# numba inspects the signature of a typer, so each number of arguments needs its own typer
_TYPERS: dict[int, Callable[..., Any]] = {
    1: lambda a: _common(a),
    2: lambda a, b: _common(a, b),
    3: lambda a, b, c: _common(a, b, c),
    4: lambda a, b, c, d: _common(a, b, c, d),
}


def primitive(python: Callable[..., Any], emit: Callable[..., Any]) -> None:
    """Register the compiled form of a plain Python function of numbers, for float64 and for groups of SIMD lanes.

    `emit(builder, numba_type, *values)` returns the LLVM value; scalars among the arguments have
    been spread over the lanes if any argument is a group.
    """
    count = python.__code__.co_argcount

    @type_callable(python)
    def type_call(context: Any) -> Any:
        return _TYPERS[count]

    @lower_builtin(python, *[types.Any] * count)
    def lower_call(context: Any, builder: Any, sig: Any, values: Any) -> Any:
        spread = [_as(builder, v, t, sig.return_type) for v, t in zip(values, sig.args, strict=True)]
        return emit(builder, sig.return_type, *spread)


def _call(name: str) -> Callable[..., Any]:
    def emit(builder: Any, numba_type: Any, *values: Any) -> Any:
        kind = ir_type(numba_type)
        suffix = f"v{WIDTH}f64" if isinstance(numba_type, LanesType) else "f64"
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind] * len(values)), f"llvm.{name}.{suffix}"
        )
        return builder.call(function, values)

    return emit


def sqrt(x: Any) -> Any:
    """Return the square root of `x`, correctly rounded."""
    return np.sqrt(x)


def absolute(x: Any) -> Any:
    """Return the absolute value of `x`."""
    return np.abs(x)


def multiply_add(a: Any, b: Any, c: Any) -> Any:
    """Return ``a * b + c``, rounded once.

    Within a function sums of products are fused by themselves (see `fusing`); of two products that is the
    one on the left, and this can say another.
    """
    return a * b + c


def copysign(x: Any, sign: Any) -> Any:
    """Return `x` with the sign of `sign`."""
    return np.copysign(x, sign)


def floor(x: Any) -> Any:
    """Return the largest whole number that is not above `x`."""
    return np.floor(x)


def upper(x: Any) -> Any:
    """Return `x` with its last 27 mantissa bits set to 0, so that products of two such numbers are exact."""
    bits = np.asarray(x, np.float64).view(np.int64) & np.int64(-(2**27))
    return bits.view(np.float64)[()]


def inverse_sqrt_rough(x: Any) -> Any:
    """Compute the inverse square root of a positive normal number, with a relative error of 3.5 %."""
    bits = np.int64(_INVERSE_ROOT) - (np.asarray(x, np.float64).view(np.int64) >> np.int64(1))
    return bits.view(np.float64)[()]


def where_less(a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where ``a < b``, else `no`; a comparison with NaN counts as not less."""
    return np.where(a < b, yes, no)[()]


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers; `b` if either is NaN."""
    return where_less(a, b, a, b)


def maximum(a: Any, b: Any) -> Any:
    """Return the larger of two numbers; `b` if either is NaN."""
    return where_less(b, a, a, b)


def times_power_of_two(x: Any, shifted: Any) -> Any:
    """Multiply `x` by 2**k, with the integer k held in the low bits of the float `shifted` (see `vecmath`)."""
    low = np.asarray(shifted, np.float64).view(np.int64) << np.int64(52)
    return (np.asarray(x, np.float64).view(np.int64) + low).view(np.float64)[()]


def negate_if_bit(x: Any, shifted: Any, bit: int) -> Any:
    """Negate `x` where bit number `bit` of the integer held in the low bits of the float `shifted` is set."""
    flip = (np.asarray(shifted, np.float64).view(np.int64) >> np.int64(bit)) & np.int64(1)
    return np.where(flip == 1, -x, x)[()]


def where_odd(shifted: Any, odd: Any, even: Any) -> Any:
    """Return `odd` where the integer held in the low bits of the float `shifted` is odd, else `even`."""
    low = np.asarray(shifted, np.float64).view(np.int64) & np.int64(1)
    return np.where(low == 1, odd, even)[()]


def any_nonzero(x: Any) -> bool:
    """Return whether a number, or any lane of a group, is not 0."""
    return bool(np.any(x != 0.0))


def binary_exponent(x: Any) -> Any:
    """Return the exponent e of a positive normal number x = m 2**e with m in [1, 2), as a float."""
    return np.frexp(x)[1] - 1.0


def mantissa(x: Any) -> Any:
    """Return the mantissa m of a positive normal number x = m 2**e with m in [1, 2)."""
    return np.frexp(x)[0] * 2.0


def _emit_where_less(builder: Any, numba_type: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), yes, no)


def _emit_minimum(builder: Any, numba_type: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _emit_maximum(builder: Any, numba_type: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", b, a), a, b)


def _emit_power(builder: Any, numba_type: Any, x: Any, shifted: Any) -> Any:
    kind = int_type(numba_type)
    shift = builder.shl(builder.bitcast(shifted, kind), int_constant(numba_type, 52))
    return builder.bitcast(builder.add(builder.bitcast(x, kind), shift), ir_type(numba_type))


def _emit_where_odd(builder: Any, numba_type: Any, shifted: Any, odd: Any, even: Any) -> Any:
    low = builder.and_(builder.bitcast(shifted, int_type(numba_type)), int_constant(numba_type, 1))
    return builder.select(builder.icmp_unsigned("!=", low, int_constant(numba_type, 0)), odd, even)


def _emit_exponent(builder: Any, numba_type: Any, x: Any) -> Any:
    # 2**52 + biased exponent, read as a float, less 2**52 and the bias
    bits = builder.bitcast(x, int_type(numba_type))
    exponent = builder.lshr(bits, int_constant(numba_type, 52))
    number = builder.or_(exponent, int_constant(numba_type, 0x4330000000000000))
    kind = ir_type(numba_type)
    offset = 2.0**52 + 1023.0
    constant = ir.Constant(kind, [offset] * WIDTH if kind is _VECTOR else offset)
    return builder.fsub(builder.bitcast(number, kind), constant)


def _emit_mantissa(builder: Any, numba_type: Any, x: Any) -> Any:
    bits = builder.bitcast(x, int_type(numba_type))
    fraction = builder.and_(bits, int_constant(numba_type, 0x000FFFFFFFFFFFFF))
    number = builder.or_(fraction, int_constant(numba_type, 0x3FF0000000000000))
    return builder.bitcast(number, ir_type(numba_type))


def _emit_upper(builder: Any, numba_type: Any, x: Any) -> Any:
    bits = builder.and_(builder.bitcast(x, int_type(numba_type)), int_constant(numba_type, -(2**27)))
    return builder.bitcast(bits, ir_type(numba_type))


def _emit_inverse_sqrt_rough(builder: Any, numba_type: Any, x: Any) -> Any:
    half = builder.ashr(builder.bitcast(x, int_type(numba_type)), int_constant(numba_type, 1))
    return builder.bitcast(builder.sub(int_constant(numba_type, _INVERSE_ROOT), half), ir_type(numba_type))


primitive(sqrt, _call("sqrt"))
primitive(inverse_sqrt_rough, _emit_inverse_sqrt_rough)
primitive(floor, _call("floor"))
primitive(upper, _emit_upper)
primitive(absolute, _call("fabs"))
primitive(multiply_add, _call("fma"))
primitive(copysign, _call("copysign"))
primitive(where_less, _emit_where_less)
primitive(minimum, _emit_minimum)
primitive(maximum, _emit_maximum)
primitive(times_power_of_two, _emit_power)
primitive(where_odd, _emit_where_odd)
primitive(binary_exponent, _emit_exponent)
primitive(mantissa, _emit_mantissa)


@type_callable(any_nonzero)
def _type_any_nonzero(context: Any) -> Any:
    return lambda x: types.boolean if _is_number(x) else None


@lower_builtin(any_nonzero, types.Any)
def _lower_any_nonzero(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    kind = ir_type(sig.args[0])
    found = builder.fcmp_unordered("!=", values[0], ir.Constant(kind, None))
    if not isinstance(sig.args[0], LanesType):
        return found
    bits = ir.IntType(WIDTH)
    return builder.icmp_unsigned("!=", builder.bitcast(found, bits), ir.Constant(bits, 0))


@type_callable(negate_if_bit)
def _type_negate_if_bit(context: Any) -> Any:
    return lambda x, shifted, bit: x if isinstance(bit, types.IntegerLiteral) else None


@lower_builtin(negate_if_bit, types.Any, types.Any, types.IntegerLiteral)
def _lower_negate_if_bit(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    kind = int_type(sig.return_type)
    shift = int_constant(sig.return_type, 63 - sig.args[2].literal_value)
    sign_bit = int_constant(sig.return_type, -(2**63))
    sign = builder.and_(builder.shl(builder.bitcast(values[1], kind), shift), sign_bit)
    flipped = builder.xor(builder.bitcast(values[0], kind), sign)
    return builder.bitcast(flipped, ir_type(sig.return_type))


def load(array: np.ndarray, offset: int) -> Any:
    """Return the group of lanes at ``array[offset : offset + WIDTH]`` (1-D float64, bounds are not checked)."""
    return array[offset : offset + WIDTH].copy()


def store(array: np.ndarray, offset: int, value: Any) -> None:
    """Write a group of lanes to ``array[offset : offset + WIDTH]`` (bounds are not checked)."""
    array[offset : offset + WIDTH] = value


def load_rows(array: np.ndarray, offset: int, n: int) -> tuple[Any, ...]:
    """Return `n` consecutive lane groups of an array as a tuple; `n` is a compile-time constant."""
    return tuple(load(array, offset + i * WIDTH) for i in range(n))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


@type_callable(load)
def _type_load(context: Any) -> Any:
    return lambda array, offset: lanes_type


@lower_builtin(load, types.Array, types.Integer)
def _lower_load(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    return builder.load(_pointer(context, builder, sig.args[0], *values), align=8)


@type_callable(store)
def _type_store(context: Any) -> Any:
    return lambda array, offset, value: types.void


@lower_builtin(store, types.Array, types.Integer, types.Any)
def _lower_store(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    vector = _as(builder, values[2], sig.args[2], lanes_type)
    builder.store(vector, _pointer(context, builder, sig.args[0], *values[:2]), align=8)
    return context.get_dummy_value()


@type_callable(load_rows)
def _type_load_rows(context: Any) -> Any:
    def typer(array: Any, offset: Any, n: Any) -> Any:
        if isinstance(n, types.IntegerLiteral):
            return types.UniTuple(lanes_type, n.literal_value)
        return None

    return typer


@lower_builtin(load_rows, types.Array, types.Integer, types.IntegerLiteral)
def _lower_load_rows(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    rows = []
    for i in range(sig.return_type.count):
        index = builder.add(values[1], ir.Constant(values[1].type, i * WIDTH))
        pointer = _pointer(context, builder, sig.args[0], values[0], index)
        rows.append(builder.load(pointer, align=8))
    return context.make_tuple(builder, sig.return_type, rows)


def store_rows(array: np.ndarray, offset: int, rows: tuple[Any, ...]) -> None:
    """Write a tuple of lane groups to consecutive rows of an array."""
    for i, row in enumerate(rows):
        store(array, offset + i * WIDTH, row)


@type_callable(store_rows)
def _type_store_rows(context: Any) -> Any:
    return lambda array, offset, rows: types.void


@lower_builtin(store_rows, types.Array, types.Integer, types.BaseTuple)
def _lower_store_rows(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    for i, numba_type in enumerate(sig.args[2]):
        index = builder.add(values[1], ir.Constant(values[1].type, i * WIDTH))
        pointer = _pointer(context, builder, sig.args[0], values[0], index)
        vector = _as(builder, builder.extract_value(values[2], i), numba_type, lanes_type)
        builder.store(vector, pointer, align=8)
    return context.get_dummy_value()


def take(queue: np.ndarray) -> int:
    """Return the next number of a queue. Compiled threads that share the queue get different numbers."""
    number = int(queue[0])
    queue[0] += 1
    return number


@type_callable(take)
def _type_take(context: Any) -> Any:
    return lambda queue: types.int64


@lower_builtin(take, types.Array)
def _lower_take(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    place = context.make_array(sig.args[0])(context, builder, values[0]).data
    return builder.atomic_rmw("add", place, ir.Constant(ir.IntType(64), 1), "monotonic")
