"""How well a hiding works, on the test photos of its scenes: the numbers of `metrics.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import ImageQuality, mean_psnr, quality
from keyss.keys import random_embeddings
from keyss.methods.learned.payload import HiddenSecret
from keyss.methods.learned.revealing import decode, reveal_gaussians


def measure_hiding(
    stego: Gaussians,
    opened: Sequence[HiddenSecret],
    scenes: Sequence[Scene],  # the cover, then the secrets in the order of `opened`, each in its own frame
    bounds: Sequence[Gaussians],  # plain models of the scenes, each in its own frame
    *,
    wrong_keys: int = 32,
    seed: int = 0,
) -> dict[str, Any]:
    """Qualities of cover and secrets, their bounds, and what wrong keys show.

    `bound`: the plain models. `wrong_key`: PSNR of what the decoders make of wrong embeddings (drawn as those
    of random keys fall), against the cover's photos and, seen from the secrets' own cameras, against theirs;
    only somebody who has a decoder but not its key would see that. `floor` is the stego cover itself against
    the secrets' photos, which a wrong key should look like.
    Raises UsageError for no wrong keys at all.
    """
    if wrong_keys < 1:
        raise UsageError(f"expected at least one wrong key, got {wrong_keys}")
    cover, secrets = scenes[0], scenes[1:]
    revealed = [reveal_gaussians(stego, each).to(stego.device) for each in opened]
    wrong = random_embeddings(wrong_keys, torch.Generator().manual_seed(seed))
    return {
        "cover": _quality(cover, stego),
        "secrets": [_quality(secret, model) for secret, model in zip(secrets, revealed, strict=True)],
        "bound": {
            "cover": _quality(cover, bounds[0]),
            "secrets": [_quality(secret, model) for secret, model in zip(secrets, bounds[1:], strict=True)],
        },
        "wrong_key": {"keys": wrong_keys, **what_wrong_keys_show(stego, opened, scenes, wrong)},
        "gaussians": len(stego),
    }


def what_wrong_keys_show(
    stego: Gaussians, opened: Sequence[HiddenSecret], scenes: Sequence[Scene], embeddings: Tensor
) -> dict[str, Any]:
    """PSNRs of what the decoders make of embeddings [E, 64] that are not theirs; see `measure_hiding`."""
    cover, secrets = scenes[0], scenes[1:]
    against_cover: list[float] = []
    against_secrets: list[list[float]] = [[] for _ in secrets]
    for embedding in embeddings:
        shown = 0.0
        for index, (each, secret) in enumerate(zip(opened, secrets, strict=True)):
            decoy = decode(stego, each, embedding)
            shown += _psnr_in(cover, decoy) / len(opened)
            against_secrets[index].append(_psnr_in(secret, each.frame.inverse().apply_gaussians(decoy)))
        against_cover.append(shown)
    return {
        "vs_cover": {"mean": sum(against_cover) / len(against_cover), "min": min(against_cover)},
        "vs_secrets": [{"mean": sum(v) / len(v), "max": max(v)} for v in against_secrets],
        "floor": [
            _psnr_in(secret, each.frame.inverse().apply_gaussians(stego))
            for each, secret in zip(opened, secrets, strict=True)
        ],
    }


def _quality(scene: Scene, model: Gaussians) -> dict[str, float]:
    result: ImageQuality = quality(model, scene.test, _background(scene, model))
    return asdict(result)


def _psnr_in(scene: Scene, model: Gaussians) -> float:
    return mean_psnr(model, scene.test, _background(scene, model))


def _background(scene: Scene, model: Gaussians) -> torch.Tensor:
    return scene.background.to(model.device)
