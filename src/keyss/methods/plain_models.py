"""Plain models, from which methods start, and upper bounds, with which their results are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.methods.method import Context, Source, Training, role_of, role_phrase


def fit_plain_models(
    sources: Sequence[Source],  # the cover, then the secrets
    configs: Sequence[FitConfig],
    context: Context,
) -> list[Source]:
    """Fit missing plain models, on the CPU and in their own frames.

    Each fit has its own seed, derived from its config's, which does not reveal other seeds. Raises the errors
    of `fit_scene`.
    """
    missing = {
        index: (source.scene, config)
        for index, (source, config) in enumerate(zip(sources, configs, strict=True))
        if source.given is None
    }
    titles = [f"plain model of {role_phrase(role_of(index, len(sources)))}" for index in range(len(sources))]
    fitted = _fit_all(missing, "plain model", titles, context)
    return [replace(source, given=fitted.get(index, source.given)) for index, source in enumerate(sources)]


@dataclass(frozen=True)
class Bound:
    """An upper bound: plain 3DGS with as many Gaussians and training steps as a scene had."""

    steps: int | None  # total training steps of the scene; None: unknown, its plain model was given
    equal: bool  # True if the plain model has equal steps and is the upper bound itself

    @staticmethod
    def of(training: Training, plain_steps: int | None) -> Bound:
        """The upper bound of a scene; `plain_steps`: steps of its plain model, if known."""
        if not training.continues:
            return Bound(training.steps, training.steps == plain_steps)
        if not training.steps:
            return Bound(plain_steps, True)
        return Bound(None if plain_steps is None else plain_steps + training.steps, False)

    def config(self, fit: FitConfig, gaussians: int | None = None) -> FitConfig:
        """The fit, with at most `gaussians`; `steps` must be known."""
        assert self.steps is not None
        limit = fit.max_gaussians if gaussians is None else max(16, gaussians)
        return replace(fit, iterations=self.steps, max_gaussians=limit)


def fit_bounds(
    scenes: Sequence[Scene], configs: Mapping[int, FitConfig], context: Context
) -> dict[int, Gaussians]:
    """The upper bounds of some scenes, by index; see `fit_plain_models`."""
    fits = {index: (scenes[index], config) for index, config in configs.items()}
    return _fit_all(fits, "bound", ["plain 3DGS of as many steps"] * len(scenes), context)


def _fit_all(
    fits: Mapping[int, tuple[Scene, FitConfig]], kind: str, titles: Sequence[str], context: Context
) -> dict[int, Gaussians]:
    """Fit scenes by index, the cover first; `kind` names the seeds and the checkpoints."""
    return {
        index: fit_scene(
            scene,
            replace(config, seed=config.seed_of(f"{kind} {index}")),
            title=f"{titles[index]} ({scene.name})",
            device=context.device,
            **context.loop_arguments(f"{kind.split()[0]}-{index}"),
        ).gaussians
        for index, (scene, config) in fits.items()
    }
