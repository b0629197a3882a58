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

from keyss.rendering.cpu.jit import finite_inlined, finite_kernel
from keyss.rendering.cpu.layout import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLUE,
    DECAY,
    ENTRY_GAUSSIAN,
    ENTRY_ROWS_SHIFT,
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
    TILE_RUN,
    TILE_WIDTH,
    TILE_WIDTH_LOG2,
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
    load_interleaved,
    maximum,
    minimum,
    multiply_add,
    negative_abs,
    prefetch_read,
    prefetch_write,
    put,
    ramp,
    select_ge,
    select_gt,
    select_le,
    splat,
    store8,
    store_interleaved,
    sum_lanes,
    sum_lanes_of_8,
)

ANCHOR_ROWS = 8  # rows between two evaluations of exp, see above
UNROLLED_ROWS = 4  # blended in one go: a row in which there is nothing to draw costs less than a branch
PLANE = TILE_PIXELS + (UNROLLED_ROWS - 1) * TILE_WIDTH  # with room for what that draws below the tile
PREFETCH = 6  # how many list entries ahead to ask for memory
BATCH = 16  # Gaussians between two tests whether the whole tile has stopped

STRIP = 3  # numbers that describe a strip, see `list_strips`
MAX_STRIPS = BATCH * (TILE_HEIGHT // ANCHOR_ROWS)

SCALE = f32(2.0**64)
INVERSE = f32(2.0**-64)
SCALED_ALPHA_MIN = ALPHA_MIN * SCALE
SCALED_ALPHA_MAX = ALPHA_MAX * SCALE
SCALED_TRANSMITTANCE_MIN = TRANSMITTANCE_MIN * INVERSE


@finite_inlined
def footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity):
    """The footprint, times 2^64, `dy` rows below the centre, and its ratio to that one row further down."""
    footprint = exp_times_2_64(multiply_add(exponent_1 + yy * dy, dy, exponent_0)) * opacity
    return footprint, exp(exponent_1 + yy * (dy + dy + ONE))


@finite_inlined
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


@finite_inlined
def has_stopped(planes):
    """Whether no pixel of the tile lets anything more through."""
    most = load8(planes, 0)
    for k in range(8, TILE_PIXELS, 8):
        most = maximum(most, load8(planes, k))
    return not any_gt(most, SCALED_TRANSMITTANCE_MIN)


@finite_inlined
def list_strips(footprints, entries, start, end, last, left, top, strips, strip_footprints):
    """Cut the Gaussians of entries start..end into strips of up to ANCHOR_ROWS rows; returns their number.

    A strip is STRIP numbers in `strips`: where the Gaussian's record starts, the first place in a plane, the
    first place after it. strip_footprints gets what `footprint_and_ratio` gives at its first row. All
    exponentials of a batch are taken before any of its rows is drawn, since they have long latencies and
    do not wait for one another. `last` is where the tile's list ends.
    """
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    count = 0
    for e in range(start, end):
        prefetch_read(footprints, (at(entries, min(e + BATCH, last - 1)) & ENTRY_GAUSSIAN) * PACKED)
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
            footprint, ratio = footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity)
            store8(strip_footprints, 16 * count, footprint)
            store8(strip_footprints, 16 * count + 8, ratio)
            put(strips, STRIP * count, g)
            put(strips, STRIP * count + 1, 8 * anchor)
            put(strips, STRIP * count + 2, 8 * min(anchor + ANCHOR_ROWS, after_rows))
            count += 1
    return count


@finite_inlined
def _blend_tile(footprints, entries, start, end, left, top, planes, strips, strip_footprints):
    """Blend entries start..end of the list into planes = [transmittance | red | green | blue].

    Returns the entry before which the whole tile had stopped.
    """
    for k in range(0, PLANE, 8):
        store8(planes, k, splat(INVERSE))
    for k in range(PLANE, 4 * PLANE, 8):
        store8(planes, k, splat(ZERO))
    entry = start
    while entry < end:
        check = min(entry + BATCH, end)
        count = list_strips(footprints, entries, entry, check, end, left, top, strips, strip_footprints)
        for strip in range(count):
            g = at(strips, STRIP * strip)
            decay = at(footprints, g + DECAY)
            red = at(footprints, g + RED)
            green = at(footprints, g + GREEN)
            blue = at(footprints, g + BLUE)
            footprint = load8(strip_footprints, 16 * strip)
            ratio = load8(strip_footprints, 16 * strip + 8)
            for four in range(
                at(strips, STRIP * strip + 1), at(strips, STRIP * strip + 2), 8 * UNROLLED_ROWS
            ):
                for k in range(four, four + 8 * UNROLLED_ROWS, 8):
                    _, weight = blend_row(planes, k, footprint)
                    footprint = footprint * ratio
                    ratio = ratio * decay
                    p = k + PLANE
                    store8(planes, p, multiply_add(weight, red, load8(planes, p)))
                    p = k + 2 * PLANE
                    store8(planes, p, multiply_add(weight, green, load8(planes, p)))
                    p = k + 3 * PLANE
                    store8(planes, p, multiply_add(weight, blue, load8(planes, p)))
        entry = check
        if has_stopped(planes):
            break
    return entry


@finite_kernel
def blend(
    counter,
    footprints,
    _,
    entries,
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
    planes = np.empty(4 * PLANE, np.float32)
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
                footprints, entries, tile_starts[tile], tile_starts[tile + 1], left, top,
                planes, strips, strip_footprints,
            )  # fmt: skip
            columns = min(TILE_WIDTH, width - left)
            for y in range(min(TILE_HEIGHT, height - top)):
                k = 8 * y
                pixel = (top + y) * width + left
                if columns == TILE_WIDTH:
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
                    for channel in range(3):
                        drawn = planes[k + x + (1 + channel) * PLANE]
                        image[top + y, left + x, channel] = drawn + light * background[channel]


@finite_inlined
def _blend_tile_backward(
    footprints, entries, slots, start, end, left, top, planes, strips, strip_footprints, moments, extras,
    extra_width, absgrad,
):  # fmt: skip
    """Replay entries start..end front to back; leave the sums of each pair in its slot (see layout.MOMENTS).

    planes = [transmittance | behind | red, green and blue gradient], where behind is the part of the loss
    gradient times the pixel that is drawn behind the current Gaussian: the whole minus what has been
    passed. Within a row dx is fixed per lane, so the loop over rows sums powers of dy only.
    """
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    zero = splat(ZERO)
    for batch in range(start, end, BATCH):
        batch_end = min(batch + BATCH, end)
        count = list_strips(footprints, entries, batch, batch_end, end, left, top, strips, strip_footprints)
        put(strips, STRIP * count, -1)
        strip = 0
        for e in range(batch, batch_end):
            prefetch_write(moments, np.int64(at(slots, min(e + PREFETCH, end - 1))) * MOMENTS)
            g = at(strips, STRIP * strip)
            y = at(footprints, g + Y) - centre_y
            xx = at(footprints, g + XX)
            xy = at(footprints, g + XY)
            yy = at(footprints, g + YY)
            decay = at(footprints, g + DECAY)
            red = at(footprints, g + RED)
            green = at(footprints, g + GREEN)
            blue = at(footprints, g + BLUE)
            dx = ramp(-(at(footprints, g + X) - centre_x))
            sum_1 = zero
            sum_y = zero
            sum_yy = zero
            sum_red = zero
            sum_green = zero
            sum_blue = zero
            sum_abs_x = zero
            sum_abs_y = zero
            while at(strips, STRIP * strip) == g:
                footprint = load8(strip_footprints, 16 * strip)
                ratio = load8(strip_footprints, 16 * strip + 8)
                first = at(strips, STRIP * strip + 1)
                row_dy = splat(f32(first >> TILE_WIDTH_LOG2) - y)
                for k in range(first, at(strips, STRIP * strip + 2), 8):
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
                        along_y = s * multiply_add(row_dy, yy * TWO, dx * xy)
                        sum_abs_x = sum_abs_x - negative_abs(along_x)
                        sum_abs_y = sum_abs_y - negative_abs(along_y)
                    row_dy = row_dy + ONE
                strip += 1
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
    footprints,
    _,
    entries,
    entry_slots,
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
    planes = np.empty(5 * TILE_PIXELS, np.float32)
    strips = np.empty(STRIP * (MAX_STRIPS + 1), np.int64)
    strip_footprints = np.empty(16 * MAX_STRIPS, np.float32)
    while True:
        run = fetch_add(counter, 0, 1) * TILE_RUN
        if run >= ends.shape[0]:
            break
        for tile in range(run, min(run + TILE_RUN, ends.shape[0])):
            left = (tile % tile_columns) * TILE_WIDTH
            top = (tile // tile_columns) * TILE_HEIGHT
            rows = min(TILE_HEIGHT, height - top)
            columns = min(TILE_WIDTH, width - left)
            for e in range(ends[tile], tile_starts[tile + 1]):
                slot = np.int64(at(entry_slots, e))
                store8(moments, slot * MOMENTS, splat(ZERO))
                for k in range(slot * extra_width, (slot + 1) * extra_width):
                    extras[k] = ZERO
            if tile_starts[tile] == ends[tile]:
                continue
            for y in range(rows):
                k = 8 * y
                pixel = (top + y) * width + left
                if columns == TILE_WIDTH:
                    red, green, blue = load_interleaved(image_gradient, 3 * pixel)
                    drawn_red, drawn_green, drawn_blue = load_interleaved(image, 3 * pixel)
                    behind = red * drawn_red + green * drawn_green + blue * drawn_blue
                    behind = behind - load8(alpha_gradient, pixel) * load8(transmittance, pixel)
                    store8(planes, k, splat(INVERSE))
                    store8(planes, k + TILE_PIXELS, behind)
                    store8(planes, k + 2 * TILE_PIXELS, red)
                    store8(planes, k + 3 * TILE_PIXELS, green)
                    store8(planes, k + 4 * TILE_PIXELS, blue)
                    continue
                for x in range(TILE_WIDTH):
                    inside = x < columns
                    planes[k + x] = INVERSE if inside else -INVERSE
                    light_behind = ZERO
                    if inside:
                        light_behind = -alpha_gradient[top + y, left + x] * transmittance[top + y, left + x]
                    for channel in range(3):
                        gradient = image_gradient[top + y, left + x, channel] if inside else ZERO
                        planes[k + x + (2 + channel) * TILE_PIXELS] = gradient
                        if inside:
                            light_behind += gradient * image[top + y, left + x, channel]
                    planes[k + x + TILE_PIXELS] = light_behind
            _blend_tile_backward(
                footprints,
                entries,
                entry_slots,
                tile_starts[tile],
                ends[tile],
                left,
                top,
                planes,
                strips,
                strip_footprints,
                moments,
                extras,
                extra_width,
                absgrad,
            )
