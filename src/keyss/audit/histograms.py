"""How often which values occur in a published model, and in plain ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from keyss.core.gaussians import SH_C0, Gaussians

BINS = 48


def histograms(stego: Gaussians, plains: Sequence[Gaussians]) -> dict[str, Any]:
    """By quantity: BINS + 1 edges, and the shares of Gaussians between them in each of the models.

    The range is that of the middle 99.8 % of all models; what lies outside counts at its ends.
    """
    found = {}
    quantities = [_quantities(model) for model in (stego, *plains)]
    for name in quantities[0]:
        values = [each[name].detach().cpu().double().nan_to_num() for each in quantities]
        together = torch.cat(values).sort().values
        low, high = (float(together[rank]) for rank in _ranks(len(together)))
        edges = torch.linspace(low, max(high, low + 1e-9), BINS + 1, dtype=torch.float64)
        shares = [_shares(each, edges) for each in values]
        found[name] = {"edges": edges.tolist(), "stego": shares[0], "plain": shares[1:]}
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


def _ranks(count: int) -> tuple[int, int]:
    return int(0.001 * (count - 1)), int(0.999 * (count - 1))


def _shares(values: Tensor, edges: Tensor) -> list[float]:
    inside = values.clamp(float(edges[0]), float(edges[-1]))
    counts = torch.histogram(inside, edges).hist
    return [round(float(count), 6) for count in counts / max(len(values), 1)]
