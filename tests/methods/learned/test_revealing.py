"""What becomes of models that came through a format with few bits."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from channels.low_bits.trained_like import trained_like
from keyss.core import InputError
from keyss.methods.learned.payload import pack_secret, unpack_secret
from methods.learned.hiding import some_secret


def test_opacities_that_were_rounded_to_zero_are_taken_for_faint_ones() -> None:
    stego = trained_like(200)
    secret = some_secret(stego)
    chosen = torch.arange(200) % 3 == 0
    rounded, faint = (
        replace(stego, opacity_logits=stego.opacity_logits.masked_fill(chosen, logit))
        for logit in (-16.0, secret.decoder.nearly_opaque_logit)
    )
    assert torch.equal(
        secret.reveal(rounded, force=True).opacity_logits,
        secret.reveal(faint, force=True).opacity_logits,
    )


@pytest.mark.parametrize("logit", [-16.0, -10.0, -5.6])  # what converters write for an opacity of nothing
def test_a_sidecar_knows_what_was_rounded_whatever_the_order(logit: float) -> None:
    stego = trained_like(200)
    hidden = torch.arange(200) % 2 == 0
    faint = stego.opacity_logits.clamp(-3, 3) - 9
    stego = replace(stego, opacity_logits=torch.where(hidden, faint, stego.opacity_logits.abs()))
    secret = some_secret(stego)
    kept = torch.cat([stego.means[hidden], stego.opacity_logits[hidden, None], stego.sh[hidden, 0]], dim=1)
    secret = unpack_secret(pack_secret(replace(secret, faint=kept)))
    rounded = replace(
        stego,
        means=(stego.means * 1000).round() / 1000,
        opacity_logits=stego.opacity_logits.masked_fill(hidden, logit),
        sh=stego.sh.masked_fill(hidden[:, None, None], 0),
    )
    order = torch.randperm(200)
    known = secret.with_faint(rounded[order])
    assert torch.equal(known.opacity_logits, stego.opacity_logits[order])
    assert torch.equal(known.sh[:, 0], stego.sh[order, 0])
    revealed, whole = (secret.reveal(model, force=True) for model in (rounded, stego))
    assert torch.equal(revealed.opacity_logits, whole.opacity_logits)


def test_positions_that_were_rounded_need_force() -> None:
    stego = trained_like(200)
    secret = some_secret(stego)
    rounded = replace(stego, means=(stego.means * 500).round() / 500)
    with pytest.raises(InputError, match="`force=True`"):
        secret.reveal(rounded)
    assert len(secret.reveal(rounded, force=True)) == 200


def test_what_is_left_makes_up_for_what_was_lost() -> None:
    stego = trained_like(200)
    secret = some_secret(stego)
    secret = unpack_secret(pack_secret(replace(secret, count=200)))
    left = secret.reveal(stego[:150])
    alone = replace(secret, count=0).reveal(stego[:150])
    assert (left.opacities > alone.opacities).all()
    assert (left.log_scales > alone.log_scales).all()
    assert torch.equal(secret.reveal(stego).sh, replace(secret, count=0).reveal(stego).sh)


@pytest.mark.parametrize("count", [-1, 2**40, 1.5, True, None])
def test_a_count_out_of_bounds_is_refused(count: object) -> None:
    secret = some_secret(trained_like(100))
    with pytest.raises(InputError, match="count"):
        unpack_secret(pack_secret(replace(secret, count=count)))  # type: ignore[arg-type]
