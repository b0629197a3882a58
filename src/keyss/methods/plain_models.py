"""Plain models, from which methods start, and upper bounds, with which their results are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.plain import fit_scene
from keyss.methods.method import Context, Source, role_of, role_phrase


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
    return [
        replace(source, given=fitted[index], steps=configs[index].iterations) if index in fitted else source
        for index, source in enumerate(sources)
    ]


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
