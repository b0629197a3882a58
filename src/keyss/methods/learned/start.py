"""What the joint training starts from: the plain models' Gaussians (warm), or sparse points (the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.parameters import initial_gaussians, initial_points
from keyss.methods.learned.opacity_band import DRAWN_LOGIT, hidden_logits
from keyss.methods.learned.options import LearnedOptions, chosen_scenes
from keyss.methods.learned.room import divided
from keyss.methods.learned.targets import PlacedScene
from keyss.rendering.contributions import contributions

SELECTION_VIEWS = 64


def make_start(
    scenes: Sequence[PlacedScene], config: LearnedOptions, generator: torch.Generator
) -> Gaussians:
    """Initial Gaussians of the published model, for the cover (first of `scenes`) and its secrets."""
    if config.start == "points":
        return _from_points(scenes, config, generator)
    return _from_models(scenes, config)


def _from_points(
    scenes: Sequence[PlacedScene], config: LearnedOptions, generator: torch.Generator
) -> Gaussians:
    """Combined SfM points: an equal share of the cap for every scene, what one leaves goes to the others."""
    fit = config.fit
    chosen = [scenes[index].scene for index in chosen_scenes(config.points, len(scenes))]
    clouds = [initial_points(scene, fit.max_gaussians, generator) for scene in chosen]
    counts = divided([len(points) for points, _ in clouds], [1.0] * len(clouds), fit.max_gaussians)
    parts = [
        initial_gaussians(points, colors, fit.sh_degree, share, generator)
        for (points, colors), share in zip(clouds, counts, strict=True)
    ]
    return Gaussians.cat(parts)


def _from_models(scenes: Sequence[PlacedScene], config: LearnedOptions) -> Gaussians:
    """The most contributing Gaussians of every plain model; those of the secrets transparent in the cover."""
    plains = [placed.plain.with_sh_degree(config.fit.sh_degree) for placed in scenes]
    # What is never drawn would lie among the hidden.
    plains = [plain[(plain.opacity_logits > DRAWN_LOGIT) & ~plain.overflow] for plain in plains]
    weights = [1.0] + [config.secret_share] * (len(plains) - 1)
    counts = divided([len(plain) for plain in plains], weights, config.fit.max_gaussians)
    chosen = [
        most_contributing(plain, placed.scene, share)
        for plain, placed, share in zip(plains, scenes, counts, strict=True)
    ]
    parts = chosen[:1] + [
        replace(part, opacity_logits=hidden_logits(part.opacity_logits, secret))
        for secret, part in enumerate(chosen[1:])
    ]
    return Gaussians.cat(parts)


def most_contributing(plain: Gaussians, scene: Scene, count: int) -> Gaussians:
    """The `count` Gaussians that add most to what the training views show, in their order."""
    if count >= len(plain):
        return plain
    cameras = [view.camera for view in subsample_views(scene.train, SELECTION_VIEWS)]
    return plain[contributions(plain, cameras).topk(count).indices.sort().values]
