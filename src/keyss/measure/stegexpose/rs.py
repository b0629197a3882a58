"""RS: how often flipping last bits makes small blocks of pixels rougher (regular) or smoother (singular)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from keyss.measure.stegexpose.pixel_pairs import smaller_root

_ROWS = 128  # origins of blocks in memory together; even, so that disjoint blocks stay disjoint
Plane = NDArray[np.int16]  # [H, W]
Counts = NDArray[np.int64]  # [2, 2]: under F1 and under F-1, the number of regular and of singular blocks


def rs(image: NDArray[np.uint8]) -> float:
    """Rate of embedding in [H, W, 3]; not bounded. NaN for images without a block.

    The mean over channels, and over overlapping and disjoint 2x2 blocks.
    """
    rates = np.zeros((2, 3))
    for channel in range(3):
        for kind, (counts, counts_of_flipped) in enumerate(_count_image(image[:, :, channel])):
            rates[kind, channel] = _rate(counts, counts_of_flipped)
    return float((rates[0].sum() / 3 + rates[1].sum() / 3) / 2)


def _count_image(plane: NDArray[np.uint8]) -> NDArray[np.int64]:
    """[2, 2, 2, 2]: of overlapping and of disjoint blocks, the `Counts` of the image and of its flip."""
    counts = np.zeros((2, 2, 2, 2), dtype=np.int64)
    for start in range(0, plane.shape[0] - 1, _ROWS):
        strip = plane[start : start + _ROWS + 1].astype(np.int16)
        for flipped, pixels in enumerate((strip, strip ^ 1)):
            counts[:, flipped] += _count_strip(pixels)
    return counts


def _count_strip(pixels: Plane) -> NDArray[np.int64]:
    """[2, 2, 2]: of overlapping and of disjoint blocks, the `Counts`."""
    counts = np.zeros((2, 2, 2), dtype=np.int64)
    across, down = np.abs(pixels[:, :-1] - pixels[:, 1:]), np.abs(pixels[:-1] - pixels[1:])
    before = _roughness(across, across, down, down)
    for sign, flipped in enumerate((pixels ^ 1, ((pixels + 1) ^ 1) - 1)):
        for after in _masked_roughness(pixels, flipped):
            regular, singular = after > before, after < before
            counts[0, sign] += np.count_nonzero(regular), np.count_nonzero(singular)
            counts[1, sign] += np.count_nonzero(regular[::2, ::2]), np.count_nonzero(singular[::2, ::2])
    return counts


def _masked_roughness(pixels: Plane, flipped: Plane) -> Iterator[Plane]:
    """Of every block with one diagonal flipped, then with the other."""
    left, right = np.abs(flipped[:, :-1] - pixels[:, 1:]), np.abs(pixels[:, :-1] - flipped[:, 1:])
    upper, lower = np.abs(flipped[:-1] - pixels[1:]), np.abs(pixels[:-1] - flipped[1:])
    yield _roughness(left, right, upper, lower)
    yield _roughness(right, left, lower, upper)


def _roughness(top: Plane, bottom: Plane, left: Plane, right: Plane) -> Plane:
    """[H-1, W-1]: per block, the sum over its edges, of differences across [H, W-1] and down [H-1, W]."""
    return top[:-1] + bottom[1:] + left[:, :-1] + right[:, 1:]


def _rate(counts: Counts, of_flipped: Counts) -> np.float64:
    """The rate of embedding of one channel."""
    (r0, s0), (r_0, s_0) = counts.astype(np.float64)
    (r1, s1), (r_1, s_1) = of_flipped.astype(np.float64)
    d0, d_0, d1, d_1 = r0 - s0, r_0 - s_0, r1 - s1, r_1 - s_1
    a, b, c = 2 * (d1 + d0), d_0 - d_1 - d1 - 3 * d0, d0 - d_0
    discriminant = b * b - 4 * a * c
    with np.errstate(all="ignore"):
        straight = ((r_0 - r0) / (r1 - r0 + r_0 - r_1) + (s_0 - s0) / (s1 - s0 + s_0 - s_1)) / 2
        x = smaller_root(a, b, discriminant) if discriminant >= 0 else straight
        if x == 0:
            of_regular = ((r_1 - r1 + r0 - r_0) + (r_0 - r0) / x) / (x - 1)
            of_singular = ((s_1 - s1 + s0 - s_0) + (s_0 - s0) / x) / (x - 1)
            if of_singular > 0 or of_regular < 0:
                x = straight
        return abs(x / (x - 0.5)) if x != 0.5 else np.float64(0)
