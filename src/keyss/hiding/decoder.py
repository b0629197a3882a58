"""The key-conditioned decoder: turns the cover's Gaussians into a secret's, one Gaussian at a time.

KeySS, section 3.2 and appendix: a common branch over all attributes of a Gaussian and the key, then a
branch of two layers per updated attribute whose output is added to the raw attribute. Corrections to
the published code: residuals are plain sums of either sign; every input comes from the one Gaussian
alone, standardised with constants that are fixed at the start and kept with the weights, so that
pruning or re-ordering the model changes nothing for the Gaussians that stay.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from keyss.core.gaussians import Gaussians
from keyss.hiding.mask import Mask
from keyss.seal.keys import EMBEDDING_SIZE

CHANNELS = {"op": 1, "ro": 4, "sc": 3, "xyz": 3}  # sh: three per coefficient
# Units of a residual, so that all branches learn at like speed: logits, quaternion components, natural
# logarithms of scale, scene extents, SH coefficients.
RESIDUAL_UNITS = {"op": 5.0, "ro": 1.0, "sc": 1.0, "xyz": 0.1, "sh": 0.5}
KEY_GAIN = 3.0  # lets a unit vector move the first layer as much as the attributes do


@dataclass(frozen=True, kw_only=True)
class DecoderShape:
    """Sizes of a decoder."""

    mask: Mask = ("op", "ro", "sc", "xyz")
    hidden: int = 128  # width of the two layers of the common branch
    branch: int = 32  # width of each attribute's branch
    frequencies: int = 6  # octaves of sines and cosines of the position
    sh_degree: int = 3

    @property
    def inputs(self) -> int:
        """Numbers that describe one Gaussian: 11 + 3 K attributes and 6 per octave."""
        return 11 + 3 * (self.sh_degree + 1) ** 2 + 6 * self.frequencies

    def channels(self, attribute: str) -> int:
        return CHANNELS.get(attribute, 3 * (self.sh_degree + 1) ** 2)


class Decoder(nn.Module):
    """`decoder(gaussians, embedding)` gives the Gaussians that the key's embedding [64] stands for.

    A new decoder changes nothing, whatever the key.
    """

    center: Tensor  # [3] world position that the encoding is centred on
    extent: Tensor  # [] world units of one step of position
    offset: Tensor  # [11 + 3 K] mean of the attributes at the start
    spread: Tensor  # [11 + 3 K] their standard deviation

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        attributes = shape.inputs - 6 * shape.frequencies
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))
        self.register_buffer("offset", torch.zeros(attributes))
        self.register_buffer("spread", torch.ones(attributes))
        self.first = nn.Linear(shape.inputs, shape.hidden)
        self.second = nn.Linear(shape.hidden, shape.hidden)
        self.first_key = nn.Linear(EMBEDDING_SIZE, shape.hidden, bias=False)
        self.second_key = nn.Linear(EMBEDDING_SIZE, shape.hidden, bias=False)
        self.branches = nn.ModuleDict()
        for attribute in shape.mask:
            last = nn.Linear(shape.branch, shape.channels(attribute))
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            self.branches[attribute] = nn.Sequential(nn.Linear(shape.hidden, shape.branch), nn.ReLU(), last)

    @torch.no_grad()
    def standardise(self, gaussians: Gaussians) -> None:
        """Fix the constants of the inputs from the model that training starts with."""
        self.center.copy_(gaussians.means.median(0).values)
        distance = (gaussians.means - self.center).norm(dim=1).median()
        self.extent.copy_(distance.clamp_min(1e-6))
        attributes = self._attributes(gaussians)
        self.offset.copy_(attributes.mean(0))
        # SH of a fresh model are zeros: a floor keeps them from being blown up later.
        self.spread.copy_(attributes.std(0, correction=0).clamp_min(0.1))

    def _attributes(self, gaussians: Gaussians) -> Tensor:
        position = self._contracted(gaussians.means)
        opacity = gaussians.opacity_logits[:, None]
        return torch.cat(
            [position, opacity, gaussians.quats, gaussians.log_scales, gaussians.sh.flatten(1)], dim=1
        )

    def _contracted(self, means: Tensor) -> Tensor:
        """[N, 3] in a ball of radius 2: far positions are drawn in (Mip-NeRF 360, eq. 10)."""
        position = (means - self.center) / (2 * self.extent)
        distance = position.norm(dim=1, keepdim=True).clamp_min(1e-9)
        return torch.where(distance <= 1, position, (2 - 1 / distance) * position / distance)

    def describe(self, gaussians: Gaussians) -> Tensor:
        """[N, inputs] what the decoder sees of each Gaussian; the same for every key."""
        attributes = self._attributes(gaussians)
        position = attributes[:, :3]
        octaves = 2.0 ** torch.arange(self.shape.frequencies, device=position.device) * (math.pi / 2)
        angles = (position[:, :, None] * octaves).flatten(1)
        standardised = (attributes - self.offset) / self.spread
        return torch.cat([standardised, angles.sin(), angles.cos()], dim=1)

    def forward(
        self, gaussians: Gaussians, embedding: Tensor, description: Tensor | None = None
    ) -> Gaussians:
        """Decode with the embedding [64]; `description` saves computing `describe(gaussians)` again."""
        if description is None:
            description = self.describe(gaussians)
        hidden = F.relu(self.first(description) + KEY_GAIN * self.first_key(embedding))
        hidden = F.relu(self.second(hidden) + KEY_GAIN * self.second_key(embedding))
        residuals = {name: self.branches[name](hidden) * RESIDUAL_UNITS[name] for name in self.shape.mask}
        return add_residuals(gaussians, residuals, self.extent)


def add_residuals(gaussians: Gaussians, residuals: Mapping[str, Tensor], extent: Tensor) -> Gaussians:
    """attribute* = attribute + residual (KeySS, eq. 9), on raw attributes; positions in units of `extent`."""
    means, quats, log_scales = gaussians.means, gaussians.quats, gaussians.log_scales
    opacity_logits, sh = gaussians.opacity_logits, gaussians.sh
    if "op" in residuals:
        opacity_logits = opacity_logits + residuals["op"][:, 0]
    if "ro" in residuals:
        quats = quats + residuals["ro"]
    if "sc" in residuals:
        log_scales = log_scales + residuals["sc"]
    if "xyz" in residuals:
        means = means + residuals["xyz"] * extent
    if "sh" in residuals:
        sh = sh + residuals["sh"].view_as(sh)
    return Gaussians(means, quats, log_scales, opacity_logits, sh)
