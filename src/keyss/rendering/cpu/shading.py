"""View-dependent colours from SH coefficients, and their gradients, for 8 Gaussians at a time."""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from keyss.rendering.cpu.jit import inlined
from keyss.rendering.cpu.layout import HALF, NORM_MIN, ONE, POSITION, ZERO
from keyss.rendering.cpu.rows import gather3, gather8, scatter
from keyss.rendering.cpu.sh import sh_basis, sh_direction_gradient
from keyss.rendering.cpu.simd8 import (
    at,
    divide,
    load8,
    maximum,
    multiply_add,
    prefetch_read,
    put,
    splat,
    square_root,
    store8,
)


@inlined
def shade(means, colors, sh_count, camera, ids, start, basis, coefficients):
    """Unclamped red, green and blue of the 8 Gaussians ids[start:]."""
    px, py, pz = gather3(means, ids, start, 3, 0)
    x, y, z, _ = view_directions(camera, px, py, pz)
    sh_basis(basis, sh_count, x, y, z)
    load_coefficients(colors, sh_count, ids, start, coefficients)
    red = splat(HALF)
    green = splat(HALF)
    blue = splat(HALF)
    for k in range(sh_count):
        value = load8(basis, 8 * k)
        red = multiply_add(value, load8(coefficients, 24 * k), red)
        green = multiply_add(value, load8(coefficients, 24 * k + 8), green)
        blue = multiply_add(value, load8(coefficients, 24 * k + 16), blue)
    return red, green, blue


@inlined
def shade_backward(
    means, colors, sh_count, camera, ids, start, red, green, blue, need_colors, basis, coefficients,
    colors_gradient,
):  # fmt: skip
    """Fills the gradients of the SH coefficients; returns dL/d(mean) through the view directions."""
    px, py, pz = gather3(means, ids, start, 3, 0)
    x, y, z, inverse = view_directions(camera, px, py, pz)
    dx = splat(ZERO)
    dy = dx
    dz = dx
    if sh_count > 1:
        load_coefficients(colors, sh_count, ids, start, coefficients)
        for k in range(sh_count):
            product = load8(coefficients, 24 * k) * red
            product = multiply_add(load8(coefficients, 24 * k + 8), green, product)
            store8(basis, 8 * k, multiply_add(load8(coefficients, 24 * k + 16), blue, product))
        dx, dy, dz = sh_direction_gradient(basis, sh_count, x, y, z)
        along = dx * x + dy * y + dz * z
        dx = (dx - along * x) * inverse
        dy = (dy - along * y) * inverse
        dz = (dz - along * z) * inverse
    if need_colors:
        sh_basis(basis, sh_count, x, y, z)
        for k in range(sh_count):
            value = load8(basis, 8 * k)
            store8(coefficients, 24 * k, value * red)
            store8(coefficients, 24 * k + 8, value * green)
            store8(coefficients, 24 * k + 16, value * blue)
        store_coefficients(colors_gradient, sh_count, ids, start, coefficients)
    return dx, dy, dz


@inlined
def view_directions(camera, px, py, pz):
    """Unit vectors from the camera to world points, and inverse distances."""
    x = px - camera[POSITION]
    y = py - camera[POSITION + 1]
    z = pz - camera[POSITION + 2]
    inverse = inverse_length(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@inlined
def inverse_length(square):
    """1 / sqrt(square); a large finite number for 0."""
    return divide(ONE, square_root(maximum(square, NORM_MIN)))


@inlined
def prefetch_coefficients(colors, sh_count, i):
    """Prefetch the SH coefficients of Gaussian i."""
    row = i * colors.shape[1] * 3
    for k in range(row, row + 3 * sh_count, 16):
        prefetch_read(colors, k)


@inlined
def load_coefficients(colors, sh_count, ids, start, coefficients):
    """Load the SH coefficients of the 8 Gaussians ids[start:]: coefficient k of channel c at 8 (3 k + c)."""
    stride = colors.shape[1] * 3
    used = sh_count * 3
    if used < 8:
        for lane in range(8):
            for k in range(used):
                coefficients[8 * k + lane] = at(colors, at(ids, start + lane) * stride + k)
        return
    for block in range(0, used, 8):
        k = min(block, used - 8)  # the last 8 may overlap
        v0, v1, v2, v3, v4, v5, v6, v7 = gather8(colors, ids, start, stride, k)
        store8(coefficients, 8 * k, v0)
        store8(coefficients, 8 * k + 8, v1)
        store8(coefficients, 8 * k + 16, v2)
        store8(coefficients, 8 * k + 24, v3)
        store8(coefficients, 8 * k + 32, v4)
        store8(coefficients, 8 * k + 40, v5)
        store8(coefficients, 8 * k + 48, v6)
        store8(coefficients, 8 * k + 56, v7)


@inlined
def store_coefficients(colors_gradient, sh_count, ids, start, coefficients):
    """The inverse of `load_coefficients`."""
    stride = colors_gradient.shape[1] * 3
    used = sh_count * 3
    if used < 8:
        for lane in range(8):
            for k in range(used):
                put(colors_gradient, at(ids, start + lane) * stride + k, at(coefficients, 8 * k + lane))
        return
    for block in range(0, used, 8):
        k = min(block, used - 8)
        values = (
            load8(coefficients, 8 * k), load8(coefficients, 8 * k + 8), load8(coefficients, 8 * k + 16),
            load8(coefficients, 8 * k + 24), load8(coefficients, 8 * k + 32), load8(coefficients, 8 * k + 40),
            load8(coefficients, 8 * k + 48), load8(coefficients, 8 * k + 56),
        )  # fmt: skip
        scatter(colors_gradient, ids, start, stride, k, values)
