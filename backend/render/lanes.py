"""Sixteen float32 numbers at a time, for numba kernels: the vector types of LLVM, which it lowers for any processor.

Left to itself the compiler does not vectorise loops as short as one row of one splat (some 10 to 30 cells), and a call
of libm's exp costs ten times the polynomial below. Arrays are flat, float32 and contiguous; an access touches
array[start : start + 16] and is not checked, so rows carry at least 16 elements of padding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

LANES = 16
LOWEST_EXPONENT = -30.0  # exp is clamped here: smaller weights would only make denormals

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)


def _operation(function: Callable[..., Any]) -> Callable[..., Any]:
    """numba's intrinsic; for a type checker, whatever its arguments are (numba drops the first, `typingctx`)."""
    return intrinsic(function)


class LanesType(types.Type):
    """Sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


lanes_type = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, value)] * LANES)


def _spread(builder: Any, scalar: Any) -> Any:
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INTS, [0] * LANES))


def _builtin(builder: Any, name: str, *values: Any) -> Any:
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(values))
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), values)


def _muladd(builder: Any, x: Any, y: Any, z: Any) -> Any:
    return _builtin(builder, "fmuladd", x, y, z)


def _address(context: Any, builder: Any, array_type: Any, array: Any, start: Any, width: int = LANES) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    pointer = builder.gep(data, [start])
    return builder.bitcast(pointer, ir.VectorType(_FLOAT, width).as_pointer())


def _is_flat_float32(array: Any) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.dtype == types.float32 and array.layout == "C"


@_operation
def spread(typingctx: Any, value: Any) -> Any:
    """The float32 number `value` in every lane."""
    del typingctx, value

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return lanes_type(types.float32), codegen


@_operation
def ramp(typingctx: Any, first: Any) -> Any:
    """first, first + 1, ..., first + 15."""
    del typingctx, first

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        steps = ir.Constant(_VECTOR, [ir.Constant(_FLOAT, float(k)) for k in range(LANES)])
        return builder.fadd(_spread(builder, args[0]), steps)

    return lanes_type(types.float32), codegen


@_operation
def load(typingctx: Any, array: Any, start: Any) -> Any:
    """array[start : start + 16]."""
    del typingctx, start
    if not _is_flat_float32(array):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, signature.args[0], args[0], args[1]), align=4)

    return lanes_type(array, types.intp), codegen


@_operation
def store(typingctx: Any, array: Any, start: Any, value: Any) -> Any:
    """array[start : start + 16] = value."""
    del typingctx, start, value
    if not _is_flat_float32(array):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, signature.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes_type), codegen


@_operation
def store_interleaved(typingctx: Any, array: Any, start: Any, even: Any, odd: Any) -> Any:
    """array[start : start + 32] = even[0], odd[0], even[1], odd[1], ..."""
    del typingctx, start, even, odd
    if not _is_flat_float32(array):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        order = [k // 2 + LANES * (k % 2) for k in range(2 * LANES)]
        mask = ir.Constant(ir.VectorType(_INT, 2 * LANES), [ir.Constant(_INT, k) for k in order])
        both = builder.shuffle_vector(args[2], args[3], mask)
        builder.store(both, _address(context, builder, signature.args[0], args[0], args[1], 2 * LANES), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes_type, lanes_type), codegen


@_operation
def load_stride2(typingctx: Any, array: Any, start: Any) -> Any:
    """array[start : start + 31 : 2]; touches 32 elements."""
    del typingctx, start
    if not _is_flat_float32(array):
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.VectorType(_FLOAT, 2 * LANES)
        both = builder.load(_address(context, builder, signature.args[0], args[0], args[1], 2 * LANES), align=4)
        mask = ir.Constant(_INTS, [ir.Constant(_INT, 2 * k) for k in range(LANES)])
        return builder.shuffle_vector(both, ir.Constant(wide, ir.Undefined), mask)

    return lanes_type(array, types.intp), codegen


@_operation
def add(typingctx: Any, x: Any, y: Any) -> Any:
    """x + y."""
    del typingctx, x, y

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(args[0], args[1])

    return lanes_type(lanes_type, lanes_type), codegen


@_operation
def multiply(typingctx: Any, x: Any, y: Any) -> Any:
    """x * y."""
    del typingctx, x, y

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(args[0], args[1])

    return lanes_type(lanes_type, lanes_type), codegen


@_operation
def muladd(typingctx: Any, x: Any, y: Any, z: Any) -> Any:
    """x * y + z, in one step where the processor has one."""
    del typingctx, x, y, z

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _muladd(builder, args[0], args[1], args[2])

    return lanes_type(lanes_type, lanes_type, lanes_type), codegen


@_operation
def larger_magnitude(typingctx: Any, x: Any, y: Any) -> Any:
    """max(x, |y|); x where y is not a number."""
    del typingctx, x, y

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        magnitude = _builtin(builder, "fabs", args[1])
        return builder.select(builder.fcmp_ordered(">", magnitude, args[0]), magnitude, args[0])

    return lanes_type(lanes_type, lanes_type), codegen


@_operation
def flushed(typingctx: Any, x: Any, smallest: Any) -> Any:
    """x, with 0 in the lanes whose magnitude is below the float32 number `smallest`."""
    del typingctx, x, smallest

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        magnitude = _builtin(builder, "fabs", args[0])
        keep = builder.fcmp_ordered(">=", magnitude, _spread(builder, args[1]))
        return builder.select(keep, args[0], _constant(0.0))

    return lanes_type(lanes_type, types.float32), codegen


# 2^f on [-1/2, 1/2], minimax of the relative error (9.2e-8) with the constant held at 1; highest power first.
_EXP2 = (0.00132647, 0.00967151, 0.05550734, 0.24022242, 0.69314698, 1.0)
_ROUND = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest integer in the low bits


def _exponential(builder: Any, x: Any) -> Any:
    lowest = _constant(LOWEST_EXPONENT)
    x = builder.select(builder.fcmp_ordered(">", x, lowest), x, lowest)
    rounded = _muladd(builder, x, _constant(1.4426950408889634), _constant(_ROUND))
    whole = builder.fsub(rounded, _constant(_ROUND))
    fraction = _muladd(builder, x, _constant(1.4426950408889634), builder.fneg(whole))
    power = _constant(_EXP2[0])
    for coefficient in _EXP2[1:]:
        power = _muladd(builder, power, fraction, _constant(coefficient))
    shift = builder.shl(builder.bitcast(rounded, _INTS), ir.Constant(_INTS, [ir.Constant(_INT, 23)] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(power, _INTS), shift), _VECTOR)


@_operation
def exponential(typingctx: Any, x: Any) -> Any:
    """exp(max(x, -30)) for x at most 0 (up to 80 in fact): 2^n times a polynomial in the fraction."""
    del typingctx, x

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _exponential(builder, args[0])

    return lanes_type(lanes_type), codegen


@_operation
def absorbed(typingctx: Any, x: Any) -> Any:
    """1 - exp(-x) for x at least 0, with all its digits near 0: there by its series to x^7."""
    del typingctx, x

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x = args[0]
        series = _constant(1.0 / 5040.0)
        for coefficient in (-1.0 / 720.0, 1.0 / 120.0, -1.0 / 24.0, 1.0 / 6.0, -0.5, 1.0):
            series = _muladd(builder, series, x, _constant(coefficient))
        whole = builder.fsub(_constant(1.0), _exponential(builder, builder.fneg(x)))
        return builder.select(builder.fcmp_ordered("<", x, _constant(0.5)), builder.fmul(series, x), whole)

    return lanes_type(lanes_type), codegen


@_operation
def total(typingctx: Any, x: Any) -> Any:
    """Sum of the lanes, always added in the same order: halves onto each other."""
    del typingctx, x

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, width = args[0], LANES
        while width > 1:
            width //= 2
            kind = ir.VectorType(_INT, width)
            low = ir.Constant(kind, [ir.Constant(_INT, k) for k in range(width)])
            high = ir.Constant(kind, [ir.Constant(_INT, k + width) for k in range(width)])
            x = builder.fadd(builder.shuffle_vector(x, x, low), builder.shuffle_vector(x, x, high))
        return builder.extract_element(x, ir.Constant(_INT, 0))

    return types.float32(lanes_type), codegen
