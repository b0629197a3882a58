"""`blending` for images of any number of channels: features, depth.

The channels of a Gaussian do not fit into registers, so each Gaussian is drawn in passes over its rows:
first the weights of its pixels, kept in a buffer, then one pass per channel. What a pixel weighs and when
it stops is computed by the same steps as in `blending`.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator"

from __future__ import annotations

import numpy as np

from keyss.rendering.cpu.blending import (
    ANCHOR_ROWS,
    BATCH,
    INVERSE,
    PREFETCH,
    SCALE,
    SCALED_ALPHA_MAX,
    blend_row,
    footprint_and_ratio,
    has_stopped,
)
from keyss.rendering.cpu.jit import finite_inlined, finite_kernel
from keyss.rendering.cpu.layout import (
    DECAY,
    ENTRY_GAUSSIAN,
    ENTRY_ROWS_SHIFT,
    HALF,
    LAST_ROW_SHIFT,
    MOMENTS,
    ONE,
    OPACITY,
    PACKED,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_RUN,
    TILE_WIDTH,
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
    at,
    divide,
    fetch_add,
    load8,
    multiply_add,
    negative_abs,
    prefetch_read,
    prefetch_write,
    ramp,
    select_le,
    splat,
    store8,
    sum_lanes,
    sum_lanes_of_8,
)


@finite_inlined
def _blend_tile(footprints, features, channels, entries, start, end, left, top, planes, weights):
    """Blend entries start..end of the list into planes = [transmittance | one per channel].

    Returns the entry before which the whole tile had stopped.
    """
    for k in range(0, TILE_PIXELS, 8):
        store8(planes, k, splat(INVERSE))
    for k in range(TILE_PIXELS, (1 + channels) * TILE_PIXELS, 8):
        store8(planes, k, splat(ZERO))
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    entry = start
    while entry < end:
        check = min(entry + BATCH, end)
        for e in range(entry, check):
            ahead = at(entries, min(e + PREFETCH, end - 1)) & ENTRY_GAUSSIAN
            prefetch_read(footprints, ahead * PACKED)
            prefetch_read(features, ahead * channels)
            i = at(entries, e) & ENTRY_GAUSSIAN
            g = i * PACKED
            rows = at(entries, e) >> ENTRY_ROWS_SHIFT
            first_row = rows & (TILE_HEIGHT - 1)
            last_row = rows >> LAST_ROW_SHIFT
            y = at(footprints, g + Y) - centre_y
            yy = at(footprints, g + YY)
            opacity = at(footprints, g + OPACITY)
            decay = at(footprints, g + DECAY)
            dx = ramp(-(at(footprints, g + X) - centre_x))
            exponent_0 = dx * dx * at(footprints, g + XX)
            exponent_1 = dx * at(footprints, g + XY)
            for anchor in range(first_row, last_row + 1, ANCHOR_ROWS):
                dy = f32(anchor) - y
                footprint, ratio = footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity)
                for k in range(anchor * 8, min(anchor + ANCHOR_ROWS, last_row + 1) * 8, 8):
                    _, weight = blend_row(planes, k, footprint)
                    store8(weights, k, weight)
                    footprint = footprint * ratio
                    ratio = ratio * decay
            for channel in range(channels):
                value = at(features, i * channels + channel)
                plane = (1 + channel) * TILE_PIXELS
                for k in range(first_row * 8, (last_row + 1) * 8, 8):
                    p = plane + k
                    store8(planes, p, multiply_add(load8(weights, k), value, load8(planes, p)))
        entry = check
        if has_stopped(planes):
            break
    return entry


@finite_kernel
def blend_features(
    counter,
    footprints,
    features,
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
    channels = image.shape[2]
    planes = np.empty((1 + channels) * TILE_PIXELS, np.float32)
    weights = np.empty(TILE_PIXELS, np.float32)
    while True:
        run = fetch_add(counter, 0, 1) * TILE_RUN
        if run >= ends.shape[0]:
            break
        for tile in range(run, min(run + TILE_RUN, ends.shape[0])):
            left = (tile % tile_columns) * TILE_WIDTH
            top = (tile // tile_columns) * TILE_HEIGHT
            rows = min(TILE_HEIGHT, height - top)
            ends[tile] = _blend_tile(
                footprints, features, channels, entries, tile_starts[tile], tile_starts[tile + 1],
                left, top, planes, weights,
            )  # fmt: skip
            for y in range(rows):
                for x in range(min(TILE_WIDTH, width - left)):
                    k = y * 8 + x
                    rest = abs(planes[k]) * SCALE
                    for channel in range(channels):
                        drawn = planes[k + (1 + channel) * TILE_PIXELS]
                        image[top + y, left + x, channel] = drawn + rest * background[channel]
                    transmittance[top + y, left + x] = rest
                    alpha[top + y, left + x] = ONE - rest


@finite_inlined
def _blend_tile_backward(
    footprints,
    features,
    channels,
    entries,
    slots,
    start,
    end,
    left,
    top,
    planes,
    weights,
    products,
    moments,
    extras,
    extra_width,
    absgrad,
):
    """Replay entries start..end front to back; leave the sums of each pair in its slot (see layout.MOMENTS).

    planes = [transmittance | behind | the gradient of each channel], with `behind` as in `blending`. A first
    pass per channel fills `products` with the products of gradient and features, pixel by pixel.
    """
    centre_x = f32(left) + HALF
    centre_y = f32(top) + HALF
    zero = splat(ZERO)
    for e in range(start, end):
        ahead = min(e + PREFETCH, end - 1)
        gaussian_ahead = at(entries, ahead) & ENTRY_GAUSSIAN
        slot_ahead = np.int64(at(slots, ahead))
        prefetch_read(footprints, gaussian_ahead * PACKED)
        prefetch_read(features, gaussian_ahead * channels)
        prefetch_write(moments, slot_ahead * MOMENTS)
        prefetch_write(extras, slot_ahead * extra_width)
        i = at(entries, e) & ENTRY_GAUSSIAN
        slot = np.int64(at(slots, e))
        g = i * PACKED
        rows = at(entries, e) >> ENTRY_ROWS_SHIFT
        first_row = rows & (TILE_HEIGHT - 1)
        last_row = rows >> LAST_ROW_SHIFT
        y = at(footprints, g + Y) - centre_y
        xx = at(footprints, g + XX)
        xy = at(footprints, g + XY)
        yy = at(footprints, g + YY)
        opacity = at(footprints, g + OPACITY)
        decay = at(footprints, g + DECAY)
        dx = ramp(-(at(footprints, g + X) - centre_x))
        exponent_0 = dx * dx * xx
        exponent_1 = dx * xy
        for k in range(first_row * 8, (last_row + 1) * 8, 8):
            store8(products, k, zero)
        for channel in range(channels):
            value = at(features, i * channels + channel)
            plane = (2 + channel) * TILE_PIXELS
            for k in range(first_row * 8, (last_row + 1) * 8, 8):
                store8(products, k, multiply_add(load8(planes, plane + k), value, load8(products, k)))
        sum_1 = zero
        sum_y = zero
        sum_yy = zero
        sum_abs_x = zero
        sum_abs_y = zero
        for anchor in range(first_row, last_row + 1, ANCHOR_ROWS):
            dy = f32(anchor) - y
            footprint, ratio = footprint_and_ratio(exponent_0, exponent_1, yy, dy, opacity)
            row_dy = splat(dy)
            for k in range(anchor * 8, min(anchor + ANCHOR_ROWS, last_row + 1) * 8, 8):
                alpha, weight = blend_row(planes, k, footprint)
                store8(weights, k, weight)
                own = weight * load8(products, k)
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
                if absgrad:
                    along_x = s * multiply_add(row_dy, xy, dx * (xx * TWO))
                    along_y = s * multiply_add(row_dy, yy * TWO, exponent_1)
                    sum_abs_x = sum_abs_x - negative_abs(along_x)
                    sum_abs_y = sum_abs_y - negative_abs(along_y)
                row_dy = row_dy + ONE
        sum_x = dx * sum_1
        store8(
            moments,
            slot * MOMENTS,
            sum_lanes_of_8(sum_1, sum_x, sum_y, sum_x * dx, dx * sum_y, sum_yy, zero, zero),
        )
        for channel in range(channels):
            plane = (2 + channel) * TILE_PIXELS
            total = zero
            for k in range(first_row * 8, (last_row + 1) * 8, 8):
                total = multiply_add(load8(planes, plane + k), load8(weights, k), total)
            extras[slot * extra_width + channel] = sum_lanes(total)
        if absgrad:
            extras[slot * extra_width + channels] = sum_lanes(sum_abs_x)
            extras[slot * extra_width + channels + 1] = sum_lanes(sum_abs_y)


@finite_kernel
def blend_features_backward(
    counter,
    footprints,
    features,
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
    channels = image.shape[2]
    planes = np.empty((2 + channels) * TILE_PIXELS, np.float32)
    weights = np.empty(TILE_PIXELS, np.float32)
    products = np.empty(TILE_PIXELS, np.float32)
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
                for x in range(TILE_WIDTH):
                    k = y * 8 + x
                    inside = x < columns
                    planes[k] = INVERSE if inside else -INVERSE
                    behind = ZERO
                    if inside:
                        rest = transmittance[top + y, left + x]
                        behind = -alpha_gradient[top + y, left + x] * rest
                    for channel in range(channels):
                        gradient = ZERO
                        if inside:
                            gradient = image_gradient[top + y, left + x, channel]
                            behind += gradient * image[top + y, left + x, channel]
                        planes[k + (2 + channel) * TILE_PIXELS] = gradient
                    planes[k + TILE_PIXELS] = behind
            _blend_tile_backward(
                footprints, features, channels, entries, entry_slots, tile_starts[tile], ends[tile],
                left, top, planes, weights, products, moments, extras, extra_width, absgrad,
            )  # fmt: skip
