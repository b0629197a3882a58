"""Number of (Gaussian, pixel) pairs to blend, counted one by one without the kernels' shortcuts."""

from __future__ import annotations

from typing import Any

from keyss.rendering.cpu.layout import (
    ALPHA_MAX,
    ALPHA_MIN,
    ENTRY_GAUSSIAN,
    OPACITY,
    TILE_HEIGHT,
    TILE_WIDTH,
    TRANSMITTANCE_MIN,
    XX,
    XY,
    YY,
    X,
    Y,
)
from keyss.rendering.cpu.rasterization import Rendering

import numba
import numpy as np


def blended_pairs(rendering: Rendering, width: int, height: int) -> int:
    """The pairs that contribute to a pixel: alpha of 1/255 or more, before the pixel is full."""
    return int(
        _count(rendering.footprints, rendering.tile_starts, rendering.entries, rendering.ends, width, height)
    )


@numba.njit(error_model="numpy")  # type: ignore[misc]
def _count(footprints: Any, starts: Any, entries: Any, ends: Any, width: int, height: int) -> int:
    columns = -(-width // TILE_WIDTH)
    total = 0
    rest = np.empty((TILE_HEIGHT, TILE_WIDTH), np.float32)
    for tile in range(ends.shape[0]):
        left = tile % columns * TILE_WIDTH
        top = tile // columns * TILE_HEIGHT
        rest[:] = 1.0
        for entry in range(starts[tile], ends[tile]):
            g = footprints[entries[entry] & ENTRY_GAUSSIAN]
            for y in range(min(TILE_HEIGHT, height - top)):
                dy = np.float32(top + y) + np.float32(0.5) - g[Y]
                for x in range(min(TILE_WIDTH, width - left)):
                    dx = np.float32(left + x) + np.float32(0.5) - g[X]
                    alpha = g[OPACITY] * np.exp(g[XX] * dx * dx + g[XY] * dx * dy + g[YY] * dy * dy)
                    if alpha >= ALPHA_MIN and rest[y, x] > 0:
                        after = rest[y, x] * (1 - min(alpha, ALPHA_MAX))
                        if after > TRANSMITTANCE_MIN:
                            rest[y, x] = after
                            total += 1
                        else:
                            rest[y, x] = 0
    return total
