"""The decoder D: turns the cover's Gaussians into a secret's, one by one, told by the key which secret.

KeySS, section 3.2 and appendix B.
"""

from __future__ import annotations

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
Mask = tuple[Attribute, ...]  # the attributes where theta (equation 8) is 1
ATTRIBUTES: Mask = get_args(Attribute)
FIELDS = {"op": "opacity_logits", "ro": "quats", "sc": "log_scales", "xyz": "means", "sh": "sh"}
CHANNELS = {"op": 1, "ro": 4, "sc": 3, "xyz": 3}  # sh: three per coefficient
DECODED_NUMBERS = 1 << 23  # held at a time: 32 MiB, whatever sizes a file gives its decoder

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
    """Kind and sizes of a decoder; appendix B: two layers for the common branch, two for each other."""

    kind: Annotated[str, Meta(min_length=1, max_length=32)] = (
        "mlp"  # see `keyss.methods.keyss.secret.DECODERS`
    )
    mask: Mask = ATTRIBUTES  # theta
    hidden: tuple[Width, Width] = (64, 128)  # of the common branch; their program's, the paper gives none
    branch: Width = 64  # of each attribute's branch
    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 3
    key_size: Width = EMBEDDING_SIZE  # numbers of a key's vector
    # Their program's inputs, residuals, start of the weights and training instead of the text's.
    released: bool = False
    secrets: Annotated[int, Meta(ge=1, le=9)] = 1  # of the model
    secret: Annotated[int, Meta(ge=0, le=8)] = 0  # which of them, if each has its own decoder

    def sized(self, sh_degree: int, key_size: int, secrets: int) -> DecoderShape:
        """The same for models of that SH degree, keys of so many numbers and so many secrets."""
        return replace(self, sh_degree=sh_degree, key_size=key_size, secrets=secrets)

    @property
    def inputs(self) -> int:
        """Numbers that describe one Gaussian and a key."""
        return 11 + 3 * (self.sh_degree + 1) ** 2 + self.key_size

    def channels(self, attribute: str) -> int:
        return CHANNELS.get(attribute, 3 * (self.sh_degree + 1) ** 2)

    @property
    def weights(self) -> int:
        """Weights that are multiplied to decode one Gaussian, without biases."""
        if self.kind == "latent":
            return 0
        first, second = self.hidden
        branches = sum(self.branch * (second + self.channels(each)) for each in self.mask)
        return self.inputs * first + first * second + branches


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
        """Decode `cover`, which may be a part of the model `whole`."""
        features = [*self.normalized(cover, whole or cover), F.normalize(key, dim=0).expand(len(cover), -1)]
        h = self.common(torch.cat(features, dim=1))
        return self.updated(cover, {name: branch(h) for name, branch in self.branches.items()})

    def normalized(self, cover: Gaussians, whole: Gaussians) -> list[Tensor]:
        """alpha, r, s, mu and c of section 3.2, each divided by its length ("L2-normalized", appendix B).

        Of the opacity, a single number, that would leave the sign: alpha in (0, 1) goes in as it is. Their
        program divides all raw opacities by the length of the vector of all.
        """
        alpha = cover.opacities
        if self.shape.released:
            alpha = cover.opacity_logits / whole.opacity_logits.norm()
        others = (cover.quats, cover.log_scales, cover.means, cover.sh.flatten(1))
        return [alpha[:, None], *(F.normalize(values, dim=1) for values in others)]

    def updated(self, cover: Gaussians, residuals: Mapping[str, Tensor]) -> Gaussians:
        """attribute* = attribute + theta . residual (equation 8), on raw attributes.

        In their program, residuals of all but the opacity are at least 0.
        """
        changed = {}
        for name, residual in residuals.items():
            before: Tensor = getattr(cover, FIELDS[name])
            one_sided = self.shape.released and name != "op"
            changed[FIELDS[name]] = before + (F.relu(residual) if one_sided else residual).view_as(before)
        return replace(cover, **changed)

    @torch.no_grad()
    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        """`forward`, in parts."""
        shape = self.shape
        numbers = 4 * (shape.inputs + sum(shape.hidden) + len(shape.mask) * shape.branch)
        step = max(1, DECODED_NUMBERS // numbers)
        starts = range(0, max(1, len(stego)), step)
        return Gaussians.cat([self(stego[at : at + step], key, stego) for at in starts])
