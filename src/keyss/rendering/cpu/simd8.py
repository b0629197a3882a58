"""Explicit vectors of 8 float32 for numba kernels, and a few scalar operations that numba lacks.

LLVM does not vectorise the row loops of the rasterizer by itself. The type maps to LLVM's <8 x float>, which
all targets support: one AVX register, two SSE or NEON registers. `+`, `-` and `*` work between vectors and
between a vector and a float32.

Arrays are indexed flat, must be contiguous, and are not bounds-checked. The decorator of the kernel sets the
floating-point assumptions of the compiler, see `jit`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import inspect
import operator
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.ir.instructions import FastMathFlags
from numba import extending, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from keyss.kernels.jit import inline

intrinsic: Any = extending.intrinsic  # kernels call intrinsics without the typing context

FLOAT = ir.FloatType()
INT = ir.IntType(32)
VECTOR = ir.VectorType(FLOAT, 8)
INT_VECTOR = ir.VectorType(INT, 8)
_ONE, _TWO, _LN_2 = np.float32(1), np.float32(2), np.float32(np.log(2))
_TWO_THIRDS, _TWO_FIFTHS, _TWO_SEVENTHS, _TWO_NINTHS = (np.float32(2 / n) for n in (3, 5, 7, 9))


class Float32x8(types.Type):
    """The numba type of a vector of 8 float32."""

    def __init__(self):
        super().__init__(name="float32x8")


float32x8 = Float32x8()


@register_model(Float32x8)
class _Float32x8Model(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, VECTOR)


# ---------------------------------------------------------------------------------------- building blocks


def _constant(value):
    return ir.Constant(VECTOR, [float(np.float32(value))] * 8)


def shuffle(builder, a, b, lanes):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, 8), lanes))


def _splat(builder, scalar):
    undefined = ir.Constant(VECTOR, ir.Undefined)
    return shuffle(builder, builder.insert_element(undefined, scalar, INT(0)), undefined, [0] * 8)


def _operand(argument_type):
    """The type of an argument: vectors unchanged, numbers as float32."""
    return argument_type if isinstance(argument_type, Float32x8) else types.float32


def _to_vectors(builder, signature, values):
    return [
        value if isinstance(argument, Float32x8) else _splat(builder, value)
        for argument, value in zip(signature.args, values, strict=True)
    ]


def _multiply_add(builder, a, b, c):
    return builder.fadd(builder.fmul(a, b), c)


def element(context, builder, array_type, array, index):
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _llvm_function(builder, name, result, arguments):
    return cgutils.get_or_insert_function(builder.module, ir.FunctionType(result, arguments), name)


# ---------------------------------------------------------------------------------------- + - *


def _register_operator(python_operator, instruction):
    @type_callable(python_operator)
    def type_of(context):
        def typer(a, b):
            vectors = [isinstance(t, Float32x8) for t in (a, b)]
            if all(vectors) or (any(vectors) and types.float32 in (a, b)):
                return float32x8
            return None

        return typer

    def lower(context, builder, signature, values):
        return getattr(builder, instruction)(*_to_vectors(builder, signature, values))

    for operands in ((Float32x8, Float32x8), (Float32x8, types.Float), (types.Float, Float32x8)):
        lower_builtin(python_operator, *operands)(lower)


_register_operator(operator.add, "fadd")
_register_operator(operator.sub, "fsub")
_register_operator(operator.mul, "fmul")


# ---------------------------------------------------------------------------------------- vectors


@intrinsic
def load8(typingctx, array, index):
    """The 8 floats from flat position `index`."""

    def codegen(context, builder, signature, arguments):
        address = builder.bitcast(
            element(context, builder, signature.args[0], *arguments), VECTOR.as_pointer()
        )
        value = builder.load(address)
        value.align = 4
        return value

    return float32x8(array, index), codegen


@intrinsic
def store8(typingctx, array, index, value):
    """Write the 8 floats from flat position `index`."""

    def codegen(context, builder, signature, arguments):
        address = element(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], builder.bitcast(address, VECTOR.as_pointer())).align = 4
        return context.get_dummy_value()

    return types.void(array, index, value), codegen


@intrinsic
def store_interleaved(typingctx, array, index, a, b, c):
    """Write (a_0, b_0, c_0, a_1, ...) from flat position `index`."""

    def codegen(context, builder, signature, arguments):
        a, b, c = arguments[2:]
        wide = ir.VectorType(INT, 16)
        ab = builder.shuffle_vector(a, b, ir.Constant(wide, list(range(16))))
        cc = builder.shuffle_vector(c, c, ir.Constant(wide, list(range(16))))
        mask = [8 * (i % 3) + i // 3 for i in range(24)]
        value = builder.shuffle_vector(ab, cc, ir.Constant(ir.VectorType(INT, 24), mask))
        address = element(context, builder, signature.args[0], *arguments[:2])
        builder.store(value, builder.bitcast(address, value.type.as_pointer())).align = 4
        return context.get_dummy_value()

    return types.void(array, index, float32x8, float32x8, float32x8), codegen


@intrinsic
def load_interleaved(typingctx, array, index):
    """The inverse of `store_interleaved`."""

    def codegen(context, builder, signature, arguments):
        address = element(context, builder, signature.args[0], *arguments)
        wide = builder.load(builder.bitcast(address, ir.VectorType(FLOAT, 24).as_pointer()))
        wide.align = 4
        parts = [shuffle(builder, wide, wide, [3 * lane + k for lane in range(8)]) for k in range(3)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(float32x8, 3)(array, index), codegen


class _NoFlags(FastMathFlags):
    """Ignores the flags of `fastmath` that numba adds to every call."""

    def add(self, name):
        pass


@intrinsic
def fused_multiply_add(typingctx, a, b, c):
    """a b + c of float32 numbers, rounded once, even on processors without such an instruction."""

    def codegen(context, builder, signature, arguments):
        # With `afn` or `contract`, LLVM would emit a product and a sum on these, which round twice.
        value = builder.fma(*arguments)
        value.fastmath = _NoFlags()
        return value

    return types.float32(types.float32, types.float32, types.float32), codegen


def _vector_intrinsic(build):
    """An intrinsic from `build`, which takes vectors; numbers among its arguments are broadcast."""

    def function(typingctx, *operands):
        def codegen(context, builder, signature, arguments):
            return build(builder, *_to_vectors(builder, signature, arguments))

        return float32x8(*map(_operand, operands)), codegen

    # numba does not support *arguments.
    function.__signature__ = inspect.signature(build)  # type: ignore[attr-defined]
    return intrinsic(function)


def _select(predicate, builder, a, b, yes, no):
    return builder.select(builder.fcmp_ordered(predicate, a, b), yes, no)


def _call(name, builder, a):
    return builder.call(_llvm_function(builder, name, VECTOR, [VECTOR]), [a])


multiply_add = _vector_intrinsic(_multiply_add)  # a * b + c, one instruction where the CPU has it
divide = _vector_intrinsic(lambda builder, a, b: builder.fdiv(a, b))
select_ge = _vector_intrinsic(partial(_select, ">="))  # (a, b, yes, no): `yes` where a >= b, else `no`
select_gt = _vector_intrinsic(partial(_select, ">"))
minimum = _vector_intrinsic(lambda builder, a, b: _select("<", builder, a, b, a, b))
maximum = _vector_intrinsic(lambda builder, a, b: _select(">", builder, a, b, a, b))
square_root = _vector_intrinsic(partial(_call, "llvm.sqrt.v8f32"))
floor8 = _vector_intrinsic(partial(_call, "llvm.floor.v8f32"))
ceil8 = _vector_intrinsic(partial(_call, "llvm.ceil.v8f32"))
absolute = _vector_intrinsic(partial(_call, "llvm.fabs.v8f32"))


@_vector_intrinsic
def splat(builder, a):
    """The vector with `a` in every lane."""
    return a


@_vector_intrinsic
def ramp(builder, start):
    """(start, start + 1, ... start + 7)."""
    return builder.fadd(start, ir.Constant(VECTOR, [float(i) for i in range(8)]))


@_vector_intrinsic
def negative_abs(builder, a):
    """-|a|."""
    bits = builder.or_(builder.bitcast(a, INT_VECTOR), ir.Constant(INT_VECTOR, [-(1 << 31)] * 8))
    return builder.bitcast(bits, VECTOR)


@_vector_intrinsic
def sum_lanes_of_8(builder, a0, a1, a2, a3, a4, a5, a6, a7):
    """The vector whose lane i is the sum of the lanes of a_i: 7 steps instead of 8 times 3."""

    def add_neighbours(a, b):
        even = shuffle(builder, a, b, [0, 2, 8, 10, 4, 6, 12, 14])
        odd = shuffle(builder, a, b, [1, 3, 9, 11, 5, 7, 13, 15])
        return builder.fadd(even, odd)

    low = add_neighbours(add_neighbours(a0, a1), add_neighbours(a2, a3))
    high = add_neighbours(add_neighbours(a4, a5), add_neighbours(a6, a7))
    left = shuffle(builder, low, high, [0, 1, 2, 3, 8, 9, 10, 11])
    right = shuffle(builder, low, high, [4, 5, 6, 7, 12, 13, 14, 15])
    return builder.fadd(left, right)


@intrinsic
def any_gt(typingctx, a, b):
    """True if a > b in any lane."""

    def codegen(context, builder, signature, arguments):
        mask = builder.fcmp_ordered(">", *_to_vectors(builder, signature, arguments))
        lanes = ir.IntType(8)
        return builder.icmp_unsigned("!=", builder.bitcast(mask, lanes), lanes(0))

    return types.boolean(_operand(a), _operand(b)), codegen


@intrinsic
def sum_lanes(typingctx, a):
    """The sum of the 8 lanes, in a fixed order."""

    def codegen(context, builder, signature, arguments):
        value = arguments[0]
        for lanes in ([4, 5, 6, 7, 0, 1, 2, 3], [2, 3, 0, 1, 6, 7, 4, 5], [1, 0, 3, 2, 5, 4, 7, 6]):
            value = builder.fadd(value, shuffle(builder, value, value, lanes))
        return builder.extract_element(value, INT(0))

    return types.float32(float32x8), codegen


@intrinsic
def _exponent_and_fraction(typingctx, x):
    """(e, f) with x = 2^e f and f in [sqrt(1/2), sqrt(2)), for positive normal x."""

    def codegen(context, builder, signature, arguments):
        def constant(value):
            return ir.Constant(INT_VECTOR, [value] * 8)

        bits = builder.bitcast(arguments[0], INT_VECTOR)
        exponent = builder.ashr(builder.sub(bits, constant(0x3F3504F3)), constant(23))
        fraction = builder.sub(bits, builder.shl(exponent, constant(23)))
        values = [builder.sitofp(exponent, VECTOR), builder.bitcast(fraction, VECTOR)]
        return context.make_tuple(builder, signature.return_type, values)

    return types.UniTuple(float32x8, 2)(float32x8), codegen


@inline
def log(x):
    """Natural logarithm of positive normal numbers, within 1e-7 (1 + |log x|)."""
    exponent, fraction = _exponent_and_fraction(x)
    t = divide(fraction - _ONE, fraction + _ONE)
    tt = t * t
    # 2 artanh(t)
    series = multiply_add(tt, _TWO_NINTHS, _TWO_SEVENTHS)
    series = multiply_add(tt, series, _TWO_FIFTHS)
    series = multiply_add(tt, series, _TWO_THIRDS)
    return multiply_add(exponent, _LN_2, t * multiply_add(tt, series, _TWO))


# 2^x on [-1/2, 1/2] with minimal relative error, 2e-8 (Lawson's method, degree 6).
_EXP2_COEFFICIENTS = (
    1.0000000005541867,
    0.6931472057371977,
    0.2402264689047862,
    0.055503287770806674,
    0.009618488973962417,
    0.0013399931181878146,
    0.00015345807464610118,
)
_LOG2_E = 1.4426950408889634


def _exponential(power):
    """e^x 2^power, exactly scaled: the power is added to the float's exponent."""
    lowest = -87.0 - power * np.log(2.0)

    def build(builder, x):
        scaled = builder.fmul(x, _constant(_LOG2_E))
        exponent = _call("llvm.rint.v8f32", builder, scaled)
        fraction = builder.fsub(scaled, exponent)
        result = _constant(_EXP2_COEFFICIENTS[-1])
        for coefficient in _EXP2_COEFFICIENTS[-2::-1]:
            result = _multiply_add(builder, result, fraction, _constant(coefficient))
        steps = builder.fptosi(exponent, INT_VECTOR)
        steps = builder.add(steps, ir.Constant(INT_VECTOR, [power] * 8))
        shift = builder.shl(steps, ir.Constant(INT_VECTOR, [23] * 8))
        result = builder.bitcast(builder.add(builder.bitcast(result, INT_VECTOR), shift), VECTOR)
        return _select(">", builder, x, _constant(lowest), result, _constant(0.0))

    return _vector_intrinsic(build)


exp = _exponential(0)  # e^x for x < 87, and 0 below -87; the relative error is about 1e-7 (1 + |x|)
exp_times_2_64 = _exponential(64)  # e^x 2^64 for x < 43, and 0 below -131


# ---------------------------------------------------------------------------------------- scalars


@intrinsic
def at(typingctx, array, index):
    """array.flat[index], without numba's test for negative indices."""

    def codegen(context, builder, signature, arguments):
        return builder.load(element(context, builder, signature.args[0], *arguments))

    return array.dtype(array, index), codegen


@intrinsic
def put(typingctx, array, index, value):
    """array.flat[index] = value, without numba's test for negative indices."""

    def codegen(context, builder, signature, arguments):
        builder.store(arguments[2], element(context, builder, signature.args[0], *arguments[:2]))
        return context.get_dummy_value()

    return types.void(array, index, array.dtype), codegen


@intrinsic
def fetch_add(typingctx, array, index, value):
    """Atomically add to an integer element; returns its old value."""

    def codegen(context, builder, signature, arguments):
        address = element(context, builder, signature.args[0], *arguments[:2])
        return builder.atomic_rmw("add", address, arguments[2], "monotonic")

    return array.dtype(array, index, array.dtype), codegen


def _prefetch(write):
    @intrinsic
    def prefetch(typingctx, array, index):
        def codegen(context, builder, signature, arguments):
            address = element(context, builder, signature.args[0], *arguments)
            address = builder.bitcast(address, ir.IntType(8).as_pointer())
            kinds = [address.type, INT, INT, INT]
            function = _llvm_function(builder, "llvm.prefetch.p0", ir.VoidType(), kinds)
            builder.call(function, [address, INT(write), INT(3), INT(1)])
            return context.get_dummy_value()

        return types.void(array, index), codegen

    return prefetch


prefetch_read = _prefetch(0)  # (array, index): prefetch the cache line of array.flat[index]
prefetch_write = _prefetch(1)
