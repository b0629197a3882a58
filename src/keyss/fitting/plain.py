"""Plain 3DGS: one scene from its training photos (Kerbl et al. 2023)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.checkpoint import State, pack_density, pack_optimizers, unpack_density, unpack_optimizers
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy
from keyss.fitting.image_metrics import mean_psnr, subsample_views
from keyss.fitting.loop import Reporter, train
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import (
    initial_gaussians,
    initial_points,
    make_optimizers,
    to_gaussians,
    to_parameters,
)
from keyss.fitting.sampling import Shuffle
from keyss.rendering import render_with_meta


@dataclass(frozen=True)
class FitResult:
    """A fitted model and how it came about."""

    gaussians: Gaussians  # on the CPU
    config: FitConfig
    seconds: float


class PlainRun:
    """The state of a plain 3DGS training and its step."""

    def __init__(self, scene: Scene, config: FitConfig, device: torch.device) -> None:
        self.config = config
        self.device = device
        self.views = scene.train
        self.watched = subsample_views(scene.test, 8)
        self.background = scene.background.to(device)
        self.iterations = config.iterations
        self.iteration = 0
        self.generator = torch.Generator().manual_seed(config.known_seed)
        points, colors = initial_points(scene, config.max_gaussians, self.generator)
        start = initial_gaussians(points, colors, config.sh_degree, config.max_gaussians, self.generator)
        self.parameters = to_parameters(start, device)
        self.means_rate = config.means_rate * scene.extent
        self.optimizers = make_optimizers(self.parameters, config, scene.extent)
        self.strategy = CappedStrategy(config)
        self.density: dict[str, Any] = self.strategy.initialize_state(scene.extent)
        self.shuffle = Shuffle(len(self.views), self.generator)

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self) -> None:
        config = self.config
        view = self.views[self.shuffle.draw()]
        self.iteration += 1
        degree = config.sh_degree_at(self.iteration)
        model = to_gaussians(self.parameters)
        image, meta = render_with_meta(model, view.camera, self.background, sh_degree=degree)
        loss = photometric_loss(image, Target.of(view.image.to(self.device)), config.ssim_weight)
        self.strategy.step_pre_backward(self.parameters, self.optimizers, self.density, self.iteration, meta)
        loss.backward()
        decay = 0.01 ** (self.iteration / config.iterations)
        self.optimizers["means"].param_groups[0]["lr"] = self.means_rate * decay
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, meta)

    def gaussians(self) -> Gaussians:
        return to_gaussians(self.parameters).detach()

    def evaluate(self) -> dict[str, float]:
        return {"PSNR": mean_psnr(self.gaussians(), self.watched, self.background)}

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_optimizers(self.parameters, self.optimizers) | pack_density(self.density)
        tensors |= {"order": self.shuffle.state(), "generator": self.generator.get_state()}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_optimizers(tensors, self.parameters, self.optimizers)
        unpack_density(tensors, self.density, self.device)
        self.shuffle.load(tensors["order"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])


def fit_scene(
    scene: Scene,
    config: FitConfig | None = None,
    *,
    device: torch.device | str = "cpu",
    title: str = "fit",
    checkpoint: Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
) -> FitResult:
    """Train plain 3DGS on the training views of `scene`; what is to be resumed needs a seed.

    Raises Interrupted on Ctrl-C after saving `checkpoint`, InputError for a checkpoint of another run.
    """
    config = (config or FitConfig()).seeded()
    run = PlainRun(scene, config, torch.device(device))
    seconds = train(
        run,
        title,
        fingerprint={"scene": scene.digest(), "config": asdict(config), "device": str(device)},
        seed=config.known_seed,
        checkpoint=checkpoint,
        resume=resume,
        checkpoint_seconds=config.checkpoint_seconds,
        evaluate_every=config.evaluate_every,
        reporter=reporter,
    )
    return FitResult(without_faint(run.gaussians().to("cpu"), config.prune_opacity), replace(config), seconds)


def without_faint(model: Gaussians, least: float) -> Gaussians:
    """`model` without what fell below the limit of pruning after density control had stopped.

    Files of the original trainer have nothing there either, and what hides something must not be known by
    having nothing.
    """
    kept = model.opacities >= least
    return model[kept] if kept.any() else model
