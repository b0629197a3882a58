"""A secret of the learned method: what it reveals of a stego model, and its bytes, the payload.

The payload is safetensors, nothing executable. It holds the decoder (a network's weights in half precision,
all constants whole) with the embedding that it belongs to, the similarity that leads back to the secret's own
frame, and *anchors*: positions of some Gaussians of the stego model. They are there in any order and, mostly,
after pruning, and tell whether the model was moved or rounded, which a decoder does not survive although
appended Gaussians do. A secret's bytes say nothing of other secrets. docs/format.md lists them.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
import safetensors
import safetensors.torch
import torch
from msgspec import Meta
from scipy.spatial import cKDTree
from torch import Tensor

from keyss.channels.appended import is_appended
from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.similarity import Similarity
from keyss.methods.base import Frame, Remains
from keyss.methods.learned.decoder import Decoder, DecoderShape, parse_mask

FORMAT, VERSION = "keyss-secret", 7
ANCHORS = 64
ANCHORS_NEEDED = 0.25  # share that must be found again
ANCHOR_TOLERANCE = 1e-6  # of the model's size
_DECODED_NUMBERS = 1 << 23  # that a decoder holds at a time: 32 MiB, for its sizes are the file's
_SLACK = 0.01  # of the Gaussians: rounding takes some over the limit of what is drawn, and others back
_WEIGHTS = "decoder."
# What reading a damaged header or damaged weights can raise.
_LIBRARY_ERRORS = (safetensors.SafetensorError, msgspec.MsgspecError)
_DAMAGE = (*_LIBRARY_ERRORS, KeyError, TypeError, ValueError, RuntimeError, UsageError)

_Three = tuple[float, float, float]


@dataclass(frozen=True)
class _Frame:
    """A `Similarity`."""

    scale: float
    rotation: tuple[_Three, _Three, _Three]
    translation: _Three


@dataclass(frozen=True)
class _Version:
    """What is read of a header before anything else."""

    format: str
    version: int


@dataclass(frozen=True)
class _Header(_Version):
    """The JSON beside the tensors; msgspec holds it to these types and bounds."""

    shape: DecoderShape
    frame: _Frame
    count: Annotated[int, Meta(ge=0, le=2**31)]


@dataclass(frozen=True)
class HiddenSecret:
    """All that revealing one secret needs besides the stego model; see `keyss.methods.base.Opened`."""

    decoder: Decoder
    frame: Similarity  # from the secret's own frame into the cover's
    anchors: Tensor  # [A, 3] positions of Gaussians of the stego model
    count: int = 0  # Gaussians that the secret has when it is revealed from a whole file; 0: not known
    chunks: tuple[int, int] | None = None  # see `Payload`; not part of what is packed

    @torch.no_grad()
    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        """A model that needs no decoder and no cover, without what is never drawn; see `Opened.reveal`.

        If Gaussians were lost, the others make up for them.
        """
        if not force:
            self.check_unchanged(stego)
        decoded = self.decode(stego, self.embedding)
        if (drawn := decoded.opacities >= DRAWN_OPACITY).any():
            decoded = compensate_pruning(decoded[drawn], self.count)
        decoded = decoded.to("cpu")
        return decoded if frame == "cover" else self.frame.inverse().apply_gaussians(decoded)

    def decode(self, stego: Gaussians, embedding: Tensor) -> Gaussians:
        """What the decoder makes of `stego` for an embedding [64]; see `Opened.decode`.

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
        """None where nothing of what was revealed is ever drawn."""
        found = int((revealed.opacities >= DRAWN_OPACITY).sum())
        return Remains(found, self.count, self.chunks, _SLACK)

    def fingerprint(self) -> str:
        return hashlib.sha256(pack_secret(self)).hexdigest()[:16]

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


def pack_secret(secret: HiddenSecret) -> bytes:
    """The bytes of a secret; the same secret gives the same bytes."""
    decoder, frame = secret.decoder, secret.frame
    header = _Header(
        FORMAT,
        VERSION,
        decoder.shape,
        _Frame(
            frame.scale,
            tuple(tuple(row) for row in frame.rotation.tolist()),  # type: ignore[arg-type]
            tuple(frame.translation.tolist()),
        ),
        secret.count,
    )
    halved = {name for name, _ in decoder.named_parameters()}
    tensors = {
        _WEIGHTS + name: (value.half() if name in halved else value).detach().cpu().contiguous()
        for name, value in decoder.state_dict().items()
    }
    tensors["anchors"] = secret.anchors.contiguous()
    return safetensors.torch.save(tensors, {"keyss": msgspec.json.encode(header).decode()})


def unpack_secret(data: bytes) -> HiddenSecret:
    """The secret of `pack_secret`. Raises InputError for anything else, for damage, and another version."""
    try:
        tensors = safetensors.torch.load(data)
        return _from_parts(_read_header(data), tensors)
    except _DAMAGE as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"the payload is no secret of keyss, or damaged: {reason}") from error


def _read_header(data: bytes) -> _Header:
    """The header in safetensors' metadata; `safetensors.torch.load` has checked the sizes."""
    size = int.from_bytes(data[:8], "little")
    outer = msgspec.json.decode(data[8 : 8 + size], type=dict[str, msgspec.Raw])
    text = msgspec.json.decode(outer["__metadata__"], type=dict[str, str])["keyss"].encode()
    found = msgspec.json.decode(text, type=_Version)
    if found.format != FORMAT:
        raise InputError("the payload is no secret of keyss")
    if found.version != VERSION:
        raise InputError(f"secret of version {found.version}; this program reads version {VERSION}")
    header = msgspec.json.decode(text, type=_Header)
    if msgspec.json.encode(header) != text or parse_mask(",".join(header.shape.mask)) != header.shape.mask:
        raise InputError("the payload is no secret of keyss: its header has more or other fields")
    return header


def _from_parts(header: _Header, tensors: dict[str, Tensor]) -> HiddenSecret:
    if not all(
        value.dtype in (torch.float16, torch.float32) and value.isfinite().all() for value in tensors.values()
    ):
        raise InputError("weights: expected finite numbers of half or single precision")
    anchors = tensors.pop("anchors").float()
    if anchors.dim() != 2 or anchors.shape[1] != 3 or not 1 <= len(anchors) <= ANCHORS:
        raise InputError(f"anchors: expected up to {ANCHORS} positions, got shape {list(anchors.shape)}")
    decoder = Decoder(header.shape)
    decoder.load_state_dict({name.removeprefix(_WEIGHTS): value for name, value in tensors.items()})
    frame = Similarity(
        header.frame.scale,
        torch.tensor(header.frame.rotation, dtype=torch.float64),
        torch.tensor(header.frame.translation, dtype=torch.float64),
    )
    return HiddenSecret(decoder.requires_grad_(False), frame, anchors, header.count)
