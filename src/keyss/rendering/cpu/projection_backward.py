"""Gradients of the Gaussians and of the camera from those of the 2D footprints: `projection` reversed."""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import math

import numpy as np

from keyss.rendering.cpu.jit import kernel
from keyss.rendering.cpu.layout import (
    BLUE,
    CHUNK,
    FX,
    FY,
    GREEN,
    HALF,
    MOMENTS,
    NORM_MIN,
    ONE,
    POSITION,
    RED,
    TWO,
    TX,
    TY,
    TZ,
    XX,
    XY,
    YY,
    ZERO,
)
from keyss.rendering.cpu.projection import rotation_matrix, slope_limits
from keyss.rendering.cpu.sh import sh_basis, sh_direction_gradient
from keyss.rendering.cpu.simd8 import at, fetch_add, lane, load8, prefetch_read, splat

PREFETCH = 12  # how many Gaussians ahead to ask for memory


@kernel
def project_backward(
    counter,
    means,
    quats,
    scales,
    opacities,
    colors,
    sh_count,
    camera,
    width,
    height,
    antialiased,
    channels,
    rank,
    packed,
    first_slots,
    moments,
    extras,
    extra_width,
    first_camera,
    need_colors,
    need_camera,
    absgrad,
    means_gradient,
    quats_gradient,
    scales_gradient,
    opacities_gradient,
    colors_gradient,
    means2d_gradient,
    means2d_absgrad,
    camera_gradient,
):
    """Add the gradients through one camera; for the first camera, what was in the outputs is overwritten.

    means2d_gradient and means2d_absgrad are of this camera only. camera_gradient has one row per piece of
    work: the sums over its Gaussians for rotation (9), translation (3) and position (3). With need_colors
    or need_camera false, colors_gradient or camera_gradient is not touched. `channels` is 0 after `blend`,
    and the number of channels after `blend_features`: those of the colours, and one for the depth where
    there is one more.
    """
    count = means.shape[0]
    x_low, x_high, y_low, y_high = slope_limits(camera, width, height)
    fx = camera[FX]
    fy = camera[FY]
    basis = np.empty(16, np.float32)
    basis_gradient = np.empty(16, np.float32)
    camera_sums = np.empty(15, np.float64)
    channel_sums = np.empty(channels, np.float32)
    with_depth = channels > colors.shape[2]
    abs_x = extra_width - 2
    while True:
        piece = fetch_add(counter, 0, 1)
        if piece * CHUNK >= count:
            break
        for k in range(15):
            camera_sums[k] = 0.0
        for i in range(piece * CHUNK, min((piece + 1) * CHUNK, count)):
            ahead = rank[min(i + PREFETCH, count - 1)]
            if ahead >= 0:
                prefetch_read(packed, ahead * packed.shape[1])
            r = np.int64(rank[i])
            seen = r >= 0 and first_slots[i] < first_slots[i + 1]
            if first_camera:
                for k in range(3):
                    means_gradient[i, k] = ZERO
                    scales_gradient[i, k] = ZERO
                for k in range(4):
                    quats_gradient[i, k] = ZERO
                opacities_gradient[i] = ZERO
                if need_colors:
                    if channels > 0 and sh_count == 0:
                        for channel in range(colors.shape[2]):
                            colors_gradient[i, 0, channel] = ZERO
                    else:
                        for k in range(sh_count if seen else 0, colors.shape[1]):
                            for channel in range(3):
                                colors_gradient[i, k, channel] = ZERO
            means2d_gradient[i, 0] = ZERO
            means2d_gradient[i, 1] = ZERO
            if absgrad:
                means2d_absgrad[i, 0] = ZERO
                means2d_absgrad[i, 1] = ZERO
            if not seen:
                continue

            sums = splat(ZERO)
            blue = ZERO
            for slot in range(first_slots[i], first_slots[i + 1]):
                sums = sums + load8(moments, slot * MOMENTS)
                blue += at(extras, slot * extra_width)
                if absgrad:
                    means2d_absgrad[i, 0] += at(extras, slot * extra_width + abs_x)
                    means2d_absgrad[i, 1] += at(extras, slot * extra_width + abs_x + 1)
            s_1 = lane(sums, 0)
            s_x = lane(sums, 1)
            s_y = lane(sums, 2)
            s_xx = lane(sums, 3)
            s_xy = lane(sums, 4)
            s_yy = lane(sums, 5)
            red = lane(sums, 6)
            green = lane(sums, 7)
            if channels > 0:
                for channel in range(channels):
                    total = ZERO
                    for slot in range(first_slots[i], first_slots[i + 1]):
                        total += at(extras, slot * extra_width + channel)
                    channel_sums[channel] = total
                if sh_count > 0:
                    red = channel_sums[0]
                    green = channel_sums[1]
                    blue = channel_sums[2]
            opacities_gradient[i] += s_1 / opacities[i]
            conic_xx = -TWO * packed[r, XX]
            conic_xy = -packed[r, XY]
            conic_yy = -TWO * packed[r, YY]
            mean_x = conic_xx * s_x + conic_xy * s_y
            mean_y = conic_xy * s_x + conic_yy * s_y
            means2d_gradient[i, 0] = mean_x
            means2d_gradient[i, 1] = mean_y

            # dL/d(covariance) = -conic dL/d(conic) conic, with dL/d(conic) = -1/2 [s_xx s_xy; s_xy s_yy].
            t_00 = conic_xx * s_xx + conic_xy * s_xy
            t_01 = conic_xx * s_xy + conic_xy * s_yy
            t_10 = conic_xy * s_xx + conic_yy * s_xy
            t_11 = conic_xy * s_xy + conic_yy * s_yy
            cov_xx = HALF * (t_00 * conic_xx + t_01 * conic_xy)
            cov_xy = HALF * (t_00 * conic_xy + t_01 * conic_yy)
            cov_yy = HALF * (t_10 * conic_xy + t_11 * conic_yy)

            # The forward projection again, up to V = J W R S.
            px = means[i, 0]
            py = means[i, 1]
            pz = means[i, 2]
            x = camera[0] * px + camera[1] * py + camera[2] * pz + camera[TX]
            y = camera[3] * px + camera[4] * py + camera[5] * pz + camera[TY]
            z = camera[6] * px + camera[7] * py + camera[8] * pz + camera[TZ]
            rz = ONE / z
            slope_x = x * rz
            slope_y = y * rz
            clamped_x = min(max(slope_x, x_low), x_high)
            clamped_y = min(max(slope_y, y_low), y_high)
            jxx = fx * rz
            jxz = -jxx * clamped_x
            jyy = fy * rz
            jyz = -jyy * clamped_y
            a0 = jxx * camera[0] + jxz * camera[6]
            a1 = jxx * camera[1] + jxz * camera[7]
            a2 = jxx * camera[2] + jxz * camera[8]
            b0 = jyy * camera[3] + jyz * camera[6]
            b1 = jyy * camera[4] + jyz * camera[7]
            b2 = jyy * camera[5] + jyz * camera[8]
            qw = quats[i, 0]
            qx = quats[i, 1]
            qy = quats[i, 2]
            qz = quats[i, 3]
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(qw, qx, qy, qz)
            s0 = scales[i, 0]
            s1 = scales[i, 1]
            s2 = scales[i, 2]
            p0 = a0 * r00 + a1 * r10 + a2 * r20
            p1 = a0 * r01 + a1 * r11 + a2 * r21
            p2 = a0 * r02 + a1 * r12 + a2 * r22
            q0 = b0 * r00 + b1 * r10 + b2 * r20
            q1 = b0 * r01 + b1 * r11 + b2 * r21
            q2 = b0 * r02 + b1 * r12 + b2 * r22

            if antialiased:
                # The opacity drawn is opacity sqrt(det(V V^T) / det(covariance)), and s_1 the gradient of
                # its logarithm; d(log det M) = M^-1. Nothing with a vanishing determinant was drawn.
                sharp_xx = p0 * p0 * s0 * s0 + p1 * p1 * s1 * s1 + p2 * p2 * s2 * s2
                sharp_xy = p0 * q0 * s0 * s0 + p1 * q1 * s1 * s1 + p2 * q2 * s2 * s2
                sharp_yy = q0 * q0 * s0 * s0 + q1 * q1 * s1 * s1 + q2 * q2 * s2 * s2
                n0 = (p1 * q2 - p2 * q1) * s1 * s2
                n1 = (p2 * q0 - p0 * q2) * s2 * s0
                n2 = (p0 * q1 - p1 * q0) * s0 * s1
                inverse = ONE / max(n0 * n0 + n1 * n1 + n2 * n2, NORM_MIN)
                cov_xx += HALF * s_1 * (sharp_yy * inverse - conic_xx)
                cov_xy -= HALF * s_1 * (sharp_xy * inverse + conic_xy)
                cov_yy += HALF * s_1 * (sharp_xx * inverse - conic_yy)

            # dL/dV = 2 dL/d(covariance) V, then scales, rotation and the rows of J W.
            du0 = TWO * (cov_xx * p0 + cov_xy * q0) * s0
            du1 = TWO * (cov_xx * p1 + cov_xy * q1) * s1
            du2 = TWO * (cov_xx * p2 + cov_xy * q2) * s2
            dv0 = TWO * (cov_xy * p0 + cov_yy * q0) * s0
            dv1 = TWO * (cov_xy * p1 + cov_yy * q1) * s1
            dv2 = TWO * (cov_xy * p2 + cov_yy * q2) * s2
            scales_gradient[i, 0] += du0 * p0 + dv0 * q0
            scales_gradient[i, 1] += du1 * p1 + dv1 * q1
            scales_gradient[i, 2] += du2 * p2 + dv2 * q2
            du0 *= s0
            du1 *= s1
            du2 *= s2
            dv0 *= s0
            dv1 *= s1
            dv2 *= s2
            d00 = a0 * du0 + b0 * dv0
            d01 = a0 * du1 + b0 * dv1
            d02 = a0 * du2 + b0 * dv2
            d10 = a1 * du0 + b1 * dv0
            d11 = a1 * du1 + b1 * dv1
            d12 = a1 * du2 + b1 * dv2
            d20 = a2 * du0 + b2 * dv0
            d21 = a2 * du1 + b2 * dv1
            d22 = a2 * du2 + b2 * dv2
            norm = qw * qw + qx * qx + qy * qy + qz * qz
            if norm > NORM_MIN:
                scale = ONE / math.sqrt(norm)
                qw *= scale
                qx *= scale
                qy *= scale
                qz *= scale
                ew = TWO * (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01))
                ex = TWO * (qy * (d10 + d01) + qz * (d20 + d02) + qw * (d21 - d12) - TWO * qx * (d11 + d22))
                ey = TWO * (qx * (d10 + d01) + qz * (d21 + d12) + qw * (d02 - d20) - TWO * qy * (d00 + d22))
                ez = TWO * (qx * (d20 + d02) + qy * (d21 + d12) + qw * (d10 - d01) - TWO * qz * (d00 + d11))
                along = ew * qw + ex * qx + ey * qy + ez * qz
                quats_gradient[i, 0] += (ew - along * qw) * scale
                quats_gradient[i, 1] += (ex - along * qx) * scale
                quats_gradient[i, 2] += (ey - along * qy) * scale
                quats_gradient[i, 3] += (ez - along * qz) * scale
            da0 = du0 * r00 + du1 * r01 + du2 * r02
            da1 = du0 * r10 + du1 * r11 + du2 * r12
            da2 = du0 * r20 + du1 * r21 + du2 * r22
            db0 = dv0 * r00 + dv1 * r01 + dv2 * r02
            db1 = dv0 * r10 + dv1 * r11 + dv2 * r12
            db2 = dv0 * r20 + dv1 * r21 + dv2 * r22

            # Through J and the projected centre to the mean in camera space (tx, ty, tz).
            djxx = da0 * camera[0] + da1 * camera[1] + da2 * camera[2]
            djxz = da0 * camera[6] + da1 * camera[7] + da2 * camera[8]
            djyy = db0 * camera[3] + db1 * camera[4] + db2 * camera[5]
            djyz = db0 * camera[6] + db1 * camera[7] + db2 * camera[8]
            tx = mean_x * jxx
            ty = mean_y * jyy
            tz = -(mean_x * jxx * slope_x + mean_y * jyy * slope_y) - (djxx * jxx + djyy * jyy) * rz
            if clamped_x == slope_x:
                tx -= djxz * jxx * rz
                tz += TWO * djxz * jxx * slope_x * rz
            else:
                tz += djxz * jxx * clamped_x * rz
            if clamped_y == slope_y:
                ty -= djyz * jyy * rz
                tz += TWO * djyz * jyy * slope_y * rz
            else:
                tz += djyz * jyy * clamped_y * rz
            if with_depth:
                tz += channel_sums[channels - 1]
            gx = camera[0] * tx + camera[3] * ty + camera[6] * tz
            gy = camera[1] * tx + camera[4] * ty + camera[7] * tz
            gz = camera[2] * tx + camera[5] * ty + camera[8] * tz
            if need_camera:
                camera_sums[0] += jxx * da0 + tx * px
                camera_sums[1] += jxx * da1 + tx * py
                camera_sums[2] += jxx * da2 + tx * pz
                camera_sums[3] += jyy * db0 + ty * px
                camera_sums[4] += jyy * db1 + ty * py
                camera_sums[5] += jyy * db2 + ty * pz
                camera_sums[6] += jxz * da0 + jyz * db0 + tz * px
                camera_sums[7] += jxz * da1 + jyz * db1 + tz * py
                camera_sums[8] += jxz * da2 + jyz * db2 + tz * pz
                camera_sums[9] += tx
                camera_sums[10] += ty
                camera_sums[11] += tz

            if sh_count == 0 and channels > 0:
                if need_colors:
                    for channel in range(colors.shape[2]):
                        colors_gradient[i, 0, channel] += channel_sums[channel]
            elif sh_count == 0:
                if need_colors:
                    colors_gradient[i, 0, 0] += red
                    colors_gradient[i, 0, 1] += green
                    colors_gradient[i, 0, 2] += blue
            else:
                # No gradient passes a colour that was clamped at 0.
                if packed[r, RED] <= ZERO:
                    red = ZERO
                if packed[r, GREEN] <= ZERO:
                    green = ZERO
                if packed[r, BLUE] <= ZERO:
                    blue = ZERO
                x = px - camera[POSITION]
                y = py - camera[POSITION + 1]
                z = pz - camera[POSITION + 2]
                scale = ONE / math.sqrt(max(x * x + y * y + z * z, NORM_MIN))
                x *= scale
                y *= scale
                z *= scale
                if need_colors:
                    sh_basis(basis, sh_count, x, y, z)
                    if first_camera:
                        for k in range(sh_count):
                            colors_gradient[i, k, 0] = basis[k] * red
                            colors_gradient[i, k, 1] = basis[k] * green
                            colors_gradient[i, k, 2] = basis[k] * blue
                    else:
                        for k in range(sh_count):
                            colors_gradient[i, k, 0] += basis[k] * red
                            colors_gradient[i, k, 1] += basis[k] * green
                            colors_gradient[i, k, 2] += basis[k] * blue
                if sh_count > 1:
                    for k in range(sh_count):
                        basis_gradient[k] = (
                            colors[i, k, 0] * red + colors[i, k, 1] * green + colors[i, k, 2] * blue
                        )
                    dx, dy, dz = sh_direction_gradient(basis_gradient, sh_count, x, y, z)
                    along = dx * x + dy * y + dz * z
                    dx = (dx - along * x) * scale
                    dy = (dy - along * y) * scale
                    dz = (dz - along * z) * scale
                    gx += dx
                    gy += dy
                    gz += dz
                    if need_camera:
                        camera_sums[12] -= dx
                        camera_sums[13] -= dy
                        camera_sums[14] -= dz
            means_gradient[i, 0] += gx
            means_gradient[i, 1] += gy
            means_gradient[i, 2] += gz
        if need_camera:
            for k in range(15):
                camera_gradient[piece, k] = camera_sums[k]
