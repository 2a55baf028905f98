"""Vectors of 16 numbers for numba kernels: explicit SIMD through LLVM, on AVX-512, AVX2 and NEON alike.

LLVM vectorizes loops over pixels only if it can prove, anew for every inner loop, that no arrays overlap. A
vector type needs no such proof. The kernels are tuned for float32; float64 uses the same code.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

LANES = 16

# Polynomials for 2^x on [-0.5, 0.5], whose degrees give a relative error near the type's rounding (1.7e-7 and
# 1e-16).
_EXP2 = {
    bits: np.polynomial.Chebyshev.interpolate(np.exp2, degree, domain=[-0.5, 0.5])
    .convert(kind=np.polynomial.Polynomial)
    .coef.tolist()
    for bits, degree in ((32, 5), (64, 12))
}


class VectorType(types.Type):
    """Vector of 16 numbers of one type, or of the booleans of a comparison."""

    def __init__(self, dtype: types.Type):
        self.dtype = dtype
        super().__init__(name=f"vector({dtype})")


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VectorType):
        element = (
            ir.IntType(1) if kind.dtype == types.boolean else manager.lookup(kind.dtype).get_value_type()
        )
        super().__init__(manager, kind, ir.VectorType(element, LANES))


def _spread(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    """Copy a scalar to every lane. Vectors are returned unchanged."""
    if isinstance(value.type, ir.VectorType):
        return value
    vector = ir.VectorType(value.type, LANES)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)


def _broadcast(*kinds: Any) -> tuple[VectorType, list[types.Type]]:
    """Return the vector type among some operands, and all their types, numbers cast to the vector's."""
    vector = next(kind for kind in kinds if isinstance(kind, VectorType))
    return vector, [kind if isinstance(kind, VectorType) else vector.dtype for kind in kinds]


def _call(builder: ir.IRBuilder, name: str, *arguments: ir.Value) -> ir.Value:
    """Call an LLVM intrinsic lane by lane."""
    kind = arguments[0].type
    size = 32 if isinstance(kind.element, ir.FloatType) else 64
    signature = ir.FunctionType(kind, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, signature, f"{name}.v{LANES}f{size}")
    return builder.call(function, arguments)


# --- operators: + - * / between vectors and with scalars, comparisons --------------------------------------


def _register(symbol: Any, comparison: bool, emit: Any) -> None:
    class Template(AbstractTemplate):
        key = symbol

        def generic(self, args, kws):
            if len(args) != 2 or not any(isinstance(arg, VectorType) for arg in args):
                return None
            kind, operands = _broadcast(*args)
            return signature(VectorType(types.boolean) if comparison else kind, *operands)

    infer_global(symbol)(Template)

    def lower(context, builder, sig, args):
        return emit(builder, *(_spread(builder, arg) for arg in args))

    for kinds in ((VectorType, VectorType), (VectorType, types.Float), (types.Float, VectorType)):
        lower_builtin(symbol, *kinds)(lower)


_FUSE = ("contract",)  # a·b + c may become one instruction

for _symbols, _emit in (
    ((operator.add, operator.iadd), lambda b, x, y: b.fadd(x, y, flags=_FUSE)),
    ((operator.sub, operator.isub), lambda b, x, y: b.fsub(x, y, flags=_FUSE)),
    ((operator.mul, operator.imul), lambda b, x, y: b.fmul(x, y, flags=_FUSE)),
    ((operator.truediv, operator.itruediv), lambda b, x, y: b.fdiv(x, y)),
):
    for _symbol in _symbols:
        _register(_symbol, False, _emit)
for _symbol, _sign in ((operator.gt, ">"), (operator.ge, ">="), (operator.lt, "<"), (operator.le, "<=")):
    _register(_symbol, True, lambda b, x, y, sign=_sign: b.fcmp_ordered(sign, x, y))
_register(operator.and_, True, lambda b, x, y: b.and_(x, y))


# --- memory ----------------------------------------------------------------------------------------------


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: ir.Value, index: ir.Value) -> ir.Value:
    data = cgutils.create_struct_proxy(kind)(context, builder, value=array).data
    return builder.gep(data, [index])


@intrinsic
def load(typing_context, array, index):
    """Load 16 consecutive entries of a one-dimensional contiguous array."""
    kind = VectorType(array.dtype)

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, array, *args)
        vector = context.get_value_type(kind)
        found = builder.load(builder.bitcast(pointer, vector.as_pointer()))
        found.align = array.dtype.bitwidth // 8
        return found

    return kind(array, types.intp), emit


@intrinsic
def store(typing_context, array, index, value):
    """Write 16 consecutive entries of a one-dimensional contiguous array."""

    def emit(context, builder, sig, args):
        pointer = _pointer(context, builder, array, *args[:2])
        place = builder.bitcast(pointer, args[2].type.as_pointer())
        builder.store(args[2], place).align = array.dtype.bitwidth // 8
        return context.get_dummy_value()

    return types.void(array, types.intp, value), emit


@intrinsic
def entry(typing_context, array, place):
    """Load the entry of a contiguous array at an index, without negative wrap-around."""

    def emit(context, builder, sig, args):
        return builder.load(_pointer(context, builder, array, *args))

    return array.dtype(array, types.intp), emit


def _column(context: Any, builder: ir.IRBuilder, kind: Any, args: Any) -> Iterator[tuple[ir.Value, ir.Value]]:
    """Yield each lane's number, and the pointer to its entry in a matrix, from a row and a column on."""
    matrix = cgutils.create_struct_proxy(kind)(context, builder, value=args[0])
    width = cgutils.unpack_tuple(builder, matrix.shape)[1]
    place = builder.add(builder.mul(args[1], width), args[2])
    for lane in range(LANES):
        yield ir.Constant(ir.IntType(32), lane), builder.gep(matrix.data, [place])
        place = builder.add(place, width)


@intrinsic
def load_column(typing_context, matrix, row, column):
    """Load `matrix[row : row + 16, column]` of a contiguous matrix."""
    kind = VectorType(matrix.dtype)

    def emit(context, builder, sig, args):
        found = ir.Constant(context.get_value_type(kind), ir.Undefined)
        for lane, pointer in _column(context, builder, matrix, args):
            found = builder.insert_element(found, builder.load(pointer), lane)
        return found

    return kind(matrix, types.intp, types.intp), emit


@intrinsic
def store_column(typing_context, matrix, row, column, value):
    """Store `matrix[row : row + 16, column] = value` in a contiguous matrix."""

    def emit(context, builder, sig, args):
        for lane, pointer in _column(context, builder, matrix, args):
            builder.store(builder.extract_element(args[3], lane), pointer)
        return context.get_dummy_value()

    return types.void(matrix, types.intp, types.intp, value), emit


# --- functions -------------------------------------------------------------------------------------------


def _unary(name: str, doc: str) -> Any:
    @intrinsic
    def function(typing_context, x):
        return x(x), lambda context, builder, sig, args: _call(builder, name, args[0])

    function.__doc__ = doc
    return function


sqrt = _unary("llvm.sqrt", "Square root of every lane.")
ceil = _unary("llvm.ceil", "Every lane rounded up.")


def _choice(sign: str, doc: str) -> Any:
    @intrinsic
    def function(typing_context, x, y):
        kind, operands = _broadcast(x, y)

        def emit(context, builder, sig, args):
            first, second = (_spread(builder, arg) for arg in args)
            return builder.select(builder.fcmp_ordered(sign, first, second), first, second)

        return kind(*operands), emit

    function.__doc__ = doc
    return function


minimum = _choice("<", "The smaller of two, lane by lane; the second where one is NaN.")
maximum = _choice(">", "The larger of two, lane by lane; the second where one is NaN.")


@intrinsic
def where(typing_context, condition, x, y):
    """Choose `x` in the lanes where the condition holds, else `y`. Scalars are broadcast."""
    kind, operands = _broadcast(x, y)

    def emit(context, builder, sig, args):
        first, second = (_spread(builder, arg) for arg in args[1:])
        return builder.select(args[0], first, second)

    return kind(condition, *operands), emit


@intrinsic
def exp2(typing_context, x):
    """Raise 2 to the power of every lane (-100 to 100), with a relative error near the type's rounding."""

    def emit(context, builder, sig, args):
        bits = x.dtype.bitwidth
        exponent_at = 23 if bits == 32 else 52
        whole = _call(builder, "llvm.rint", args[0])
        rest = builder.fsub(args[0], whole)
        *lower, value = (ir.Constant(rest.type, [coefficient] * LANES) for coefficient in _EXP2[bits])
        for coefficient in reversed(lower):
            value = _call(builder, "llvm.fmuladd", value, rest, coefficient)
        integers = ir.VectorType(ir.IntType(bits), LANES)
        shift = ir.Constant(integers, [exponent_at] * LANES)
        exponent = builder.shl(builder.fptosi(whole, integers), shift)
        # Adding to the exponent's bits multiplies by a power of two.
        return builder.bitcast(builder.add(builder.bitcast(value, integers), exponent), value.type)

    return x(x), emit


@intrinsic
def total(typing_context, x):
    """Sum all lanes."""

    def emit(context, builder, sig, args):
        element = args[0].type.element
        kind = ir.FunctionType(element, [element, args[0].type])
        name = f"llvm.vector.reduce.fadd.v{LANES}f{x.dtype.bitwidth}"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.Constant(element, -0.0), args[0]], fastmath=("reassoc",))

    return x.dtype(x), emit


@intrinsic
def bits(typing_context, condition):
    """Pack the lanes in which a comparison holds into the bits of an integer; lane 0 is the lowest bit."""

    def emit(context, builder, sig, args):
        packed = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.zext(packed, ir.IntType(64))

    return types.int64(condition), emit


@intrinsic
def lowest_bit(typing_context, mask):
    """Return the index of the lowest set bit. The mask must not be 0."""

    def emit(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit
