"""The stage before every method: a plain model of each scene, given or fitted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import of_secret
from keyss.fitting.plain import fit_scene
from keyss.methods.base import Context


def plain_models(
    scenes: Sequence[Scene],  # the cover, then the secrets
    given: Sequence[Gaussians | None],
    config: FitConfig,
    context: Context,
) -> list[Gaussians]:
    """Plain models of the scenes on the CPU, in their own frames; those that are not given are fitted.

    Each from a seed of its own, which follows from that of `config`: what one model tells of its seed tells
    nothing of the others'.
    Raises Interrupted on Ctrl-C, InputError for a checkpoint of another run.
    """
    models = []
    for index, (scene, model) in enumerate(zip(scenes, given, strict=True)):
        if model is None:
            role = "cover" if index == 0 else "secret" if len(scenes) == 2 else f"secret {index}"
            folder = context.checkpoints
            model = fit_scene(
                scene,
                replace(config, seed=config.seed_of(f"plain model {index}")),
                device=context.device,
                title=f"plain model of the {role} ({scene.name})",
                checkpoint=folder / f"plain-{index}.safetensors" if folder else None,
                resume=context.resume,
                reporter=context.reporter if index == 0 else of_secret(context.reporter),
            ).gaussians
        models.append(model)
    return models
