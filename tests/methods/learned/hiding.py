"""The learned method from scenes to a stego model and back, below the level of files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from keyss.core import Gaussians, Scene
from keyss.core.similarity import Similarity
from keyss.fitting.loop import Reporter
from keyss.keys import random_embeddings
from keyss.methods import registry
from keyss.methods.base import Context, KeyedSource, Opened, SceneInput, Source
from keyss.methods.learned.decoder import Decoder, DecoderShape
from keyss.methods.learned.options import LearnedOptions
from keyss.methods.learned.payload import HiddenSecret, choose_anchors
from keyss.methods.plain_models import plain_models


@dataclass(frozen=True)
class Hidden:
    """What hiding gave."""

    stego: Gaussians
    sidecar: bytes | None
    opened: tuple[Opened, ...]

    @property
    def secrets(self) -> tuple[HiddenSecret, ...]:
        """Those that have a decoder: with a sidecar, and started from points."""
        return tuple(each for each in self.opened if isinstance(each, HiddenSecret))


def hide_scenes(
    scenes: Sequence[Scene],
    keys: Sequence[str],
    options: LearnedOptions,
    *,
    plains: Sequence[Gaussians | None] | None = None,
    sidecar: bool = False,
    checkpoints: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Hidden:
    """Hide `scenes[1:]` in `scenes[0]`, with seed 0 unless `options` have one.

    Models are fitted where `plains` has none.
    """
    given = plains or [None] * len(scenes)
    method = registry.get("learned")
    options = replace(options, sidecar=sidecar, fit=options.fit.seeded(0))
    options = method.prepare([SceneInput(model, photos=True) for model in given], options)
    context = Context(torch.device("cpu"), checkpoints, resume, reporter)
    cover, *secrets = map(Source, scenes, plain_models(scenes, given, options.fit, context))
    stego = method.hide(cover, list(map(KeyedSource, secrets, keys)), options, context)
    return Hidden(stego.gaussians, stego.sidecar, stego.opened)


def open_secret(stego: Gaussians, key: str, sidecar: bytes | None = None) -> HiddenSecret:
    """What `key` opens; raises WrongKeyError."""
    opened = registry.open_model(stego, key, sidecar=sidecar)
    assert isinstance(opened, HiddenSecret)
    return opened


def some_secret(stego: Gaussians) -> HiddenSecret:
    """A secret that `stego` belongs to, whose opacity remap changes a little."""
    generator = torch.Generator().manual_seed(0)
    decoder = Decoder(DecoderShape(sh_degree=stego.sh_degree))
    decoder.prepare(stego, random_embeddings(1, generator)[0])
    decoder.values.normal_(std=0.02, generator=generator)
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    return HiddenSecret(decoder.requires_grad_(False), frame, choose_anchors(stego, generator))
