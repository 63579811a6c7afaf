"""Fuse products with sums (multiply-add) by a fixed rule, so that results have the same bits on every CPU.

A fused multiply-add, ``a * b + c`` rounded once, costs half as much as a product and a sum, so compilers like to fuse.
But which operations a compiler fuses depends on the CPU, on the compiler's version and on inlining; so the last bits
of a result would depend on them, too. Here fusing depends only on the source of the function:

- A sum or difference is fused with a product that is one of its two terms (or the negative of one). The product may
  be written in the sum, or assigned to a name before.
- If both terms are products, the left one is fused.
- Nothing else is fused: not the result of another function, and not a named product from another branch or from
  outside the present loop body.

The rule is applied to numba's LLVM code of each function, before LLVM optimises it; LLVM itself is not allowed to
fuse. On a CPU without a multiply-add instruction, the function ``fma`` of the C library gives the same bits.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from llvmlite.ir.instructions import InsertValue
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary


class FusedLibrary(JITCodeLibrary):
    """Code library for numba that fuses products with sums in the functions added to it."""

    def add_ir_module(self, ir_module: Any) -> None:
        """Add the LLVM code of a function after fusing its products with sums."""
        fuse_products(ir_module)
        super().add_ir_module(ir_module)  # type: ignore[no-untyped-call]


def fuse_products(module: ir.Module) -> None:
    """Replace sums with a product by fused multiply-adds in every function of an LLVM module, in place."""
    for function in module.functions:
        _fuse_in(function)


def _fuse_in(function: ir.Function) -> None:
    replaced: dict[ir.Instruction, ir.Instruction] = {}
    for block in function.blocks:
        for instruction in list(block.instructions):
            if instruction.opname in ("fadd", "fsub") and not _is_negation(instruction):
                fused = _fused(instruction)
                if fused is not None:
                    replaced[instruction] = fused
                    # the product stays; LLVM removes it if nothing else uses it
                    block.instructions.remove(instruction)
    if not replaced:
        return
    for block in function.blocks:
        for instruction in block.instructions:
            for operand in {x for x in instruction.operands if x in replaced}:
                instruction.replace_usage(operand, replaced[operand])
                if isinstance(instruction, InsertValue):  # llvmlite stores this operand twice and prints the copy
                    instruction.value = instruction.operands[1]


def _fused(instruction: ir.Instruction) -> Any:
    """Insert a fused multiply-add before a sum or difference and return it; None if neither term is a product."""
    if getattr(instruction.type, "element", instruction.type) != ir.DoubleType():
        return None
    builder = ir.IRBuilder(instruction.parent)
    builder.position_before(instruction)
    left, right = instruction.operands
    is_difference = instruction.opname == "fsub"
    factors = _factors(builder, left)
    if factors is not None:
        rest = builder.fneg(right) if is_difference else right
        return _multiply_add(builder, *factors, rest)
    factors = _factors(builder, right)
    if factors is None:
        return None
    a, b = factors
    return _multiply_add(builder, builder.fneg(a) if is_difference else a, b, left)


def _is_negation(value: Any) -> bool:
    """Return whether an LLVM instruction negates a value, written as ``fneg`` or as a difference -0.0 - x."""
    opname = getattr(value, "opname", None)
    if opname != "fsub":
        return bool(opname == "fneg")
    left = value.operands[0]
    zero = left.constant if isinstance(left, ir.Constant) else None
    return isinstance(zero, float) and zero == 0.0 and math.copysign(1.0, zero) < 0.0


def _factors(builder: ir.IRBuilder, value: Any) -> tuple[Any, Any] | None:
    """Return the two factors of a product, or of a scalar product copied to all SIMD lanes; None for any other LLVM
    value.
    """
    opname = getattr(value, "opname", None)
    if opname == "fmul":
        return tuple(value.operands)
    if _is_negation(value):
        factors = _factors(builder, value.operands[-1])
        return None if factors is None else (builder.fneg(factors[0]), factors[1])
    if opname == "shufflevector" and getattr(value.operands[0], "opname", None) == "insertelement":
        factors = _factors(builder, value.operands[0].operands[1])
        return None if factors is None else tuple(_like(builder, value, x) for x in factors)
    return None


def _like(builder: ir.IRBuilder, spread: Any, scalar: Any) -> Any:
    """Copy a scalar to all SIMD lanes, by instructions like those that made `spread`."""
    inserted, undefined, mask = spread.operands
    first = builder.insert_element(inserted.operands[0], scalar, inserted.operands[2])
    return builder.shuffle_vector(first, undefined, mask)


def _multiply_add(builder: ir.IRBuilder, a: Any, b: Any, c: Any) -> Any:
    kind = c.type
    name = f"llvm.fma.v{kind.count}f64" if isinstance(kind, ir.VectorType) else "llvm.fma.f64"
    signature = ir.FunctionType(kind, [kind] * 3)
    function = cgutils.get_or_insert_function(builder.module, signature, name)  # type: ignore[no-untyped-call]
    return builder.call(function, (a, b, c))
