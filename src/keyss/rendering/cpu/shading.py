"""View-dependent colours from SH coefficients, and their gradients, for 8 Gaussians at a time.

The polynomials of the real spherical harmonics up to degree 3 are those of Sloan, "Efficient Spherical
Harmonic Evaluation" (JCGT 2013), with the sign convention of 3DGS. The k-th of 8 basis functions is the
vector at 8 k.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from keyss.kernels.jit import inline
from keyss.rendering.cpu.constants import HALF, NORM_MIN, ONE, POSITION, TWO, ZERO, f32
from keyss.rendering.cpu.gather import gather3, gather8, scatter
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

C0 = f32(0.28209479177387814)
C1 = f32(0.4886025119029199)
C2_XY = f32(1.0925484305920792)
C2_ZZ = f32(0.9461746957575601)
C2_1 = f32(0.3153915652525201)
C2_XXYY = f32(0.5462742152960396)
C3_YXX = f32(0.5900435899266435)
C3_XYZ = f32(2.890611442640554)
C3_YZZ = f32(0.4570457994644658)
C3_ZZZ = f32(0.3731763325901154)
C3_ZXX = f32(1.445305721320277)

_3 = f32(3)
_5 = f32(5)
_6 = f32(6)
_10 = f32(10)
_15 = f32(15)


@inline
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


@inline
def shade_backward(
    means, colors, sh_count, camera, ids, start, red, green, blue, need_colors, basis, coefficients,
    colors_gradient,
):  # fmt: skip
    """Fill the gradients of the SH coefficients; returns dL/d(mean) through the view directions."""
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


@inline
def sh_basis(basis, count, x, y, z):
    """Fill basis[:8 count] (count 1, 4, 9 or 16) for the unit directions (x, y, z)."""
    store8(basis, 0, splat(C0))
    if count > 1:
        store8(basis, 8, y * -C1)
        store8(basis, 16, z * C1)
        store8(basis, 24, x * -C1)
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        store8(basis, 32, x * y * C2_XY)
        store8(basis, 40, y * z * -C2_XY)
        store8(basis, 48, zz * C2_ZZ - C2_1)
        store8(basis, 56, x * z * -C2_XY)
        store8(basis, 64, (xx - yy) * C2_XXYY)
        if count > 9:
            t = zz * _5 - ONE
            store8(basis, 72, (xx * _3 - yy) * y * -C3_YXX)
            store8(basis, 80, x * y * z * C3_XYZ)
            store8(basis, 88, y * t * -C3_YZZ)
            store8(basis, 96, (zz * _5 - _3) * z * C3_ZZZ)
            store8(basis, 104, x * t * -C3_YZZ)
            store8(basis, 112, (xx - yy) * z * C3_ZXX)
            store8(basis, 120, (xx - yy * _3) * x * -C3_YXX)


@inline
def sh_direction_gradient(d, count, x, y, z):
    """dL/d(x, y, z) where d[8 k:] = dL/d(basis k), count 4 or more; x, y, z are treated as independent."""
    gx = load8(d, 24) * -C1
    gy = load8(d, 8) * -C1
    gz = load8(d, 16) * C1
    if count > 4:
        d_4 = load8(d, 32)
        d_5 = load8(d, 40)
        d_6 = load8(d, 48)
        d_7 = load8(d, 56)
        d_8 = load8(d, 64) * (TWO * C2_XXYY)
        gx = gx + (y * d_4 - z * d_7) * C2_XY + x * d_8
        gy = gy + (x * d_4 - z * d_5) * C2_XY - y * d_8
        gz = gz + z * d_6 * (TWO * C2_ZZ) - (y * d_5 + x * d_7) * C2_XY
        if count > 9:
            zz = z * z
            xy = x * y
            xx_yy = x * x - y * y
            t = zz * _5 - ONE
            d_9 = load8(d, 72) * C3_YXX
            d_10 = load8(d, 80) * C3_XYZ
            d_11 = load8(d, 88) * C3_YZZ
            d_12 = load8(d, 96) * C3_ZZZ
            d_13 = load8(d, 104) * C3_YZZ
            d_14 = load8(d, 112) * C3_ZXX
            d_15 = load8(d, 120) * C3_YXX
            gx = gx + y * z * d_10 - t * d_13 + x * z * d_14 * TWO - xy * d_9 * _6 - xx_yy * d_15 * _3
            gy = gy + x * z * d_10 - t * d_11 - y * z * d_14 * TWO - xx_yy * d_9 * _3 + xy * d_15 * _6
            gz = gz + xy * d_10 - (y * d_11 + x * d_13) * z * _10 + (zz * _15 - _3) * d_12 + xx_yy * d_14
    return gx, gy, gz


@inline
def view_directions(camera, px, py, pz):
    """Unit vectors from the camera to world points, and inverse distances."""
    x = px - camera[POSITION]
    y = py - camera[POSITION + 1]
    z = pz - camera[POSITION + 2]
    inverse = inverse_length(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@inline
def inverse_length(square):
    """1 / sqrt(square); a large finite number for 0."""
    return divide(ONE, square_root(maximum(square, NORM_MIN)))


@inline
def prefetch_coefficients(colors, sh_count, i):
    """Prefetch the SH coefficients of Gaussian i."""
    row = i * colors.shape[1] * 3
    for k in range(row, row + 3 * sh_count, 16):
        prefetch_read(colors, k)


@inline
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


@inline
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
