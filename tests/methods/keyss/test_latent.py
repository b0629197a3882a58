"""The design `latent`: encryption, decoding, training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import kstest
from torch import Tensor

from channels.quiet.trained_like import trained_like
from channels.test_harmonics import heavy_tailed
from keyss import Gaussians
from keyss.channels.harmonics import row_ids
from keyss.core import InputError, UsageError
from keyss.lab import search_embeddings
from keyss.methods import LatentDecoder
from keyss.methods.keyss.decoder import latents_of
from methods.hiding import hide_scenes, three_scenes
from methods.keyss.small import KEYS, VECTORS, latent_model, small


def _embed_latents(secrets: int = 1) -> tuple[Gaussians, list[LatentDecoder], list[Tensor]]:
    """Write latents of `secrets` secrets in 900 of 1,000 rows."""
    stego, found, latents = latent_model(heavy_tailed(1000), 900, secrets)
    return stego, [secret.decoder for secret in found], latents  # type: ignore[misc]


@pytest.mark.parametrize("secrets", [1, 2])
def test_round_trip(secrets: int) -> None:
    stego, decoders, values = _embed_latents(secrets)
    for index, (decoder, expected) in enumerate(zip(decoders, values, strict=True)):
        decoded = decoder.decode(stego, VECTORS[index])
        assert len(decoded) == 900
        wanted = decoder.to_gaussians(expected)
        torch.testing.assert_close(decoded.means, wanted.means, atol=0.01, rtol=0)
        torch.testing.assert_close(decoded.sh, wanted.sh, atol=0.02, rtol=0)
        turned = (decoded.quats * wanted.quats).sum(1).abs()
        assert float(turned.min()) > 0.999
        assert float((decoded.means - wanted.means).abs().median()) < 1e-5
        for wrong in (VECTORS[2], VECTORS[1 - index]):
            assert decoder.decode(stego, wrong) is stego


def test_ciphertext_is_uniform() -> None:
    """Even for constant latents."""
    _, (decoder,), _ = _embed_latents()
    ids = row_ids(trained_like(2000, seed=3))
    constant = np.tile(decoder.knots.double().numpy()[:, 16], (2000, 1))
    ranks = decoder.encrypt(constant, VECTORS[0], ids)
    assert kstest(ranks.ravel(), "uniform").pvalue > 1e-6
    assert kstest((ranks[:, 0] - ranks[:, 1]) % 1, "uniform").pvalue > 1e-6


def test_nearby_keys_open_nothing() -> None:
    stego, (decoder,), _ = _embed_latents()
    near = VECTORS[0].clone()
    near[0] = torch.nextafter(near[0], torch.tensor(2.0))
    assert decoder.decode(stego, near) is stego
    for found in search_embeddings(decoder.decode, stego, restarts=2, steps=20):
        assert decoder.decode(stego, found) is stego


def test_changed_rows() -> None:
    stego, (decoder,), _ = _embed_latents()
    whole = decoder.decode(stego, VECTORS[0])
    assert decoder.decode(Gaussians.cat([stego, stego]), VECTORS[0]).digest() == whole.digest()
    backwards = decoder.decode(stego[torch.arange(999, -1, -2)], VECTORS[0])
    assert backwards[torch.arange(len(backwards) - 1, -1, -1)].digest() == whole[1::2].digest()
    exchanged = replace(stego, sh=torch.cat([stego.sh[:, :4], stego.sh[:, 4:].roll(1, 0)], dim=1))
    assert decoder.decode(exchanged, VECTORS[0]) is exchanged
    _, (secret,), _ = latent_model(heavy_tailed(1000), 900)
    with pytest.raises(InputError, match="none of its Gaussians opens"):
        secret.reveal(exchanged)


def test_capacity() -> None:
    assert [latents_of(3, 1), latents_of(3, 2), latents_of(2, 1)] == [24, 14, 13]
    for degree, secrets in ((3, 3), (2, 2), (1, 1), (0, 1)):
        with pytest.raises(UsageError, match="no room for one of each"):
            latents_of(degree, secrets)


def test_cover_without_harmonics() -> None:
    scenes, models = three_scenes()
    with pytest.raises(InputError, match="train longer"):
        hide_scenes(
            scenes[:2],
            KEYS[:1],
            small("latent"),
            plains=[models[0].with_sh_degree(0).with_sh_degree(3), models[1]],
        )
    with pytest.raises(InputError, match="train longer"):
        hide_scenes(scenes[:2], KEYS[:1], small("latent").with_fit(iterations=1), plains=models[:2])
