"""The decoder D: maps each of the cover's Gaussians to a secret's (KeySS, section 3.2 and appendix B)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from keyss.core.gaussians import Gaussians
from keyss.methods.keyss.options import DecoderShape

FIELDS = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
DECODED_NUMBERS = 1 << 23  # maximum activations at a time: 32 MiB, even for untrusted files


class Decoder(nn.Module):
    """`decoder(cover, key)` returns D(G_cover, k) of equation 6 for the vector [key_size] of a key."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        first, second = shape.hidden
        self.common = nn.Sequential(
            nn.Linear(shape.inputs, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU()
        )
        self.branches = nn.ModuleDict(
            {
                each: nn.Sequential(
                    nn.Linear(second, shape.branch), nn.ReLU(), nn.Linear(shape.branch, shape.channels(each))
                )
                for each in shape.mask
            }
        )
        if shape.released:
            for layer in self.modules():
                if isinstance(layer, nn.Linear):
                    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                    nn.init.zeros_(layer.bias)

    def forward(self, cover: Gaussians, key: Tensor, whole: Gaussians | None = None) -> Gaussians:
        """Decode `cover`, which may be a part of `whole`."""
        features = [*self.normalize(cover, whole or cover), F.normalize(key, dim=0).expand(len(cover), -1)]
        h = self.common(torch.cat(features, dim=1))
        return self.add_residuals(cover, {name: branch(h) for name, branch in self.branches.items()})

    def normalize(self, cover: Gaussians, whole: Gaussians) -> list[Tensor]:
        """alpha, r, s, mu and c of section 3.2, each divided by its length ("L2-normalized", appendix B).

        The opacity is a single number, so normalising would leave only its sign: alpha in (0, 1) is not
        normalised. The authors' program divides raw opacities by the norm of all of them.
        """
        alpha = cover.opacities
        if self.shape.released:
            alpha = cover.opacity_logits / whole.opacity_logits.norm()
        others = (cover.quats, cover.log_scales, cover.means, cover.sh.flatten(1))
        return [alpha[:, None], *(F.normalize(values, dim=1) for values in others)]

    def add_residuals(self, cover: Gaussians, residuals: Mapping[str, Tensor]) -> Gaussians:
        """attribute* = attribute + theta . residual (equation 8), on raw attributes.

        In the authors' program, all residuals but the opacity's are clamped at 0.
        """
        changed = {}
        for name, residual in residuals.items():
            before: Tensor = getattr(cover, FIELDS[name])
            one_sided = self.shape.released and name != "op"
            changed[FIELDS[name]] = before + (F.relu(residual) if one_sided else residual).view_as(before)
        return replace(cover, **changed)

    @torch.no_grad()
    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        """`forward` in parts, to bound memory."""
        shape = self.shape
        numbers = 4 * (shape.inputs + sum(shape.hidden) + len(shape.mask) * shape.branch)
        step = max(1, DECODED_NUMBERS // numbers)
        starts = range(0, max(1, len(stego)), step)
        return Gaussians.cat([self(stego[at : at + step], key, stego) for at in starts])
