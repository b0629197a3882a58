"""From 3D Gaussians to 2D ones: EWA splatting (Zwicker et al. 2001, eq. 31) in the form of 3DGS.

The covariance in the image is V V^T + eps2d I with the 2x3 matrix V = J W R S: the Jacobian of the
perspective, the camera rotation, the Gaussian's rotation and scales. V itself is kept rather than the
product, because its determinant is then a sum of squares and cannot cancel.

Gaussians are taken 8 at a time, one in each lane of the vectors.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import inlined, kernel
from keyss.rendering.cpu.layout import (
    ALPHA_MIN,
    BLUE,
    CHANNEL_MAX,
    CHUNK,
    CX,
    CY,
    FOV_MARGIN,
    FX,
    FY,
    GREEN,
    HALF,
    HUGE,
    INVERSE_ALPHA_MIN,
    ONE,
    PACKED,
    RADIUS_SIGMAS,
    RED,
    TILE_HEIGHT,
    TILE_WIDTH,
    TWO,
    TX,
    TY,
    TZ,
    ZERO,
    f32,
)
from keyss.rendering.cpu.rows import gather1, gather3, gather4, scatter
from keyss.rendering.cpu.shading import inverse_length, prefetch_coefficients, shade
from keyss.rendering.cpu.simd8 import (
    absolute,
    any_gt,
    at,
    ceil8,
    divide,
    exp,
    fetch_add,
    floor8,
    log,
    maximum,
    minimum,
    multiply_add,
    put,
    select_ge,
    select_gt,
    splat,
    square_root,
    store8,
)

PREFETCH = 24  # how many Gaussians ahead to ask for memory
RADIUS_MAX = f32(2**30)
COLUMN = f32(1 / TILE_WIDTH)
ROW = f32(1 / TILE_HEIGHT)


@inlined
def rotation_matrix(w, x, y, z):
    """The 9 entries, row-major, of the rotations by unit quaternions."""
    return (
        ONE - (y * y + z * z) * TWO,
        (x * y - w * z) * TWO,
        (x * z + w * y) * TWO,
        (x * y + w * z) * TWO,
        ONE - (x * x + z * z) * TWO,
        (y * z - w * x) * TWO,
        (x * z - w * y) * TWO,
        (y * z + w * x) * TWO,
        ONE - (x * x + y * y) * TWO,
    )


@inlined
def slope_limits(camera, width, height):
    """Smallest and largest x/z and y/z at which the perspective is linearised: the image and a margin."""
    image_width = f32(width)
    image_height = f32(height)
    margin_x = FOV_MARGIN * image_width / camera[FX]
    margin_y = FOV_MARGIN * image_height / camera[FY]
    return (
        -(camera[CX] / camera[FX] + margin_x),
        (image_width - camera[CX]) / camera[FX] + margin_x,
        -(camera[CY] / camera[FY] + margin_y),
        (image_height - camera[CY]) / camera[FY] + margin_y,
    )


@inlined
def camera_coordinates(camera, px, py, pz):
    """x, y and depth in the camera's frame of points of the world."""
    return (
        px * camera[0] + py * camera[1] + pz * camera[2] + camera[TX],
        px * camera[3] + py * camera[4] + pz * camera[5] + camera[TY],
        px * camera[6] + py * camera[7] + pz * camera[8] + camera[TZ],
    )


@inlined
def jacobian_rows(camera, jxx, jxz, jyy, jyz):
    """The 6 entries of J W."""
    return (
        jxx * camera[0] + jxz * camera[6],
        jxx * camera[1] + jxz * camera[7],
        jxx * camera[2] + jxz * camera[8],
        jyy * camera[3] + jyz * camera[6],
        jyy * camera[4] + jyz * camera[7],
        jyy * camera[5] + jyz * camera[8],
    )


@kernel
def project(
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
    near,
    far,
    eps2d,
    radius_clip,
    antialiased,
    footprints,
    features,
    means2d,
    depths,
    radii,
    tile_bounds,
):
    """Fill one row per Gaussian of `footprints` (packed layout), means2d, depths, radii and tile_bounds.

    tile_bounds[i] is a number of tiles that the Gaussian meets at most. What cannot be seen, or has a
    colour of CHANNEL_MAX or more, gets depth 0, radii 0 and no tiles; its footprint means nothing. sh_count
    is the number of SH coefficients to use, or 0 where colors[:, 0] is the colour itself. Where `features`
    has columns, it gets the channels to draw: the colour, of any number of channels, and in one column more
    the depth.

    With `antialiased` the opacity is multiplied by sqrt(det(V V^T) / det(V V^T + eps2d I)), so that
    widening a footprint by eps2d does not add to what it covers (Mip-Splatting, Yu et al. 2024, eq. 8).
    """
    count = means.shape[0]
    ids = np.empty(CHUNK + 8, np.int64)
    seen = np.empty(CHUNK + 8, np.int64)
    results = np.empty(64, np.float32)
    basis = np.empty(16 * 8, np.float32)
    coefficients = np.empty(48 * 8, np.float32)
    while True:
        start = fetch_add(counter, 0, 1) * CHUNK
        if start >= count:
            break
        size = min(CHUNK, count - start)
        for k in range(CHUNK + 8):
            ids[k] = start + min(k, size - 1)
        visible = 0
        for k in range(0, size, 8):
            _project(
                means, quats, scales, opacities, camera, width, height, near, far, eps2d, radius_clip,
                antialiased, footprints, ids, k, results,
            )  # fmt: skip
            for lane in range(min(8, size - k)):
                i = start + k + lane
                put(means2d, 2 * i, at(results, lane))
                put(means2d, 2 * i + 1, at(results, 8 + lane))
                put(depths, i, at(results, 16 + lane))
                put(radii, 2 * i, np.int32(at(results, 24 + lane)))
                put(radii, 2 * i + 1, np.int32(at(results, 32 + lane)))
                put(tile_bounds, i, np.int32(at(results, 40 + lane)))
                put(seen, visible, i)
                visible += at(results, 16 + lane) > ZERO
        for k in range(visible, min(visible + 8, CHUNK + 8)):
            seen[k] = seen[max(visible - 1, 0)]
        if sh_count > 0:
            for k in range(0, visible, 8):
                for ahead in range(k + PREFETCH, min(k + PREFETCH + 8, visible)):
                    prefetch_coefficients(colors, sh_count, at(seen, ahead))
                red, green, blue = shade(means, colors, sh_count, camera, seen, k, basis, coefficients)
                drawn = (maximum(red, ZERO), maximum(green, ZERO), maximum(blue, ZERO))
                scatter(footprints, seen, k, PACKED, RED, drawn)
                # Written so that a NaN counts, too.
                size_of_color = absolute(red) + absolute(green) + absolute(blue)
                if any_gt(select_gt(CHANNEL_MAX, size_of_color, ZERO, ONE), ZERO):
                    store8(results, 0, size_of_color)
                    for lane in range(min(8, visible - k)):
                        if not results[lane] < CHANNEL_MAX:
                            _hide(seen[k + lane], depths, radii, tile_bounds)
        else:
            _copy_colors(colors, seen, visible, features, footprints, depths, radii, tile_bounds)
        if features.shape[1] > 0:
            _copy_features(sh_count, colors.shape[2], seen, visible, footprints, depths, features)


@inlined
def _project(
    means, quats, scales, opacities, camera, width, height, near, far, eps2d, radius_clip, antialiased,
    footprints, ids, start, results,
):  # fmt: skip
    """Footprints without colour; results = [mean x | mean y | depth | radius x | radius y | tiles]."""
    x_low, x_high, y_low, y_high = slope_limits(camera, width, height)
    fx = camera[FX]
    fy = camera[FY]
    opacity = gather1(opacities, ids, start)
    px, py, pz = gather3(means, ids, start, 3, 0)
    x, y, z = camera_coordinates(camera, px, py, pz)
    # `seen` is 1 or 0. Every test is written so that a NaN fails it.
    seen = select_ge(opacity, ALPHA_MIN, ONE, ZERO)
    seen = select_gt(HUGE, opacity, seen, ZERO)
    seen = select_ge(z, near, seen, ZERO)
    seen = select_ge(far, z, seen, ZERO)
    rz = divide(ONE, z)
    u = x * rz
    v = y * rz
    mean_x = multiply_add(u, fx, splat(camera[CX]))
    mean_y = multiply_add(v, fy, splat(camera[CY]))
    u = minimum(maximum(u, x_low), x_high)
    v = minimum(maximum(v, y_low), y_high)
    jxx = rz * fx
    jyy = rz * fy
    a0, a1, a2, b0, b1, b2 = jacobian_rows(camera, jxx, ZERO - jxx * u, jyy, ZERO - jyy * v)
    w, i, j, k = gather4(quats, ids, start, 4, 0)
    norm = inverse_length(w * w + i * i + j * j + k * k)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(w * norm, i * norm, j * norm, k * norm)
    s0, s1, s2 = gather3(scales, ids, start, 3, 0)
    u0 = (a0 * r00 + a1 * r10 + a2 * r20) * s0
    u1 = (a0 * r01 + a1 * r11 + a2 * r21) * s1
    u2 = (a0 * r02 + a1 * r12 + a2 * r22) * s2
    v0 = (b0 * r00 + b1 * r10 + b2 * r20) * s0
    v1 = (b0 * r01 + b1 * r11 + b2 * r21) * s1
    v2 = (b0 * r02 + b1 * r12 + b2 * r22) * s2
    cov_xx = u0 * u0 + u1 * u1 + u2 * u2
    cov_xy = u0 * v0 + u1 * v1 + u2 * v2
    cov_yy = v0 * v0 + v1 * v1 + v2 * v2
    # |u x v|^2 is det(V V^T) by Cauchy-Binet.
    n0 = u1 * v2 - u2 * v1
    n1 = u2 * v0 - u0 * v2
    n2 = u0 * v1 - u1 * v0
    sharp_det = n0 * n0 + n1 * n1 + n2 * n2
    det = sharp_det + (cov_xx + cov_yy + eps2d) * eps2d
    seen = select_gt(HUGE, det, seen, ZERO)
    inverse = divide(ONE, det)
    if antialiased:
        opacity = opacity * square_root(sharp_det * inverse)
        seen = select_ge(opacity, ALPHA_MIN, seen, ZERO)
    cov_xx = cov_xx + eps2d
    cov_yy = cov_yy + eps2d
    level = maximum(log(maximum(opacity * INVERSE_ALPHA_MIN, ONE)) * TWO, ZERO)
    sigmas = square_root(level)
    sigma_x = square_root(cov_xx)
    sigma_y = square_root(cov_yy)
    reach = minimum(sigmas, RADIUS_SIGMAS)
    radius_x = ceil8(reach * sigma_x)
    radius_y = ceil8(reach * sigma_y)
    seen = select_gt(maximum(radius_x, radius_y), radius_clip, seen, ZERO)
    seen = select_gt(mean_x + radius_x, ZERO, seen, ZERO)
    seen = select_gt(f32(width), mean_x - radius_x, seen, ZERO)
    seen = select_gt(mean_y + radius_y, ZERO, seen, ZERO)
    seen = select_gt(f32(height), mean_y - radius_y, seen, ZERO)
    # A little wider than exact, so that rounding never cuts off a pixel that counts.
    extent_x = sigmas * sigma_x * f32(1.0005) + f32(1e-3)
    extent_y = sigmas * sigma_y * f32(1.0005) + f32(1e-3)
    columns = _tiles(mean_x, extent_x, width, COLUMN)
    rows = _tiles(mean_y, extent_y, height, ROW)
    store8(results, 0, select_gt(seen, HALF, mean_x, ZERO))
    store8(results, 8, select_gt(seen, HALF, mean_y, ZERO))
    store8(results, 16, select_gt(seen, HALF, z, ZERO))
    store8(results, 24, select_gt(seen, HALF, minimum(radius_x, RADIUS_MAX), ZERO))
    store8(results, 32, select_gt(seen, HALF, minimum(radius_y, RADIUS_MAX), ZERO))
    store8(results, 40, select_gt(seen, HALF, columns * rows, ZERO))

    zero = splat(ZERO)
    conic = (cov_yy * inverse * -HALF, cov_xy * inverse, cov_xx * inverse * -HALF)
    scatter(footprints, ids, start, PACKED, 0, (mean_x, mean_y, *conic, level, opacity, zero))
    decay = exp(ZERO - cov_xx * inverse)
    scatter(footprints, ids, start, PACKED, 8, (zero, zero, extent_x, extent_y, decay, zero, zero, zero))


@inlined
def _tiles(centre, extent, size, per_pixel):
    """How many tiles, along one axis, hold pixel centres within the extents."""
    first = floor8(maximum(ceil8(centre - extent - HALF), ZERO) * per_pixel)
    last = floor8(minimum(floor8(centre + extent - HALF), f32(size - 1)) * per_pixel)
    return maximum(last - first + ONE, ZERO)


@inlined
def _hide(i, depths, radii, tile_bounds):
    depths[i] = ZERO
    radii[i, 0] = 0
    radii[i, 1] = 0
    tile_bounds[i] = 0


@inlined
def _copy_colors(colors, seen, visible, features, footprints, depths, radii, tile_bounds):
    """Colours that are no SH: into the footprints where they are drawn from there, else into `features`."""
    channels = colors.shape[2]
    to_features = features.shape[1] > 0
    for k in range(visible):
        i = seen[k]
        for channel in range(channels):
            value = colors[i, 0, channel]
            if to_features:
                features[i, channel] = value
            else:
                footprints[i, RED + channel] = value
            if not abs(value) < CHANNEL_MAX:
                _hide(i, depths, radii, tile_bounds)


@inlined
def _copy_features(sh_count, color_channels, seen, visible, footprints, depths, features):
    """Colours computed from SH, and depths, into `features`."""
    for k in range(visible):
        i = seen[k]
        if sh_count > 0:
            features[i, 0] = footprints[i, RED]
            features[i, 1] = footprints[i, GREEN]
            features[i, 2] = footprints[i, BLUE]
        if features.shape[1] > color_channels:
            features[i, features.shape[1] - 1] = depths[i]
