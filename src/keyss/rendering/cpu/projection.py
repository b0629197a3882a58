"""Projection of 3D Gaussians to 2D: EWA splatting (Zwicker et al. 2001, eq. 31) in the form of 3DGS.

The covariance in the image is V V^T + eps2d I with the 2x3 matrix V = J W R S: the Jacobian of the
perspective, the camera rotation, the Gaussian's rotation and scales. The code uses V instead of the product:
the determinant is then a sum of squares, without cancellation.

A vector holds 8 Gaussians, one in each lane.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from keyss.kernels.jit import inline, kernel
from keyss.rendering.cpu.constants import (
    ALPHA_MIN,
    CHANNEL_MAX,
    CHUNK,
    CX,
    CY,
    FOV_MARGIN,
    FX,
    FY,
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
from keyss.rendering.cpu.gather import gather1, gather3, gather4, scatter
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

PREFETCH = 24  # Gaussians ahead whose memory is prefetched
RADIUS_MAX = f32(2**30)
COLUMN = f32(1 / TILE_WIDTH)
ROW = f32(1 / TILE_HEIGHT)


class Linearised(NamedTuple):
    """The projection of 8 Gaussians up to J W R, which forward and backward pass share."""

    point: Any  # x, y and depth of the centre in camera space
    inverse_depth: Any
    slopes: Any  # x / z and y / z
    clamped: Any  # slopes at which the perspective is linearised
    jacobian: Any  # entries xx, xz, yy and yz; the others are 0
    jw: Any  # rows of J W
    quaternion: Any  # normalised
    square: Any  # squared length of the quaternion
    norm: Any  # factor that normalised it
    rotation: Any  # rows
    jwr: Any  # rows of J W R


@inline
def linearise(camera, settings, means, quats, ids, start):
    """`Linearised` of the 8 Gaussians ids[start:]."""
    px, py, pz = gather3(means, ids, start, 3, 0)
    x = px * camera[0] + py * camera[1] + pz * camera[2] + camera[TX]
    y = px * camera[3] + py * camera[4] + pz * camera[5] + camera[TY]
    z = px * camera[6] + py * camera[7] + pz * camera[8] + camera[TZ]
    inverse = divide(ONE, z)
    u = x * inverse
    v = y * inverse
    clamped_u = _clamp_to_margin(u, camera[CX], camera[FX], f32(settings.width))
    clamped_v = _clamp_to_margin(v, camera[CY], camera[FY], f32(settings.height))
    jxx = inverse * camera[FX]
    jyy = inverse * camera[FY]
    jxz = ZERO - jxx * clamped_u
    jyz = ZERO - jyy * clamped_v
    a = (
        jxx * camera[0] + jxz * camera[6],
        jxx * camera[1] + jxz * camera[7],
        jxx * camera[2] + jxz * camera[8],
    )
    b = (
        jyy * camera[3] + jyz * camera[6],
        jyy * camera[4] + jyz * camera[7],
        jyy * camera[5] + jyz * camera[8],
    )
    qw, qx, qy, qz = gather4(quats, ids, start, 4, 0)
    square = qw * qw + qx * qx + qy * qy + qz * qz
    norm = inverse_length(square)
    quaternion = (qw * norm, qx * norm, qy * norm, qz * norm)
    rotation = _rotation_matrix(quaternion)
    jwr = (_times_matrix(a, rotation), _times_matrix(b, rotation))
    return Linearised(
        (x, y, z), inverse, (u, v), (clamped_u, clamped_v), (jxx, jxz, jyy, jyz), (a, b), quaternion, square,
        norm, rotation, jwr,
    )  # fmt: skip


@inline
def _clamp_to_margin(slope, centre, focal, size):
    """Slopes clamped to the image and a margin around it."""
    margin = FOV_MARGIN * size / focal
    return minimum(maximum(slope, -(centre / focal + margin)), (size - centre) / focal + margin)


@inline
def _rotation_matrix(quaternion):
    """The rows of the rotation matrices of unit quaternions."""
    w, x, y, z = quaternion
    return (
        (ONE - (y * y + z * z) * TWO, (x * y - w * z) * TWO, (x * z + w * y) * TWO),
        ((x * y + w * z) * TWO, ONE - (x * x + z * z) * TWO, (y * z - w * x) * TWO),
        ((x * z - w * y) * TWO, (y * z + w * x) * TWO, ONE - (x * x + y * y) * TWO),
    )


@inline
def _times_matrix(row, matrix):
    """A row vector times a 3x3 matrix, given by its rows."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


@inline
def times(a, b):
    """Elementwise products of 3 vectors each."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inline
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inline
def _squared_area(u, v):
    """|u x v|^2, which is det(V V^T) by Cauchy-Binet for the rows u and v of V."""
    x = u[1] * v[2] - u[2] * v[1]
    y = u[2] * v[0] - u[0] * v[2]
    z = u[0] * v[1] - u[1] * v[0]
    return x * x + y * y + z * z


@kernel
def project(counter, gaussians, camera, settings, projected):
    """Fill `projected`; footprints get colours if these are SH coefficients.

    Gaussians that are invisible, or have such a colour of CHANNEL_MAX or more, get depth 0, radii 0 and no
    tiles; their footprints are undefined.
    """
    means, _, _, _, colors = gaussians
    footprints, means2d, depths, radii, tile_bounds = projected
    sh_count = settings.sh_count
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
            _project(gaussians, camera, settings, footprints, ids, k, results)
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
                clamped = (maximum(red, ZERO), maximum(green, ZERO), maximum(blue, ZERO))
                scatter(footprints, seen, k, PACKED, RED, clamped)
                # NaN must count too.
                size_of_color = absolute(red) + absolute(green) + absolute(blue)
                if any_gt(select_gt(CHANNEL_MAX, size_of_color, ZERO, ONE), ZERO):
                    store8(results, 0, size_of_color)
                    for lane in range(min(8, visible - k)):
                        if not results[lane] < CHANNEL_MAX:
                            _hide(seen[k + lane], projected)


@inline
def _project(gaussians, camera, settings, footprints, ids, start, results):
    """Footprints without colour; results = [mean x | mean y | depth | radius x | radius y | tiles]."""
    width, height, near, far, eps2d, _ = settings
    (opacity,) = gather1(gaussians.opacities, ids, start, 1, 0)
    linear = linearise(camera, settings, gaussians.means, gaussians.quats, ids, start)
    z = linear.point[2]
    # `seen` is 1 or 0. A NaN fails every test.
    seen = select_ge(opacity, ALPHA_MIN, ONE, ZERO)
    seen = select_gt(HUGE, opacity, seen, ZERO)
    seen = select_ge(z, near, seen, ZERO)
    seen = select_ge(far, z, seen, ZERO)
    mean_x = multiply_add(linear.slopes[0], camera[FX], splat(camera[CX]))
    mean_y = multiply_add(linear.slopes[1], camera[FY], splat(camera[CY]))
    scales = gather3(gaussians.scales, ids, start, 3, 0)
    u = times(linear.jwr[0], scales)
    v = times(linear.jwr[1], scales)
    cov_xx = dot(u, u)
    cov_xy = dot(u, v)
    cov_yy = dot(v, v)
    det = _squared_area(u, v) + (cov_xx + cov_yy + eps2d) * eps2d
    seen = select_gt(HUGE, det, seen, ZERO)
    inverse = divide(ONE, det)
    cov_xx = cov_xx + eps2d
    cov_yy = cov_yy + eps2d
    level = maximum(log(maximum(opacity * INVERSE_ALPHA_MIN, ONE)) * TWO, ZERO)
    sigmas = square_root(level)
    sigma_x = square_root(cov_xx)
    sigma_y = square_root(cov_yy)
    reach = minimum(sigmas, RADIUS_SIGMAS)
    radius_x = ceil8(reach * sigma_x)
    radius_y = ceil8(reach * sigma_y)
    seen = select_gt(maximum(radius_x, radius_y), ZERO, seen, ZERO)
    seen = select_gt(mean_x + radius_x, ZERO, seen, ZERO)
    seen = select_gt(f32(width), mean_x - radius_x, seen, ZERO)
    seen = select_gt(mean_y + radius_y, ZERO, seen, ZERO)
    seen = select_gt(f32(height), mean_y - radius_y, seen, ZERO)
    # Slightly wider than exact, so that rounding never cuts off a visible pixel.
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


@inline
def _tiles(centre, extent, size, per_pixel):
    """The number of tiles, along one axis, with pixel centres within the extents."""
    first = floor8(maximum(ceil8(centre - extent - HALF), ZERO) * per_pixel)
    last = floor8(minimum(floor8(centre + extent - HALF), f32(size - 1)) * per_pixel)
    return maximum(last - first + ONE, ZERO)


@inline
def _hide(i, projected):
    projected.depths[i] = ZERO
    projected.radii[i, 0] = 0
    projected.radii[i, 1] = 0
    projected.tile_bounds[i] = 0
