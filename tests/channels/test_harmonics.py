from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest, spearmanr

from channels.quiet.trained_like import trained_like
from keyss.channels import Payload, QuietReader
from keyss.channels.harmonics import RANKS, Harmonics, high_harmonics, pads, row_ids, with_high_harmonics
from keyss.channels.quiet.bits import read_low_bits
from keyss.channels.quiet.quiet_channel import LOW_BITS
from keyss.core import Gaussians, InputError

COUNT = 24


def heavy_tailed(count: int = 4000, seed: int = 0) -> Gaussians:
    """Harmonics whose size differs from row to row, and otherwise in weak directions, as trained ones do."""
    model = trained_like(count, seed)
    generator = torch.Generator().manual_seed(seed)
    mixing = torch.linalg.qr(torch.randn(36, 36, generator=torch.Generator().manual_seed(7)))[0]
    strong, weak = (torch.randn(count, 1, generator=generator) for _ in range(2))
    size = torch.where(torch.arange(36) < COUNT, 0.3 * strong + 0.5 * weak - 2, 0.6 * strong).exp()
    numbers = torch.randn(count, 36, generator=generator) * torch.linspace(0.05, 0.1, 36) * size
    return replace(model, sh=torch.cat([model.sh[:, :4], (numbers @ mixing).view(-1, 12, 3)], dim=1))


def fitted(model: Gaussians) -> Harmonics:
    place = Harmonics(36, COUNT)
    place.fit(model)
    return place


def ranks_for(model: Gaussians, seed: int = 1) -> np.ndarray:  # type: ignore[type-arg]
    return np.random.default_rng(seed).random((len(model), COUNT))


def test_ranks_come_back_from_single_precision() -> None:
    model = heavy_tailed()
    place, ranks = fitted(model), ranks_for(model)
    stego = with_high_harmonics(model, place.write(high_harmonics(model), ranks))
    found, alive = place.read(high_harmonics(stego))
    assert alive.all()
    assert stego.sh.dtype == torch.float32
    assert np.abs(found - ranks).max() < 2e-4  # a quarter of the guard of the design `latent`
    assert np.median(np.abs(found - ranks)) < 2e-7
    assert torch.equal(stego.sh[:, :4], model.sh[:, :4])
    kept = torch.from_numpy(np.linalg.qr(place.directions.numpy(), mode="complete")[0][:, COUNT:])
    before, after = (torch.from_numpy(high_harmonics(each)) @ kept.double() for each in (model, stego))
    torch.testing.assert_close(after, before, atol=1e-6, rtol=0)


def test_uniform_ranks_are_written_as_a_plain_model_has_them() -> None:
    """Direction by direction: the same spread, and the same dependence on the rest and on each other.

    The Kolmogorov-Smirnov distance of two samples of 4,000 exceeds 0.062 once in 10^6 times where their
    distributions are equal; the Bonferroni bound for 24 directions adds 0.004.
    """
    model = heavy_tailed()
    place = fitted(model)
    stego = with_high_harmonics(model, place.write(high_harmonics(model), ranks_for(model)))
    directions = place.directions.double().numpy()
    plain, own = (high_harmonics(each) @ directions for each in (model, stego))
    for column in range(COUNT):
        assert kstest(plain[:, column], own[:, column]).statistic < 0.066
    level = np.linalg.norm(high_harmonics(model) - plain @ directions.T, axis=1)
    together = [spearmanr(level, np.linalg.norm(each, axis=1)).statistic for each in (plain, own)]
    assert abs(together[1] - together[0]) < 0.1
    among = [spearmanr(np.abs(each)).statistic[np.triu_indices(COUNT, 1)].mean() for each in (plain, own)]
    assert 0.9 < among[1] / among[0] < 1.1
    eigenvalues = [np.linalg.eigvalsh(np.cov(high_harmonics(each).T)) for each in (model, stego)]
    assert np.abs(np.log(eigenvalues[0] / eigenvalues[1])).max() < 0.5


def test_rows_that_no_view_showed_stay_as_they_are() -> None:
    model = heavy_tailed()
    sh = model.sh.clone()
    sh[::7, 4:] = 0
    model = replace(model, sh=sh)
    place = fitted(model)
    stego = with_high_harmonics(model, place.write(high_harmonics(model), ranks_for(model)))
    assert torch.equal(stego.sh[::7], model.sh[::7])
    assert np.flatnonzero(~place.read(high_harmonics(stego))[1]).tolist() == list(range(0, len(model), 7))


def test_a_model_without_harmonics_is_refused() -> None:
    model = trained_like(300)
    with pytest.raises(InputError, match="train longer"):
        fitted(replace(model, sh=model.sh * (torch.arange(16) < 4)[:, None]))


def test_pads_are_uniform_and_follow_from_the_secret_and_the_row() -> None:
    ids = row_ids(trained_like(2000))
    found = pads(bytes(32), ids, COUNT)
    assert found.shape == (2000, COUNT)
    assert kstest(found.ravel(), "uniform").pvalue > 1e-6
    assert np.array_equal(found[::-1], pads(bytes(32), ids[::-1].copy(), COUNT))
    assert not np.isin(found, pads(b"\1" + bytes(31), ids, COUNT)).any()
    assert abs(np.corrcoef(found[:, 0], found[:, 1])[0, 1]) < 5 / 2000**0.5


def test_quantiles_describe_the_ends_closely() -> None:
    assert RANKS[0] == 0
    assert RANKS[-1] == 1
    assert RANKS[1] < 1e-3
    assert (np.diff(RANKS) > 0).all()


def test_low_bits_of_high_harmonics_stay_where_latents_lie() -> None:
    """And the reader finds the payload all the same, also after pruning."""
    cover = trained_like(4000)
    prepared = LOW_BITS.prepare(cover, sh_degree=1)
    payload = Payload("keyss", np.random.default_rng(0).bytes(3000))
    stego = prepared.embed([("a key", payload)], entropy=bytes(32))
    assert torch.equal(stego.sh[:, 4:], cover.sh[:, 4:])
    changed = (read_low_bits(stego) != read_low_bits(cover)).mean(axis=0)
    assert (changed[:16] > 0.5).all()  # of 17 fields, 4 bits of the last do not fill a byte
    assert not changed[16:].any()
    chosen = torch.randperm(4000, generator=torch.Generator().manual_seed(0))[:3200]
    for model in (stego, stego[chosen]):
        assert QuietReader.of(model).open("a key") == payload
