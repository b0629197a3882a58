"""Real spherical harmonics up to degree 3: basis, colour, and the gradient with respect to the direction.

The polynomials are those of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), with the sign
convention of 3DGS.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from keyss.rendering.cpu.jit import kernel
from keyss.rendering.cpu.layout import ONE, TWO, f32

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


@kernel
def sh_basis(basis, count, x, y, z):
    """Fill basis[:count] (count 1, 4, 9 or 16) for the unit direction (x, y, z)."""
    basis[0] = C0
    if count > 1:
        basis[1] = -C1 * y
        basis[2] = C1 * z
        basis[3] = -C1 * x
    if count > 4:
        xx = x * x
        yy = y * y
        zz = z * z
        basis[4] = C2_XY * x * y
        basis[5] = -C2_XY * y * z
        basis[6] = C2_ZZ * zz - C2_1
        basis[7] = -C2_XY * x * z
        basis[8] = C2_XXYY * (xx - yy)
        if count > 9:
            t = _5 * zz - ONE
            basis[9] = -C3_YXX * y * (_3 * xx - yy)
            basis[10] = C3_XYZ * x * y * z
            basis[11] = -C3_YZZ * y * t
            basis[12] = C3_ZZZ * z * (_5 * zz - _3)
            basis[13] = -C3_YZZ * x * t
            basis[14] = C3_ZXX * z * (xx - yy)
            basis[15] = -C3_YXX * x * (xx - _3 * yy)


@kernel
def sh_direction_gradient(d, count, x, y, z):
    """dL/d(x, y, z) where d[k] = dL/d(basis[k]); x, y, z are treated as independent."""
    gx = -C1 * d[3]
    gy = -C1 * d[1]
    gz = C1 * d[2]
    if count > 4:
        gx += C2_XY * (y * d[4] - z * d[7]) + TWO * C2_XXYY * x * d[8]
        gy += C2_XY * (x * d[4] - z * d[5]) - TWO * C2_XXYY * y * d[8]
        gz += -C2_XY * (y * d[5] + x * d[7]) + TWO * C2_ZZ * z * d[6]
        if count > 9:
            zz = z * z
            xx_yy = x * x - y * y
            t = _5 * zz - ONE
            gx += (
                -_6 * C3_YXX * x * y * d[9]
                + C3_XYZ * y * z * d[10]
                - C3_YZZ * t * d[13]
                + TWO * C3_ZXX * x * z * d[14]
                - _3 * C3_YXX * xx_yy * d[15]
            )
            gy += (
                -_3 * C3_YXX * xx_yy * d[9]
                + C3_XYZ * x * z * d[10]
                - C3_YZZ * t * d[11]
                - TWO * C3_ZXX * y * z * d[14]
                + _6 * C3_YXX * x * y * d[15]
            )
            gz += (
                C3_XYZ * x * y * d[10]
                - _10 * C3_YZZ * z * (y * d[11] + x * d[13])
                + C3_ZZZ * (_15 * zz - _3) * d[12]
                + C3_ZXX * xx_yy * d[14]
            )
    return gx, gy, gz
