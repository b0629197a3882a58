"""A secret of the designs with a network: revealing it, and its bytes, the payload.

The payload holds the decoder (a network's weights in half precision, all constants in single) with the
embedding that it belongs to, the similarity from the secret's own frame, and *anchors*: positions of some
Gaussians of the stego model. Anchors are found in any order and, mostly, after pruning. In a model without
them, which was moved or rounded, the decoder may still be found in appended Gaussians, but reveals nothing.
The bytes of a secret say nothing of other secrets. docs/format.md lists them.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.channels import Content, Payload, is_appended
from keyss.core.errors import InputError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians, compensate_pruning
from keyss.core.similarity import Similarity
from keyss.methods.keyss import rows
from keyss.methods.keyss.decoder import Decoder, DecoderShape, parse_mask
from keyss.methods.keyss.rows import RowSecret
from keyss.methods.opened import Frame, Remains
from keyss.methods.tensors import Header, damage_refused, pack_tensors, unpack_tensors

NAME = "keyss"
FORMAT, VERSION = "keyss-secret", 8
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # share that must be found again
ANCHOR_TOLERANCE = 1e-6  # of the model's size
_DECODED_NUMBERS = 1 << 23  # held at a time: 32 MiB, whatever sizes a file gives its decoder
_SLACK = 0.01  # share of the Gaussians that rounding may make visible or invisible
_WEIGHTS = "decoder."


@dataclass(frozen=True)
class _Header(Header):
    """msgspec holds it to these types and bounds."""

    shape: DecoderShape
    frame: Similarity
    count: Annotated[int, Meta(ge=0, le=2**31)]


@dataclass(frozen=True)
class HiddenSecret:
    """Everything beside the stego model that reveals one secret; see `keyss.methods.opened.Opened`."""

    decoder: Decoder
    frame: Similarity  # from the secret's own frame into the cover's
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model
    count: int = 0  # Gaussians that the secret has when it is revealed from a whole file; 0: not known
    chunks: tuple[int, int] | None = None  # see `Payload`; not part of what is packed

    def payload(self) -> Payload:
        """The payload for a channel; the same secret gives the same bytes."""
        header = _Header(FORMAT, VERSION, self.decoder.shape, self.frame, self.count)
        halved = {name for name, _ in self.decoder.named_parameters()}
        tensors = {
            _WEIGHTS + name: value.half() if name in halved else value
            for name, value in self.decoder.state_dict().items()
        }
        return Payload(NAME, pack_tensors({**tensors, "anchors": self.anchors}, header))

    @staticmethod
    def of(content: Content) -> HiddenSecret:
        """What `payload` gave. Raises InputError for anything else, for damage, and another version."""
        with damage_refused("the payload is no secret of keyss, or damaged"):
            if not isinstance(content, Payload):
                raise ValueError("expected one string of bytes, got records")
            header, tensors = unpack_tensors(content.data, _Header, FORMAT, VERSION)
            if parse_mask(",".join(header.shape.mask)) != header.shape.mask:
                raise ValueError("its mask is in another order")
            if not {value.dtype for value in tensors.values()} <= {torch.float16, torch.float32}:
                raise ValueError("expected numbers of half or single precision")
            anchors = tensors.pop("anchors").float()
            if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
                raise ValueError(f"expected up to {ANCHORS} anchors, got shape {list(anchors.shape)}")
            decoder = Decoder(header.shape)
            decoder.load_state_dict({name.removeprefix(_WEIGHTS): value for name, value in tensors.items()})
        numbers = header.count, content.chunks
        return HiddenSecret(decoder.requires_grad_(False), header.frame, anchors, *numbers)

    @torch.no_grad()
    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """A model that needs no decoder and no cover, without invisible Gaussians; see `Opened.reveal`.

        If Gaussians were lost, the others make up for them.
        """
        if not force:
            self.check_unchanged(stego)
        decoded = self.decode(stego, self.embedding)
        if (visible := decoded.opacities >= DRAWN_OPACITY).any():
            decoded = compensate_pruning(decoded[visible], self.count)
        decoded = decoded.to("cpu")
        return decoded if frame == "cover" else self.frame.inverse().apply_gaussians(decoded)

    def decode(self, stego: Gaussians, embedding: Tensor) -> Gaussians:
        """The decoder's output for `stego` and an embedding [64]; see `Opened.decode`.

        Appended Gaussians are left out: they came after the training.
        """
        decoder, embedding = self.decoder.to(stego.device), embedding.to(stego.device)
        stego = stego[~is_appended(stego)].with_sh_degree(decoder.shape.sh_degree)
        if torch.is_grad_enabled():
            return decoder(stego, embedding)  # type: ignore[no-any-return]
        step = max(1, _DECODED_NUMBERS // decoder.shape.numbers)
        starts = range(0, max(1, len(stego)), step)
        return Gaussians.cat([decoder(stego[at : at + step], embedding, stego) for at in starts])

    def remains(self, revealed: Gaussians) -> Remains:
        """See `Opened.remains`; Gaussians that are never rendered do not count."""
        found = int((revealed.opacities >= DRAWN_OPACITY).sum())
        return Remains(found, self.count, self.chunks, _SLACK)

    def fingerprint(self) -> str:
        return hashlib.sha256(self.payload().data).hexdigest()[:16]

    @property
    def embedding(self) -> Tensor:
        """[64] what its key is to the decoder."""
        return self.decoder.key

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


def choose_anchors(stego: Gaussians, generator: torch.Generator) -> Tensor:
    """[A, 3] positions of randomly chosen Gaussians."""
    return stego.means[torch.randperm(len(stego), generator=generator)[:ANCHORS]].detach().cpu()


def unpack(content: Content) -> HiddenSecret | RowSecret:
    """The secret, whose version tells which design it is of. Raises InputError."""
    carriers = isinstance(content, Payload) and rows.MARK in content.data[:512]
    return RowSecret.of(content) if carriers else HiddenSecret.of(content)
