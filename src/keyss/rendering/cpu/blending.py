"""Alpha blending of the Gaussians of each tile, front to back (3DGS, eq. 3), and its backward pass.

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

The backward pass replays the entries of each tile front to back, with the same arithmetic.
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
    splat,
    store8,
    store_interleaved,
    sum_lanes,
    sum_lanes_of_8,
)

ANCHOR_ROWS = 8  # rows between two evaluations of exp
UNROLLED_ROWS = 4  # blended without a branch, which would cost more than an empty row
PLANE = TILE_PIXELS + (UNROLLED_ROWS - 1) * TILE_WIDTH  # includes room for unrolled rows below the tile
BATCH = 16  # Gaussians between two tests for a full tile
PREFETCH = 6  # list entries ahead whose memory the backward pass prefetches

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


@finite_inline
def _blend_tile_backward(
    footprints, features, channels, entries, slots, start, end, left, top, planes, weights, strips,
    strip_footprints, moments, extras,
):  # fmt: skip
    """Replay entries start..end front to back; write the sums of each pair to its slot (see `MOMENTS`).

    planes = [transmittance | behind | the gradient of each channel]. `behind` is the product of the loss
    gradient and the light from behind the current Gaussian: the pixel minus the Gaussians in front. dx is
    constant per lane, so the loop over rows only sums powers of dy.
    """
    extra_width = 1 if features is None else channels
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    zero = splat(ZERO)
    for batch in range(start, end, BATCH):
        batch_end = min(batch + BATCH, end)
        count = list_strips(
            footprints, features, entries, batch, batch_end, end, left, top, strips, strip_footprints
        )
        put(strips, STRIP * count, -1)
        strip = 0
        for e in range(batch, batch_end):
            slot_ahead = np.int64(at(slots, min(e + PREFETCH, end - 1)))
            prefetch_write(moments, slot_ahead * MOMENTS)
            if features is not None:
                prefetch_write(extras, slot_ahead * extra_width)
            slot = np.int64(at(slots, e))
            g = at(strips, STRIP * strip)
            y = at(footprints, g + Y) - centre_y
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
            first_of_all = at(strips, STRIP * strip + 1)
            while at(strips, STRIP * strip) == g:
                footprint = load8(strip_footprints, 16 * strip)
                ratio = load8(strip_footprints, 16 * strip + 8)
                first = at(strips, STRIP * strip + 1)
                after = at(strips, STRIP * strip + 2)
                row_dy = splat(f32(first >> TILE_WIDTH_LOG2) - y)
                for k in range(first, after, 8):
                    alpha, weight = blend_row(planes, k, footprint)
                    if features is None:
                        gradient_red = load8(planes, k + 2 * TILE_PIXELS)
                        gradient_green = load8(planes, k + 3 * TILE_PIXELS)
                        gradient_blue = load8(planes, k + 4 * TILE_PIXELS)
                        sum_red = multiply_add(weight, gradient_red, sum_red)
                        sum_green = multiply_add(weight, gradient_green, sum_green)
                        sum_blue = multiply_add(weight, gradient_blue, sum_blue)
                        product = multiply_add(gradient_green, green, gradient_blue * blue)
                        emitted = weight * multiply_add(gradient_red, red, product)
                    else:
                        store8(weights, k, weight)
                        product = zero
                        for channel in range(channels):
                            value = at(features, g // PACKED * channels + channel)
                            gradient = load8(planes, k + (2 + channel) * TILE_PIXELS)
                            product = multiply_add(gradient, value, product)
                        emitted = weight * product
                    behind = load8(planes, k + TILE_PIXELS) - emitted
                    store8(planes, k + TILE_PIXELS, behind)
                    # alpha dL/d(alpha); the light from behind is dimmed by 1 - alpha.
                    s = emitted - behind * divide(alpha, SCALE - alpha)
                    s = select_ge(SCALED_ALPHA_MAX, footprint, s, ZERO)
                    footprint = footprint * ratio
                    ratio = ratio * decay
                    s_dy = s * row_dy
                    sum_1 = sum_1 + s
                    sum_y = sum_y + s_dy
                    sum_yy = multiply_add(s_dy, row_dy, sum_yy)
                    row_dy = row_dy + ONE
                strip += 1
            sum_x = dx * sum_1
            store8(
                moments,
                slot * MOMENTS,
                sum_lanes_of_8(sum_1, sum_x, sum_y, sum_x * dx, dx * sum_y, sum_yy, sum_red, sum_green),
            )
            extra = slot * extra_width
            if features is None:
                extras[extra] = sum_lanes(sum_blue)
            else:
                after_all = at(strips, STRIP * strip - 1)
                for channel in range(channels):
                    plane = (2 + channel) * TILE_PIXELS
                    total = zero
                    for k in range(first_of_all, after_all, 8):
                        total = multiply_add(load8(planes, plane + k), load8(weights, k), total)
                    extras[extra + channel] = sum_lanes(total)


@finite_kernel
def blend_backward(
    counter, footprints, features, entries, entry_slots, tile_starts, ends, tile_columns, image,
    transmittance, image_gradient, alpha_gradient, moments, extras,
):  # fmt: skip
    """Fill every slot of `moments` and `extras` from the gradients of the image and of alpha."""
    height, width, channels = image.shape
    extra_width = 1 if features is None else channels
    planes = np.empty((2 + channels) * TILE_PIXELS, np.float32)
    weights = np.empty(TILE_PIXELS, np.float32)
    strips = np.empty(STRIP * (MAX_STRIPS + 1), np.int64)
    strip_footprints = np.empty(16 * MAX_STRIPS, np.float32)
    while True:
        run = fetch_add(counter, 0, 1) * TILE_RUN
        if run >= ends.shape[0]:
            break
        for tile in range(run, min(run + TILE_RUN, ends.shape[0])):
            left = (tile % tile_columns) * TILE_WIDTH
            top = (tile // tile_columns) * TILE_HEIGHT
            columns = min(TILE_WIDTH, width - left)
            for e in range(ends[tile], tile_starts[tile + 1]):
                slot = np.int64(at(entry_slots, e))
                store8(moments, slot * MOMENTS, splat(ZERO))
                for k in range(slot * extra_width, (slot + 1) * extra_width):
                    extras[k] = ZERO
            if tile_starts[tile] == ends[tile]:
                continue
            for y in range(min(TILE_HEIGHT, height - top)):
                k = 8 * y
                pixel = (top + y) * width + left
                if features is None and columns == TILE_WIDTH:
                    red, green, blue = load_interleaved(image_gradient, 3 * pixel)
                    image_red, image_green, image_blue = load_interleaved(image, 3 * pixel)
                    behind = red * image_red + green * image_green + blue * image_blue
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
                    for channel in range(channels):
                        gradient = image_gradient[top + y, left + x, channel] if inside else ZERO
                        planes[k + x + (2 + channel) * TILE_PIXELS] = gradient
                        if inside:
                            light_behind += gradient * image[top + y, left + x, channel]
                    planes[k + x + TILE_PIXELS] = light_behind
            _blend_tile_backward(
                footprints, features, channels, entries, entry_slots, tile_starts[tile], ends[tile], left,
                top, planes, weights, strips, strip_footprints, moments, extras,
            )  # fmt: skip
