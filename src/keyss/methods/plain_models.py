"""Plain models that a method starts from, and bounds that its results are compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.methods.base import Context, Source, Training, role_of


def with_plain_models(
    sources: Sequence[Source],  # the cover, then the secrets
    configs: Sequence[FitConfig],
    context: Context,
) -> list[Source]:
    """The sources with plain models on the CPU, in their own frames; those that are not given are fitted.

    Each fit has its own seed, derived from that of its config, and tells nothing of the seeds of others.
    Raises what `fit_scene` raises.
    """
    missing = {
        index: (source.scene, config)
        for index, (source, config) in enumerate(zip(sources, configs, strict=True))
        if source.given is None
    }
    titles = [plain_stage(role_of(index, len(sources))) for index in range(len(sources))]
    fitted = _fit_all(missing, "plain model", titles, context)
    return [replace(source, given=fitted.get(index, source.given)) for index, source in enumerate(sources)]


def plain_stage(role: str) -> str:
    """The title of the fit of a plain model; `role`: see `role_of`."""
    return f"plain model of the {role}"


@dataclass(frozen=True)
class Bound:
    """Plain 3DGS of as many Gaussians and as many training steps as a scene had, for comparison."""

    steps: int | None  # total training steps of the scene; None: unknown, its plain model was given
    equal: bool  # True if the plain model has as many steps and is the bound itself

    @staticmethod
    def of(training: Training, plain_steps: int | None) -> Bound:
        """The bound of a scene; `plain_steps`: steps of its plain model, if they are known."""
        if not training.continues:
            return Bound(training.steps, training.steps == plain_steps)
        if not training.steps:
            return Bound(plain_steps, True)
        return Bound(None if plain_steps is None else plain_steps + training.steps, False)

    def config(self, fit: FitConfig, gaussians: int | None = None) -> FitConfig:
        """The fit, with at most so many `gaussians`. Raises ValueError if `steps` are not known."""
        if self.steps is None:
            raise ValueError("the number of steps is not known")
        limit = fit.max_gaussians if gaussians is None else max(16, gaussians)
        return replace(fit, iterations=self.steps, max_gaussians=limit)


def fit_bounds(
    scenes: Sequence[Scene], configs: Mapping[int, FitConfig], context: Context
) -> dict[int, Gaussians]:
    """The bounds of some scenes, by index; see `with_plain_models`."""
    fits = {index: (scenes[index], config) for index, config in configs.items()}
    return _fit_all(fits, "bound", ["plain 3DGS of as many steps"] * len(scenes), context)


def _fit_all(
    fits: Mapping[int, tuple[Scene, FitConfig]], kind: str, titles: Sequence[str], context: Context
) -> dict[int, Gaussians]:
    """Fit scenes by index, the cover first; `kind` names the seeds and the checkpoints."""
    folder = context.checkpoints
    return {
        index: fit_scene(
            scene,
            replace(config, seed=config.seed_of(f"{kind} {index}")),
            title=f"{titles[index]} ({scene.name})",
            checkpoint=folder / f"{kind.split()[0]}-{index}.safetensors" if folder else None,
            reporter=context.reporter if index == 0 else context.reporter and context.reporter.of_secret(),
            device=context.device,
            resume=context.resume,
        ).gaussians
        for index, (scene, config) in fits.items()
    }
