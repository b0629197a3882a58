"""How often which values occur in a published model, and in control models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from keyss.core.gaussians import SH_C0, Gaussians

BINS = 48


@dataclass(frozen=True)
class Histogram:
    """Shares of Gaussians by the value of a quantity. Raises ValueError unless edges rise and lengths fit."""

    edges: tuple[float, ...]  # one more than there are shares
    stego: tuple[float, ...]
    controls: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        fits = all(len(shares) == len(self.edges) - 1 for shares in (self.stego, *self.controls))
        if not fits or any(a >= b for a, b in pairwise(self.edges)):
            raise ValueError("expected rising edges, and one share fewer in each histogram")


def histograms(stego: Gaussians, controls: Sequence[Gaussians]) -> dict[str, Histogram]:
    """By quantity, histograms with BINS bins.

    The range is that of the middle 99.8 % of all models; what lies outside counts at its ends.
    """
    found = {}
    quantities = [_quantities(model) for model in (stego, *controls)]
    for name in quantities[0]:
        values = [each[name].detach().cpu().double().nan_to_num() for each in quantities]
        together = torch.cat(values).sort().values
        low, high = (float(together[int(share * (len(together) - 1))]) for share in (0.001, 0.999))
        edges = torch.linspace(low, max(high, low + 1e-9), BINS + 1, dtype=torch.float64)
        shares = [_shares(each, edges) for each in values]
        found[name] = Histogram(tuple(edges.tolist()), shares[0], tuple(shares[1:]))
    return found


def _quantities(model: Gaussians) -> dict[str, Tensor]:
    """[N] each, in units that a person can read."""
    middle = model.means.median(0).values
    log_scales = model.log_scales.sort(dim=1).values
    energy = model.sh[:, 1:].square().sum((1, 2)) if model.sh_degree else torch.zeros(len(model))
    return {
        "opacity (logit)": model.opacity_logits.clamp(-15, 15),
        "distance from the middle (log10)": (model.means - middle).norm(dim=1).clamp_min(1e-9).log10(),
        "largest scale (log10)": log_scales[:, 2] / torch.log(torch.tensor(10.0)),
        "elongation (log10)": (log_scales[:, 2] - log_scales[:, 0]) / torch.log(torch.tensor(10.0)),
        "length of the quaternion": model.quats.norm(dim=1),
        "brightness": (model.sh[:, 0] * SH_C0 + 0.5).mean(1),
        "energy of the harmonics (log10)": energy.clamp_min(1e-12).log10(),
    }


def _shares(values: Tensor, edges: Tensor) -> tuple[float, ...]:
    inside = values.clamp(float(edges[0]), float(edges[-1]))
    counts = torch.histogram(inside, edges).hist
    return tuple(round(float(count), 6) for count in counts / max(len(values), 1))
