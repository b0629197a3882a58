"""What somebody makes of a stego model who has read the source, and has no key."""

from __future__ import annotations

from dataclasses import astuple, replace

import pytest
import torch

from keyss.core import Gaussians
from keyss.methods.learned.attacks import known_remaps
from keyss.methods.learned.opacity_band import OpacityBand, hidden_logits
from tiny_scenes import random_gaussians


@pytest.mark.parametrize("secret", [0, 1, 2])
def test_the_remap_of_a_band_gives_its_opacities_back_and_hides_the_rest(secret: int) -> None:
    model = random_gaussians(50)
    hidden = replace(model, opacity_logits=hidden_logits(model.opacity_logits, secret))
    shown = known_remaps(Gaussians.cat([model, hidden]), 3)
    own = shown[f"secret {secret + 1}"]
    torch.testing.assert_close(own.opacity_logits[50:], model.opacity_logits.clamp(-4, 6), atol=1e-4, rtol=0)
    assert (own.opacities[:50] < 1 / 255).all()
    assert (shown[f"secret {(secret + 1) % 3 + 1}"].opacities < 1 / 255).all()


def test_what_is_not_drawn_and_in_no_band_is_made_opaque() -> None:
    first, second = OpacityBand.of_secret(0), OpacityBand.of_secret(1)
    inside = [sum(astuple(band)) / 4 for band in (first, second)]
    stray = [first.outer_high + 0.1, second.outer_low - 0.1]
    logits = torch.tensor([*inside, *stray, -5.0, 2.0])
    model = replace(random_gaussians(len(logits)), opacity_logits=logits)
    outside = known_remaps(model, 2)["outside the bands"]
    assert torch.equal(outside.means, model.means[2:4])
    assert (outside.opacities > 0.9).all()
