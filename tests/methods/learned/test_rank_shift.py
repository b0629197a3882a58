"""The keyed rank shift: undone by its key, in any order, and saying nothing to others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from channels.low_bits.trained_like import trained_like
from keyss.channels.low_bits.bits import read_low_bits, usable_carriers, write_low_bits
from keyss.core import Gaussians
from keyss.methods.learned.rank_shift import RankShift, match_quaternion_lengths

BAND = (-10.0, -6.0)
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def _stego() -> Gaussians:
    """A thousand visible Gaussians and a thousand hidden ones that lie elsewhere and look otherwise."""
    cover, secret = trained_like(1000), trained_like(1000, 1)
    hidden = replace(
        secret,
        means=0.2 * secret.means + 7,
        log_scales=secret.log_scales - 2,
        opacity_logits=-8 + 0.1 * secret.opacity_logits.clamp(-9, 9),
    )
    return Gaussians.cat([replace(cover, opacity_logits=cover.opacity_logits.abs()), hidden])


def _hidden(model: Gaussians) -> Gaussians:
    return model[(model.opacity_logits > BAND[0]) & (model.opacity_logits < BAND[1])]


@pytest.fixture(scope="module")
def encrypted() -> tuple[RankShift, Gaussians, Gaussians]:
    stego = _stego()
    rank_shift = RankShift.of(stego, b"k" * 32, BAND)
    return rank_shift, stego, rank_shift.encrypt(stego)


def test_only_the_hidden_change_and_they_stay_hidden(
    encrypted: tuple[RankShift, Gaussians, Gaussians],
) -> None:
    _, stego, published = encrypted
    for name in FIELDS:
        assert torch.equal(getattr(published, name)[:1000], getattr(stego, name)[:1000]), name
    assert len(_hidden(published)) == 1000
    for name in ("means", "log_scales", "opacity_logits"):
        assert (getattr(published, name)[1000:] != getattr(stego, name)[1000:]).all(), name


@pytest.mark.parametrize("seed", range(8))
def test_the_key_puts_them_back_whatever_the_order_and_the_low_bits(seed: int) -> None:
    """Also those at the ends of the ranks, which a shift by a whole turn makes neighbours."""
    stego = _stego()
    rank_shift = RankShift.of(stego, bytes([seed]) * 32, BAND)
    published = rank_shift.encrypt(stego)
    rows = np.flatnonzero(usable_carriers(published))
    noise = np.random.default_rng(seed).integers(0, 256, read_low_bits(published)[rows].shape, dtype=np.uint8)
    order = torch.randperm(2000, generator=torch.Generator().manual_seed(seed))[:1500]
    decrypted = rank_shift.decrypt(write_low_bits(published, rows, noise)[order])
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        error = (getattr(decrypted, name) - getattr(stego, name)[order]).abs()
        assert float(error.quantile(0.99)) < (5e-4 if name == "means" else 2e-3), name
        assert float(error.max()) < 2e-2, name


def test_another_key_puts_nothing_back(encrypted: tuple[RankShift, Gaussians, Gaussians]) -> None:
    rank_shift, stego, published = encrypted
    decrypted = replace(rank_shift, key=b"j" * 32).decrypt(published)
    distance = (decrypted.means - stego.means)[1000:].norm(dim=1)
    chance = (stego.means[1000:][torch.randperm(1000)] - stego.means[1000:]).norm(dim=1)
    assert float(distance.median()) > 0.8 * float(chance.median())


def test_what_is_published_is_distributed_as_the_cover_and_independent_of_what_is_hidden(
    encrypted: tuple[RankShift, Gaussians, Gaussians],
) -> None:
    _, stego, published = encrypted
    for name in ("means", "log_scales"):
        for axis in range(3):
            shown = getattr(published, name)[1000:, axis].numpy()
            cover, hidden = (
                getattr(stego, name)[part, axis].numpy() for part in (slice(1000), slice(1000, 2000))
            )
            assert kstest(shown, cover).pvalue > 1e-3
            assert kstest(shown, hidden).pvalue < 1e-9
            assert abs(np.corrcoef(shown.argsort().argsort(), hidden.argsort().argsort())[0, 1]) < 0.12


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_hidden_gaussians_are_no_special_case(count: int) -> None:
    stego = _stego()[: 1000 + count]
    rank_shift = RankShift.of(stego, b"k" * 32, BAND)
    decrypted = rank_shift.decrypt(rank_shift.encrypt(stego))
    torch.testing.assert_close(decrypted.means, stego.means, atol=1e-3, rtol=1e-3)


def test_round_and_grey_covers_get_round_and_grey_ghosts() -> None:
    """What goes together in the cover does in what is published, and opens all the same."""
    stego = _stego()
    noise = torch.randn(2000, 1, generator=torch.Generator().manual_seed(2))
    round_grey = replace(
        stego,
        log_scales=stego.log_scales.mean(1, keepdim=True) + noise + 1e-3 * stego.log_scales,
        sh=torch.cat([noise[:, :, None] + 1e-3 * stego.sh[:, :1], stego.sh[:, 1:]], dim=1),
    )
    cover = Gaussians.cat([round_grey[:1000], stego[1000:]])
    rank_shift = RankShift.of(cover, b"k" * 32, BAND)
    hidden = rank_shift.encrypt(cover)[1000:]
    for values in (hidden.log_scales, hidden.sh[:, 0]):
        assert float(np.corrcoef(values.numpy().T)[0, 1:].min()) > 0.95
    decrypted = rank_shift.decrypt(rank_shift.encrypt(cover))
    for name in ("log_scales", "sh"):
        error = (getattr(decrypted, name) - getattr(cover, name)).abs()
        assert float(error.max()) < 2e-2, name


def test_quaternions_get_lengths_of_the_cover_and_keep_their_directions() -> None:
    stego = _stego()
    stego = replace(stego, quats=torch.cat([stego.quats[:1000], 3 * stego.quats[1000:]]))
    changed = match_quaternion_lengths(stego, BAND)
    lengths = changed.quats.norm(dim=1)
    torch.testing.assert_close(lengths[1000:].sort().values, stego.quats[:1000].norm(dim=1).sort().values)
    turned = torch.nn.functional.cosine_similarity(changed.quats, stego.quats)
    torch.testing.assert_close(turned, torch.ones(2000))
    for name in ("means", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(changed, name), getattr(stego, name))


@pytest.mark.parametrize(("name", "value"), [("means", 1e15), ("log_scales", -1000.0), ("sh", 1e6)])
@pytest.mark.parametrize("row", [5, 1005])  # of the cover, of the secret
def test_an_outlier_spoils_neither_the_others_nor_what_is_published(
    name: str, value: float, row: int
) -> None:
    stego = _stego()
    getattr(stego, name)[row] = value
    rank_shift = RankShift.of(stego, b"k" * 32, BAND)
    published = rank_shift.encrypt(stego)
    decrypted = rank_shift.decrypt(published)
    others = torch.arange(2000) != row
    for each in ("means", "log_scales", "sh"):
        error = (getattr(decrypted, each) - getattr(stego, each)).abs()[others]
        assert float(error.max()) < (1e-3 if each != "log_scales" else 2e-2), each
    usual, hidden = _stego(), torch.arange(1000, 2000)
    for each in ("means", "log_scales"):
        reach = getattr(usual, each)[:1000].abs().max()
        assert float(getattr(published, each)[hidden].abs().max()) < 1.5 * reach, each
