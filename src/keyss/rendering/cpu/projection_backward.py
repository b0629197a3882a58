"""Gradients of the Gaussians and of the camera from those of the 2D footprints: `projection` reversed.

Only Gaussians that some tile drew have a gradient; they are taken 8 at a time, one in each lane of the
vectors. Where fewer than 8 are left, the last of them fills the lanes that are free: it is computed and
written several times, always the same.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import inlined, kernel
from keyss.rendering.cpu.layout import (
    CHUNK,
    FX,
    FY,
    GREEN,
    HALF,
    MOMENTS,
    NORM_MIN,
    ONE,
    PACKED,
    RED,
    TWO,
    ZERO,
    f32,
)
from keyss.rendering.cpu.projection import (
    PREFETCH,
    camera_coordinates,
    jacobian_rows,
    rotation_matrix,
    slope_limits,
)
from keyss.rendering.cpu.rows import gather1, gather3, gather4, gather8, load_transposed, scatter
from keyss.rendering.cpu.shading import inverse_length, prefetch_coefficients, shade_backward
from keyss.rendering.cpu.simd8 import (
    at,
    divide,
    fetch_add,
    load8,
    maximum,
    minimum,
    put,
    ramp,
    select_ge,
    select_gt,
    splat,
    store8,
    sum_lanes,
)

# What `_sum_pairs` puts where in its buffer.
SUMS = 0  # over all tiles: the first 6 of `layout.MOMENTS`, two more that are not read
COLOR = 64  # gradients of red, green and blue
DEPTH = 88  # gradient of the depth
ALL_SUMS = 96


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
    footprints,
    first_slots,
    slot_counts,
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
    or need_camera false, colors_gradient or camera_gradient is not touched. `channels` is 0 where colours
    were drawn from the footprints, else the number of channels: those of the colours, and one for the depth
    where there is one more.
    """
    count = means.shape[0]
    with_depth = channels > colors.shape[2]
    ids = np.empty(CHUNK + 8, np.int64)
    sums = np.empty(ALL_SUMS, np.float32)
    basis = np.empty(16 * 8, np.float32)
    coefficients = np.empty(48 * 8, np.float32)
    results = np.empty(3 * 8, np.float32)
    camera_sums = np.empty(15, np.float64)
    while True:
        piece = fetch_add(counter, 0, 1)
        if piece * CHUNK >= count:
            break
        for k in range(15):
            camera_sums[k] = 0.0
        drawn = _find_drawn(
            piece * CHUNK, min((piece + 1) * CHUNK, count), sh_count, slot_counts, first_camera, need_colors,
            absgrad, ids, means_gradient, quats_gradient, scales_gradient, opacities_gradient,
            colors_gradient, means2d_gradient, means2d_absgrad,
        )  # fmt: skip
        for k in range(drawn, drawn + 8):
            ids[k] = ids[max(drawn - 1, 0)]
        for start in range(0, drawn, 8):
            size = min(8, drawn - start)
            if sh_count > 1:
                for ahead in range(start + PREFETCH, min(start + PREFETCH + 8, drawn)):
                    prefetch_coefficients(colors, sh_count, at(ids, ahead))
            _sum_pairs(
                ids, start, size, first_slots, slot_counts, moments, extras, extra_width, channels,
                with_depth, sh_count, first_camera, need_colors, absgrad, colors_gradient,
                means2d_absgrad, sums,
            )  # fmt: skip
            dx = splat(ZERO)
            dy = dx
            dz = dx
            if sh_count > 0:
                _, _, _, _, _, _, _, red = gather8(footprints, ids, start, PACKED, RED - RED % 8)
                green, blue, _, _, _, _, _, _ = gather8(footprints, ids, start, PACKED, GREEN - GREEN % 8)
                # The maximum of 0.5 + basis . colors and 0 lets no gradient through where it is 0.
                red = select_gt(red, ZERO, load8(sums, COLOR), ZERO)
                green = select_gt(green, ZERO, load8(sums, COLOR + 8), ZERO)
                blue = select_gt(blue, ZERO, load8(sums, COLOR + 16), ZERO)
                dx, dy, dz = shade_backward(
                    means, colors, sh_count, camera, ids, start, red, green, blue, first_camera,
                    need_colors, basis, coefficients, colors_gradient,
                )  # fmt: skip
            elif need_colors and channels == 0:
                for lane in range(size):
                    for channel in range(3):
                        value = sums[COLOR + 8 * channel + lane]
                        if not first_camera:
                            value += colors_gradient[ids[start + lane], 0, channel]
                        colors_gradient[ids[start + lane], 0, channel] = value
            _gaussian_gradients(
                means, quats, scales, opacities, footprints, ids, start, size, camera, width, height,
                antialiased, with_depth, need_camera, first_camera, sums, dx, dy, dz, means_gradient,
                quats_gradient, scales_gradient, opacities_gradient, means2d_gradient, camera_sums, results,
            )  # fmt: skip
        if need_camera:
            for k in range(15):
                camera_gradient[piece, k] = camera_sums[k]


@inlined
def _find_drawn(
    start, end, sh_count, slot_counts, first_camera, need_colors, absgrad, ids, means_gradient,
    quats_gradient, scales_gradient, opacities_gradient, colors_gradient, means2d_gradient, means2d_absgrad,
):  # fmt: skip
    """Fill `ids` with those Gaussians that have pairs; returns how many. Zeros all other gradients."""
    channels = colors_gradient.shape[2]
    stride = colors_gradient.shape[1] * channels
    drawn = 0
    for i in range(start, end):
        used = 0  # colour gradients that are overwritten later
        if at(slot_counts, i) > 0:
            put(ids, drawn, i)
            drawn += 1
            used = max(sh_count, 1) * channels
        else:
            for k in range(2 * i, 2 * i + 2):
                put(means2d_gradient, k, ZERO)
                if absgrad:
                    put(means2d_absgrad, k, ZERO)
            if first_camera:
                for k in range(3 * i, 3 * i + 3):
                    put(means_gradient, k, ZERO)
                    put(scales_gradient, k, ZERO)
                for k in range(4 * i, 4 * i + 4):
                    put(quats_gradient, k, ZERO)
                put(opacities_gradient, i, ZERO)
        if first_camera and need_colors:
            for k in range(i * stride + used, (i + 1) * stride):
                put(colors_gradient, k, ZERO)
    return drawn


@inlined
def _sum_pairs(
    ids, start, size, first_slots, slot_counts, moments, extras, extra_width, channels, with_depth, sh_count,
    first_camera, need_colors, absgrad, colors_gradient, means2d_absgrad, sums,
):  # fmt: skip
    """The sums over all tiles of a Gaussian, for the 8 of ids[start:], into `sums`.

    Gradients of channels that are no SH, and for absgrad, are handed out here.
    """
    store8(sums, DEPTH, splat(ZERO))
    for lane in range(8):
        i = at(ids, start + lane)
        first = np.int64(at(first_slots, i))
        after = first + at(slot_counts, i)
        own = splat(ZERO)
        for slot in range(first, after):
            own = own + load8(moments, slot * MOMENTS)
        store8(sums, SUMS + 8 * lane, own)
        for extra in range(extra_width):
            total = ZERO
            for slot in range(first, after):
                total += at(extras, slot * extra_width + extra)
            if absgrad and extra >= extra_width - 2:
                means2d_absgrad[i, extra + 2 - extra_width] = total
            elif channels == 0:
                put(sums, COLOR + 16 + lane, total)
            elif with_depth and extra == channels - 1:
                put(sums, DEPTH + lane, total)
            elif sh_count > 0:
                put(sums, COLOR + 8 * extra + lane, total)
            elif need_colors and lane < size:
                if not first_camera:
                    total += colors_gradient[i, 0, extra]
                colors_gradient[i, 0, extra] = total
    m0, m1, m2, m3, m4, m5, red, green = load_transposed(sums, SUMS)
    store8(sums, SUMS, m0)
    store8(sums, SUMS + 8, m1)
    store8(sums, SUMS + 16, m2)
    store8(sums, SUMS + 24, m3)
    store8(sums, SUMS + 32, m4)
    store8(sums, SUMS + 40, m5)
    if channels == 0:
        store8(sums, COLOR, red)
        store8(sums, COLOR + 8, green)


@inlined
def _gaussian_gradients(
    means, quats, scales, opacities, footprints, ids, start, size, camera, width, height, antialiased,
    with_depth, need_camera, first_camera, sums, dx, dy, dz, means_gradient, quats_gradient, scales_gradient,
    opacities_gradient, means2d_gradient, camera_sums, results,
):  # fmt: skip
    """Through the 2D footprints and the perspective; (dx, dy, dz) is the gradient through the colours."""
    x_low, x_high, y_low, y_high = slope_limits(camera, width, height)
    s_1 = load8(sums, SUMS)
    s_x = load8(sums, SUMS + 8)
    s_y = load8(sums, SUMS + 16)
    s_xx = load8(sums, SUMS + 24)
    s_xy = load8(sums, SUMS + 32)
    s_yy = load8(sums, SUMS + 40)
    _, _, conic_xx, conic_xy, conic_yy, _, _, _ = gather8(footprints, ids, start, PACKED, 0)
    conic_xx = conic_xx * -TWO
    conic_xy = conic_xy * -ONE
    conic_yy = conic_yy * -TWO
    mean_x = conic_xx * s_x + conic_xy * s_y
    mean_y = conic_xy * s_x + conic_yy * s_y
    opacity_gradient = divide(s_1, gather1(opacities, ids, start))
    if not first_camera:
        opacity_gradient = opacity_gradient + gather1(opacities_gradient, ids, start)
    store8(results, 0, opacity_gradient)
    store8(results, 8, mean_x)
    store8(results, 16, mean_y)
    for lane in range(8):
        i = at(ids, start + lane)
        put(opacities_gradient, i, at(results, lane))
        put(means2d_gradient, 2 * i, at(results, 8 + lane))
        put(means2d_gradient, 2 * i + 1, at(results, 16 + lane))

    # dL/d(covariance) = -conic dL/d(conic) conic, with dL/d(conic) = -1/2 [s_xx s_xy; s_xy s_yy].
    t_00 = conic_xx * s_xx + conic_xy * s_xy
    t_01 = conic_xx * s_xy + conic_xy * s_yy
    t_10 = conic_xy * s_xx + conic_yy * s_xy
    t_11 = conic_xy * s_xy + conic_yy * s_yy
    cov_xx = (t_00 * conic_xx + t_01 * conic_xy) * HALF
    cov_xy = (t_00 * conic_xy + t_01 * conic_yy) * HALF
    cov_yy = (t_10 * conic_xy + t_11 * conic_yy) * HALF

    # The forward projection again, up to V = J W R S.
    px, py, pz = gather3(means, ids, start, 3, 0)
    x, y, z = camera_coordinates(camera, px, py, pz)
    rz = divide(ONE, z)
    slope_x = x * rz
    slope_y = y * rz
    clamped_x = minimum(maximum(slope_x, x_low), x_high)
    clamped_y = minimum(maximum(slope_y, y_low), y_high)
    jxx = rz * camera[FX]
    jxz = ZERO - jxx * clamped_x
    jyy = rz * camera[FY]
    jyz = ZERO - jyy * clamped_y
    a0, a1, a2, b0, b1, b2 = jacobian_rows(camera, jxx, jxz, jyy, jyz)
    qw, qx, qy, qz = gather4(quats, ids, start, 4, 0)
    square = qw * qw + qx * qx + qy * qy + qz * qz
    norm = inverse_length(square)
    qw = qw * norm
    qx = qx * norm
    qy = qy * norm
    qz = qz * norm
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(qw, qx, qy, qz)
    s0, s1, s2 = gather3(scales, ids, start, 3, 0)
    p0 = a0 * r00 + a1 * r10 + a2 * r20
    p1 = a0 * r01 + a1 * r11 + a2 * r21
    p2 = a0 * r02 + a1 * r12 + a2 * r22
    q0 = b0 * r00 + b1 * r10 + b2 * r20
    q1 = b0 * r01 + b1 * r11 + b2 * r21
    q2 = b0 * r02 + b1 * r12 + b2 * r22

    if antialiased:
        # The opacity drawn is opacity sqrt(det(V V^T) / det(covariance)), and s_1 the gradient of its
        # logarithm; d(log det M) = M^-1. Nothing with a vanishing determinant was drawn.
        u0, u1, u2 = p0 * s0, p1 * s1, p2 * s2
        v0, v1, v2 = q0 * s0, q1 * s1, q2 * s2
        n0 = u1 * v2 - u2 * v1
        n1 = u2 * v0 - u0 * v2
        n2 = u0 * v1 - u1 * v0
        inverse = divide(ONE, maximum(n0 * n0 + n1 * n1 + n2 * n2, NORM_MIN))
        half = s_1 * HALF
        cov_xx = cov_xx + half * ((v0 * v0 + v1 * v1 + v2 * v2) * inverse - conic_xx)
        cov_xy = cov_xy - half * ((u0 * v0 + u1 * v1 + u2 * v2) * inverse + conic_xy)
        cov_yy = cov_yy + half * ((u0 * u0 + u1 * u1 + u2 * u2) * inverse - conic_yy)

    # dL/dV = 2 dL/d(covariance) V, then scales, rotation and the rows of J W.
    du0 = (cov_xx * p0 + cov_xy * q0) * s0 * TWO
    du1 = (cov_xx * p1 + cov_xy * q1) * s1 * TWO
    du2 = (cov_xx * p2 + cov_xy * q2) * s2 * TWO
    dv0 = (cov_xy * p0 + cov_yy * q0) * s0 * TWO
    dv1 = (cov_xy * p1 + cov_yy * q1) * s1 * TWO
    dv2 = (cov_xy * p2 + cov_yy * q2) * s2 * TWO
    _add3(
        scales_gradient, ids, start, first_camera,
        du0 * p0 + dv0 * q0, du1 * p1 + dv1 * q1, du2 * p2 + dv2 * q2,
    )  # fmt: skip
    du0 = du0 * s0
    du1 = du1 * s1
    du2 = du2 * s2
    dv0 = dv0 * s0
    dv1 = dv1 * s1
    dv2 = dv2 * s2
    d00 = a0 * du0 + b0 * dv0
    d01 = a0 * du1 + b0 * dv1
    d02 = a0 * du2 + b0 * dv2
    d10 = a1 * du0 + b1 * dv0
    d11 = a1 * du1 + b1 * dv1
    d12 = a1 * du2 + b1 * dv2
    d20 = a2 * du0 + b2 * dv0
    d21 = a2 * du1 + b2 * dv1
    d22 = a2 * du2 + b2 * dv2
    ew = (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01)) * TWO
    ex = (qy * (d10 + d01) + qz * (d20 + d02) + qw * (d21 - d12) - qx * (d11 + d22) * TWO) * TWO
    ey = (qx * (d10 + d01) + qz * (d21 + d12) + qw * (d02 - d20) - qy * (d00 + d22) * TWO) * TWO
    ez = (qx * (d20 + d02) + qy * (d21 + d12) + qw * (d10 - d01) - qz * (d00 + d11) * TWO) * TWO
    along = ew * qw + ex * qx + ey * qy + ez * qz
    # A zero quaternion is drawn without a rotation, and stays so.
    norm = select_gt(square, NORM_MIN, norm, ZERO)
    _add4(
        quats_gradient, ids, start, first_camera,
        (ew - along * qw) * norm, (ex - along * qx) * norm,
        (ey - along * qy) * norm, (ez - along * qz) * norm,
    )  # fmt: skip
    da0 = du0 * r00 + du1 * r01 + du2 * r02
    da1 = du0 * r10 + du1 * r11 + du2 * r12
    da2 = du0 * r20 + du1 * r21 + du2 * r22
    db0 = dv0 * r00 + dv1 * r01 + dv2 * r02
    db1 = dv0 * r10 + dv1 * r11 + dv2 * r12
    db2 = dv0 * r20 + dv1 * r21 + dv2 * r22

    # Through J and the projected centre to the mean in camera space (tx, ty, tz). Where the slope was
    # clamped, J does not depend on it.
    djxx = da0 * camera[0] + da1 * camera[1] + da2 * camera[2]
    djxz = (da0 * camera[6] + da1 * camera[7] + da2 * camera[8]) * jxx * rz
    djyy = db0 * camera[3] + db1 * camera[4] + db2 * camera[5]
    djyz = (db0 * camera[6] + db1 * camera[7] + db2 * camera[8]) * jyy * rz
    free_x = _one_where_equal(slope_x, clamped_x)
    free_y = _one_where_equal(slope_y, clamped_y)
    mean_x = mean_x * jxx
    mean_y = mean_y * jyy
    tx = mean_x - djxz * free_x
    ty = mean_y - djyz * free_y
    tz = ZERO - (mean_x * slope_x + mean_y * slope_y) - (djxx * jxx + djyy * jyy) * rz
    tz = tz + djxz * clamped_x * (free_x + ONE) + djyz * clamped_y * (free_y + ONE)
    if with_depth:
        tz = tz + load8(sums, DEPTH)
    _add3(
        means_gradient, ids, start, first_camera,
        tx * camera[0] + ty * camera[3] + tz * camera[6] + dx,
        tx * camera[1] + ty * camera[4] + tz * camera[7] + dy,
        tx * camera[2] + ty * camera[5] + tz * camera[8] + dz,
    )  # fmt: skip
    if need_camera:
        # Lanes that repeat a Gaussian do not count.
        valid = select_gt(f32(size), ramp(ZERO), ONE, ZERO)
        camera_sums[0] += sum_lanes(valid * (jxx * da0 + tx * px))
        camera_sums[1] += sum_lanes(valid * (jxx * da1 + tx * py))
        camera_sums[2] += sum_lanes(valid * (jxx * da2 + tx * pz))
        camera_sums[3] += sum_lanes(valid * (jyy * db0 + ty * px))
        camera_sums[4] += sum_lanes(valid * (jyy * db1 + ty * py))
        camera_sums[5] += sum_lanes(valid * (jyy * db2 + ty * pz))
        camera_sums[6] += sum_lanes(valid * (jxz * da0 + jyz * db0 + tz * px))
        camera_sums[7] += sum_lanes(valid * (jxz * da1 + jyz * db1 + tz * py))
        camera_sums[8] += sum_lanes(valid * (jxz * da2 + jyz * db2 + tz * pz))
        camera_sums[9] += sum_lanes(valid * tx)
        camera_sums[10] += sum_lanes(valid * ty)
        camera_sums[11] += sum_lanes(valid * tz)
        camera_sums[12] -= sum_lanes(valid * dx)
        camera_sums[13] -= sum_lanes(valid * dy)
        camera_sums[14] -= sum_lanes(valid * dz)


@inlined
def _one_where_equal(a, b):
    return select_ge(a, b, select_ge(b, a, ONE, ZERO), ZERO)


@inlined
def _add3(array, ids, start, first_camera, x, y, z):
    """Add 3 vectors to the columns of an array [N, 3]; for the first camera, overwrite them."""
    if not first_camera:
        old_x, old_y, old_z = gather3(array, ids, start, 3, 0)
        x = x + old_x
        y = y + old_y
        z = z + old_z
    scatter(array, ids, start, 3, 0, (x, y, z))


@inlined
def _add4(array, ids, start, first_camera, w, x, y, z):
    """`_add3` for arrays [N, 4]."""
    if not first_camera:
        old_w, old_x, old_y, old_z = gather4(array, ids, start, 4, 0)
        w = w + old_w
        x = x + old_x
        y = y + old_y
        z = z + old_z
    scatter(array, ids, start, 4, 0, (w, x, y, z))
