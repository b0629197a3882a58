"""Models whose values look as after training, made in milliseconds."""

from __future__ import annotations

from dataclasses import replace

import torch

from keyss.core import Gaussians


def trained_like(count: int, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """Normal numbers of the magnitudes that training gives, every bit of their mantissas random.

    Drawn in double precision and rounded once, so that they do not differ in the last bits from one processor
    to the next.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int, mean: float = 0.0, spread: float = 1.0) -> torch.Tensor:
        return (mean + spread * torch.randn(*shape, generator=generator, dtype=torch.float64)).float()

    return Gaussians(
        means=normal(count, 3, spread=2.0),
        quats=normal(count, 4),
        log_scales=normal(count, 3, mean=-4.0),
        opacity_logits=normal(count, spread=2.0),
        sh=normal(count, (sh_degree + 1) ** 2, 3, spread=0.1),
    )


def rounded(model: Gaussians, seed: int = 0, step: float = 4e-5) -> Gaussians:
    """`model` as trainers leave it that round an optimiser's last step before they subtract it.

    Harmonics smaller than the step keep the grid of the larger number that they came from: below 2^-15, bits
    0 to 3 are ones in 22, 33, 43 and 47 % of the cases; 22, 37, 42 and 48 % in a model trained in that way.
    """
    generator = torch.Generator().manual_seed(seed)
    steps = (step * torch.randn(model.sh[:, 1:].shape, generator=generator, dtype=torch.float64)).float()
    return replace(model, sh=torch.cat([model.sh[:, :1], (model.sh[:, 1:] + steps) - steps], dim=1))


def _half_precision(model: Gaussians) -> Gaussians:
    return model.map(lambda values: values.half().float())


def _eight_bits(model: Gaussians) -> Gaussians:
    return model.map(lambda values: (values * 16).round() / 16 * 1.1)


def _moved(model: Gaussians) -> Gaussians:
    return replace(model, log_scales=model.log_scales * 2**-14 + 3.0)


# What leaves no natural low bits.
UNNATURAL = (_half_precision, _eight_bits, _moved)
