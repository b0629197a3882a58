"""From 3D Gaussians to 2D ones: EWA splatting (Zwicker et al. 2001, eq. 31) in the form of 3DGS.

The covariance in the image is V V^T + eps2d I with the 2x3 matrix V = J W R S: the Jacobian of the
perspective, the camera rotation, the Gaussian's rotation and scales. V itself is kept rather than the
product, because its determinant is then a sum of squares and cannot cancel.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import math

import numpy as np

from keyss.rendering.cpu.binning import tile_box
from keyss.rendering.cpu.jit import kernel
from keyss.rendering.cpu.layout import (
    ALPHA_MIN,
    BLUE,
    CHANNEL_MAX,
    CHUNK,
    CX,
    CY,
    DECAY,
    EXTENT_X,
    EXTENT_Y,
    FOV_MARGIN,
    FX,
    FY,
    GREEN,
    HALF,
    HUGE,
    LEVEL,
    NORM_MIN,
    ONE,
    OPACITY,
    PACKED,
    POSITION,
    RADIUS_SIGMAS,
    RED,
    TWO,
    TX,
    TY,
    TZ,
    XX,
    XY,
    YY,
    ZERO,
    X,
    Y,
    f32,
)
from keyss.rendering.cpu.sh import sh_basis
from keyss.rendering.cpu.simd8 import ceil, fetch_add, prefetch_write

PREFETCH = 12  # how many Gaussians ahead to ask for memory


@kernel
def rotation_matrix(w, x, y, z):
    """The 9 entries, row-major, of the rotation by the quaternion; a zero quaternion is the identity."""
    scale = ONE / math.sqrt(max(w * w + x * x + y * y + z * z, NORM_MIN))
    w *= scale
    x *= scale
    y *= scale
    z *= scale
    return (
        ONE - TWO * (y * y + z * z),
        TWO * (x * y - w * z),
        TWO * (x * z + w * y),
        TWO * (x * y + w * z),
        ONE - TWO * (x * x + z * z),
        TWO * (y * z - w * x),
        TWO * (x * z - w * y),
        TWO * (y * z + w * x),
        ONE - TWO * (x * x + y * y),
    )


@kernel
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


@kernel
def project(
    counter,
    means,
    quats,
    scales,
    opacities,
    camera,
    width,
    height,
    near,
    far,
    eps2d,
    radius_clip,
    antialiased,
    footprints,
    means2d,
    depths,
    radii,
):
    """Fill one row per Gaussian of `footprints` (packed layout without colour), means2d, depths and radii.

    A Gaussian that cannot be seen gets depth 0 and radii 0; its footprint is left as it is. With
    `antialiased` the opacity is multiplied by sqrt(det(V V^T) / det(V V^T + eps2d I)), so that widening a
    footprint by eps2d does not add to what it covers (Mip-Splatting, Yu et al. 2024, eq. 8).
    """
    count = means.shape[0]
    image_width = f32(width)
    image_height = f32(height)
    x_low, x_high, y_low, y_high = slope_limits(camera, width, height)
    while True:
        start = fetch_add(counter, 0, 1) * CHUNK
        if start >= count:
            break
        for i in range(start, min(start + CHUNK, count)):
            depths[i] = ZERO
            means2d[i, 0] = ZERO
            means2d[i, 1] = ZERO
            radii[i, 0] = 0
            radii[i, 1] = 0
            # Every test below is written so that a NaN fails it.
            opacity = opacities[i]
            if not (opacity >= ALPHA_MIN and opacity < HUGE):
                continue
            px = means[i, 0]
            py = means[i, 1]
            pz = means[i, 2]
            z = camera[6] * px + camera[7] * py + camera[8] * pz + camera[TZ]
            if not (z >= near and z <= far):
                continue
            x = camera[0] * px + camera[1] * py + camera[2] * pz + camera[TX]
            y = camera[3] * px + camera[4] * py + camera[5] * pz + camera[TY]
            rz = ONE / z
            u = x * rz
            v = y * rz
            mean_x = camera[FX] * u + camera[CX]
            mean_y = camera[FY] * v + camera[CY]
            u = min(max(u, x_low), x_high)
            v = min(max(v, y_low), y_high)
            jxx = camera[FX] * rz
            jxz = -jxx * u
            jyy = camera[FY] * rz
            jyz = -jyy * v
            a0 = jxx * camera[0] + jxz * camera[6]
            a1 = jxx * camera[1] + jxz * camera[7]
            a2 = jxx * camera[2] + jxz * camera[8]
            b0 = jyy * camera[3] + jyz * camera[6]
            b1 = jyy * camera[4] + jyz * camera[7]
            b2 = jyy * camera[5] + jyz * camera[8]
            r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_matrix(
                quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            )
            s0 = scales[i, 0]
            s1 = scales[i, 1]
            s2 = scales[i, 2]
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
            det = sharp_det + eps2d * (cov_xx + cov_yy + eps2d)
            if not det < HUGE:
                continue
            if antialiased:
                opacity *= math.sqrt(sharp_det / det)
                if not opacity >= ALPHA_MIN:
                    continue
            cov_xx += eps2d
            cov_yy += eps2d
            level = max(TWO * math.log(f32(255.0) * opacity), ZERO)
            sigmas = math.sqrt(level)
            sigma_x = math.sqrt(cov_xx)
            sigma_y = math.sqrt(cov_yy)
            reach = sigmas if sigmas < RADIUS_SIGMAS else RADIUS_SIGMAS
            radius_x = ceil(reach * sigma_x)
            radius_y = ceil(reach * sigma_y)
            if f32(max(radius_x, radius_y)) <= radius_clip:
                continue
            if not (
                mean_x + f32(radius_x) > ZERO
                and mean_x - f32(radius_x) < image_width
                and mean_y + f32(radius_y) > ZERO
                and mean_y - f32(radius_y) < image_height
            ):
                continue
            inverse = ONE / det
            means2d[i, 0] = mean_x
            means2d[i, 1] = mean_y
            depths[i] = z
            radii[i, 0] = min(radius_x, 2**30)
            radii[i, 1] = min(radius_y, 2**30)
            footprints[i, X] = mean_x
            footprints[i, Y] = mean_y
            footprints[i, XX] = -HALF * cov_yy * inverse
            footprints[i, XY] = cov_xy * inverse
            footprints[i, YY] = -HALF * cov_xx * inverse
            footprints[i, LEVEL] = level
            footprints[i, OPACITY] = opacity
            # A little wider than exact, so that rounding never cuts off a pixel that counts.
            footprints[i, EXTENT_X] = sigmas * sigma_x * f32(1.0005) + f32(1e-3)
            footprints[i, EXTENT_Y] = sigmas * sigma_y * f32(1.0005) + f32(1e-3)
            footprints[i, DECAY] = math.exp(-cov_xx * inverse)


@kernel
def pack(
    counter,
    footprints,
    means,
    colors,
    sh_count,
    camera,
    tile_columns,
    tile_rows,
    depths,
    rank,
    radii,
    packed,
    features,
    tile_bounds,
):
    """Copy the footprints of visible Gaussians into depth order, with their colours as seen from the camera.

    sh_count is the number of SH coefficients to use, or 0 where colors[:, 0] is the colour itself.
    Where `features` has columns, it gets the channels to draw: the colour, of any number of channels, and
    in one column more the depth. tile_bounds[r] becomes a number of tiles that Gaussian r of the depth
    order meets at most. A Gaussian whose colour is not below CHANNEL_MAX is hidden: its rank becomes -1, its
    radii and extents are made empty.
    """
    count = rank.shape[0]
    channels = features.shape[1]
    basis = np.empty(16, np.float32)
    while True:
        start = fetch_add(counter, 0, 1) * CHUNK
        if start >= count:
            break
        for i in range(start, min(start + CHUNK, count)):
            prefetch_write(packed, np.int64(rank[min(i + PREFETCH, count - 1)]) * PACKED)
            r = rank[i]
            if r < 0:
                continue
            for k in range(DECAY + 1):
                packed[r, k] = footprints[i, k]
            finite = True
            red = ZERO
            green = ZERO
            blue = ZERO
            if sh_count == 0 and channels > 0:
                for channel in range(colors.shape[2]):
                    finite = finite and abs(colors[i, 0, channel]) < CHANNEL_MAX
                    features[r, channel] = colors[i, 0, channel]
            elif sh_count == 0:
                red = colors[i, 0, 0]
                green = colors[i, 0, 1]
                blue = colors[i, 0, 2]
            else:
                x = means[i, 0] - camera[POSITION]
                y = means[i, 1] - camera[POSITION + 1]
                z = means[i, 2] - camera[POSITION + 2]
                inverse = ONE / math.sqrt(max(x * x + y * y + z * z, NORM_MIN))
                sh_basis(basis, sh_count, x * inverse, y * inverse, z * inverse)
                red = HALF
                green = HALF
                blue = HALF
                for k in range(sh_count):
                    red += basis[k] * colors[i, k, 0]
                    green += basis[k] * colors[i, k, 1]
                    blue += basis[k] * colors[i, k, 2]
            if not (
                finite and abs(red) < CHANNEL_MAX and abs(green) < CHANNEL_MAX and abs(blue) < CHANNEL_MAX
            ):
                rank[i] = -1
                radii[i, 0] = 0
                radii[i, 1] = 0
                packed[r, EXTENT_X] = f32(-1e6)
                packed[r, EXTENT_Y] = f32(-1e6)
                tile_bounds[r] = 0
                continue
            if sh_count > 0:
                red = max(red, ZERO)
                green = max(green, ZERO)
                blue = max(blue, ZERO)
                if channels > 0:
                    features[r, 0] = red
                    features[r, 1] = green
                    features[r, 2] = blue
            if channels > colors.shape[2]:
                features[r, channels - 1] = depths[i]
            packed[r, RED] = red
            packed[r, GREEN] = green
            packed[r, BLUE] = blue
            first_column, last_column, first_row, last_row = tile_box(
                packed[r, X],
                packed[r, Y],
                packed[r, EXTENT_X],
                packed[r, EXTENT_Y],
                tile_columns,
                tile_rows,
            )
            tile_bounds[r] = max(last_column - first_column + 1, 0) * max(last_row - first_row + 1, 0)
