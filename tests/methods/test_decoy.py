"""Decoys: what wrong keys open with `decoy`."""

from __future__ import annotations

import pytest

from channels.quiet.trained_like import keys, trained_like
from keyss.channels import APPENDED, LOW_BITS, Channel, Payload
from keyss.core import Gaussians, KeyssWarning
from keyss.methods import Decoy, embed_models, open_model
from keyss.rendering import psnr_between

KEY = "a key of many characters: 93hXmQ2"


def decoy_of(stego: Gaussians, seed: int = 0, records: bool = True) -> Gaussians:
    return Decoy.of(stego, keys(seed)[0], records=records).reveal(stego)


def test_deterministic_per_key() -> None:
    stego = trained_like(300)
    first, again, other = (decoy_of(stego, seed) for seed in (0, 0, 1))
    assert first.digest() == again.digest()
    assert not set(first.means[:, 0].tolist()) & set(other.means[:, 0].tolist())
    assert not set(first.means[:, 0].tolist()) & set(stego.means[:, 0].tolist())


@pytest.mark.parametrize("records", [False, True])
def test_resembles_cover(records: bool) -> None:
    stego = trained_like(2000)
    assert psnr_between(stego, decoy_of(stego, records=records)) > 30


@pytest.mark.parametrize("channel", [LOW_BITS, APPENDED], ids=["low bits", "appended"])
def test_statistics_match_revealed_secret(channel: Channel) -> None:
    """Unit quaternions and as many distinct values per attribute."""
    cover, model = trained_like(3000, 0), trained_like(2700, 1)
    stego = embed_models(channel.prepare(cover), [KEY], [model]).gaussians
    secret = open_model(stego, KEY, decoy=True).reveal(stego)
    wrong = open_model(stego, "another key of many characters", decoy=True)
    assert isinstance(wrong, Decoy)
    decoy = wrong.reveal(stego)
    for found in (secret, decoy):
        assert float((found.quats.norm(dim=1) - 1).abs().max()) < 1e-6
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        of_secret, of_decoy = (getattr(each, name) for each in (secret, decoy))
        ratio = len(of_decoy.unique()) / len(of_secret.unique()) * of_secret.numel() / of_decoy.numel()
        assert 0.5 < ratio < 2, name
    # The order of Gaussians is as local.
    distances = [each.means.diff(dim=0).norm(dim=1).median() / each.means.std() for each in (secret, decoy)]
    assert float(distances[1]) == pytest.approx(float(distances[0]), rel=0.35)


def test_decoy_of_plain_model() -> None:
    plain = trained_like(300)
    opened = open_model(plain, KEY, decoy=True)
    assert isinstance(opened, Decoy)
    assert 230 < len(opened.reveal(plain)) < 300


def test_appended_gaussians_do_not_hide_what_lies_in_low_bits() -> None:
    """Whoever appends a secret of their own does not make a right key open the decoy, nor go unnoticed."""
    stego = embed_models(LOW_BITS.prepare(trained_like(3000, 0)), [KEY], [trained_like(300, 1)]).gaussians
    more = APPENDED.prepare(stego).embed([("a key of somebody else", Payload("file", bytes(100)))])
    with pytest.warns(KeyssWarning, match=r"about [\d,]+ Gaussians were added"):
        assert not isinstance(open_model(more, KEY, decoy=True), Decoy)
    assert isinstance(open_model(more, "another key of many characters", decoy=True), Decoy)
