"""Plain 3DGS (Kerbl et al. 2023): train a model on the photos of one scene, or fine-tune a given model."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.files.images import downscale
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy
from keyss.fitting.image_metrics import mean_psnr, subsample_views
from keyss.fitting.loop import Shuffle, TrainingRun, train
from keyss.fitting.losses import Target, Targets, photometric_loss
from keyss.fitting.parameters import (
    initial_gaussians,
    initial_points,
    make_optimizers,
    to_gaussians,
    to_parameters,
)
from keyss.fitting.schedule import Schedule, shrinking
from keyss.progress import Reporter
from keyss.rendering import render_with_meta

FINE_TUNING_SETTLE = 0.5  # `settle` of fine-tuning


@dataclass(frozen=True)
class FitResult:
    """A fitted model and its configuration."""

    gaussians: Gaussians  # on the CPU
    config: FitConfig  # includes the seed


class PlainRun(TrainingRun):
    """A plain 3DGS training. With a `model`, it starts from it and keeps its number of Gaussians."""

    def __init__(
        self, scene: Scene, config: FitConfig, device: torch.device, model: Gaussians | None = None
    ) -> None:
        super().__init__(config, device)
        self.grows = model is None
        self.views = scene.train
        self.watched = subsample_views(scene.test, 8)
        self.background = scene.background.to(device)
        if model is None:
            points, colors = initial_points(scene, config.max_gaussians, self.generator)
            model = initial_gaussians(points, colors, config.sh_degree, config.max_gaussians, self.generator)
        self.parameters = to_parameters(model, device)
        self.optimizers = make_optimizers(self.parameters, config, scene.extent)
        self.schedule = Schedule(config, [view.camera for view in self.views], scene.extent)
        self.strategy = CappedStrategy(config if self.grows else replace(config, grow_stop=0.0))
        self.density = self.strategy.initialize_state(scene.extent)
        self.order = self.shuffles["order"] = Shuffle(len(self.views), self.generator)
        self.pixels = max(view.camera.width * view.camera.height for view in self.views)
        self.shrunk, self.targets = 1, Targets()

    def step(self) -> None:
        fit = self.fit
        index = self.order.sample()
        self.iteration += 1
        degree = fit.sh_degree_at(self.iteration) if self.grows else fit.sh_degree
        factor = shrinking(fit, self.iteration, self.pixels) if self.grows else 1
        if factor != self.shrunk:
            self.shrunk, self.targets = factor, Targets()
        view = self.views[index]
        camera = view.camera
        size = max(1, camera.width // factor), max(1, camera.height // factor)
        camera = camera if factor == 1 else camera.resized(*size)
        model = to_gaussians(self.parameters)
        image, meta = render_with_meta(model, camera, self.background, sh_degree=degree)
        target = self.targets.of(index, lambda: _target(view, size, self.device))
        self.optimise(photometric_loss(image, target, fit.ssim_weight), [(meta, None, 1.0)])
        if self.grows and self.iteration == self.iterations:
            # Gaussians become faint after density control has stopped. The original trainer leaves none
            # either, so their absence does not reveal a secret.
            self.strategy.prune(self.parameters, self.optimizers, self.density)

    def gaussians(self) -> Gaussians:
        return to_gaussians(self.parameters).detach()

    def evaluate(self) -> dict[str, float]:
        return {
            f"PSNR of {len(self.watched)} views": mean_psnr(self.gaussians(), self.watched, self.background)
        }


def _target(view: View, size: tuple[int, int], device: torch.device) -> Target:
    """The target of a photo, shrunk to `size` (width, height) if it is larger."""
    image, mask = view.image, view.mask
    if size != (view.camera.width, view.camera.height):
        image = torch.from_numpy(downscale(image.numpy(), *size))
        if mask is not None:
            shares = downscale(np.uint8(255) * mask.numpy(), *size)
            mask = torch.from_numpy(shares >= min(128, shares.max()))  # at least one pixel
    return Target.of(image.to(device), mask)


def fit_scene(
    scene: Scene,
    config: FitConfig | None = None,
    *,
    model: Gaussians | None = None,
    rate: float = 1.0,
    device: torch.device | str = "cpu",
    title: str = "fit",
    checkpoint: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Train plain 3DGS on the training views of `scene`; only a run with a seed can be resumed.

    A given `model` is fine-tuned without density control, at the rates of `config` times `rate` and at its
    own SH degree. Raises Interrupted on Ctrl-C after saving `checkpoint`, InputError for a checkpoint of
    another run.
    """
    config, inputs = (config or FitConfig()).with_seed(), {"scene": scene.digest()}
    if model is not None:
        rates = {name: rate * value for name, value in vars(config).items() if name.endswith("_rate")}
        config = replace(config, sh_degree=model.sh_degree, settle=FINE_TUNING_SETTLE, boost=1.0, **rates)
        inputs["model"] = model.digest()
    run = PlainRun(scene, config, torch.device(device), model)
    fingerprint = {**inputs, "config": asdict(config)}
    train(run, title, fingerprint=fingerprint, checkpoint=checkpoint, resume=resume, reporter=reporter)
    return FitResult(run.gaussians().to("cpu"), config)
