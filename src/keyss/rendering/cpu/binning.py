"""Which Gaussians touch which tile, front to back.

One radix sort of all visible Gaussians by depth, then a counting sort of (Gaussian, tile) pairs into
tiles that keeps the depth order. Each pair also has a slot: pairs of one Gaussian are neighbours in the
order of slots, so the backward pass can leave its sums there without any two threads meeting, and add
them up in an order that never changes.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, disable-error-code="misc"

from __future__ import annotations

import math

import numpy as np

from keyss.rendering.cpu.jit import kernel
from keyss.rendering.cpu.layout import (
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
from keyss.rendering.cpu.simd8 import at, ceil, fetch_add, floor


@kernel
def sort_by_depth(depths, rank, order, spare_order, keys, spare_keys):
    """Sort by depth those Gaussians whose depth is not 0; returns how many those are.

    order[j] becomes the j-th Gaussian, and rank[i] the place of Gaussian i or -1. A stable radix sort
    with three digits of 11 bits: positive floats sort like their bit patterns.
    """
    bits = depths.view(np.uint32)
    mask = np.uint32(2047)
    starts = np.zeros((3, 2048), np.int64)
    # Three passes from `source` to `target` and back end in `order`.
    source, target = spare_order, order
    source_keys, target_keys = spare_keys, keys
    count = 0
    for i in range(depths.shape[0]):
        rank[i] = -1
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
    for j in range(count):
        rank[order[j]] = j
    return count


@kernel
def tile_box(x, y, extent_x, extent_y, tile_columns, tile_rows):
    """First and last column and row of tiles that may hold pixel centres within the extents."""
    return (
        max(ceil(x - extent_x - HALF), 0) >> TILE_WIDTH_LOG2,
        min(floor(x + extent_x - HALF), tile_columns * TILE_WIDTH - 1) >> TILE_WIDTH_LOG2,
        max(ceil(y - extent_y - HALF), 0) >> TILE_HEIGHT_LOG2,
        min(floor(y + extent_y - HALF), tile_rows * TILE_HEIGHT - 1) >> TILE_HEIGHT_LOG2,
    )


@kernel
def _list_tiles(packed, r, tile_columns, tile_rows, height, tiles, rows, place, counts):
    """Append the tiles that Gaussian r meets to `tiles` from `place` on, and count them in `counts`.

    `rows` gets the rows of each tile that the ellipse alpha >= 1/255 meets, see `layout.LAST_ROW_SHIFT`.
    Goes through the ellipse from left to right, one column of tiles after the other: at x from its centre
    it spans -shear x -+ sqrt(level - curvature x^2), its lowest point lies at x = lowest_x and its highest
    at -lowest_x. Returns the place after the last.
    """
    g = r * PACKED
    x = at(packed, g + X)
    y = at(packed, g + Y)
    extent_x = at(packed, g + EXTENT_X)
    extent_y = at(packed, g + EXTENT_Y)
    first_column, last_column, _, _ = tile_box(x, y, extent_x, extent_y, tile_columns, tile_rows)
    slope = HALF * at(packed, g + XY)
    inverse = ONE / at(packed, g + YY)
    shear = slope * inverse
    lowest_x = -slope / at(packed, g + XX) * extent_y
    level = f32(-0.5005) * at(packed, g + LEVEL) * inverse
    curvature = level / (extent_x * extent_x)
    left = max(f32(first_column * TILE_WIDTH) + HALF - x, -extent_x)
    half = math.sqrt(max(level - curvature * left * left, ZERO)) + f32(1e-3)
    left_top = -shear * left - half
    left_bottom = -shear * left + half
    for column in range(first_column, last_column + 1):
        # A pixel more than the column's 8, so that the next one can begin with what is known here.
        right = min(f32((column + 1) * TILE_WIDTH) + HALF - x, extent_x)
        half = math.sqrt(max(level - curvature * right * right, ZERO)) + f32(1e-3)
        right_top = -shear * right - half
        right_bottom = -shear * right + half
        top = -extent_y
        if not (left <= -lowest_x and -lowest_x <= right):
            top = max(top, min(left_top, right_top))
        bottom = extent_y
        if not (left <= lowest_x and lowest_x <= right):
            bottom = min(bottom, max(left_bottom, right_bottom))
        first = max(ceil(y + top - HALF), 0)
        last = min(floor(y + bottom - HALF), height - 1)
        if first <= last:
            for row in range(first >> TILE_HEIGHT_LOG2, (last >> TILE_HEIGHT_LOG2) + 1):
                tile = row * tile_columns + column
                counts[tile] += 1
                tiles[place] = tile
                first_row = max(first - row * TILE_HEIGHT, 0)
                last_row = min(last - row * TILE_HEIGHT, TILE_HEIGHT - 1)
                rows[place] = first_row | last_row << LAST_ROW_SHIFT
                place += 1
        left = right
        left_top = right_top
        left_bottom = right_bottom
    return place


@kernel
def share_bounds(tile_bounds, starts):
    """starts[w] becomes the sum of tile_bounds over the shares before w; the last entry is the total."""
    shares = starts.shape[0] - 1
    count = tile_bounds.shape[0]
    total = 0
    for share in range(shares):
        starts[share] = total
        for r in range(share * count // shares, (share + 1) * count // shares):
            total += tile_bounds[r]
    starts[shares] = total


@kernel
def list_pairs(
    counter, packed, tile_columns, tile_rows, height, starts, tiles, rows, tiles_per_gaussian, cursors
):
    """List the tiles of each Gaussian and its rows there, share by share, that of share w from starts[w] on.

    cursors[w, t] becomes the number of Gaussians in share w that meet tile t.
    """
    shares = cursors.shape[0]
    count = packed.shape[0]
    while True:
        share = fetch_add(counter, 0, 1)
        if share >= shares:
            break
        counts = cursors[share]
        for tile in range(counts.shape[0]):
            counts[tile] = 0
        place = starts[share]
        for r in range(share * count // shares, (share + 1) * count // shares):
            before = place
            place = _list_tiles(packed, r, tile_columns, tile_rows, height, tiles, rows, place, counts)
            tiles_per_gaussian[r] = place - before


@kernel
def offsets_from_counts(cursors, tiles_per_gaussian, rank, tile_starts, first_slots):
    """Turn counts into starts, in place for the cursors. Returns the number of pairs."""
    total = 0
    for tile in range(cursors.shape[1]):
        tile_starts[tile] = total
        for share in range(cursors.shape[0]):
            here = cursors[share, tile]
            cursors[share, tile] = total
            total += here
    tile_starts[cursors.shape[1]] = total
    slot = 0
    for i in range(rank.shape[0]):
        first_slots[i] = slot
        if rank[i] >= 0:
            slot += tiles_per_gaussian[rank[i]]
    first_slots[rank.shape[0]] = slot
    return total


@kernel
def sort_pairs(
    counter,
    order,
    starts,
    tiles,
    rows,
    tiles_per_gaussian,
    cursors,
    first_slots,
    tile_ranks,
    tile_rows,
    tile_slots,
):
    """Sort the pairs of `list_pairs` into tiles, from the cursors that `offsets_from_counts` left.

    tile_slots may be empty: then it stays so.
    """
    shares = cursors.shape[0]
    count = order.shape[0]
    keep_slots = tile_slots.shape[0] > 0
    while True:
        share = fetch_add(counter, 0, 1)
        if share >= shares:
            break
        cursor = cursors[share]
        pair = starts[share]
        for r in range(share * count // shares, (share + 1) * count // shares):
            slot = first_slots[order[r]]
            for _ in range(tiles_per_gaussian[r]):
                tile = tiles[pair]
                place = cursor[tile]
                cursor[tile] = place + 1
                tile_ranks[place] = r
                tile_rows[place] = rows[pair]
                if keep_slots:
                    tile_slots[place] = slot
                pair += 1
                slot += 1
