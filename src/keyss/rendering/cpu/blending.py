"""Alpha blending of the Gaussians of each tile, front to back, and its gradient (3DGS, eq. 3).

A tile is 8 pixels wide: one vector is one row. A pixel's transmittance is stored negated once it has
stopped.

Down a column of pixels a Gaussian's footprint is a Gaussian in y, so it follows from two recurrences:
footprint(y + 1) = footprint(y) ratio(y) and ratio(y + 1) = ratio(y) decay. A row costs two
multiplications for it, and exp is needed only where a run of ANCHOR_ROWS rows starts. There the
footprint may be far below the smallest float though a row further down counts: with eps2d >= 0.3 the
curvature in y is at most 1/0.3, so 7 rows above a pixel with alpha >= 1/255 it can be e^-130. Therefore
footprints and alphas are kept multiplied by 2^64, and transmittances divided by it, which is exact.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.jit import finite_kernel
from keyss.rendering.cpu.layout import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUE,
    DECAY,
    GREEN,
    HALF,
    LAST_ROW_SHIFT,
    MOMENTS,
    ONE,
    OPACITY,
    PACKED,
    RED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    TRANSMITTANCE_MIN,
    TWO,
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
    divide,
    exp,
    exp_times_2_64,
    fetch_add,
    load8,
    maximum,
    minimum,
    multiply_add,
    negative_abs,
    prefetch_read,
    prefetch_write,
    ramp,
    select_ge,
    select_gt,
    select_le,
    splat,
    store8,
    sum_lanes,
    sum_lanes_of_8,
)

ANCHOR_ROWS = 8  # rows between two evaluations of exp, see above
PREFETCH = 6  # how many list entries ahead to ask for memory
STOP_CHECK = 16  # Gaussians between two tests whether the whole tile has stopped

SCALE = f32(2.0**64)
INVERSE = f32(2.0**-64)
SCALED_ALPHA_MIN = ALPHA_MIN * SCALE
SCALED_ALPHA_MAX = ALPHA_MAX * SCALE
SCALED_TRANSMITTANCE_MIN = TRANSMITTANCE_MIN * INVERSE


@finite_kernel
def footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity):
    """The footprint, times 2^64, `dy` rows below the centre, and its ratio to that one row further down."""
    footprint = exp_times_2_64(multiply_add(exponent_1 + yy * dy, dy, exponent_0)) * opacity
    return footprint, exp(exponent_1 + yy * (dy + dy + ONE))


@finite_kernel
def blend_row(planes, k, footprint):
    """Let a row of a footprint dim the transmittance at planes[k:k + 8].

    Returns alpha (times 2^64) and alpha times the transmittance before, both 0 where nothing is drawn.
    """
    alpha = select_ge(footprint, SCALED_ALPHA_MIN, minimum(footprint, SCALED_ALPHA_MAX), ZERO)
    before = load8(planes, k)
    weight = alpha * maximum(before, ZERO)
    after = multiply_add(weight, -INVERSE, before)
    store8(planes, k, select_gt(after, SCALED_TRANSMITTANCE_MIN, after, negative_abs(before)))
    alpha = select_gt(after, SCALED_TRANSMITTANCE_MIN, alpha, ZERO)
    return alpha, select_gt(after, SCALED_TRANSMITTANCE_MIN, weight, ZERO)


@finite_kernel
def has_stopped(planes):
    """Whether no pixel of the tile lets anything more through."""
    most = load8(planes, 0)
    for k in range(8, TILE_PIXELS, 8):
        most = maximum(most, load8(planes, k))
    return not any_gt(most, SCALED_TRANSMITTANCE_MIN)


@finite_kernel
def _blend_tile(packed, ranks, rows, start, end, left, top, planes):
    """Blend entries start..end of the list into planes = [transmittance | red | green | blue].

    Returns the entry before which the whole tile had stopped.
    """
    for k in range(0, TILE_PIXELS, 8):
        store8(planes, k, splat(INVERSE))
    for k in range(TILE_PIXELS, 4 * TILE_PIXELS, 8):
        store8(planes, k, splat(ZERO))
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    entry = start
    while entry < end:
        check = min(entry + STOP_CHECK, end)
        for e in range(entry, check):
            prefetch_read(packed, np.int64(at(ranks, min(e + PREFETCH, end - 1))) * PACKED)
            g = np.int64(at(ranks, e)) * PACKED
            y = at(packed, g + Y) - centre_y
            both_rows = np.int64(at(rows, e))
            first_row = both_rows & (TILE_HEIGHT - 1)
            last_row = both_rows >> LAST_ROW_SHIFT
            yy = at(packed, g + YY)
            opacity = at(packed, g + OPACITY)
            decay = at(packed, g + DECAY)
            red = at(packed, g + RED)
            green = at(packed, g + GREEN)
            blue = at(packed, g + BLUE)
            dx = ramp(-(at(packed, g + X) - centre_x))
            exponent_0 = dx * dx * at(packed, g + XX)
            exponent_1 = dx * at(packed, g + XY)
            for anchor in range(first_row, last_row + 1, ANCHOR_ROWS):
                dy = f32(anchor) - y
                footprint, ratio = footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity)
                for k in range(anchor * 8, min(anchor + ANCHOR_ROWS, last_row + 1) * 8, 8):
                    _, weight = blend_row(planes, k, footprint)
                    footprint = footprint * ratio
                    ratio = ratio * decay
                    p = k + TILE_PIXELS
                    store8(planes, p, multiply_add(weight, red, load8(planes, p)))
                    p = k + 2 * TILE_PIXELS
                    store8(planes, p, multiply_add(weight, green, load8(planes, p)))
                    p = k + 3 * TILE_PIXELS
                    store8(planes, p, multiply_add(weight, blue, load8(planes, p)))
        entry = check
        if has_stopped(planes):
            break
    return entry


@finite_kernel
def blend(
    counter,
    packed,
    _,
    tile_ranks,
    tile_rows,
    tile_starts,
    tile_columns,
    width,
    height,
    background,
    image,
    alpha,
    transmittance,
    ends,
):
    """Draw all tiles; ends[t] is the first list entry of tile t that was not looked at."""
    planes = np.empty(4 * TILE_PIXELS + 16, np.float32)
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= ends.shape[0]:
            break
        left = (tile % tile_columns) * TILE_WIDTH
        top = (tile // tile_columns) * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - top)
        ends[tile] = _blend_tile(
            packed, tile_ranks, tile_rows, tile_starts[tile], tile_starts[tile + 1], left, top, planes
        )
        for y in range(rows):
            for x in range(min(TILE_WIDTH, width - left)):
                k = y * 8 + x
                rest = abs(planes[k]) * SCALE
                image[top + y, left + x, 0] = planes[k + TILE_PIXELS] + rest * background[0]
                image[top + y, left + x, 1] = planes[k + 2 * TILE_PIXELS] + rest * background[1]
                image[top + y, left + x, 2] = planes[k + 3 * TILE_PIXELS] + rest * background[2]
                transmittance[top + y, left + x] = rest
                alpha[top + y, left + x] = ONE - rest


@finite_kernel
def _blend_tile_backward(
    packed, ranks, rows, slots, start, end, left, top, planes, moments, extras, extra_width, absgrad
):
    """Replay entries start..end front to back; leave the sums of each pair in its slot (see layout.MOMENTS).

    planes = [transmittance | behind | red, green and blue gradient], where behind is the part of the loss
    gradient times the pixel that is drawn behind the current Gaussian: the whole minus what has been
    passed. Within a row dx is fixed per lane, so the loop over rows sums powers of dy only.
    """
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    zero = splat(ZERO)
    for e in range(start, end):
        ahead = min(e + PREFETCH, end - 1)
        prefetch_read(packed, np.int64(at(ranks, ahead)) * PACKED)
        prefetch_write(moments, np.int64(at(slots, ahead)) * MOMENTS)
        g = np.int64(at(ranks, e)) * PACKED
        y = at(packed, g + Y) - centre_y
        both_rows = np.int64(at(rows, e))
        first_row = both_rows & (TILE_HEIGHT - 1)
        last_row = both_rows >> LAST_ROW_SHIFT
        xx = at(packed, g + XX)
        xy = at(packed, g + XY)
        yy = at(packed, g + YY)
        opacity = at(packed, g + OPACITY)
        decay = at(packed, g + DECAY)
        red = at(packed, g + RED)
        green = at(packed, g + GREEN)
        blue = at(packed, g + BLUE)
        dx = ramp(-(at(packed, g + X) - centre_x))
        exponent_0 = dx * dx * xx
        exponent_1 = dx * xy
        sum_1 = zero
        sum_y = zero
        sum_yy = zero
        sum_red = zero
        sum_green = zero
        sum_blue = zero
        sum_abs_x = zero
        sum_abs_y = zero
        for anchor in range(first_row, last_row + 1, ANCHOR_ROWS):
            dy = f32(anchor) - y
            footprint, ratio = footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity)
            row_dy = splat(dy)
            for k in range(anchor * 8, min(anchor + ANCHOR_ROWS, last_row + 1) * 8, 8):
                alpha, weight = blend_row(planes, k, footprint)
                gradient_red = load8(planes, k + 2 * TILE_PIXELS)
                gradient_green = load8(planes, k + 3 * TILE_PIXELS)
                gradient_blue = load8(planes, k + 4 * TILE_PIXELS)
                own = weight * multiply_add(
                    gradient_red, red, multiply_add(gradient_green, green, gradient_blue * blue)
                )
                behind = load8(planes, k + TILE_PIXELS) - own
                store8(planes, k + TILE_PIXELS, behind)
                # alpha dL/d(alpha), where what lies behind is dimmed by 1 - alpha.
                s = own - behind * divide(alpha, SCALE - alpha)
                s = select_le(footprint, SCALED_ALPHA_MAX, s, ZERO)
                footprint = footprint * ratio
                ratio = ratio * decay
                s_dy = s * row_dy
                sum_1 = sum_1 + s
                sum_y = sum_y + s_dy
                sum_yy = multiply_add(s_dy, row_dy, sum_yy)
                sum_red = multiply_add(weight, gradient_red, sum_red)
                sum_green = multiply_add(weight, gradient_green, sum_green)
                sum_blue = multiply_add(weight, gradient_blue, sum_blue)
                if absgrad:
                    along_x = s * multiply_add(row_dy, xy, dx * (xx * TWO))
                    along_y = s * multiply_add(row_dy, yy * TWO, exponent_1)
                    sum_abs_x = sum_abs_x - negative_abs(along_x)
                    sum_abs_y = sum_abs_y - negative_abs(along_y)
                row_dy = row_dy + ONE
        sum_x = dx * sum_1
        slot = np.int64(at(slots, e))
        store8(
            moments,
            slot * MOMENTS,
            sum_lanes_of_8(sum_1, sum_x, sum_y, sum_x * dx, dx * sum_y, sum_yy, sum_red, sum_green),
        )
        extras[slot * extra_width] = sum_lanes(sum_blue)
        if absgrad:
            extras[slot * extra_width + 1] = sum_lanes(sum_abs_x)
            extras[slot * extra_width + 2] = sum_lanes(sum_abs_y)


@finite_kernel
def blend_backward(
    counter,
    packed,
    _,
    tile_ranks,
    tile_rows,
    tile_slots,
    tile_starts,
    ends,
    tile_columns,
    width,
    height,
    image,
    transmittance,
    image_gradient,
    alpha_gradient,
    moments,
    extras,
    extra_width,
    absgrad,
):
    """Fill every slot of `moments` and `extras` from the gradients of the image and of alpha."""
    planes = np.zeros(5 * TILE_PIXELS + 16, np.float32)
    while True:
        tile = fetch_add(counter, 0, 1)
        if tile >= ends.shape[0]:
            break
        left = (tile % tile_columns) * TILE_WIDTH
        top = (tile // tile_columns) * TILE_HEIGHT
        rows = min(TILE_HEIGHT, height - top)
        columns = min(TILE_WIDTH, width - left)
        for e in range(ends[tile], tile_starts[tile + 1]):
            slot = np.int64(at(tile_slots, e))
            store8(moments, slot * MOMENTS, splat(ZERO))
            for k in range(slot * extra_width, (slot + 1) * extra_width):
                extras[k] = ZERO
        if tile_starts[tile] == ends[tile]:
            continue
        for y in range(rows):
            for x in range(TILE_WIDTH):
                k = y * 8 + x
                if x < columns:
                    red = image_gradient[top + y, left + x, 0]
                    green = image_gradient[top + y, left + x, 1]
                    blue = image_gradient[top + y, left + x, 2]
                    planes[k] = INVERSE
                    planes[k + TILE_PIXELS] = (
                        red * image[top + y, left + x, 0]
                        + green * image[top + y, left + x, 1]
                        + blue * image[top + y, left + x, 2]
                        - alpha_gradient[top + y, left + x] * transmittance[top + y, left + x]
                    )
                    planes[k + 2 * TILE_PIXELS] = red
                    planes[k + 3 * TILE_PIXELS] = green
                    planes[k + 4 * TILE_PIXELS] = blue
                else:
                    planes[k] = -INVERSE
                    planes[k + TILE_PIXELS] = ZERO
                    planes[k + 2 * TILE_PIXELS] = ZERO
                    planes[k + 3 * TILE_PIXELS] = ZERO
                    planes[k + 4 * TILE_PIXELS] = ZERO
        _blend_tile_backward(
            packed,
            tile_ranks,
            tile_rows,
            tile_slots,
            tile_starts[tile],
            ends[tile],
            left,
            top,
            planes,
            moments,
            extras,
            extra_width,
            absgrad,
        )
