from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from keyss.core import View
from keyss.fitting import Target, photometric_loss, psnr, quality, ssim, ssim_torch
from keyss.rendering import render
from tiny_scenes import random_gaussians, ring_cameras


def _images(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


def _ssim_by_definition(a: torch.Tensor, b: torch.Tensor, mask: torch.Tensor | None = None) -> float:
    """Wang et al. 2004, window by window in float64, zero-padded."""
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    weights = torch.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    weights = (weights / weights.sum())[..., None]
    pad = (0, 0, 5, 5, 5, 5)
    a, b = (torch.nn.functional.pad(x.double(), pad) for x in (a, b))
    values = []
    for y in range(a.shape[0] - 10):
        for x in range(a.shape[1] - 10):
            p, q = a[y : y + 11, x : x + 11], b[y : y + 11, x : x + 11]
            mp, mq = (weights * p).sum((0, 1)), (weights * q).sum((0, 1))
            vp, vq = (weights * p * p).sum((0, 1)) - mp**2, (weights * q * q).sum((0, 1)) - mq**2
            cov = (weights * p * q).sum((0, 1)) - mp * mq
            c1, c2 = 0.01**2, 0.03**2
            values.append(
                ((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))).mean()
            )
    found = torch.stack(values)
    return float((found if mask is None else found[mask.flatten()]).mean())


def test_ssim() -> None:
    a, b = _images(17, 14)
    expected = _ssim_by_definition(a, b)
    assert float(ssim(a, Target.of(b))) == pytest.approx(expected, abs=2e-6)
    assert float(ssim_torch(a, Target.of(b))) == pytest.approx(expected, abs=2e-6)


def test_quality_with_mask() -> None:
    """The photo is a render where the mask is True, and noise elsewhere."""
    model, camera = random_gaussians(), ring_cameras(1)[0]
    image = (render(model, camera).clamp(0, 1) * 255).round().to(torch.uint8)
    mask = torch.rand(image.shape[:2], generator=torch.Generator().manual_seed(1)) > 0.3
    noise = torch.randint(0, 256, image.shape, generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    view = View(camera, torch.where(mask[:, :, None], image, noise), mask=mask)
    found = quality(model, [view], torch.zeros(3))
    expected = (render(model, camera).clamp(0, 1) - image / 255)[mask].square().mean()
    assert found.psnr == pytest.approx(float(-10 * expected.log10()), abs=1e-3)
    assert found.ssim > 0.999
    assert quality(model, [replace(view, mask=None)], torch.zeros(3)).ssim < 0.9


def test_ssim_with_mask() -> None:
    """Windows contain the mean colour where the mask is False."""
    a, b = _images(17, 14)
    mask = torch.rand(17, 14, generator=torch.Generator().manual_seed(3)) > 0.3
    mean = b[mask].mean(0)
    filled = [torch.where(mask[..., None], each, mean) for each in (a, b)]
    expected = _ssim_by_definition(*filled, mask)
    assert float(ssim(a, Target.of(b, mask))) == pytest.approx(expected, abs=2e-6)
    assert expected != pytest.approx(_ssim_by_definition(a, b), abs=1e-3)


@settings(deadline=None, max_examples=20)
@given(st.integers(1, 70), st.integers(1, 40), st.integers(0, 99))
def test_ssim_gradient(height: int, width: int, seed: int) -> None:
    a, b = _images(height, width, seed)
    fast = a.clone().requires_grad_()
    slow = a.double().requires_grad_()
    target = Target.of(b)
    double = Target(*(getattr(target, name).double() for name in ("planes", "mean", "variance")))
    value, reference = ssim(fast, target), ssim_torch(slow, double)
    (3 * value).backward()
    (3 * reference).backward()
    assert value.item() == pytest.approx(reference.item(), abs=2e-5)
    assert fast.grad is not None
    assert slow.grad is not None
    scale = slow.grad.abs().max()
    assert (fast.grad - slow.grad).abs().max() <= 2e-4 * scale


def test_photometric_loss() -> None:
    a, b = _images(24, 24)
    target = Target.of(b)
    l1 = float((a - b).abs().mean())
    assert float(photometric_loss(a, target, 0)) == pytest.approx(l1)
    assert float(photometric_loss(a, target, 1)) == pytest.approx(1 - float(ssim(a, target)), abs=1e-6)
    mixed = float(photometric_loss(a, target, 0.2))
    assert mixed == pytest.approx(0.8 * l1 + 0.2 * (1 - float(ssim(a, target))), abs=1e-6)


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_photometric_loss_gradient(weight: float) -> None:
    a, b = _images(37, 29)
    a[:5] = b[:5]  # |x| is not differentiable at 0
    target = Target.of(b)
    fast, slow = a.clone().requires_grad_(), a.clone().requires_grad_()
    (3 * photometric_loss(fast, target, weight)).backward()
    (3 * ((1 - weight) * (slow - b).abs().mean() + weight * (1 - ssim_torch(slow, target)))).backward()
    assert fast.grad is not None
    assert slow.grad is not None
    assert (fast.grad - slow.grad).abs().max() <= 1e-5 * slow.grad.abs().max()


def test_psnr() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-0.5, 1.5, (2, 7, 5, 3))
    error = np.mean((a.clip(0, 1) - b.clip(0, 1)) ** 2)
    assert psnr(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(-10 * np.log10(error))
    assert psnr(torch.from_numpy(a), torch.from_numpy(a)) == pytest.approx(120)  # instead of infinity
