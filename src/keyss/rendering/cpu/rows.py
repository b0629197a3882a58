"""Rows of arrays in and out of vectors: column k of 8 rows, which may lie anywhere, becomes one vector.

A row is what an array holds of one Gaussian; `ids[start:start + 8]` says which 8. One may be there several
times; what is stored must then be the same for all of them.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from keyss.rendering.cpu.jit import inlined
from keyss.rendering.cpu.simd8 import (
    at,
    load3,
    load4,
    load8,
    store3,
    store4,
    store8,
    transpose,
)


@inlined
def gather3(array, ids, start):
    """The columns of an array [N, 3]."""
    x, y, z, _, _, _, _, _ = transpose(
        load3(array, 3 * at(ids, start)),
        load3(array, 3 * at(ids, start + 1)),
        load3(array, 3 * at(ids, start + 2)),
        load3(array, 3 * at(ids, start + 3)),
        load3(array, 3 * at(ids, start + 4)),
        load3(array, 3 * at(ids, start + 5)),
        load3(array, 3 * at(ids, start + 6)),
        load3(array, 3 * at(ids, start + 7)),
    )
    return x, y, z


@inlined
def gather4(array, ids, start):
    """The columns of an array [N, 4]."""
    w, x, y, z, _, _, _, _ = transpose(
        load4(array, 4 * at(ids, start)),
        load4(array, 4 * at(ids, start + 1)),
        load4(array, 4 * at(ids, start + 2)),
        load4(array, 4 * at(ids, start + 3)),
        load4(array, 4 * at(ids, start + 4)),
        load4(array, 4 * at(ids, start + 5)),
        load4(array, 4 * at(ids, start + 6)),
        load4(array, 4 * at(ids, start + 7)),
    )
    return w, x, y, z


@inlined
def gather_columns(array, ids, start, stride, column):
    """Columns column:column + 8 of rows of `stride` floats."""
    return transpose(
        load8(array, at(ids, start) * stride + column),
        load8(array, at(ids, start + 1) * stride + column),
        load8(array, at(ids, start + 2) * stride + column),
        load8(array, at(ids, start + 3) * stride + column),
        load8(array, at(ids, start + 4) * stride + column),
        load8(array, at(ids, start + 5) * stride + column),
        load8(array, at(ids, start + 6) * stride + column),
        load8(array, at(ids, start + 7) * stride + column),
    )


@inlined
def scatter3(array, ids, start, stride, column, x, y, z):
    """Write columns column:column + 3 of rows of `stride` floats."""
    h0, h1, h2, h3, h4, h5, h6, h7 = transpose(x, y, z, x, x, x, x, x)
    store3(array, at(ids, start) * stride + column, h0)
    store3(array, at(ids, start + 1) * stride + column, h1)
    store3(array, at(ids, start + 2) * stride + column, h2)
    store3(array, at(ids, start + 3) * stride + column, h3)
    store3(array, at(ids, start + 4) * stride + column, h4)
    store3(array, at(ids, start + 5) * stride + column, h5)
    store3(array, at(ids, start + 6) * stride + column, h6)
    store3(array, at(ids, start + 7) * stride + column, h7)


@inlined
def scatter4(array, ids, start, w, x, y, z):
    """Write the columns of an array [N, 4]."""
    h0, h1, h2, h3, h4, h5, h6, h7 = transpose(w, x, y, z, x, x, x, x)
    store4(array, 4 * at(ids, start), h0)
    store4(array, 4 * at(ids, start + 1), h1)
    store4(array, 4 * at(ids, start + 2), h2)
    store4(array, 4 * at(ids, start + 3), h3)
    store4(array, 4 * at(ids, start + 4), h4)
    store4(array, 4 * at(ids, start + 5), h5)
    store4(array, 4 * at(ids, start + 6), h6)
    store4(array, 4 * at(ids, start + 7), h7)


@inlined
def scatter_columns(array, ids, start, stride, column, v0, v1, v2, v3, v4, v5, v6, v7):
    """Write columns column:column + 8 of rows of `stride` floats."""
    h0, h1, h2, h3, h4, h5, h6, h7 = transpose(v0, v1, v2, v3, v4, v5, v6, v7)
    store8(array, at(ids, start) * stride + column, h0)
    store8(array, at(ids, start + 1) * stride + column, h1)
    store8(array, at(ids, start + 2) * stride + column, h2)
    store8(array, at(ids, start + 3) * stride + column, h3)
    store8(array, at(ids, start + 4) * stride + column, h4)
    store8(array, at(ids, start + 5) * stride + column, h5)
    store8(array, at(ids, start + 6) * stride + column, h6)
    store8(array, at(ids, start + 7) * stride + column, h7)
