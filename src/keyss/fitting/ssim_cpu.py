"""SSIM and its gradient on a CPU, as numba kernels: 20 to 50 times faster than torch's convolutions.

With zero padding the symmetric window is its own adjoint, so the gradient of the mean SSIM is three
more blurs of pointwise derivatives. Value and gradient are computed together in one pass.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from keyss.rendering.cpu import parallel
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
def _products(counter: Any, planes: Any, target: Any, stacked: Any) -> None:
    """stacked [9, H, W] = x, x^2, x y."""
    _, height, width = planes.shape
    while True:
        job = fetch_add(counter, 0, 1)
        if job >= 3 * height:
            break
        c, y = job // height, job % height
        for x in range(width):
            value = planes[c, y, x]
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
def _chain(counter: Any, planes: Any, target: Any, derivatives: Any, scale: Any, gradient: Any) -> None:
    """gradient [3, H, W] = scale (d mean + 2 x d square + y d product) of the blurred derivatives."""
    _, height, width = planes.shape
    while True:
        job = fetch_add(counter, 0, 1)
        if job >= 3 * height:
            break
        c, y = job // height, job % height
        for x in range(width):
            gradient[c, y, x] = scale * (
                derivatives[c, y, x]
                + TWO * planes[c, y, x] * derivatives[3 + c, y, x]
                + target[c, y, x] * derivatives[6 + c, y, x]
            )


def blur(source: Array, result: Array) -> None:
    """`result` = SSIM's window (11x11, sigma 1.5, zeros outside) over the last two axes of [B, H, W]."""
    parallel.run(_blur, source, result)


def ssim_and_gradient(planes: Array, target: Array, mean: Array, variance: Array) -> tuple[float, Array]:
    """Mean SSIM of [3, H, W] and a target, whose `mean` and `variance` are given, and its gradient."""
    stacked = np.empty((9, *planes.shape[1:]), np.float32)
    stats = np.empty_like(stacked)
    parallel.run(_products, planes, target, stacked)
    blur(stacked, stats)
    row_sums = np.empty(3 * planes.shape[1], np.float32)
    parallel.run(_similarity, stats, mean, variance, row_sums)
    blur(stats, stacked)
    gradient = np.empty_like(planes)
    parallel.run(_chain, planes, target, stacked, np.float32(1 / planes.size), gradient)
    return float(row_sums.sum(dtype=np.float64) / planes.size), gradient
