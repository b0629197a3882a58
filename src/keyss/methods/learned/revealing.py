"""From a stego model and a key to the secret."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from keyss.channels.low_bits.bits import identities
from keyss.channels.low_bits.container import extract_derived, key_for
from keyss.channels.sidecar import open_slots, read_header
from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.similarity import Similarity
from keyss.files.reading import read_file
from keyss.keys import DerivedKey
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.payload import HiddenSecret, choose_anchors, pack_secret, unpack_secret
from keyss.methods.learned.scramble import LEAST_OPACITY

Frame = Literal["secret", "cover"]
MAX_SIDECAR_BYTES = 1 << 30
_ROUNDED_SHARE = 0.25  # of the opacities of transparent Gaussians may differ where they were rounded
_DECOY_STRENGTH = 0.02  # standard deviation of a decoy's changes of opacity logits
_DECOY_MOVE = 1e-4  # and of its turns (radians), shifts (of the model's size) and changes of scale


def open_secret(
    stego: Gaussians, key: str, sidecar: bytes | None = None, *, decoy: bool = False
) -> HiddenSecret:
    """What `key` opens, in the low bits of `stego` or in the bytes of a `sidecar`.

    `decoy`: a key that opens nothing gets a secret that shows the cover, see `decoy_secret`. Otherwise raises
    WrongKeyError for it. Raises InputError when what is there is damaged.
    """
    names = identities(stego) if sidecar is None else []
    derived = key_for(names, key) if sidecar is None else DerivedKey(key, read_header(sidecar)[0])
    try:
        packed = extract_derived(stego, derived, names) if sidecar is None else open_slots(sidecar, derived)
    except WrongKeyError:
        if not decoy:
            raise
        packed = pack_secret(decoy_secret(stego, derived))
    return unpack_secret(packed)


def decoy_secret(stego: Gaussians, key: DerivedKey) -> HiddenSecret:
    """A secret that is the cover: what a wrong key opens for whoever looks on.

    Its decoder has the default shape and a random curve, its frame is a random one, and both change too
    little to be seen. So a reveal does the same work as with a right key, and gives neither the bytes of
    `stego` nor, for who does not have the key, bytes that can be computed.
    """
    generator = torch.Generator().manual_seed(int.from_bytes(key.expand("decoy", 8), "little") >> 1)
    decoder = Decoder(DecoderShape(sh_degree=stego.sh_degree))
    decoder.prepare(stego, key.embedding())
    decoder.values.normal_(std=_DECOY_STRENGTH, generator=generator)
    turn, shift = _DECOY_MOVE * torch.randn(2, 3, generator=generator, dtype=torch.float64)
    skew = torch.zeros(3, 3, dtype=torch.float64)
    skew[[2, 0, 1], [1, 2, 0]] = turn
    size = (stego.means - stego.means.mean(0)).norm(dim=1).median().double().clamp_min(1e-9)
    frame = Similarity(1 + float(shift.mean()), torch.matrix_exp(skew - skew.T), shift * size)
    return HiddenSecret(decoder.requires_grad_(False), frame, choose_anchors(stego, generator))


def read_sidecar(path: Path) -> bytes:
    """The bytes of a sidecar's file. Raises InputError for one that is missing or beyond all measure."""
    return read_file(path, MAX_SIDECAR_BYTES)


@torch.no_grad()
def reveal_gaussians(
    stego: Gaussians, secret: HiddenSecret, *, frame: Frame = "secret", force: bool = False
) -> Gaussians:
    """The secret as a model of its own that needs no decoder and no cover, without what is never drawn.

    `frame`: "secret" gives it in its own frame, so that its cameras fit it; "cover" leaves it where it was
    hidden. `force` is for models that were quantised: it skips the check that the secret belongs to this one.
    Where opacities were rounded to nothing, they are taken from the sidecar. If Gaussians were lost, the
    others make up for them. Raises InputError for a secret of another model.
    """
    if not force:
        secret.check_belongs_to(stego)
    if (force or secret.faint is not None) and _is_rounded(stego):
        stego = secret.with_faint(stego)
    decoded = decode(stego, secret, secret.embedding)
    if (drawn := is_drawn(decoded)).any():
        decoded = decoded[drawn]
    decoded = compensate_pruning(decoded, secret.count)
    if frame == "cover":
        return decoded
    return secret.frame.inverse().apply_gaussians(decoded.to("cpu"))


def is_drawn(gaussians: Gaussians) -> Tensor:
    """[N] which Gaussians are opaque enough to be drawn at all."""
    return gaussians.opacities >= LEAST_OPACITY


def _is_rounded(stego: Gaussians) -> bool:
    """Whether the opacities of transparent Gaussians are so few that a format must have rounded them."""
    logits = stego.opacity_logits[~is_drawn(stego)]
    return len(logits.unique()) < _ROUNDED_SHARE * len(logits)


@torch.no_grad()
def decode(stego: Gaussians, secret: HiddenSecret, embedding: Tensor) -> Gaussians:
    """What the secret's decoder makes of `stego` for an embedding [64], in the cover's frame."""
    decoder = secret.decoder.to(stego.device)
    if secret.scramble is not None:
        stego = secret.scramble.open(stego)
    decoded: Gaussians = decoder(stego.with_sh_degree(decoder.shape.sh_degree), embedding.to(stego.device))
    return decoded
