"""Refits: further training of secrets with as many Gaussians as the cover has room for."""

from __future__ import annotations

from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.plain import fit_scene
from keyss.fitting.schedule import boost_of
from keyss.methods.base import Context
from keyss.rendering import contributions

# Without photos, the start is nearly right: the largest number of steps, and a factor on the rates.
MODEL_ITERATIONS, _MODEL_RATE = 400, 0.1
_SELECTION_VIEWS = 64


def refitted(
    secret: Gaussians,
    scene: Scene,
    count: int,
    fit: FitConfig,
    context: Context,
    *,
    photos: bool,
    name: str,
) -> Gaussians:
    """Train the `count` Gaussians of `secret` that contribute most.

    Raises Interrupted on Ctrl-C, InputError for a checkpoint of another run.
    """
    return fit_scene(
        scene,
        # A refit must not depend on the other secrets.
        replace(fit, seed=fit.seed_of(name)),
        model=most_contributing(secret, scene, count),
        rate=boost_of(fit) if photos else _MODEL_RATE,
        device=context.device,
        title=f"refit of the {name}",
        checkpoint=context.checkpoints / f"{name.replace(' ', '-')}.safetensors"
        if context.checkpoints
        else None,
        resume=context.resume,
        reporter=context.reporter and context.reporter.of_secret(),
    ).gaussians


def most_contributing(plain: Gaussians, scene: Scene, count: int) -> Gaussians:
    """The `count` Gaussians with the largest blending weights in the training views, in their order."""
    if count >= len(plain):
        return plain
    cameras = [view.camera for view in subsample_views(scene.train, _SELECTION_VIEWS)]
    return plain[contributions(plain, cameras).topk(count).indices.sort().values]
