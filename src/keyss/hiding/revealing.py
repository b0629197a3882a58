"""From a stego model, its decoder and a key to the secret."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from keyss.core.errors import WrongKeyError
from keyss.core.gaussians import Gaussians
from keyss.hiding.decoder_file import SavedDecoder
from keyss.seal.keys import DerivedKey

Frame = Literal["secret", "cover"]


@torch.no_grad()
def reveal_gaussians(
    stego: Gaussians,
    saved: SavedDecoder,
    key: str,
    *,
    frame: Frame = "secret",
    decoy: bool = False,
    force: bool = False,
) -> Gaussians:
    """The secret that `key` opens, as a model of its own that needs no decoder and no cover.

    `frame`: "secret" gives it in its own frame, so that its cameras fit it; "cover" leaves it where it was
    hidden. `decoy`: a wrong key gives what the method gives for it, the cover, instead of raising
    WrongKeyError. `force` skips the check that the decoder belongs to this model, for models whose
    positions were quantised. Raises InputError for a decoder of another model.
    """
    derived = DerivedKey(key, saved.derivation)
    if not force:
        saved.check_belongs_to(stego)
    decoded = decode(stego, saved, derived.embedding())
    try:
        secret = saved.find(derived)
    except WrongKeyError:
        if decoy:
            return decoded
        raise
    if frame == "cover":
        return decoded
    return secret.frame.inverse().apply_gaussians(decoded.to("cpu"))


@torch.no_grad()
def decode(stego: Gaussians, saved: SavedDecoder, embedding: Tensor) -> Gaussians:
    """What the decoder makes of `stego` for a key's embedding [64], in the cover's frame."""
    decoder = saved.decoder.to(stego.device)
    decoded: Gaussians = decoder(stego.with_sh_degree(decoder.shape.sh_degree), embedding.to(stego.device))
    return decoded
