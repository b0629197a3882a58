"""Gather and scatter rows of arrays: column k of 8 rows becomes one vector.

A row belongs to one Gaussian; `ids[start:start + 8]` selects 8 of them. A Gaussian may occur several times if
the stored values are equal. Arrays are flat: row i starts at i * stride.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils

from keyss.rendering.cpu.simd8 import FLOAT, INT, VECTOR, element, float32x8, intrinsic, shuffle


def _transpose(builder, rows):
    """The transpose of 8 vectors: the i-th result has the i-th lanes of all rows."""
    rows = list(rows)
    # Exchange lanes between rows 4, 2 and 1 apart.
    for distance in (4, 2, 1):
        low = [lane if not lane & distance else 8 + lane - distance for lane in range(8)]
        high = [lane + distance if not lane & distance else 8 + lane for lane in range(8)]
        for i in range(8):
            if not i & distance:
                a, b = rows[i], rows[i + distance]
                rows[i] = shuffle(builder, a, b, low)
                rows[i + distance] = shuffle(builder, a, b, high)
    return rows


def _addresses(context, builder, signature, arguments):
    """The addresses of the 8 rows at `column`, for arguments (array, ids, start, stride, column)."""
    array, ids, start, stride, column = arguments[:5]
    first = element(context, builder, signature.args[1], ids, start)
    for lane in range(8):
        row = builder.load(builder.gep(first, [INT(lane)]))
        place = builder.add(builder.mul(row, stride), column)
        yield element(context, builder, signature.args[0], array, place)


def _parts(builder, address, count):
    """`count` floats as vectors of 8, 4, 2 and 1: (first lane, lanes, address)."""
    first = 0
    for size in (8, 4, 2, 1):
        if count & size:
            part = ir.VectorType(FLOAT, size)
            yield first, size, builder.bitcast(builder.gep(address, [INT(first)]), part.as_pointer())
            first += size


def _make_gather(count):
    @intrinsic
    def gather(typingctx, array, ids, start, stride, column):
        def codegen(context, builder, signature, arguments):
            rows = []
            for row in _addresses(context, builder, signature, arguments):
                value = ir.Constant(VECTOR, None)
                for first, size, address in _parts(builder, row, count):
                    part = builder.load(address)
                    part.align = 4
                    wide = ir.Constant(ir.VectorType(INT, 8), [min(lane, size - 1) for lane in range(8)])
                    lanes = [8 + lane - first if first <= lane < first + size else lane for lane in range(8)]
                    value = shuffle(builder, value, builder.shuffle_vector(part, part, wide), lanes)
                rows.append(value)
            return context.make_tuple(builder, signature.return_type, _transpose(builder, rows)[:count])

        return types.UniTuple(float32x8, count)(array, ids, start, types.intp, types.intp), codegen

    return gather


# (array, ids, start, stride, column): columns column:column + count of the 8 rows, as a tuple of vectors.
gather1 = _make_gather(1)
gather3 = _make_gather(3)
gather4 = _make_gather(4)
gather8 = _make_gather(8)


@intrinsic
def scatter(typingctx, array, ids, start, stride, column, values):
    """Write a tuple of vectors to the columns starting at `column`."""

    def codegen(context, builder, signature, arguments):
        count = signature.args[5].count
        columns = cgutils.unpack_tuple(builder, arguments[5], count)
        rows = _transpose(builder, columns + [ir.Constant(VECTOR, ir.Undefined)] * (8 - count))
        for value, row in zip(rows, _addresses(context, builder, signature, arguments), strict=True):
            for first, size, address in _parts(builder, row, count):
                lanes = ir.Constant(ir.VectorType(INT, size), list(range(first, first + size)))
                builder.store(builder.shuffle_vector(value, value, lanes), address).align = 4
        return context.get_dummy_value()

    return types.void(array, ids, start, types.intp, types.intp, values), codegen


@intrinsic
def load_transposed(typingctx, array, index):
    """The columns of the 8 x 8 floats from flat position `index`, as a tuple of vectors."""

    def codegen(context, builder, signature, arguments):
        address = element(context, builder, signature.args[0], *arguments)
        rows = []
        for row in range(8):
            place = builder.gep(address, [INT(8 * row)])
            rows.append(builder.load(builder.bitcast(place, VECTOR.as_pointer())))
            rows[-1].align = 4
        return context.make_tuple(builder, signature.return_type, _transpose(builder, rows))

    return types.UniTuple(float32x8, 8)(array, index), codegen
