"""The learned method from scenes to a stego model and back, below the level of files."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from keyss.core import Gaussians, KeyssWarning, Scene
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
    opened: tuple[Opened, ...]

    @property
    def secrets(self) -> tuple[HiddenSecret, ...]:
        """Those that have a decoder: started from points."""
        return tuple(each for each in self.opened if isinstance(each, HiddenSecret))


def hide_scenes(
    scenes: Sequence[Scene],
    keys: Sequence[str],
    options: LearnedOptions,
    *,
    plains: Sequence[Gaussians | None] | None = None,
    checkpoints: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> Hidden:
    """Hide `scenes[1:]` in `scenes[0]`, with seed 0 unless `options` have one.

    Models are fitted where `plains` has none. That decoders of so small models are appended is not said.
    """
    given = plains or [None] * len(scenes)
    method = registry.get("learned")
    options = replace(options, fit=options.fit.seeded(0))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*appended", KeyssWarning)
        options = method.prepare([SceneInput(model, photos=True) for model in given], options)
        context = Context(torch.device("cpu"), checkpoints, resume, reporter)
        cover, *secrets = map(Source, scenes, plain_models(scenes, given, options.fit, context))
        stego = method.hide(cover, list(map(KeyedSource, secrets, keys)), options, context)
    return Hidden(stego.gaussians, stego.opened)


def open_secret(stego: Gaussians, key: str) -> HiddenSecret:
    """What `key` opens; raises WrongKeyError."""
    opened = registry.open_model(stego, key)
    assert isinstance(opened, HiddenSecret)
    return opened


def some_secret(stego: Gaussians) -> HiddenSecret:
    """A secret that `stego` belongs to, whose decoder changes opacities a little."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    decoder = Decoder(DecoderShape(hidden=(8, 8), branch=8, sh_degree=stego.sh_degree))
    decoder.prepare(stego, random_embeddings(1, generator)[0])
    torch.nn.init.normal_(decoder.network.branches["op"][-1].weight, std=0.01, generator=generator)  # type: ignore[index,union-attr,arg-type]
    frame = Similarity(1.001, translation=torch.full((3,), 0.01, dtype=torch.float64))
    return HiddenSecret(decoder.requires_grad_(False), frame, choose_anchors(stego, generator))
