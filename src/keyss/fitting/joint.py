"""Joint training of several scenes: views, rates, checkpoints, and the part of a step after the loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, Scene
from keyss.fitting.checkpoint import State, pack_model, pack_network, unpack_model, unpack_network
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.fixed_rows import of_scene
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.parameters import Optimizers, Parameters, make_optimizers, to_parameters
from keyss.fitting.sampling import Shuffle, own_randomness
from keyss.fitting.schedule import Schedule

T = TypeVar("T")


class JointRun(ABC):
    """See `keyss.fitting.loop.TrainingRun`. Scene 0 gives the scale; all scenes are in one frame."""

    parameters: Parameters  # Gaussians
    optimizers: Optimizers
    networks: torch.nn.ModuleList

    def __init__(
        self, scenes: Sequence[Scene], fit: FitConfig, device: torch.device, names: Sequence[str]
    ) -> None:
        self.fit, self.device, self.names = fit, device, names
        self.iterations, self.iteration = fit.iterations, 0
        self.views_per_step = fit.views_per_step
        self.generator = torch.Generator().manual_seed(fit.known_seed)
        self.watched = [subsample_views(scene.test, 8) for scene in scenes]
        self.backgrounds = [scene.background.to(device) for scene in scenes]
        # One generator per scene: the order of the first scene's views must not depend on the others.
        self.orders = [
            torch.Generator().manual_seed(fit.seed_of(f"views of scene {index}"))
            for index in range(len(scenes))
        ]
        self.shuffles = [
            Shuffle(len(scene.train), order) for scene, order in zip(scenes, self.orders, strict=True)
        ]
        self.extent = scenes[0].extent
        cameras = [view.camera for scene in scenes for view in scene.train]
        self.schedules = [Schedule(fit, cameras, self.extent)]  # scenes with own parameters

    def begin(self, start: Gaussians, network_rate: float, weight_decay: float) -> None:
        """Make parameters, networks and optimisers. AdamW trains networks; its rate decays to 5 %."""
        self.parameters = to_parameters(start, self.device)
        self.optimizers = make_optimizers(self.parameters, self.fit, self.extent)
        self.networks, self.network_rate = torch.nn.ModuleList(), network_rate
        with own_randomness(self.fit.known_seed):
            self.prepare(start)
        self.networks.to(self.device)
        # Without networks, the optimiser still needs a parameter.
        weights = list(self.networks.parameters()) or [torch.nn.Parameter(torch.zeros(1))]
        self.network_optimizer = torch.optim.AdamW(weights, lr=network_rate, weight_decay=weight_decay)
        self.strategy = self.density_control()
        self.density: dict[str, Any] = self.strategy.initialize_state(self.extent)

    @abstractmethod
    def prepare(self, start: Gaussians) -> None:
        """Add the networks and parameters to train beside `start`, under the run's own random state."""

    @abstractmethod
    def density_control(self) -> CappedStrategy:
        """The strategy that clones, splits and prunes."""

    @abstractmethod
    def show(self, scene: int, camera: Camera, sh_degree: int) -> Tensor:
        """[H, W, 3] a render of a scene."""

    def optimise(self, views: Sequence[T], loss_at: Callable[[T], tuple[Tensor, list[Rendered]]]) -> None:
        """Take an optimisation step on the mean loss of `views`; see `CappedStrategy.backward`."""
        self.loss, info = self.strategy.backward(views, loss_at, len(self))
        self.set_rates()
        for optimizer in (*self.optimizers.values(), self.network_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, info)

    def set_rates(self) -> None:
        for scene, schedule in enumerate(self.schedules):
            schedule.set(of_scene(self.optimizers, scene), self.iteration)
        rate = self.network_rate * 0.05 ** (self.iteration / self.iterations)
        self.network_optimizer.param_groups[0]["lr"] = rate

    def __len__(self) -> int:
        return len(self.parameters["means"])

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Mean PSNR of each scene on held-out views."""
        found = {}
        for scene, (name, views) in enumerate(zip(self.names, self.watched, strict=True)):
            shown = [(view, self.show(scene, view.camera, self.fit.sh_degree)) for view in views]
            values = [psnr(image, view.photo(self.device), view.mask) for view, image in shown]
            found[name] = sum(values) / len(values)
        return found

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_model(self.parameters, self.optimizers, self.density)
        tensors |= pack_network("networks", self.networks, self.network_optimizer)
        tensors["generator"] = self.generator.get_state()
        tensors |= {f"order.{i}": shuffle.state() for i, shuffle in enumerate(self.shuffles)}
        tensors |= {f"order_generator.{i}": order.get_state() for i, order in enumerate(self.orders)}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_model(tensors, self.parameters, self.optimizers, self.density)
        unpack_network(tensors, "networks", self.networks, self.network_optimizer)
        for i, shuffle in enumerate(self.shuffles):
            shuffle.load(tensors[f"order.{i}"])
            self.orders[i].set_state(tensors[f"order_generator.{i}"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])
