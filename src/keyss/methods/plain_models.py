"""Plain models beside a method: those before it, given or fitted here, and those it is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.reporting import of_secret
from keyss.fitting.side_by_side import Fit, fit_scenes
from keyss.methods.base import Context, Source, Training, role_of


def with_plain_models(
    sources: Sequence[Source],  # the cover, then the secrets
    configs: Sequence[FitConfig],
    context: Context,
) -> list[Source]:
    """The sources with plain models on the CPU, in their own frames; those that are not given are fitted.

    Each has a seed of its own, which follows from that of its config: one model tells nothing of the seeds of
    others. See `fit_scenes` for what it raises.
    """
    missing = {
        index: _fit(
            source.scene,
            replace(config, seed=config.seed_of(f"plain model {index}")),
            f"{plain_stage(role_of(index, len(sources)))} ({source.scene.name})",
            f"plain-{index}",
            index,
            context,
        )
        for index, (source, config) in enumerate(zip(sources, configs, strict=True))
        if source.given is None
    }
    fitted = _fitted(missing, context)
    return [replace(source, fitted=fitted.get(index)) for index, source in enumerate(sources)]


def plain_stage(role: str) -> str:
    """What the fitting of the plain model of `role_of` is called."""
    return f"plain model of the {role}"


@dataclass(frozen=True)
class Bound:
    """Plain 3DGS of as many Gaussians and as many training steps as a scene had, for comparison."""

    steps: int | None  # of the scene, in all; None: its plain model was given, and nothing is known of it
    equal: bool  # whether its plain model has as many, so that it is the bound itself

    @staticmethod
    def of(training: Training, plain_steps: int | None) -> Bound:
        """Of a scene whose plain model had `plain_steps`, where they are known."""
        if not training.continues:
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


def fit_bounds(
    scenes: Sequence[Scene], configs: Mapping[int, FitConfig], context: Context
) -> dict[int, Gaussians]:
    """The bounds of some scenes of a hiding, by their index, from seeds of their own; see `plain_models`."""
    fits = {
        index: _fit(
            scenes[index],
            replace(config, seed=config.seed_of(f"bound {index}")),
            f"plain 3DGS of as many steps ({scenes[index].name})",
            f"bound-{index}",
            index,
            context,
        )
        for index, config in configs.items()
    }
    return _fitted(fits, context)


def _fit(scene: Scene, config: FitConfig, title: str, name: str, index: int, context: Context) -> Fit:
    return Fit(
        scene,
        config,
        title,
        context.checkpoints / f"{name}.safetensors" if context.checkpoints else None,
        context.reporter if index == 0 else of_secret(context.reporter),
    )


def _fitted(fits: Mapping[int, Fit], context: Context) -> dict[int, Gaussians]:
    models = fit_scenes(list(fits.values()), device=context.device, resume=context.resume)
    return dict(zip(fits, models, strict=True))
