"""The decoder: turns the cover's Gaussians into a secret's, one Gaussian at a time, for one key.

KeySS, section 3.2 and appendix: attribute* = attribute + residual, on raw attributes. The residuals come
from a network: a common branch over all attributes of a Gaussian, then a branch of two layers per updated
attribute.

Corrections to the published code: residuals are plain sums of either sign, and all inputs come from the one
Gaussian, standardised with constants that are fixed at the start and stored with the weights. Pruning or
reordering the model changes nothing for the Gaussians that remain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import torch
import torch.nn.functional as F
from msgspec import Meta
from torch import Tensor, nn

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.keys.derivation import EMBEDDING_SIZE

Attribute = Literal["op", "ro", "sc", "xyz", "sh"]  # opacity, rotation, scale, position, colour
Mask = tuple[Attribute, ...]  # the paper's theta: which attributes the decoder updates
ATTRIBUTES: Mask = get_args(Attribute)
FIELDS = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
CHANNELS = {"op": 1, "ro": 4, "sc": 3, "xyz": 3}  # sh: three per coefficient
# Units of a residual, with which all branches learn about equally fast: logits, quaternion components,
# natural logarithms of scale, scene extents, SH coefficients.
RESIDUAL_UNITS = {"op": 5.0, "ro": 1.0, "sc": 1.0, "xyz": 0.1, "sh": 0.5}
KEY_GAIN = 3.0  # with it a unit vector moves the first layer as much as the attributes do
# The gate is open from this cosine between an embedding and the decoder's own. Two random unit vectors of 64
# numbers are that close less than once in 10^10 times.
GATE = 0.8
# Difference of opacity logits between two scenes at the start. Logits that matter range from -5 (0.7 %) to 6
# (99.8 %), so Gaussians that one scene shows are too faint in the others.
APART = 15.0

Width = Annotated[int, Meta(ge=1, le=4096)]  # bounds for what is read from files


def parse_mask(text: str) -> Mask:
    """The attributes in a text like `op,ro,sc`, in canonical order. Raises UsageError for unknown or none."""
    names = {name.strip() for name in text.split(",") if name.strip()}
    unknown = sorted(names - set(ATTRIBUTES))
    if unknown or not names:
        raise UsageError(
            f"mask {text!r}: expected some of {','.join(ATTRIBUTES)}, got {','.join(unknown) or 'none'}"
        )
    return tuple(name for name in ATTRIBUTES if name in names)


@dataclass(frozen=True, kw_only=True)
class DecoderShape:
    """Sizes of a decoder."""

    mask: Mask = ("op",)
    conditioning: Literal["gate", "bias"] = "gate"  # how the key enters; bias: the paper's
    hidden: tuple[Width, Width] = (64, 64)  # widths of the two layers of the common branch
    branch: Width = 32  # width of each attribute's branch
    frequencies: Annotated[int, Meta(ge=0, le=16)] = 6  # octaves of sines and cosines of the position
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    inputs: Literal["standardised", "normalised"] = "standardised"  # see `Network`
    residuals: Literal["signed", "one-sided"] = "signed"  # one-sided: ReLU on all but the opacity's

    @property
    def inputs_size(self) -> int:
        """Numbers that describe one Gaussian: 11 + 3 K attributes and 6 per octave."""
        return 11 + 3 * (self.sh_degree + 1) ** 2 + 6 * self.frequencies

    @property
    def numbers(self) -> int:
        """Upper bound of the floats held while one Gaussian is decoded, up to a factor of a few."""
        return 4 * (self.inputs_size + sum(self.hidden) + len(self.mask) * self.branch)

    @property
    def network_weights(self) -> int:
        """Weights of the network without a key's, biases not counted."""
        common = self.inputs_size * self.hidden[0] + self.hidden[0] * self.hidden[1]
        return common + sum(self.branch * (self.hidden[1] + self.channels(each)) for each in self.mask)

    def channels(self, attribute: str) -> int:
        return CHANNELS.get(attribute, 3 * (self.sh_degree + 1) ** 2)


class Decoder(nn.Module):
    """`decoder(gaussians, embedding)` returns the Gaussians that the key's embedding [64] stands for.

    A new decoder with standardised inputs changes nothing, whatever the key.
    """

    key: Tensor  # [64] the embedding that it belongs to

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.register_buffer("key", torch.zeros(EMBEDDING_SIZE))
        self.network = Network(shape)

    @torch.no_grad()
    def prepare(self, gaussians: Gaussians, embedding: Tensor) -> None:
        """Fix the key and the constants of the inputs, from the model that training starts with."""
        self.key.copy_(embedding)
        self.network.prepare(gaussians)

    def forward(self, gaussians: Gaussians, embedding: Tensor, whole: Gaussians | None = None) -> Gaussians:
        """Decode `gaussians`, some or by default all of those of the model `whole`, with the embedding."""
        # With a gate, a mistyped key shows the cover without any loss for it. Neither protects a secret:
        # whoever has the decoder has `key`, and the white-box attack (`keyss.measure`) undoes a bias.
        cosine = F.cosine_similarity(embedding.detach(), self.key, dim=0)
        if self.shape.conditioning == "gate" and cosine < GATE:
            return gaussians
        residuals = self.network(gaussians, embedding, whole or gaussians)
        return add_residuals(gaussians, residuals, self.network.extent)


class Network(nn.Module):
    """Residuals of the attributes in the mask, from all attributes of a Gaussian (KeySS, eq. 8 and 9).

    With `inputs="normalised"` it is the authors': inputs scaled to length 1, and residuals without units that
    are not zero at first. With standardised inputs it also sees where a Gaussian is and changes nothing at
    first.
    """

    center: Tensor  # [3] world position that the encoding is centred on
    extent: Tensor  # [] world units of one step of position
    offset: Tensor  # [11 + 3 K] mean of the attributes at the start
    spread: Tensor  # [11 + 3 K] their standard deviation

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        attributes = shape.inputs_size - 6 * shape.frequencies
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))
        self.register_buffer("offset", torch.zeros(attributes))
        self.register_buffer("spread", torch.ones(attributes))
        self.first = nn.Linear(shape.inputs_size, shape.hidden[0])
        self.second = nn.Linear(*shape.hidden)
        if shape.conditioning == "bias":
            self.first_key = nn.Linear(EMBEDDING_SIZE, shape.hidden[0], bias=False)
        self.branches = nn.ModuleDict()
        for attribute in shape.mask:
            last = nn.Linear(shape.branch, shape.channels(attribute))
            if shape.inputs == "standardised":
                nn.init.zeros_(last.weight)
                nn.init.zeros_(last.bias)
            self.branches[attribute] = nn.Sequential(
                nn.Linear(shape.hidden[1], shape.branch), nn.ReLU(), last
            )

    @torch.no_grad()
    def prepare(self, gaussians: Gaussians) -> None:
        """Fix the constants of the inputs."""
        if self.shape.inputs == "normalised":
            return
        self.center.copy_(gaussians.means.median(0).values)
        distance = (gaussians.means - self.center).norm(dim=1).median()
        self.extent.copy_(distance.clamp_min(1e-6))
        attributes = self._attributes(gaussians)
        self.offset.copy_(attributes.mean(0))
        # The SH of a fresh model are zeros: the floor keeps later values in range.
        self.spread.copy_(attributes.std(0, correction=0).clamp_min(0.1))

    @torch.no_grad()
    def separate(self, opaque: float, scene: int) -> None:
        """Initially show only Gaussians that are `scene` times APART fainter than a logit `opaque`.

        Their opacities get a residual of `scene` times APART, which falls to -APART for more opaque ones.
        The first two units of each layer hold how far an opacity is above the start and the end of that fall.
        """
        knots = opaque - APART * (scene - self.offset.new_tensor([0.375, 0.625]))
        third, last = (each for each in self.branches["op"].children() if isinstance(each, nn.Linear))
        for layer in (self.first, self.second, third):
            layer.weight[:2] = torch.eye(2, layer.in_features)
            layer.bias[:2] = 0.0
        self.first.weight[:2] = 0.0
        self.first.weight[:2, 3] = self.spread[3]
        self.first.bias[:2] = self.offset[3] - knots
        last.bias[0] = scene * APART / RESIDUAL_UNITS["op"]
        last.weight[0, :2] = self.offset.new_tensor([-4.0, 4.0]) * (scene + 1) / RESIDUAL_UNITS["op"]

    def forward(self, gaussians: Gaussians, embedding: Tensor, whole: Gaussians) -> dict[str, Tensor]:
        normalised = self.shape.inputs == "normalised"
        hidden = self.first(self.describe(gaussians, whole))
        if self.shape.conditioning == "bias":
            hidden = hidden + (1 if normalised else KEY_GAIN) * self.first_key(embedding)
        hidden = F.relu(self.second(F.relu(hidden)))
        residuals = {}
        for name, branch in self.branches.items():
            residual = branch(hidden) * (1 if normalised else RESIDUAL_UNITS[name])
            one_sided = self.shape.residuals == "one-sided" and name != "op"
            residuals[name] = F.relu(residual) if one_sided else residual
        return residuals

    def describe(self, gaussians: Gaussians, whole: Gaussians) -> Tensor:
        """[N, inputs] what the network sees of each Gaussian."""
        if self.shape.inputs == "normalised":
            return _normalised(gaussians, whole)
        attributes = self._attributes(gaussians)
        position = attributes[:, :3]
        octaves = 2.0 ** torch.arange(self.shape.frequencies, device=position.device) * (math.pi / 2)
        angles = (position[:, :, None] * octaves).flatten(1)
        standardised = (attributes - self.offset) / self.spread
        return torch.cat([standardised, angles.sin(), angles.cos()], dim=1)

    def _attributes(self, gaussians: Gaussians) -> Tensor:
        position = self._contracted(gaussians.means)
        opacity = gaussians.opacity_logits[:, None]
        return torch.cat(
            [position, opacity, gaussians.quats, gaussians.log_scales, gaussians.sh.flatten(1)], dim=1
        )

    def _contracted(self, means: Tensor) -> Tensor:
        """[N, 3] in a ball of radius 2: far positions are contracted (Mip-NeRF 360, eq. 10)."""
        position = (means - self.center) / (2 * self.extent)
        distance = position.norm(dim=1, keepdim=True).clamp_min(1e-9)
        return torch.where(distance <= 1, position, (2 - 1 / distance) * position / distance)


def _normalised(gaussians: Gaussians, whole: Gaussians) -> Tensor:
    """[N, 11 + 3 K] attributes scaled to length 1, as the authors' code has them (KeySS, appendix).

    The opacities of the whole model are one vector; every other attribute is one vector per Gaussian.
    """
    attributes = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.sh.flatten(1))
    means, *others = (F.normalize(values, dim=1) for values in attributes)
    opacities = (gaussians.opacity_logits / whole.opacity_logits.norm())[:, None]
    return torch.cat([means, opacities, *others], dim=1)


def add_residuals(gaussians: Gaussians, residuals: Mapping[str, Tensor], extent: Tensor) -> Gaussians:
    """attribute* = attribute + residual (KeySS, eq. 9), on raw attributes; positions in units of `extent`."""
    changed = {}
    for attribute, residual in residuals.items():
        before: Tensor = getattr(gaussians, FIELDS[attribute])
        step = residual * extent if attribute == "xyz" else residual
        changed[FIELDS[attribute]] = before + step.view_as(before)
    return replace(gaussians, **changed)
