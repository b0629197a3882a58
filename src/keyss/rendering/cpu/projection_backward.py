"""Gradients of the Gaussians from those of the 2D footprints: the backward pass of `projection`.

Only Gaussians in the list of a tile have a gradient. A vector holds 8 of them, one in each lane; at the end
the last Gaussian fills the free lanes, and its gradient is computed and written several times, with equal
results.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import inlined, kernel
from keyss.rendering.cpu.layout import (
    CHUNK,
    GREEN,
    HALF,
    HUGE,
    MOMENTS,
    NORM_MIN,
    ONE,
    PACKED,
    RED,
    TWO,
    ZERO,
)
from keyss.rendering.cpu.projection import PREFETCH, dot, linearised, times
from keyss.rendering.cpu.rows import gather1, gather3, gather4, gather8, load_transposed, scatter
from keyss.rendering.cpu.shading import prefetch_coefficients, shade_backward
from keyss.rendering.cpu.simd8 import (
    absolute,
    at,
    divide,
    fetch_add,
    load8,
    put,
    select_ge,
    select_gt,
    splat,
    store8,
)

# The buffer of `_sum_pairs`.
COLOR = 64  # gradients of red, green and blue; before them the sums of `layout.MOMENTS` over all tiles
ALL_SUMS = 88


@kernel
def project_backward(
    counter, gaussians, camera, settings, channels, footprints, first_slots, slot_counts, moments, extras,
    first_camera, need_colors, gradients, means2d_gradient,
):  # fmt: skip
    """Add the gradients through one camera to `gradients`; for the first camera, overwrite them.

    means2d_gradient is that of this camera only. Without need_colors, gradients.colors is not touched.
    `channels` is the number of feature channels, 0 if the colours are in the footprints.
    """
    means, colors, colors_gradient = gaussians.means, gaussians.colors, gradients.colors
    sh_count = settings.sh_count
    count = means.shape[0]
    ids = np.empty(CHUNK + 8, np.int64)
    sums = np.empty(ALL_SUMS, np.float32)
    basis = np.empty(16 * 8, np.float32)
    coefficients = np.empty(48 * 8, np.float32)
    results = np.empty(3 * 8, np.float32)
    while True:
        piece = fetch_add(counter, 0, 1)
        if piece * CHUNK >= count:
            break
        listed = _find_listed(
            piece * CHUNK, min((piece + 1) * CHUNK, count), sh_count, slot_counts, first_camera, need_colors,
            ids, gradients, means2d_gradient,
        )  # fmt: skip
        for k in range(listed, listed + 8):
            ids[k] = ids[max(listed - 1, 0)]
        for start in range(0, listed, 8):
            size = min(8, listed - start)
            if sh_count > 1:
                for ahead in range(start + PREFETCH, min(start + PREFETCH + 8, listed)):
                    prefetch_coefficients(colors, sh_count, at(ids, ahead))
            _sum_pairs(
                ids, start, size, first_slots, slot_counts, moments, extras, channels, first_camera,
                need_colors, colors_gradient, sums,
            )  # fmt: skip
            through_color = (splat(ZERO), splat(ZERO), splat(ZERO))
            if sh_count > 0:
                _, _, _, _, _, _, _, red = gather8(footprints, ids, start, PACKED, RED - RED % 8)
                green, blue, _, _, _, _, _, _ = gather8(footprints, ids, start, PACKED, GREEN - GREEN % 8)
                # No gradient passes where 0.5 + basis . colors was clamped to 0.
                red = select_gt(red, ZERO, load8(sums, COLOR), ZERO)
                green = select_gt(green, ZERO, load8(sums, COLOR + 8), ZERO)
                blue = select_gt(blue, ZERO, load8(sums, COLOR + 16), ZERO)
                through_color = shade_backward(
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
                gaussians, camera, settings, footprints, ids, start, first_camera, sums, through_color,
                gradients, means2d_gradient, results,
            )  # fmt: skip


@inlined
def _find_listed(
    start, end, sh_count, slot_counts, first_camera, need_colors, ids, gradients, means2d_gradient,
):  # fmt: skip
    """Fill `ids` with the Gaussians that have pairs; returns their number. Zeros the other gradients."""
    means_gradient, quats_gradient, scales_gradient, opacities_gradient, colors_gradient = gradients
    channels = colors_gradient.shape[2]
    stride = colors_gradient.shape[1] * channels
    listed = 0
    for i in range(start, end):
        used = 0  # colour gradients that will be overwritten
        if at(slot_counts, i) > 0:
            put(ids, listed, i)
            listed += 1
            used = max(sh_count, 1) * channels
        else:
            for k in range(2 * i, 2 * i + 2):
                put(means2d_gradient, k, ZERO)
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
    return listed


@inlined
def _sum_pairs(
    ids, start, size, first_slots, slot_counts, moments, extras, channels, first_camera, need_colors,
    colors_gradient, sums,
):  # fmt: skip
    """Sum over the tiles of each of the 8 Gaussians ids[start:], into `sums`.

    Gradients of feature channels are final, and go to colors_gradient.
    """
    extra_width = max(channels, 1)
    for lane in range(8):
        i = at(ids, start + lane)
        first = np.int64(at(first_slots, i))
        after = first + at(slot_counts, i)
        own = splat(ZERO)
        for slot in range(first, after):
            own = own + load8(moments, slot * MOMENTS)
        store8(sums, 8 * lane, own)
        for extra in range(extra_width):
            total = ZERO
            for slot in range(first, after):
                total += at(extras, slot * extra_width + extra)
            if channels == 0:
                put(sums, COLOR + 16 + lane, total)
            elif need_colors and lane < size:
                if not first_camera:
                    total += colors_gradient[i, 0, extra]
                colors_gradient[i, 0, extra] = total
    m0, m1, m2, m3, m4, m5, red, green = load_transposed(sums, 0)
    store8(sums, 0, m0)
    store8(sums, 8, m1)
    store8(sums, 16, m2)
    store8(sums, 24, m3)
    store8(sums, 32, m4)
    store8(sums, 40, m5)
    if channels == 0:
        store8(sums, COLOR, red)
        store8(sums, COLOR + 8, green)


@inlined
def _gaussian_gradients(
    gaussians, camera, settings, footprints, ids, start, first_camera, sums, through_color, gradients,
    means2d_gradient, results,
):  # fmt: skip
    """Go back through footprint and perspective. `through_color`: dL/d(mean) through the view directions."""
    s_1 = load8(sums, 0)
    s_x = load8(sums, 8)
    s_y = load8(sums, 16)
    s_xx = load8(sums, 24)
    s_xy = load8(sums, 32)
    s_yy = load8(sums, 40)
    _, _, conic_xx, conic_xy, conic_yy, _, _, _ = gather8(footprints, ids, start, PACKED, 0)
    conic_xx = conic_xx * -TWO
    conic_xy = conic_xy * -ONE
    conic_yy = conic_yy * -TWO
    mean_x = conic_xx * s_x + conic_xy * s_y
    mean_y = conic_xy * s_x + conic_yy * s_y
    opacity_gradient = divide(s_1, gather1(gaussians.opacities, ids, start))
    if not first_camera:
        opacity_gradient = opacity_gradient + gather1(gradients.opacities, ids, start)
    store8(results, 0, opacity_gradient)
    store8(results, 8, mean_x)
    store8(results, 16, mean_y)
    for lane in range(8):
        i = at(ids, start + lane)
        put(gradients.opacities, i, at(results, lane))
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

    linear = linearised(camera, settings, gaussians.means, gaussians.quats, ids, start)
    p, q = linear.jwr
    scales = gather3(gaussians.scales, ids, start, 3, 0)

    # dL/dV = 2 dL/d(covariance) V, then scales, rotation and the rows of J W.
    doubled = (scales[0] * TWO, scales[1] * TWO, scales[2] * TWO)
    du = times(_combined(cov_xx, p, cov_xy, q), doubled)
    dv = times(_combined(cov_xy, p, cov_yy, q), doubled)
    u = times(du, p)
    v = times(dv, q)
    _add3(gradients.scales, ids, start, first_camera, (u[0] + v[0], u[1] + v[1], u[2] + v[2]))
    du = times(du, scales)
    dv = times(dv, scales)
    a, b = linear.jw
    d00, d01, d02 = _combined(a[0], du, b[0], dv)
    d10, d11, d12 = _combined(a[1], du, b[1], dv)
    d20, d21, d22 = _combined(a[2], du, b[2], dv)
    qw, qx, qy, qz = linear.quaternion
    ew = (qx * (d21 - d12) + qy * (d02 - d20) + qz * (d10 - d01)) * TWO
    ex = (qy * (d10 + d01) + qz * (d20 + d02) + qw * (d21 - d12) - qx * (d11 + d22) * TWO) * TWO
    ey = (qx * (d10 + d01) + qz * (d21 + d12) + qw * (d02 - d20) - qy * (d00 + d22) * TWO) * TWO
    ez = (qx * (d20 + d02) + qy * (d21 + d12) + qw * (d10 - d01) - qz * (d00 + d11) * TWO) * TWO
    along = ew * qw + ex * qx + ey * qy + ez * qz
    # A zero quaternion is rendered without rotation, and gets no gradient.
    norm = select_gt(linear.square, NORM_MIN, linear.norm, ZERO)
    quat_gradient = (
        _finite((ew - along * qw) * norm),
        _finite((ex - along * qx) * norm),
        _finite((ey - along * qy) * norm),
        _finite((ez - along * qz) * norm),
    )
    if not first_camera:
        w, x, y, z = gather4(gradients.quats, ids, start, 4, 0)
        w_new, x_new, y_new, z_new = quat_gradient
        quat_gradient = (w_new + w, x_new + x, y_new + y, z_new + z)
    scatter(gradients.quats, ids, start, 4, 0, quat_gradient)
    r = linear.rotation
    da = (_finite(dot(du, r[0])), _finite(dot(du, r[1])), _finite(dot(du, r[2])))
    db = (_finite(dot(dv, r[0])), _finite(dot(dv, r[1])), _finite(dot(dv, r[2])))

    # Through J and the projected centre to the mean in camera space (tx, ty, tz). J does not depend on a
    # clamped slope.
    jxx, _, jyy, _ = linear.jacobian
    clamped_x, clamped_y = linear.clamped
    djxx = da[0] * camera[0] + da[1] * camera[1] + da[2] * camera[2]
    djxz = (da[0] * camera[6] + da[1] * camera[7] + da[2] * camera[8]) * jxx * linear.inverse_depth
    djyy = db[0] * camera[3] + db[1] * camera[4] + db[2] * camera[5]
    djyz = (db[0] * camera[6] + db[1] * camera[7] + db[2] * camera[8]) * jyy * linear.inverse_depth
    free_x = _one_where_equal(linear.slopes[0], clamped_x)
    free_y = _one_where_equal(linear.slopes[1], clamped_y)
    mean_x = mean_x * jxx
    mean_y = mean_y * jyy
    tx = mean_x - djxz * free_x
    ty = mean_y - djyz * free_y
    tz = ZERO - (mean_x * linear.slopes[0] + mean_y * linear.slopes[1])
    tz = tz - (djxx * jxx + djyy * jyy) * linear.inverse_depth
    tz = tz + djxz * clamped_x * (free_x + ONE) + djyz * clamped_y * (free_y + ONE)
    tx, ty, tz = _finite(tx), _finite(ty), _finite(tz)
    dx, dy, dz = through_color
    mean_gradient = (
        tx * camera[0] + ty * camera[3] + tz * camera[6] + dx,
        tx * camera[1] + ty * camera[4] + tz * camera[7] + dy,
        tx * camera[2] + ty * camera[5] + tz * camera[8] + dz,
    )
    _add3(gradients.means, ids, start, first_camera, mean_gradient)


@inlined
def _combined(x, p, y, q):
    """x p + y q, with 3 vectors each in p and q."""
    return x * p[0] + y * q[0], x * p[1] + y * q[1], x * p[2] + y * q[2]


@inlined
def _finite(a):
    """`a`, and 0 where it is NaN or too large to multiply, as happens for Gaussians of absurd sizes."""
    return select_gt(HUGE, absolute(a), a, ZERO)


@inlined
def _one_where_equal(a, b):
    return select_ge(a, b, select_ge(b, a, ONE, ZERO), ZERO)


@inlined
def _add3(array, ids, start, first_camera, values):
    """Add 3 vectors to the columns of an array [N, 3]; for the first camera, overwrite them."""
    if not first_camera:
        x, y, z = gather3(array, ids, start, 3, 0)
        values = (values[0] + x, values[1] + y, values[2] + z)
    scatter(array, ids, start, 3, 0, values)
