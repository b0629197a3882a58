"""Models embedded as records."""

from __future__ import annotations

import torch

from channels.quiet.trained_like import trained_like
from keyss.channels import LOW_BITS
from keyss.core import same_bits
from keyss.methods.records.embedding import embed_models


def test_overwritten_cover() -> None:
    cover, keys, secrets = trained_like(3000, 0), ["7Vw3-Qp of the first"], [trained_like(900, 1)]
    before = cover.map(torch.clone)
    stego = embed_models(LOW_BITS.prepare(cover), keys, secrets, entropy=bytes(32)).gaussians
    assert same_bits(cover, before)
    prepared = LOW_BITS.prepare(cover)
    assert prepared.usable is LOW_BITS.prepare(cover).usable  # found once
    own = embed_models(prepared, keys, secrets, entropy=bytes(32), overwrite=True).gaussians
    assert same_bits(own, stego)
    assert same_bits(cover, stego)
    assert prepared.usable is not LOW_BITS.prepare(cover).usable  # found again: the cover is another model
