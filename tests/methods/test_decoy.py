"""What a wrong key opens with `decoy`, whichever method there is."""

from __future__ import annotations

from dataclasses import replace

import torch

from channels.low_bits.trained_like import keys, trained_like
from keyss.core import same_bits
from keyss.methods import Decoy, open_model

NAMES = ("means", "quats", "log_scales", "opacity_logits")

KEY = "a key of many characters: 93hXmQ2"


def test_every_value_changes_by_little_and_a_key_gives_the_same_each_time() -> None:
    stego = trained_like(300)
    first, again, other = (Decoy.of(stego, keys(seed)[0]).reveal(stego) for seed in (0, 0, 1))
    assert same_bits(first, again)
    assert not torch.equal(first.means, other.means)
    size = float((stego.means - stego.means.mean(0)).norm(dim=1).median())
    for name in NAMES:
        value, was = getattr(first, name), getattr(stego, name)
        assert (value != was).float().mean() > 0.9, name
        torch.testing.assert_close(value, was, rtol=0, atol=0.1 if name == "opacity_logits" else 2e-2 * size)


def test_opacities_that_are_alike_change_alike() -> None:
    """No key-shaped noise on single Gaussians: the change is a smooth function of opacity."""
    stego = trained_like(500)
    stego = stego[stego.opacities > 0.01]  # no change makes one transparent
    decoy = Decoy.of(stego, keys()[0])
    order = stego.opacity_logits.argsort()
    change = (decoy.reveal(stego, frame="cover").opacity_logits - stego.opacity_logits)[order]
    steps = stego.opacity_logits[order].diff()
    assert (change.diff().abs() <= 0.2 * steps + 1e-5).all()


def test_transparent_gaussians_are_left_out_as_of_a_secret() -> None:
    stego = trained_like(300)
    chosen = torch.arange(300) % 3 == 0
    stego = replace(stego, opacity_logits=torch.where(chosen, -9.0, stego.opacity_logits.abs()))
    assert len(Decoy.of(stego, keys()[0]).reveal(stego)) == 200
    stego = replace(stego, opacity_logits=torch.full((300,), -9.0))
    assert len(Decoy.of(stego, keys()[0]).reveal(stego)) == 300


def test_a_plain_model_has_a_decoy_too() -> None:
    plain = trained_like(300)
    opened = open_model(plain, KEY, decoy=True)
    assert isinstance(opened, Decoy)
    assert opened.decode is None
    assert len(opened.reveal(plain)) == 300
