"""Real spherical harmonics up to degree 3 for 8 directions at a time: basis and gradient.

The polynomials are those of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), with the sign
convention of 3DGS. The k-th of 8 basis functions is the vector at 8 k.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from keyss.rendering.cpu.jit import inlined
from keyss.rendering.cpu.layout import ONE, TWO, f32
from keyss.rendering.cpu.simd8 import load8, splat, store8

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


@inlined
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


@inlined
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
