"""Files with one detectable weakness each, and plain models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from channels.lsb.trained_like import rounded, trained_like
from keyss.core import Gaussians

COUNT = 3000


def plain(seed: int, count: int = COUNT) -> Gaussians:
    """Harmonics of many magnitudes, large Gaussians last, no opacity below 0.005."""
    model = trained_like(count, seed)
    generator = torch.Generator().manual_seed(1000 + seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    # Double precision, rounded once: single precision gives other last bits on other processors.
    strength = torch.exp(2.0 * normal(count, 1, 1) - 3.0)
    sh = torch.cat([model.sh[:, :1], (model.sh[:, 1:] * strength).float()], dim=1)
    # Low bits of their own, for subtracting leaves zeros in numbers near 0.
    noise = 1e-5 * normal(count)
    logits = model.opacity_logits.double().abs() * 2.5 - 5.2 + noise
    model = replace(model, sh=sh, opacity_logits=logits.float())
    first = model.log_scales.double().mean(1) + normal(count)
    return model[first.argsort()]


def plain_rounded(seed: int) -> Gaussians:
    """A plain model of a trainer that rounds steps."""
    return rounded(plain(seed), seed)


def overwritten(model: Gaussians, seed: int = 0, bits: int = 8) -> Gaussians:
    """Random bits 1 to `bits` in all scales, quaternions, opacities and harmonics."""
    random = np.random.default_rng(seed)

    def new(values: torch.Tensor) -> torch.Tensor:
        words = values.contiguous().numpy().view(np.uint32)
        mask = np.uint32(((1 << bits) - 1) << 1)
        noise = random.integers(0, 1 << 31, words.shape, dtype=np.uint32)
        return torch.from_numpy((words & ~mask | noise & mask).view(np.float32))

    return replace(
        model,
        log_scales=new(model.log_scales),
        quats=new(model.quats),
        opacity_logits=new(model.opacity_logits),
        sh=torch.cat([model.sh[:, :1], new(model.sh[:, 1:])], dim=1),
    )


def normalised(model: Gaussians) -> Gaussians:
    """Unit quaternions, as some tools write them."""
    return replace(model, quats=torch.nn.functional.normalize(model.quats.double(), dim=1).float())


def grey(model: Gaussians) -> Gaussians:
    """A third of the Gaussians with grey harmonics."""
    sh = model.sh.clone()
    sh[::3, 1:] = sh[::3, 1:, :1]
    return replace(model, sh=sh)


def with_siblings(model: Gaussians) -> Gaussians:
    """Split every tenth Gaussian: halves differ in position and scale only."""
    halves = model[::10]
    moved = replace(halves, means=halves.means + 1e-3, log_scales=halves.log_scales - 0.47)
    return Gaussians.cat([model, moved])


def banded(model: Gaussians, *secrets: Gaussians) -> Gaussians:
    """Append secrets with invisible opacities, each in its own band and frame."""
    turned = []
    for index, secret in enumerate(secrets):
        logits = -8.2 - 3.7 * index + 0.25 * secret.opacity_logits.clamp(-4, 6)
        means = secret.means @ torch.linalg.qr(torch.ones(3, 3) + torch.eye(3)).Q + 1.0
        turned.append(replace(secret, means=means, opacity_logits=logits))
    return Gaussians.cat([model, *turned])


def shuffled(model: Gaussians, seed: int = 0) -> Gaussians:
    order: npt.NDArray[np.int64] = np.random.default_rng(seed).permutation(len(model))
    return model[torch.from_numpy(order)]
