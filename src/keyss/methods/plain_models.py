"""Plain models, from which methods start, and upper bounds, with which their results are compared."""

from __future__ import annotations

from collections.abc import Sequence
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
    fitted = list(sources)
    for index, (source, config) in enumerate(zip(sources, configs, strict=True)):
        if source.given is None:
            title = f"plain model of {role_phrase(role_of(index, len(sources)))}"
            model = _fit(source.scene, config, f"plain model {index}", title, context)
            fitted[index] = replace(source, given=model, steps=config.iterations)
    return fitted


def fit_bound(scene: Scene, config: FitConfig, index: int, context: Context) -> Gaussians:
    """The upper bound of scene `index`; see `fit_plain_models`."""
    return _fit(scene, config, f"bound {index}", "plain 3DGS of as many steps", context)


def _fit(scene: Scene, config: FitConfig, name: str, title: str, context: Context) -> Gaussians:
    """Fit a scene; `name` names the seed and the checkpoint."""
    words = name.split()
    return fit_scene(
        scene,
        replace(config, seed=config.seed_of(name)),
        title=f"{title} ({scene.name})",
        device=context.device,
        **context.loop_arguments(f"{words[0]}-{words[-1]}"),
    ).gaussians
