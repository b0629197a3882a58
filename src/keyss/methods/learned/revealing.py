"""From a stego model and what a key opened to the secret."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import torch
from torch import Tensor

from keyss.core.gaussians import DRAWN_OPACITY, Gaussians
from keyss.core.pruning_compensation import compensate_pruning
from keyss.core.similarity import Similarity
from keyss.methods.base import Frame
from keyss.methods.learned.payload import HiddenSecret, pack_secret

_ROUNDED_SHARE = 0.25  # of the opacities of transparent Gaussians may differ where they were rounded


@dataclass(frozen=True)
class OpenedSecret:
    """A secret of the learned method as its key opens it; see `keyss.methods.base.Opened`."""

    secret: HiddenSecret

    @property
    def frame(self) -> Similarity:
        return self.secret.frame

    def decode(self, stego: Gaussians, embedding: Tensor) -> Gaussians:
        return decode(stego, self.secret, embedding)

    def reveal(self, stego: Gaussians, *, frame: Frame = "secret", force: bool = False) -> Gaussians:
        return reveal_gaussians(stego, self.secret, frame=frame, force=force).to("cpu")

    def fingerprint(self) -> str:
        return hashlib.sha256(pack_secret(self.secret)).hexdigest()[:16]


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
    return gaussians.opacities >= DRAWN_OPACITY


def _is_rounded(stego: Gaussians) -> bool:
    """Whether the opacities of transparent Gaussians are so few that a format must have rounded them."""
    logits = stego.opacity_logits[~is_drawn(stego)]
    return len(logits.unique()) < _ROUNDED_SHARE * len(logits)


def decode(stego: Gaussians, secret: HiddenSecret, embedding: Tensor) -> Gaussians:
    """What the secret's decoder makes of `stego` for an embedding [64], in the cover's frame.

    Differentiable in the embedding where the decoder is: the white-box attack searches by that gradient.
    """
    decoder = secret.decoder.to(stego.device)
    if secret.rank_shift is not None:
        stego = secret.rank_shift.decrypt(stego)
    decoded: Gaussians = decoder(stego.with_sh_degree(decoder.shape.sh_degree), embedding.to(stego.device))
    return decoded
