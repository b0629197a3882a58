"""From a stego model and a key to the secret."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.files.reading import read_file
from keyss.hiding.payload import HiddenSecret, unpack_secret
from keyss.seal import extract, unseal_sidecar

Frame = Literal["secret", "cover"]
MAX_SIDECAR_BYTES = 1 << 30


def open_secret(stego: Gaussians, key: str, sidecar: bytes | None = None) -> HiddenSecret:
    """What `key` opens, in the low bits of `stego` or in the bytes of a `sidecar`.

    Raises WrongKeyError when it opens nothing, InputError when what is there is damaged.
    """
    return unpack_secret(extract(stego, key) if sidecar is None else unseal_sidecar(sidecar, key))


def read_sidecar(path: Path) -> bytes:
    """The bytes of a sidecar's file. Raises InputError for one that is missing or beyond all measure."""
    return read_file(path, MAX_SIDECAR_BYTES)


@torch.no_grad()
def reveal_gaussians(
    stego: Gaussians, secret: HiddenSecret, *, frame: Frame = "secret", force: bool = False
) -> Gaussians:
    """The secret as a model of its own that needs no decoder and no cover.

    `frame`: "secret" gives it in its own frame, so that its cameras fit it; "cover" leaves it where it was
    hidden. `force` skips the check that the secret belongs to this model, for models whose positions were
    quantised. Raises InputError for a secret of another model.
    """
    if not force:
        secret.check_belongs_to(stego)
    decoded = decode(stego, secret, secret.embedding)
    if frame == "cover":
        return decoded
    return secret.frame.inverse().apply_gaussians(decoded.to("cpu"))


@torch.no_grad()
def decode(stego: Gaussians, secret: HiddenSecret, embedding: Tensor) -> Gaussians:
    """What the secret's decoder makes of `stego` for an embedding [64], in the cover's frame."""
    decoder = secret.decoder.to(stego.device)
    decoded: Gaussians = decoder(stego.with_sh_degree(decoder.shape.sh_degree), embedding.to(stego.device))
    return decoded
