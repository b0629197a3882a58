"""L1 and SSIM and their gradient on a CPU, as numba kernels: 20 to 50 times faster than torch's convolutions.

With zero padding the symmetric window is its own adjoint, so the gradient of the mean SSIM is three
more blurs of pointwise derivatives. Value and gradient are computed together in one pass.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.rendering.cpu import memory, parallel
from keyss.rendering.cpu.jit import finite_kernel
from keyss.rendering.cpu.simd8 import fetch_add

RADIUS = 5  # SSIM's 11x11 window
SIGMA = 1.5
_weights = np.exp(-(np.arange(-RADIUS, RADIUS + 1, dtype=np.float64) ** 2) / (2 * SIGMA**2))
WINDOW = (_weights / _weights.sum()).astype(np.float32)
W0, W1, W2, W3, W4, W5 = WINDOW[RADIUS:]
C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)
TWO = np.float32(2)
ROWS_PER_JOB = 32

Array = npt.NDArray[np.float32]


@finite_kernel
def _blur(counter: Any, source: Any, result: Any) -> None:
    """Separable 11x11 window over the last two axes of [B, H, W], zeros outside.

    Both passes run down one row at a time while it is in the first-level cache, with all eleven taps
    in one expression, which LLVM turns into full-width fused multiply-adds.
    """
    count, height, width = source.shape
    jobs_per_plane = (height + ROWS_PER_JOB - 1) // ROWS_PER_JOB
    while True:
        job = fetch_add(counter, 0, 1)
        if job >= count * jobs_per_plane:
            break
        plane = job // jobs_per_plane
        start = (job % jobs_per_plane) * ROWS_PER_JOB
        zeros = np.zeros(width, np.float32)
        padded = np.zeros(width + 2 * RADIUS, np.float32)
        for y in range(start, min(start + ROWS_PER_JOB, height)):
            centre = source[plane, y]
            above1 = source[plane, y - 1] if y >= 1 else zeros
            above2 = source[plane, y - 2] if y >= 2 else zeros
            above3 = source[plane, y - 3] if y >= 3 else zeros
            above4 = source[plane, y - 4] if y >= 4 else zeros
            above5 = source[plane, y - 5] if y >= 5 else zeros
            below1 = source[plane, y + 1] if y + 1 < height else zeros
            below2 = source[plane, y + 2] if y + 2 < height else zeros
            below3 = source[plane, y + 3] if y + 3 < height else zeros
            below4 = source[plane, y + 4] if y + 4 < height else zeros
            below5 = source[plane, y + 5] if y + 5 < height else zeros
            for x in range(width):
                padded[x + RADIUS] = (
                    W0 * centre[x]
                    + W1 * (above1[x] + below1[x])
                    + W2 * (above2[x] + below2[x])
                    + W3 * (above3[x] + below3[x])
                    + W4 * (above4[x] + below4[x])
                    + W5 * (above5[x] + below5[x])
                )
            line = result[plane, y]
            for x in range(width):
                line[x] = (
                    W0 * padded[x + 5]
                    + W1 * (padded[x + 4] + padded[x + 6])
                    + W2 * (padded[x + 3] + padded[x + 7])
                    + W3 * (padded[x + 2] + padded[x + 8])
                    + W4 * (padded[x + 1] + padded[x + 9])
                    + W5 * (padded[x] + padded[x + 10])
                )


@finite_kernel
def _products(counter: Any, image: Any, target: Any, stacked: Any) -> None:
    """stacked [9, H, W] = x, x^2, x y of image [H, W, 3] and target [3, H, W]."""
    _, height, width = target.shape
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            break
        for c in range(3):
            for x in range(width):
                value = image[y, x, c]
                stacked[c, y, x] = value
                stacked[3 + c, y, x] = value * value
                stacked[6 + c, y, x] = value * target[c, y, x]


@finite_kernel
def _similarity(counter: Any, stats: Any, target_mean: Any, target_variance: Any, row_sums: Any) -> None:
    """Row sums of the SSIM map; its derivatives to mean, square, product overwrite `stats` [9, H, W]."""
    _, height, width = target_mean.shape
    while True:
        job = fetch_add(counter, 0, 1)
        if job >= 3 * height:
            break
        c, y = job // height, job % height
        total = np.float32(0)
        for x in range(width):
            mean = stats[c, y, x]
            mean_t = target_mean[c, y, x]
            variance = stats[3 + c, y, x] - mean * mean
            covariance = stats[6 + c, y, x] - mean * mean_t
            a1 = TWO * mean * mean_t + C1
            a2 = TWO * covariance + C2
            b1 = mean * mean + mean_t * mean_t + C1
            b2 = variance + target_variance[c, y, x] + C2
            inverse = np.float32(1) / (b1 * b2)
            s = a1 * a2 * inverse
            total += s
            stats[c, y, x] = TWO * mean_t * (a2 - a1) * inverse - TWO * mean * s * (b2 - b1) * inverse
            stats[3 + c, y, x] = -s * b1 * inverse
            stats[6 + c, y, x] = TWO * a1 * inverse
        row_sums[job] = total


@finite_kernel
def _chain(
    counter: Any,
    image: Any,
    target: Any,
    derivatives: Any,
    ssim_scale: Any,
    l1_scale: Any,
    gradient: Any,
    row_sums: Any,
) -> None:
    """gradient [H, W, 3] of l1_scale sum |x - y| + ssim_scale sum SSIM, from SSIM's blurred derivatives.

    row_sums [H] become those of |x - y|.
    """
    _, height, width = target.shape
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            break
        total = np.float32(0)
        for c in range(3):
            for x in range(width):
                value, wanted = image[y, x, c], target[c, y, x]
                slope = derivatives[c, y, x] + TWO * value * derivatives[3 + c, y, x]
                slope = ssim_scale * (slope + wanted * derivatives[6 + c, y, x])
                difference = value - wanted
                total += abs(difference)
                if difference > 0:
                    slope += l1_scale
                elif difference < 0:
                    slope -= l1_scale
                gradient[y, x, c] = slope
        row_sums[y] = total


def blur(source: Array, result: Array) -> None:
    """`result` = SSIM's window (11x11, sigma 1.5, zeros outside) over the last two axes of [B, H, W]."""
    parallel.run(_blur, source, result)


def loss_and_gradient(
    image: Array, target: Array, mean: Array, variance: Array, ssim_weight: float
) -> tuple[float, Array]:
    """(1 - w) L1 + w (1 - SSIM) of image [H, W, 3] and a target, and its gradient [H, W, 3].

    The target is given as planes [3, H, W] with their local `mean` and `variance`.
    """
    _, height, width = target.shape
    stacked = memory.empty((9, height, width), np.float32)
    stats = memory.empty((9, height, width), np.float32)
    parallel.run(_products, image, target, stacked)
    blur(stacked, stats)
    similarities = np.empty(3 * height, np.float32)
    parallel.run(_similarity, stats, mean, variance, similarities)
    blur(stats, stacked)
    gradient = memory.empty(image.shape, np.float32)
    differences = np.empty(height, np.float32)
    scales = (-ssim_weight / image.size, (1 - ssim_weight) / image.size)
    parallel.run(
        _chain, image, target, stacked, *(np.float32(scale) for scale in scales), gradient, differences
    )
    ssim = similarities.sum(dtype=np.float64) / image.size
    l1 = differences.sum(dtype=np.float64) / image.size
    return float((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)), gradient
