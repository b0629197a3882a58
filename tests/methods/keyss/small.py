"""Small KeySS options and secrets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from channels.quiet.trained_like import trained_like
from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.channels.harmonics import high_harmonics, row_ids, with_high_harmonics
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import DESIGNS, Decoder, DecoderShape, KeyssSecret, LatentDecoder, choose_anchors
from keyss.methods.keyss.decoder import latents_of
from keyss.methods.keyss.keyss_secret import visibility

FIT = FitConfig(iterations=60, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0)
KEYS = ("first key", "second key")
VECTORS = random_embeddings(3, torch.Generator().manual_seed(1234))


def small(design: str, fit: FitConfig = FIT, **changes: object) -> KeyssOptions:
    """Options of a design with a tiny decoder."""
    known = DESIGNS[design]
    decoder = replace(known.decoder, hidden=(8, 8), branch=8)
    return KeyssOptions(fit=fit, design=replace(known, decoder=decoder, **changes))  # type: ignore[arg-type]


def make_secret(stego: Gaussians) -> KeyssSecret:
    """A secret in `stego` whose decoder changes opacities slightly."""
    torch.manual_seed(0)
    shape = DecoderShape(mask=("op",), hidden=(8, 8), branch=8, sh_degree=stego.sh_degree)
    decoder = Decoder(shape).requires_grad_(False)
    decoder.branches["op"][-1].weight *= 0.01
    decoder.branches["op"][-1].bias *= 0.01
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    key = VECTORS[0]
    return KeyssSecret(decoder, key, frame, choose_anchors(stego, 0), *visibility(decoder.decode(stego, key)))


def latent_model(
    cover: Gaussians, count: int, secrets: int = 1
) -> tuple[Gaussians, list[KeyssSecret], list[Tensor]]:
    """`cover` with latents in its first `count` rows, the secrets, and their latents [count, D]."""
    size = latents_of(3, secrets)
    ranks = np.random.default_rng(0).random((len(cover), size * secrets))
    decoders, values = [], []
    for secret in range(secrets):
        decoder = LatentDecoder(DecoderShape(kind="latent", secrets=secrets, secret=secret))
        decoder.place.fit(cover)
        torch.nn.init.normal_(decoder.basis, generator=torch.Generator().manual_seed(secret))
        decoder.basis.data = decoder.basis.data.half().float()  # as in a payload
        model = trained_like(count, seed=10 + secret)
        colours = torch.cat([model.sh[:, 0], model.sh[:, 1:].flatten(1)[:, : size - 13]], dim=1)
        latents = decoder.requires_grad_(False).to_latents(model, colours)
        decoder.fit_secret(latents.double().numpy())
        ids = row_ids(cover)[:count]
        ranks[:count, decoder.own] = decoder.encrypt(latents.double().numpy(), VECTORS[secret], ids)
        decoders.append(decoder)
        values.append(latents)
    stego = with_high_harmonics(cover, decoders[0].place.write(high_harmonics(cover), ranks))
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    found = [
        KeyssSecret(
            decoder,
            VECTORS[secret],
            frame,
            choose_anchors(stego, 0),
            *visibility(decoder.decode(stego, VECTORS[secret])),
        )
        for secret, decoder in enumerate(decoders)
    ]
    return stego, found, values
