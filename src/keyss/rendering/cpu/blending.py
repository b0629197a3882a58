"""Alpha blending of the Gaussians of each tile, front to back (3DGS, eq. 3).

A tile is 8 pixels wide, so that a vector is a row. The transmittance of a full pixel is stored negated.

Down a column of pixels, a Gaussian's footprint is a Gaussian in y, evaluated by two recurrences:
footprint(y + 1) = footprint(y) ratio(y) and ratio(y + 1) = ratio(y) decay. A row costs two multiplications;
exp is needed only every ANCHOR_ROWS rows. At such an anchor, the footprint may underflow although a row below
is visible: with eps2d >= 0.3 the curvature in y is at most 1/0.3, so it can be e^-130 at 7 rows above a pixel
with alpha >= 1/255. Therefore footprints and alphas are multiplied by 2^64, and transmittances divided by it,
which is exact.

Each kernel is compiled twice. If `features` is None, the three colours of a Gaussian's footprint stay in
registers while its rows are blended. If `features` is an array [N, channels], the channels do not fit into
registers: the weights of a strip's pixels are buffered, then each channel passes over them. Numba removes the
branches on None at compile time.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator"

from __future__ import annotations

import numpy as np

from keyss.kernels.jit import finite_inline, finite_kernel
from keyss.rendering.cpu.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUE,
    DECAY,
    ENTRY_GAUSSIAN,
    ENTRY_ROWS_SHIFT,
    GREEN,
    HALF,
    LAST_ROW_SHIFT,
    ONE,
    OPACITY,
    PACKED,
    RED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_RUN,
    TILE_WIDTH,
    TRANSMITTANCE_MIN,
    XX,
    XY,
    YY,
    ZERO,
    X,
    Y,
    f32,
)
from keyss.rendering.cpu.simd8 import (
    any_gt,
    at,
    exp,
    exp_times_2_64,
    fetch_add,
    load8,
    maximum,
    minimum,
    multiply_add,
    negative_abs,
    prefetch_read,
    put,
    ramp,
    select_ge,
    select_gt,
    splat,
    store8,
    store_interleaved,
)

ANCHOR_ROWS = 8  # rows between two evaluations of exp, see above
UNROLLED_ROWS = 4  # blended without a branch, which would cost more than an empty row
PLANE = TILE_PIXELS + (UNROLLED_ROWS - 1) * TILE_WIDTH  # includes room for unrolled rows below the tile
BATCH = 16  # Gaussians between two tests for a full tile

STRIP = 3  # numbers per strip, see `list_strips`
MAX_STRIPS = BATCH * (TILE_HEIGHT // ANCHOR_ROWS)

SCALE = f32(2.0**64)
INVERSE = f32(2.0**-64)
SCALED_ALPHA_MIN = ALPHA_MIN * SCALE
SCALED_ALPHA_MAX = ALPHA_MAX * SCALE
SCALED_TRANSMITTANCE_MIN = TRANSMITTANCE_MIN * INVERSE


@finite_inline
def blend_row(planes, k, footprint):
    """Blend a row of a footprint into the transmittance at planes[k:k + 8].

    Returns alpha (times 2^64) and its product with the transmittance before, both 0 for skipped pixels.
    """
    alpha = select_ge(footprint, SCALED_ALPHA_MIN, minimum(footprint, SCALED_ALPHA_MAX), ZERO)
    before = load8(planes, k)
    weight = alpha * maximum(before, ZERO)
    after = multiply_add(weight, -INVERSE, before)
    store8(planes, k, select_gt(after, SCALED_TRANSMITTANCE_MIN, after, negative_abs(before)))
    alpha = select_gt(after, SCALED_TRANSMITTANCE_MIN, alpha, ZERO)
    return alpha, select_gt(after, SCALED_TRANSMITTANCE_MIN, weight, ZERO)


@finite_inline
def _is_full(planes):
    """True if all pixels of the tile are full."""
    largest = load8(planes, 0)
    for k in range(8, TILE_PIXELS, 8):
        largest = maximum(largest, load8(planes, k))
    return not any_gt(largest, SCALED_TRANSMITTANCE_MIN)


@finite_inline
def list_strips(footprints, features, entries, start, end, last, left, top, strips, strip_footprints):
    """Cut the Gaussians of entries start..end into strips of up to ANCHOR_ROWS rows; returns their number.

    A strip is STRIP numbers in `strips`: the start of the Gaussian's record, and the start and end of its
    pixels in a plane. strip_footprints gets the footprint (times 2^64) of its first row, and the ratio of the
    next row to it. Exponentials of a batch are independent and have long latencies, so they are computed
    before blending. `last` is the end of the tile's list.
    """
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    count = 0
    for e in range(start, end):
        ahead = at(entries, min(e + BATCH, last - 1)) & ENTRY_GAUSSIAN
        prefetch_read(footprints, ahead * PACKED)
        if features is not None:
            prefetch_read(features, ahead * features.shape[1])
        g = (at(entries, e) & ENTRY_GAUSSIAN) * PACKED
        rows = at(entries, e) >> ENTRY_ROWS_SHIFT
        after_rows = (rows >> LAST_ROW_SHIFT) + 1
        y = at(footprints, g + Y) - centre_y
        yy = at(footprints, g + YY)
        opacity = at(footprints, g + OPACITY)
        dx = ramp(-(at(footprints, g + X) - centre_x))
        exponent_0 = dx * dx * at(footprints, g + XX)
        exponent_1 = dx * at(footprints, g + XY)
        for anchor in range(rows & (TILE_HEIGHT - 1), after_rows, ANCHOR_ROWS):
            dy = f32(anchor) - y
            footprint = exp_times_2_64(multiply_add(exponent_1 + yy * dy, dy, exponent_0)) * opacity
            store8(strip_footprints, 16 * count, footprint)
            store8(strip_footprints, 16 * count + 8, exp(exponent_1 + yy * (dy + dy + ONE)))
            put(strips, STRIP * count, g)
            put(strips, STRIP * count + 1, 8 * anchor)
            put(strips, STRIP * count + 2, 8 * min(anchor + ANCHOR_ROWS, after_rows))
            count += 1
    return count


@finite_inline
def _blend_tile(
    footprints, features, channels, entries, start, end, left, top, planes, weights, strips, strip_footprints
):
    """Blend entries start..end of the list into planes = [transmittance | one per channel].

    Returns the entry at which the whole tile was full.
    """
    for k in range(0, PLANE, 8):
        store8(planes, k, splat(INVERSE))
    for k in range(PLANE, (1 + channels) * PLANE, 8):
        store8(planes, k, splat(ZERO))
    entry = start
    while entry < end:
        check = min(entry + BATCH, end)
        count = list_strips(
            footprints, features, entries, entry, check, end, left, top, strips, strip_footprints
        )
        for strip in range(count):
            g = at(strips, STRIP * strip)
            first = at(strips, STRIP * strip + 1)
            after = at(strips, STRIP * strip + 2)
            decay = at(footprints, g + DECAY)
            red = at(footprints, g + RED)
            green = at(footprints, g + GREEN)
            blue = at(footprints, g + BLUE)
            footprint = load8(strip_footprints, 16 * strip)
            ratio = load8(strip_footprints, 16 * strip + 8)
            for four in range(first, after, 8 * UNROLLED_ROWS):
                for k in range(four, four + 8 * UNROLLED_ROWS, 8):
                    _, weight = blend_row(planes, k, footprint)
                    footprint = footprint * ratio
                    ratio = ratio * decay
                    if features is None:
                        p = k + PLANE
                        store8(planes, p, multiply_add(weight, red, load8(planes, p)))
                        p = k + 2 * PLANE
                        store8(planes, p, multiply_add(weight, green, load8(planes, p)))
                        p = k + 3 * PLANE
                        store8(planes, p, multiply_add(weight, blue, load8(planes, p)))
                    else:
                        store8(weights, k, weight)
            if features is not None:
                for channel in range(channels):
                    value = at(features, g // PACKED * channels + channel)
                    plane = (1 + channel) * PLANE
                    # Two rows at a time; below the strip the weights are 0.
                    for two in range(first, after, 16):
                        for k in range(two, two + 16, 8):
                            p = plane + k
                            store8(planes, p, multiply_add(load8(weights, k), value, load8(planes, p)))
        entry = check
        if _is_full(planes):
            break
    return entry


@finite_kernel
def blend(
    counter, footprints, features, entries, tile_starts, tile_columns, background, image, alpha,
    transmittance, ends,
):  # fmt: skip
    """Blend all tiles into image [H, W, channels], alpha and transmittance [H, W].

    ends[t] becomes the first list entry of tile t that was not read.
    """
    height, width, channels = image.shape
    planes = np.empty((1 + channels) * PLANE, np.float32)
    weights = np.empty(PLANE, np.float32)
    strips = np.empty(STRIP * (MAX_STRIPS + 1), np.int64)
    strip_footprints = np.empty(16 * MAX_STRIPS, np.float32)
    while True:
        run = fetch_add(counter, 0, 1) * TILE_RUN
        if run >= ends.shape[0]:
            break
        for tile in range(run, min(run + TILE_RUN, ends.shape[0])):
            left = (tile % tile_columns) * TILE_WIDTH
            top = (tile // tile_columns) * TILE_HEIGHT
            ends[tile] = _blend_tile(
                footprints, features, channels, entries, tile_starts[tile], tile_starts[tile + 1], left, top,
                planes, weights, strips, strip_footprints,
            )  # fmt: skip
            columns = min(TILE_WIDTH, width - left)
            for y in range(min(TILE_HEIGHT, height - top)):
                k = 8 * y
                pixel = (top + y) * width + left
                if features is None and columns == TILE_WIDTH:
                    rest = (ZERO - negative_abs(load8(planes, k))) * SCALE
                    store8(transmittance, pixel, rest)
                    store8(alpha, pixel, ONE - rest)
                    store_interleaved(
                        image,
                        3 * pixel,
                        multiply_add(rest, background[0], load8(planes, k + PLANE)),
                        multiply_add(rest, background[1], load8(planes, k + 2 * PLANE)),
                        multiply_add(rest, background[2], load8(planes, k + 3 * PLANE)),
                    )
                    continue
                for x in range(columns):
                    light = abs(planes[k + x]) * SCALE
                    transmittance[top + y, left + x] = light
                    alpha[top + y, left + x] = ONE - light
                    for channel in range(channels):
                        color = planes[k + x + (1 + channel) * PLANE]
                        image[top + y, left + x, channel] = color + light * background[channel]
