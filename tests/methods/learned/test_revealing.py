"""What becomes of models that were rounded or pruned."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from channels.low_bits.trained_like import trained_like
from keyss.core import InputError
from keyss.methods.learned.payload import pack_secret, unpack_secret
from methods.learned.hiding import some_secret


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
