"""The photometric loss of 3DGS: (1 - lambda) L1 + lambda (1 - SSIM) (3DGS, eq. 7; KeySS, eq. 4, 5 and 7).

SSIM is the 3DGS variant: 11x11 Gaussian window of sigma 1.5, zero padding, mean over all pixels and
channels. A `Target` stores the statistics of the target image, which never change.

On a CPU numba kernels give the value and its gradient in one pass, 20 to 50 times faster than torch's
convolutions. With zero padding the symmetric window is its own adjoint, so the gradient of the mean SSIM is
three more blurs of pointwise derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.scene import View

# Cached kernels would miss changes in other files: they use only these, see `kernels.jit`.
from keyss.kernels import memory, parallel
from keyss.kernels.jit import finite_kernel
from keyss.rendering.cpu.simd8 import fetch_add

C1, C2 = 0.01**2, 0.03**2
RADIUS = 5  # SSIM's 11x11 window
SIGMA = 1.5
_weights = np.exp(-(np.arange(-RADIUS, RADIUS + 1, dtype=np.float64) ** 2) / (2 * SIGMA**2))
WINDOW = (_weights / _weights.sum()).astype(np.float32)
W0, W1, W2, W3, W4, W5 = WINDOW[RADIUS:]
_C1, _C2 = np.float32(C1), np.float32(C2)
TWO = np.float32(2)
ROWS_PER_JOB = 32
TARGET_BYTES = 512 << 20


def _blur(planes: Tensor) -> Tensor:
    """Blur the last two axes of [B, H, W] with SSIM's window, zeros outside, in torch."""
    window = torch.from_numpy(WINDOW).to(planes)
    rows = F.conv2d(planes[:, None], window.view(1, 1, 1, -1), padding=(0, RADIUS))
    return F.conv2d(rows, window.view(1, 1, -1, 1), padding=(RADIUS, 0))[:, 0]


@dataclass(frozen=True)
class Target:
    """A target image and its SSIM statistics."""

    planes: Tensor  # [3, H, W] in [0, 1]
    mean: Tensor  # [3, H, W] local mean
    variance: Tensor  # [3, H, W] local variance
    mask: Tensor | None = None  # [H, W] bool: False at ignored pixels

    @staticmethod
    def of(image: Tensor, mask: Tensor | None = None) -> Target:
        """The target of an image [H, W, 3], float in [0, 1] or uint8.

        Where `mask` [H, W] is False it becomes the mean colour of the others, which SSIM's windows see.
        """
        if image.dtype == torch.uint8:
            image = image.float() / 255
        if mask is not None:
            mask = mask.to(image.device)
            image = torch.where(mask[:, :, None], image, image[mask].mean(0))
        planes = image.permute(2, 0, 1).contiguous()
        stacked = torch.cat([planes, planes * planes])
        if image.device.type == "cpu":
            blurred = torch.empty_like(stacked)
            parallel.run(_blur_cpu, stacked.numpy(), blurred.numpy())
        else:
            blurred = _blur(stacked)
        mean, square = blurred.chunk(2)
        return Target(planes, mean, square - mean * mean, mask)

    @property
    def image(self) -> Tensor:
        """[H, W, 3] the image."""
        return self.planes.permute(1, 2, 0)

    def masked(self, image: Tensor) -> Tensor:
        """`image` [H, W, 3], with the pixels of the target outside the mask."""
        return image if self.mask is None else torch.where(self.mask[:, :, None], image, self.image)


class Targets:
    """The targets of a training, cached up to TARGET_BYTES: making one takes 5 to 8 % of a step."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, Target] = {}
        self._left = TARGET_BYTES

    @staticmethod
    def max_bytes(views: Iterable[View]) -> int:
        """Bytes of the cached targets of `views`."""
        return min(TARGET_BYTES, sum(12 * view.image.numel() for view in views))

    def of(self, key: Hashable, make: Callable[[], Target]) -> Target:
        """The target that `make` returned for this `key`, or returns now."""
        if (target := self._kept.get(key)) is None:
            target = make()
            needed = 12 * target.planes.numel()  # three tensors of float32
            if needed <= self._left:
                self._kept[key] = target
                self._left -= needed
        return target


@finite_kernel
def _blur_cpu(counter: Any, source: Any, result: Any) -> None:
    """Blur the last two axes of [B, H, W] with the separable 11x11 window, zeros outside.

    Both passes process one row at a time while it is in the first-level cache, with all eleven taps in one
    expression, which LLVM turns into full-width fused multiply-adds.
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
def _similarity(counter: Any, stats: Any, target_mean: Any, target_variance: Any, row_sums: Any) -> None:
    """Row sums of the SSIM map. `stats` [9, H, W] becomes its derivatives to mean, square and product."""
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
            a1 = TWO * mean * mean_t + _C1
            a2 = TWO * covariance + _C2
            b1 = mean * mean + mean_t * mean_t + _C1
            b2 = variance + target_variance[c, y, x] + _C2
            inverse = np.float32(1) / (b1 * b2)
            s = a1 * a2 * inverse
            total += s
            stats[c, y, x] = TWO * mean_t * (a2 - a1) * inverse - TWO * mean * s * (b2 - b1) * inverse
            stats[3 + c, y, x] = -s * b1 * inverse
            stats[6 + c, y, x] = TWO * a1 * inverse
        row_sums[job] = total


@finite_kernel
def _chain(
    counter: Any, image: Any, target: Any, derivatives: Any, scales: Any, gradient: Any, row_sums: Any
) -> None:
    """gradient [H, W, 3] of scales[0] sum SSIM + scales[1] sum |x - y|, from SSIM's blurred derivatives.

    row_sums [H] becomes the sums of |x - y|. One loop computes the channels into a cached row, a second one
    interleaves them: LLVM vectorises each of the two loops, but not a single one for both.
    """
    ssim_scale, l1_scale = scales
    _, height, width = target.shape
    slopes = np.empty((3, width), np.float32)
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            break
        total = np.float32(0)
        for c in range(3):
            line = slopes[c]
            for x in range(width):
                value, other = image[y, x, c], target[c, y, x]
                slope = derivatives[c, y, x] + TWO * value * derivatives[3 + c, y, x]
                slope = ssim_scale * (slope + other * derivatives[6 + c, y, x])
                difference = value - other
                total += abs(difference)
                sign = np.float32(difference > 0) - np.float32(difference < 0)
                line[x] = slope + sign * l1_scale
        for x in range(width):
            gradient[y, x, 0] = slopes[0, x]
            gradient[y, x, 1] = slopes[1, x]
            gradient[y, x, 2] = slopes[2, x]
        row_sums[y] = total


class _PhotometricCpu(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Target, ssim_weight: float) -> Tensor:
        pixels, planes = image.detach().contiguous().numpy(), target.planes.numpy()
        _, height, width = planes.shape
        stacked = memory.empty((9, height, width), np.float32)
        stats = memory.empty((9, height, width), np.float32)
        x, squares, products = torch.from_numpy(stacked).split(3)
        x.copy_(image.permute(2, 0, 1))
        torch.mul(x, x, out=squares)
        torch.mul(x, target.planes, out=products)
        parallel.run(_blur_cpu, stacked, stats)
        similarities = np.empty(3 * height, np.float32)
        parallel.run(_similarity, stats, target.mean.numpy(), target.variance.numpy(), similarities)
        parallel.run(_blur_cpu, stats, stacked)
        gradient = memory.empty(pixels.shape, np.float32)
        differences = np.empty(height, np.float32)
        scales = np.float32(-ssim_weight / pixels.size), np.float32((1 - ssim_weight) / pixels.size)
        parallel.run(_chain, pixels, planes, stacked, scales, gradient, differences)
        ctx.save_for_backward(torch.from_numpy(gradient))
        ssim = similarities.sum(dtype=np.float64) / pixels.size
        l1 = differences.sum(dtype=np.float64) / pixels.size
        return image.new_tensor(float((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)))

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return upstream * gradient, None, None


def ssim_torch(image: Tensor, target: Target) -> Tensor:
    """`ssim` in plain torch, on any device and in any precision: the reference of the kernels."""
    planes = target.masked(image).permute(2, 0, 1)
    mean, square, product = _blur(torch.cat([planes, planes * planes, planes * target.planes])).chunk(3)
    variance = square - mean * mean
    covariance = product - mean * target.mean
    numerator = (2 * mean * target.mean + C1) * (2 * covariance + C2)
    denominator = (mean * mean + target.mean * target.mean + C1) * (variance + target.variance + C2)
    similarity = numerator / denominator
    return (similarity if target.mask is None else similarity[:, target.mask]).mean()


def ssim(image: Tensor, target: Target) -> Tensor:
    """Mean structural similarity of `image` [H, W, 3] and the target: a differentiable scalar, at most 1."""
    if target.mask is not None:
        return ssim_torch(image, target)
    return 1 - photometric_loss(image, target, 1.0)


def photometric_loss(image: Tensor, target: Target, ssim_weight: float) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) of `image` [H, W, 3] against the target, w in [0, 1].

    The mean is over all pixels; those that do not count are equal.
    """
    target, image = replace(target, mask=None), target.masked(image)
    if ssim_weight != 0 and image.device.type == "cpu":
        return _PhotometricCpu.apply(image, target, ssim_weight)  # type: ignore[no-any-return, no-untyped-call]
    loss = (image - target.image).abs().mean()
    if ssim_weight == 0:
        return loss
    return (1 - ssim_weight) * loss + ssim_weight * (1 - ssim_torch(image, target))
