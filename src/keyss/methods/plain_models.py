"""Plain models beside a method: those before it, given or fitted here, and those it is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.loop import of_secret
from keyss.fitting.plain import fit_scene
from keyss.methods.base import Context, Training, role_of


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
            folder = context.checkpoints
            model = fit_scene(
                scene,
                replace(config, seed=config.seed_of(f"plain model {index}")),
                device=context.device,
                title=f"plain model of the {role_of(index, len(scenes))} ({scene.name})",
                checkpoint=folder / f"plain-{index}.safetensors" if folder else None,
                resume=context.resume,
                reporter=context.reporter if index == 0 else of_secret(context.reporter),
            ).gaussians
        models.append(model)
    return models


@dataclass(frozen=True)
class Bound:
    """Plain 3DGS of as many Gaussians and as many training steps as a scene had, for comparison."""

    steps: int | None  # of the scene, in all; None: its plain model was given, and nothing is known of it
    equal: bool  # whether its plain model has as many, so that it is the bound itself

    @staticmethod
    def of(training: Training, plain_steps: int | None) -> Bound:
        """Of a scene whose plain model had `plain_steps`, where they are known."""
        if not training.goes_on:
            return Bound(training.steps, training.steps == plain_steps)
        if not training.steps:
            return Bound(plain_steps, True)
        return Bound(None if plain_steps is None else plain_steps + training.steps, False)

    def config(self, fit: FitConfig, gaussians: int | None = None) -> FitConfig:
        """How it is fitted, with `gaussians` at most. Raises ValueError where `steps` are not known."""
        if self.steps is None:
            raise ValueError("the number of steps is not known")
        most = fit.max_gaussians if gaussians is None else max(16, gaussians)
        return replace(fit, iterations=self.steps, max_gaussians=most)


def fit_bound(scene: Scene, config: FitConfig, index: int, context: Context) -> Gaussians:
    """The bound of scene `index` of a hiding, on the CPU, from a seed of its own; see `plain_models`."""
    folder = context.checkpoints
    return fit_scene(
        scene,
        replace(config, seed=config.seed_of(f"bound {index}")),
        device=context.device,
        title=f"plain 3DGS of as many steps ({scene.name})",
        checkpoint=folder / f"bound-{index}.safetensors" if folder else None,
        resume=context.resume,
        reporter=context.reporter if index == 0 else of_secret(context.reporter),
    ).gaussians
