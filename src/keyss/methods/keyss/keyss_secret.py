"""A hidden secret, and its payload, which a channel encrypts with the secret's key.

The payload holds the decoder (weights in half precision, constants in single), the vector of the key, the
similarity from the secret's frame to the cover's, and *anchors*: positions of some Gaussians of the stego
model, to detect a moved or rounded model. docs/byte-layout.md lists the bytes.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.channels import Payload, is_appended
from keyss.core.errors import InputError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.similarity import Similarity
from keyss.methods.hidden import Frame, HiddenScene, Remains
from keyss.methods.keyss.decoder import DECODERS, Decoder
from keyss.methods.keyss.keyss_options import DecoderShape, parse_mask
from keyss.methods.tensors import Header, pack_tensors, refuse_damage, unpack_tensors

NAME = "keyss"
FORMAT, VERSION = "keyss-secret", 10
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # minimum share found
ANCHOR_TOLERANCE = 1e-6  # fraction of the model's size
_SLACK = 0.01  # share of the Gaussians that rounding may make visible or invisible
_WEIGHTS = "decoder."
_GROWTH = 0.25  # exponent; the best of 0 to 0.5 on the scenes bonsai and fox with 25 and 50 % lost
_LEAST_LEFT, _COMPLETE = 0.1, 0.99  # shares; smaller ones are compensated like 10 %, larger ones not at all


@dataclass(frozen=True)
class _Header(Header):
    """Types and bounds that msgspec checks."""

    shape: DecoderShape
    frame: Similarity
    count: Annotated[int, Meta(ge=0, le=2**31)]
    visibility: Annotated[float, Meta(ge=0)]


@dataclass(frozen=True)
class KeyssSecret(HiddenScene):
    """Everything beside the stego model that reveals one secret."""

    decoder: Decoder
    key: Tensor = field(repr=False)  # [K] the vector of its key
    frame: Similarity  # secret frame to cover frame
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model
    count: int = 0  # Gaussians revealed from a complete file; 0: unknown
    visibility: float = 0.0  # sum of opacities, revealed from a complete file
    chunks: tuple[int, int] | None = None  # see `Payload`; not packed

    def payload(self) -> Payload:
        """The payload for a channel; the same secret gives the same bytes."""
        header = _Header(FORMAT, VERSION, self.decoder.shape, self.frame, self.count, self.visibility)
        halved = {name for name, _ in self.decoder.named_parameters()}
        tensors = {
            _WEIGHTS + name: value.half() if name in halved else value
            for name, value in self.decoder.state_dict().items()
        }
        return Payload(NAME, pack_tensors({**tensors, "key": self.key, "anchors": self.anchors}, header))

    @staticmethod
    def of(payload: Payload) -> KeyssSecret:
        """Read a payload. Raises InputError for other data, damage and another version."""
        with refuse_damage("the payload is no secret of keyss, or damaged"):
            header, tensors = unpack_tensors(payload.data, _Header, FORMAT, VERSION)
            shape = header.shape
            if parse_mask(",".join(shape.mask)) != shape.mask:
                raise ValueError("its mask is in another order")
            if shape.kind not in DECODERS:
                raise InputError(
                    f"the secret needs a decoder of kind {shape.kind!r}, and this program has "
                    f"{', '.join(DECODERS)}: import the module that adds it to `DECODERS` first"
                )
            if sum(value.numel() for value in tensors.values()) < shape.weights:
                raise ValueError("its decoder has more weights than the payload")
            anchors, key = tensors.pop("anchors").float(), tensors.pop("key").float()
            if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
                raise ValueError(f"expected up to {ANCHORS} anchors, got shape {list(anchors.shape)}")
            if key.shape != (shape.key_size,):
                raise ValueError(f"expected a key of {shape.key_size} numbers, got {list(key.shape)}")
            decoder = DECODERS[shape.kind](shape)
            decoder.load_state_dict({name.removeprefix(_WEIGHTS): value for name, value in tensors.items()})
        return KeyssSecret(
            decoder.requires_grad_(False), key, header.frame, anchors, header.count, header.visibility,
            payload.chunks,
        )  # fmt: skip

    @torch.no_grad()
    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """The secret as a standalone model, without invisible Gaussians; see `HiddenScene.reveal`.

        If Gaussians were lost, the others are enlarged to compensate.
        """
        if not force:
            self.check_unchanged(stego)
        decoded = self.decode(stego, self.key)
        if decoded is stego:
            raise InputError(
                "the harmonics of the model were changed since the secret was hidden in them: none of its "
                "Gaussians opens"
            )
        decoded = decoded.to("cpu")
        if (visible := decoded.opacities >= DRAWN_OPACITY).any():
            decoded = decoded[visible]
        left = min(1.0, visibility(decoded)[1] / max(self.visibility, 1e-9))
        decoded = compensate_pruning(decoded, left)
        return decoded if frame == "cover" else self.frame.inverse().apply_gaussians(decoded)

    def decode(self, stego: Gaussians, key: Tensor) -> Gaussians:
        """D(stego, k) for the vector [K] of a key, or `stego` itself if the key opens no row.

        Appended Gaussians are left out: they were added after the training.
        """
        decoder, key = self.decoder.to(stego.device), key.to(stego.device)
        own = stego[~is_appended(stego)].with_sh_degree(decoder.shape.sh_degree)
        decoded: Gaussians = decoder(own, key) if torch.is_grad_enabled() else decoder.decode(own, key)
        return stego if decoded is own else decoded

    def remains(self, revealed: Gaussians) -> Remains:
        """See `HiddenScene.remains`; Gaussians that are never rendered do not count."""
        return Remains(visibility(revealed)[0], self.count, self.chunks, _SLACK)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.payload().data).hexdigest()[:16]

    @property
    def key_size(self) -> int:
        """Numbers of a key's vector."""
        return len(self.key)

    def check_unchanged(self, stego: Gaussians) -> None:
        """Raise InputError unless enough anchors are Gaussians of `stego`."""
        means = stego.means.detach().double().cpu().numpy()
        size = float(np.ptp(means, axis=0).max())
        distances, _ = cKDTree(means).query(self.anchors.double().numpy())
        found = float((distances <= ANCHOR_TOLERANCE * size).mean())
        if found < ANCHORS_NEEDED:
            raise InputError(
                "the model was moved or rounded since its decoder was trained, or it is another one: "
                f"{found:.0%} of the decoder's anchors are there, at least {ANCHORS_NEEDED:.0%} expected "
                "(`force=True` tries all the same)"
            )


def choose_anchors(stego: Gaussians, seed: int) -> Tensor:
    """[A, 3] positions of randomly chosen Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    return stego.means[torch.randperm(len(stego), generator=generator)[:ANCHORS]].detach().cpu()


def visibility(model: Gaussians) -> tuple[int, float]:
    """The number of visible Gaussians, and the sum of their opacities."""
    visible = model.opacities[model.opacities >= DRAWN_OPACITY]
    return len(visible), float(visible.double().sum())


def compensate_pruning(gaussians: Gaussians, left: float) -> Gaussians:
    """Enlarge the Gaussians that are `left` of a pruned model, a share, and raise their opacities.

    Opacities become 1 - (1 - opacity)^(1 / left), and the standard deviations grow by left^-0.25. With a
    quarter of a model left, this recovers 0.4 to 1 dB of the 2 to 4 dB lost.
    """
    if left >= _COMPLETE:
        return gaussians
    share = max(left, _LEAST_LEFT)
    transmittance = (1 - gaussians.opacities.double()).clamp(1e-7, 1 - 1e-7) ** (1 / share)
    return replace(
        gaussians,
        opacity_logits=torch.logit(1 - transmittance.clamp_min(1e-7)).float(),
        log_scales=gaussians.log_scales + _GROWTH * math.log(1 / share),
    )
