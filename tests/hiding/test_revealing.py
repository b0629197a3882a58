"""Decoys, and what becomes of models that came through a format with few bits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from keyss.core import InputError
from keyss.hiding.payload import pack_secret, unpack_secret
from keyss.hiding.revealing import decoy_secret, reveal_gaussians
from seal.trained_like import keys, trained_like


def test_opacities_that_were_rounded_to_zero_are_taken_for_faint_ones() -> None:
    stego = trained_like(200)
    secret = decoy_secret(stego, keys()[0])
    chosen = torch.arange(200) % 3 == 0
    rounded, faint = (
        replace(stego, opacity_logits=stego.opacity_logits.masked_fill(chosen, logit))
        for logit in (-16.0, secret.decoder.faint_logit)
    )
    assert torch.equal(
        reveal_gaussians(rounded, secret, force=True).opacity_logits,
        reveal_gaussians(faint, secret, force=True).opacity_logits,
    )


def test_a_sidecar_knows_the_opacities_that_were_rounded_whatever_the_order() -> None:
    stego = trained_like(200)
    hidden = torch.arange(200) % 2 == 0
    faint = stego.opacity_logits.clamp(-3, 3) - 9
    stego = replace(stego, opacity_logits=torch.where(hidden, faint, stego.opacity_logits.abs()))
    secret = decoy_secret(stego, keys()[0])
    kept = torch.cat([stego.means[hidden], stego.opacity_logits[hidden, None]], dim=1)
    secret = unpack_secret(pack_secret(replace(secret, faint=kept)))
    rounded = replace(
        stego,
        means=(stego.means * 1000).round() / 1000,
        opacity_logits=stego.opacity_logits.masked_fill(hidden, -16),
    )
    order = torch.randperm(200)
    assert torch.equal(
        secret.with_faint_opacities(rounded[order]).opacity_logits, stego.opacity_logits[order]
    )


def test_positions_that_were_rounded_need_force() -> None:
    stego = trained_like(200)
    secret = decoy_secret(stego, keys()[0])
    rounded = replace(stego, means=(stego.means * 500).round() / 500)
    with pytest.raises(InputError, match="--force"):
        reveal_gaussians(rounded, secret)
    assert len(reveal_gaussians(rounded, secret, force=True)) == 200
