"""The backward pass of `projection`: gradients of the Gaussians from those of the 2D footprints.

Only Gaussians in the list of a tile have a gradient. A vector holds 8 of them, one in each lane. The last
Gaussian fills free lanes at the end: its gradient is written several times, with equal results.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.kernels.jit import inline, kernel
from keyss.rendering.cpu.constants import CHUNK, HALF, HUGE, MOMENTS, NORM_MIN, ONE, PACKED, RED, TWO, ZERO
from keyss.rendering.cpu.gather import gather1, gather3, gather8, load_transposed, scatter
from keyss.rendering.cpu.projection import PREFETCH, dot, linearise, times
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


@kernel
def project_backward(
    counter, gaussians, camera, settings, channels, footprints, first_slots, slot_counts, moments, extras,
    need_colors, gradients, means2d_gradient,
):  # fmt: skip
    """Fill `gradients` and means2d_gradient.

    Without need_colors, gradients.colors does not change. `channels` is the number of feature channels, 0 if
    the colours are in the footprints.
    """
    means, colors, colors_gradient = gaussians.means, gaussians.colors, gradients.colors
    sh_count = settings.sh_count
    count = means.shape[0]
    ids = np.empty(CHUNK + 8, np.int64)
    sums = np.empty(9 * 8, np.float32)
    basis = np.empty(16 * 8, np.float32)
    coefficients = np.empty(48 * 8, np.float32)
    while True:
        piece = fetch_add(counter, 0, 1)
        if piece * CHUNK >= count:
            break
        listed = _find_listed(
            piece * CHUNK, min((piece + 1) * CHUNK, count), sh_count, slot_counts, need_colors, ids,
            gradients, means2d_gradient,
        )  # fmt: skip
        for k in range(listed, listed + 8):
            ids[k] = ids[max(listed - 1, 0)]
        for start in range(0, listed, 8):
            if sh_count > 1:
                for ahead in range(start + PREFETCH, min(start + PREFETCH + 8, listed)):
                    prefetch_coefficients(colors, sh_count, at(ids, ahead))
            own_moments, red, green, blue = _sum_pairs(
                ids, start, first_slots, slot_counts, moments, extras, channels, need_colors, colors_gradient,
                sums,
            )  # fmt: skip
            through_color = (splat(ZERO), splat(ZERO), splat(ZERO))
            if sh_count > 0:
                # No gradient passes where 0.5 + basis . colors was clamped to 0.
                drawn_red, drawn_green, drawn_blue = gather3(footprints, ids, start, PACKED, RED)
                red = select_gt(drawn_red, ZERO, red, ZERO)
                green = select_gt(drawn_green, ZERO, green, ZERO)
                blue = select_gt(drawn_blue, ZERO, blue, ZERO)
                through_color = shade_backward(
                    means, colors, sh_count, camera, ids, start, red, green, blue, need_colors, basis,
                    coefficients, colors_gradient,
                )  # fmt: skip
            elif need_colors and channels == 0:
                scatter(colors_gradient, ids, start, 3, 0, (red, green, blue))
            _gaussian_gradients(
                gaussians, camera, settings, footprints, ids, start, own_moments, through_color, gradients,
                means2d_gradient,
            )  # fmt: skip


@inline
def _find_listed(start, end, sh_count, slot_counts, need_colors, ids, gradients, means2d_gradient):
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
            for k in range(3 * i, 3 * i + 3):
                put(means_gradient, k, ZERO)
                put(scales_gradient, k, ZERO)
            for k in range(4 * i, 4 * i + 4):
                put(quats_gradient, k, ZERO)
            put(opacities_gradient, i, ZERO)
        if need_colors:
            for k in range(i * stride + used, (i + 1) * stride):
                put(colors_gradient, k, ZERO)
    return listed


@inline
def _sum_pairs(
    ids, start, first_slots, slot_counts, moments, extras, channels, need_colors, colors_gradient, sums,
):  # fmt: skip
    """Sums over the tiles of the 8 Gaussians ids[start:]: six moments, red, green and blue.

    Sums of feature channels are written to colors_gradient instead.
    """
    extra_width = max(channels, 1)
    for lane in range(8):
        i = at(ids, start + lane)
        first = np.int64(at(first_slots, i))
        after = first + at(slot_counts, i)
        moments_sum = splat(ZERO)
        for slot in range(first, after):
            moments_sum = moments_sum + load8(moments, slot * MOMENTS)
        store8(sums, 8 * lane, moments_sum)
        for extra in range(extra_width):
            total = ZERO
            for slot in range(first, after):
                total += at(extras, slot * extra_width + extra)
            if channels == 0:
                put(sums, 64 + lane, total)
            elif need_colors:
                colors_gradient[i, 0, extra] = total
    columns = load_transposed(sums, 0)
    return columns[:6], columns[6], columns[7], load8(sums, 64)


@inline
def _gaussian_gradients(
    gaussians, camera, settings, footprints, ids, start, moments, through_color, gradients, means2d_gradient,
):  # fmt: skip
    """Differentiate footprint and perspective. `through_color`: dL/d(mean) through the view directions."""
    s_1, s_x, s_y, s_xx, s_xy, s_yy = moments
    _, _, conic_xx, conic_xy, conic_yy, _, _, _ = gather8(footprints, ids, start, PACKED, 0)
    conic_xx = conic_xx * -TWO
    conic_xy = conic_xy * -ONE
    conic_yy = conic_yy * -TWO
    mean_x = conic_xx * s_x + conic_xy * s_y
    mean_y = conic_xy * s_x + conic_yy * s_y
    (opacity,) = gather1(gaussians.opacities, ids, start, 1, 0)
    scatter(gradients.opacities, ids, start, 1, 0, (divide(s_1, opacity),))
    scatter(means2d_gradient, ids, start, 2, 0, (mean_x, mean_y))

    # dL/d(covariance) = -conic dL/d(conic) conic, with dL/d(conic) = -1/2 [s_xx s_xy; s_xy s_yy].
    t_00 = conic_xx * s_xx + conic_xy * s_xy
    t_01 = conic_xx * s_xy + conic_xy * s_yy
    t_10 = conic_xy * s_xx + conic_yy * s_xy
    t_11 = conic_xy * s_xy + conic_yy * s_yy
    cov_xx = (t_00 * conic_xx + t_01 * conic_xy) * HALF
    cov_xy = (t_00 * conic_xy + t_01 * conic_yy) * HALF
    cov_yy = (t_10 * conic_xy + t_11 * conic_yy) * HALF

    linear = linearise(camera, settings, gaussians.means, gaussians.quats, ids, start)
    p, q = linear.jwr
    scales = gather3(gaussians.scales, ids, start, 3, 0)

    # dL/dV = 2 dL/d(covariance) V, then scales, rotation and the rows of J W.
    doubled = (scales[0] * TWO, scales[1] * TWO, scales[2] * TWO)
    du = times(_combine(cov_xx, p, cov_xy, q), doubled)
    dv = times(_combine(cov_xy, p, cov_yy, q), doubled)
    u = times(du, p)
    v = times(dv, q)
    scatter(gradients.scales, ids, start, 3, 0, (u[0] + v[0], u[1] + v[1], u[2] + v[2]))
    du = times(du, scales)
    dv = times(dv, scales)
    a, b = linear.jw
    d00, d01, d02 = _combine(a[0], du, b[0], dv)
    d10, d11, d12 = _combine(a[1], du, b[1], dv)
    d20, d21, d22 = _combine(a[2], du, b[2], dv)
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
    scatter(gradients.quats, ids, start, 4, 0, quat_gradient)
    r = linear.rotation
    da = (_finite(dot(du, r[0])), _finite(dot(du, r[1])), _finite(dot(du, r[2])))
    db = (_finite(dot(dv, r[0])), _finite(dot(dv, r[1])), _finite(dot(dv, r[2])))

    # Gradient of the mean in camera space (tx, ty, tz), through J and the projected centre. J does not depend
    # on clamped slopes.
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
    scatter(gradients.means, ids, start, 3, 0, mean_gradient)


@inline
def _combine(x, p, y, q):
    """x p + y q, with 3 vectors each in p and q."""
    return x * p[0] + y * q[0], x * p[1] + y * q[1], x * p[2] + y * q[2]


@inline
def _finite(a):
    """`a`, or 0 if it is NaN or too large to multiply, as for absurdly large Gaussians."""
    return select_gt(HUGE, absolute(a), a, ZERO)


@inline
def _one_where_equal(a, b):
    return select_ge(a, b, select_ge(b, a, ONE, ZERO), ZERO)
