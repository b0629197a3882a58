"""Lists of the Gaussians that touch each tile, front to back.

A radix sort orders the visible Gaussians by depth; a stable counting sort then bins (Gaussian, tile) pairs by
tile. Each pair has a slot, in which the backward pass stores its sums. The slots of a Gaussian are
contiguous: threads need no locks, and sums are added in a fixed order.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc,operator,assignment"

from __future__ import annotations

import numpy as np

from keyss.kernels.jit import inline, kernel
from keyss.rendering.cpu.constants import (
    ENTRY_ROWS_SHIFT,
    EXTENT_X,
    EXTENT_Y,
    HALF,
    LAST_ROW_SHIFT,
    LEVEL,
    ONE,
    PACKED,
    TILE_HEIGHT,
    TILE_HEIGHT_LOG2,
    TILE_WIDTH,
    TILE_WIDTH_LOG2,
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
    ceil8,
    fetch_add,
    floor8,
    maximum,
    minimum,
    prefetch_read,
    put,
    ramp,
    select_ge,
    square_root,
    store8,
)

BATCH = 16  # Gaussians measured before the first of them is listed


@kernel
def sort_by_depth(depths, order, spare_order, keys, spare_keys):
    """Sort the Gaussians with nonzero depth by depth; returns their number.

    order[j] becomes the j-th Gaussian. A stable radix sort with three digits of 11 bits: positive floats
    sort like their bit patterns.
    """
    bits = depths.view(np.uint32)
    mask = np.uint32(2047)
    starts = np.zeros((3, 2048), np.int64)
    # Three passes between `source` and `target` end in `order`.
    source, target = spare_order, order
    source_keys, target_keys = spare_keys, keys
    count = 0
    for i in range(depths.shape[0]):
        key = bits[i]
        if key != 0:
            source[count] = i
            source_keys[count] = key
            starts[0, key & mask] += 1
            starts[1, (key >> np.uint32(11)) & mask] += 1
            starts[2, key >> np.uint32(22)] += 1
            count += 1
    for digit in range(3):
        total = 0
        for value in range(2048):
            here = starts[digit, value]
            starts[digit, value] = total
            total += here
    for digit in range(3):
        shift = np.uint32(11 * digit)
        for j in range(count):
            key = source_keys[j]
            value = (key >> shift) & mask
            place = starts[digit, value]
            starts[digit, value] = place + 1
            target[place] = source[j]
            target_keys[place] = key
        source, target = target, source
        source_keys, target_keys = target_keys, source_keys
    return count


@inline
def _measure_columns(footprints, g, height, first_column, spans, place):
    """Compute the rows of pixels that the ellipse alpha >= 1/255 covers in 8 columns of tiles.

    Its footprint starts at g. spans[place:] gets the first rows, spans[place + 8:] the last ones. At x from
    its centre, the ellipse spans shear x -+ sqrt(level - curvature x^2). Within a column, its extremes in y
    are at x = +-lowest_x or at the column's edges.
    """
    x = at(footprints, g + X)
    y = at(footprints, g + Y) - HALF
    extent_x = at(footprints, g + EXTENT_X)
    extent_y = at(footprints, g + EXTENT_Y)
    slope = -HALF * at(footprints, g + XY)
    inverse = ONE / at(footprints, g + YY)
    shear = slope * inverse
    lowest_x = slope / at(footprints, g + XX) * extent_y
    level = f32(-0.5005) * at(footprints, g + LEVEL) * inverse
    curvature = level / (extent_x * extent_x)
    left = ramp(f32(first_column)) * f32(TILE_WIDTH) + (HALF - x)
    right = minimum(left + f32(TILE_WIDTH - 1), extent_x)
    left = maximum(left, -extent_x)
    left_half = square_root(maximum(level - left * left * curvature, ZERO)) + f32(1e-3)
    right_half = square_root(maximum(level - right * right * curvature, ZERO)) + f32(1e-3)
    top = minimum(left * shear - left_half, right * shear - right_half)
    bottom = maximum(left * shear + left_half, right * shear + right_half)
    top = select_ge(right, -lowest_x, select_ge(-lowest_x, left, -extent_y, top), top)
    bottom = select_ge(right, lowest_x, select_ge(lowest_x, left, extent_y, bottom), bottom)
    store8(spans, place, maximum(ceil8(maximum(top, -extent_y) + y), ZERO))
    store8(spans, place + 8, minimum(floor8(minimum(bottom, extent_y) + y), f32(height - 1)))


@kernel
def list_pairs(counter, footprints, order, tile_columns, height, starts, tiles, rows, slot_counts, cursors):
    """List the tiles of each Gaussian and its rows in them; the list of share w begins at starts[w].

    slot_counts[i] becomes the number of tiles that Gaussian i touches, cursors[w, t] the number of Gaussians
    in share w that touch tile t. `tiles` and `rows` have room for one more entry at the end.
    """
    shares = cursors.shape[0]
    count = order.shape[0]
    spans = np.empty(16 * BATCH, np.float32)
    first_columns = np.empty(BATCH, np.int64)
    columns = np.empty(BATCH, np.int64)
    while True:
        share = fetch_add(counter, 0, 1)
        if share >= shares:
            break
        counts = cursors[share]
        for tile in range(counts.shape[0]):
            counts[tile] = 0
        place = starts[share]
        end = (share + 1) * count // shares
        for start in range(share * count // shares, end, BATCH):
            size = min(BATCH, end - start)
            # Arithmetic with long latencies first, for the whole batch, then branches on its results.
            for k in range(size):
                prefetch_read(footprints, np.int64(at(order, min(start + k + BATCH, end - 1))) * PACKED)
                g = np.int64(at(order, start + k)) * PACKED
                x = at(footprints, g + X) - HALF
                extent_x = at(footprints, g + EXTENT_X)
                first_column = max(np.int64(np.ceil(x - extent_x)), 0) >> TILE_WIDTH_LOG2
                last_pixel = min(np.int64(np.floor(x + extent_x)), tile_columns * TILE_WIDTH - 1)
                last_column = last_pixel >> TILE_WIDTH_LOG2
                first_columns[k] = first_column
                columns[k] = last_column + 1 - first_column
                _measure_columns(footprints, g, height, first_column, spans, 16 * k)
            for k in range(size):
                i = np.int64(at(order, start + k))
                before = place
                for column in range(columns[k]):
                    first_column = first_columns[k] + column
                    if column > 0 and column % 8 == 0:
                        _measure_columns(footprints, i * PACKED, height, first_column, spans, 16 * k)
                    first = np.int64(at(spans, 16 * k + column % 8))
                    last = np.int64(at(spans, 16 * k + 8 + column % 8))
                    for row in range(first >> TILE_HEIGHT_LOG2, (last >> TILE_HEIGHT_LOG2) + 1):
                        tile = row * tile_columns + first_column
                        # Written unconditionally: a branch for empty columns would be slower.
                        tiles[place] = tile
                        first_row = max(first - row * TILE_HEIGHT, 0)
                        last_row = min(last - row * TILE_HEIGHT, TILE_HEIGHT - 1)
                        rows[place] = first_row | last_row << LAST_ROW_SHIFT
                        met = np.int64(first_row <= last_row)
                        counts[tile] += met
                        place += met
                slot_counts[i] = place - before


@kernel
def sort_pairs(counter, order, starts, tiles, rows, slot_counts, first_slots, cursors, entries, entry_slots):
    """Sort the pairs of `list_pairs` into tiles, starting at the cursors.

    An entry is a Gaussian and, shifted by `constants.ENTRY_ROWS_SHIFT`, its rows. entry_slots gets the slots:
    Gaussian i has slot_counts[i] slots from first_slots[i]. If it is empty, first_slots is not read.
    """
    shares = cursors.shape[0]
    count = order.shape[0]
    keep_slots = entry_slots.shape[0] > 0
    while True:
        share = fetch_add(counter, 0, 1)
        if share >= shares:
            break
        cursor = cursors[share]
        pair = starts[share]
        slot = 0
        for r in range(share * count // shares, (share + 1) * count // shares):
            i = np.int64(at(order, r))
            if keep_slots:
                slot = np.int64(at(first_slots, i))
            for _ in range(at(slot_counts, i)):
                tile = np.int64(at(tiles, pair))
                place = at(cursor, tile)
                put(cursor, tile, place + 1)
                put(entries, place, i | np.int64(at(rows, pair)) << ENTRY_ROWS_SHIFT)
                if keep_slots:
                    put(entry_slots, place, np.int32(slot))
                    slot += 1
                pair += 1
