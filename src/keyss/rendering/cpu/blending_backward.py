"""The backward pass of `blending`: gradients of footprints and colours from those of the image.

Entries are replayed front to back, with the same arithmetic as in the forward pass.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator"

from __future__ import annotations

import numpy as np

from keyss.kernels.jit import finite_inline, finite_kernel
from keyss.rendering.cpu.blending import (
    BATCH,
    INVERSE,
    MAX_STRIPS,
    SCALE,
    SCALED_ALPHA_MAX,
    STRIP,
    blend_row,
    list_strips,
)
from keyss.rendering.cpu.constants import (
    BLUE,
    DECAY,
    GREEN,
    HALF,
    MOMENTS,
    ONE,
    PACKED,
    RED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_RUN,
    TILE_WIDTH,
    TILE_WIDTH_LOG2,
    ZERO,
    X,
    Y,
    f32,
)
from keyss.rendering.cpu.simd8 import (
    at,
    divide,
    fetch_add,
    load8,
    load_interleaved,
    multiply_add,
    prefetch_write,
    put,
    ramp,
    select_le,
    splat,
    store8,
    sum_lanes,
    sum_lanes_of_8,
)

PREFETCH = 6  # list entries ahead whose memory is prefetched


@finite_inline
def _blend_tile_backward(
    footprints, features, channels, entries, slots, start, end, left, top, planes, weights, strips,
    strip_footprints, moments, extras,
):  # fmt: skip
    """Replay entries start..end front to back; write the sums of each pair to its slot (see layout.MOMENTS).

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
                        own = weight * multiply_add(gradient_red, red, product)
                    else:
                        store8(weights, k, weight)
                        product = zero
                        for channel in range(channels):
                            value = at(features, g // PACKED * channels + channel)
                            gradient = load8(planes, k + (2 + channel) * TILE_PIXELS)
                            product = multiply_add(gradient, value, product)
                        own = weight * product
                    behind = load8(planes, k + TILE_PIXELS) - own
                    store8(planes, k + TILE_PIXELS, behind)
                    # alpha dL/d(alpha); the light from behind is dimmed by 1 - alpha.
                    s = own - behind * divide(alpha, SCALE - alpha)
                    s = select_le(footprint, SCALED_ALPHA_MAX, s, ZERO)
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
