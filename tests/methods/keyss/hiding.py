"""Small options of KeySS, and a secret of its own making."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from keyss.methods.keyss.rows import encrypt_rows, secret_tables

from channels.low_bits.trained_like import trained_like
from keyss import FitConfig, Gaussians, KeyssOptions
from keyss.core.similarity import Similarity
from keyss.keys import random_embeddings
from keyss.methods import ATTRIBUTES, Codec, Decoder, DecoderShape, HiddenSecret, RowSecret, choose_anchors

FIT = FitConfig(iterations=80, max_gaussians=600, grow_start=0.2, grow_every=20, evaluate_every=0, seed=0)
SMALL: dict[str, Any] = {"hidden": (16, 16), "branch": 8}  # a decoder of few bytes
OPTIONS = KeyssOptions(design="mlp", fit=FIT, mask=ATTRIBUTES, decoder_rate=1e-2, **SMALL)
# The paper's, but small and with inputs that learn in few steps.
PUBLISHED = KeyssOptions(
    fit=replace(FIT, iterations=60), design="published", inputs="standardised", decoder_rate=3e-3, **SMALL
)
KEYS = ("first key", "second key")
EMBEDDINGS = random_embeddings(3, torch.Generator().manual_seed(1234))


def some_secret(stego: Gaussians) -> HiddenSecret:
    """A secret that `stego` belongs to, whose decoder changes opacities a little."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(hidden=(8, 8), branch=8, sh_degree=stego.sh_degree))
    decoder.prepare(stego, random_embeddings(1, generator)[0])
    torch.nn.init.normal_(decoder.network.branches["op"][-1].weight, std=0.01, generator=generator)  # type: ignore[index,union-attr,arg-type]
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    return HiddenSecret(decoder.requires_grad_(False), frame, choose_anchors(stego, generator))


def cover_with_zeros(count: int = 1000) -> Gaussians:
    """A tenth of the rows without blue harmonics, and a tenth without any."""
    cover = trained_like(count)
    sh = cover.sh.clone()
    sh[::10, 1:, 2] = 0
    sh[5::10, 1:] = 0
    return replace(cover, sh=sh)


def written(
    secrets: int = 1, count: int = 850, rows: int = 1000
) -> tuple[Gaussians, list[RowSecret], list[Gaussians]]:
    """Models in the rows of a larger one."""
    cover = cover_with_zeros(rows)
    tables = secret_tables(3, secrets)
    models = [trained_like(count, seed=1 + i).with_sh_degree(tables[0].sh_degree) for i in range(secrets)]
    made = [
        RowSecret(
            EMBEDDINGS[i],
            tuple(Codec.fit(model.with_sh_degree(table.sh_degree), table) for table in tables),
            Similarity(),
            i,
            secrets,
            count,
            1.0,
        )
        for i, model in enumerate(models)
    ]
    return encrypt_rows(cover, made, models, bytes(32)), made, models
