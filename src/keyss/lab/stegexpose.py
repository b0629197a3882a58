"""StegExpose (2014): four detectors of LSB replacement in 8-bit images, and their mean.

- Chi-square: random last bits make values that differ only in the last bit equally frequent.
- Primary sets and sample pairs: count pairs of neighbours (u, v), whose differences LSB replacement evens
  out, and solve the same quadratic equation for the embedding rate.
- RS: counts small blocks that become rougher (regular) or smoother (singular) when last bits are flipped.

An independent implementation that reproduces the original's scores, quirks included. On renders, the expected
AUC is 0.5: nothing replaces the last bits of pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from keyss.core.arrays import Bytes, Integers
from keyss.core.errors import UsageError
from keyss.lab.auc import Auc, auc_between

_SAMPLES = 1024  # per block of chi-square
_MIN_BLOCKS = 256  # the original program fails with fewer
_FREEDOM = 127  # degrees of freedom: 128 terms - 1

Plane = NDArray[np.int16]  # [H, W]
Counts = Integers  # [2, 2]: under F1 and under F-1, the number of regular and of singular blocks
Number = np.float64


def score_image(image: Bytes) -> dict[str, float]:
    """Scores of an image [H, W, 3] uint8 by detector, and their mean `fusion`; each in [0, 1].

    A detector is NaN if its equation has no solution, or if it does not accept the image (Sample Pairs: odd
    width or height; Chi Square: less than about 87,700 pixels). `fusion` is the mean of the available scores,
    NaN if there are none: compare only images of one size. Raises UsageError for another shape or type.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise UsageError(f"expected an image [H, W, 3] of uint8, got {list(image.shape)} of {image.dtype}")
    scores = {name: float(np.minimum(abs(detector(image)), 1.0)) for name, detector in DETECTORS.items()}
    available = [score for score in scores.values() if not math.isnan(score)]
    return scores | {"fusion": sum(available) / len(available) if available else math.nan}


def stegexpose_auc(plain_images: Sequence[Bytes], stego_images: Sequence[Bytes]) -> Auc:
    """AUC of the mean of the detectors between renders [H, W, 3] uint8 of the same views by two models.

    Chi Square needs about 87,700 pixels, Sample Pairs even sizes.
    """
    plain, stego = (
        [score_image(image)["fusion"] for image in images] for images in (plain_images, stego_images)
    )
    return auc_between(plain, stego)


def chi_square(image: Bytes) -> float:
    """Mean p-value over the first 1024, 2048, ... samples of [H, W, 3], in [0, 1].

    Samples are in row-major order, red, green, blue. NaN for images of less than about 87,700 pixels. Not
    calibrated: a smooth histogram alone gives 0.3.
    """
    samples = image.reshape(-1)
    blocks = len(samples) // _SAMPLES - 1
    if blocks < _MIN_BLOCKS:
        return math.nan
    bins = samples[: blocks * _SAMPLES].reshape(blocks, _SAMPLES) + 256 * np.arange(blocks)[:, None]
    counts = np.bincount(bins.reshape(-1), minlength=256 * blocks).reshape(blocks, 256)
    histograms = 1 + counts.cumsum(0)
    observed = histograms[:, 0::2].astype(np.float64)
    expected = ((histograms[:, 0::2] + histograms[:, 1::2]) // 2).astype(np.float64)
    expected *= (observed.sum(1) / expected.sum(1))[:, None]
    statistic = ((observed - expected) ** 2 / expected).sum(1)
    return float(gammaincc(_FREEDOM / 2, statistic / 2).mean())


def primary_sets(image: Bytes) -> float:
    """Embedding rate in the red channel of [H, W, 3], from horizontal pairs; unbounded.

    NaN if the equation has no real root: rare for clean photos, usual for full payloads.
    """
    pairs, y, z, _, w = _horizontal_pairs(image[:, :, 0])
    a, b, _, discriminant = _equation(pairs, y, z, w)
    with np.errstate(all="ignore"):
        return float((-b - np.sqrt(discriminant)) / (2 * a))


def sample_pairs(image: Bytes) -> float:
    """Mean embedding rate over the channels of [H, W, 3], from horizontal and vertical pairs; unbounded.

    NaN if width or height is odd: the original program fails.
    """
    if image.shape[0] % 2 or image.shape[1] % 2:
        return math.nan
    rates = []
    for plane in np.moveaxis(image, 2, 0):
        pairs, y, z, w, _ = _horizontal_pairs(plane) + _horizontal_pairs(plane.T)
        a, b, c, discriminant = _equation(pairs, y, z, w)
        with np.errstate(all="ignore"):
            rate = c / b if discriminant < 0 else smaller_root(a, b, discriminant) or c / b
        rates.append(rate)
    return float(sum(rates) / 3)


def smaller_root(a: Number, b: Number, discriminant: Number) -> Number:
    """The root of a x^2 + b x + c nearer to zero, the first at a tie; IEEE arithmetic if a is zero."""
    with np.errstate(all="ignore"):
        first: Number = (-b + np.sqrt(discriminant)) / (2 * a)
        second: Number = (-b - np.sqrt(discriminant)) / (2 * a)
    return first if abs(first) <= abs(second) else second


def _equation(pairs: int, y: int, z: int, w: int) -> tuple[Number, Number, Number, Number]:
    """(a, b, c, discriminant) of the equation for the rate, from counts of pairs."""
    x = pairs - y - z
    a, b, c = Number((w + z) / 2), Number(2 * x - pairs), Number(y - x)
    return a, b, c, b * b - 4 * a * c


def _horizontal_pairs(plane: Bytes) -> Integers:
    """[5] counts of kinds of disjoint pairs (0, 1), (2, 3), ... in the rows of [H, W].

    All; y: u > v for even v, u < v for odd v; z: u = v; w: u and v differ only in the last bit; w of primary
    sets: y without pairs of even values. An odd last column is ignored.
    """
    even = plane.shape[1] // 2 * 2
    u, v = plane[:, 0:even:2], plane[:, 1:even:2]
    y = np.where(v & 1, u < v, u > v)
    kinds = (y, u == v, (u ^ v) == 1, y & (((u | v) & 1) != 0))
    return np.array([u.size, *map(np.count_nonzero, kinds)])


def rs(image: Bytes) -> float:
    """Mean embedding rate over channels of [H, W, 3], and over overlapping and disjoint 2x2 blocks.

    Unbounded; NaN for images without a block.
    """
    rates = np.zeros((2, 3))
    for channel, plane in enumerate(np.moveaxis(image, 2, 0).astype(np.int16)):
        for kind, counts in enumerate(zip(_count_blocks(plane), _count_blocks(plane ^ 1), strict=True)):
            rates[kind, channel] = _rate(*counts)
    return float((rates[0].sum() / 3 + rates[1].sum() / 3) / 2)


def _count_blocks(pixels: Plane) -> Integers:
    """[2, 2, 2]: `Counts` of overlapping and disjoint blocks."""
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
    """Roughness of each block with one diagonal flipped, then with the other."""
    left, right = np.abs(flipped[:, :-1] - pixels[:, 1:]), np.abs(pixels[:, :-1] - flipped[:, 1:])
    upper, lower = np.abs(flipped[:-1] - pixels[1:]), np.abs(pixels[:-1] - flipped[1:])
    yield _roughness(left, right, upper, lower)
    yield _roughness(right, left, lower, upper)


def _roughness(top: Plane, bottom: Plane, left: Plane, right: Plane) -> Plane:
    """[H-1, W-1] sums of the edges of each block, from differences across [H, W-1] and down [H-1, W]."""
    return top[:-1] + bottom[1:] + left[:, :-1] + right[:, 1:]


def _rate(counts: Counts, of_flipped: Counts) -> np.float64:
    """The embedding rate of one channel."""
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


# In the order of the original's table.
DETECTORS = {"primary_sets": primary_sets, "chi_square": chi_square, "sample_pairs": sample_pairs, "rs": rs}
