"""The joint training that all peers share: one set of Gaussians, two scenes, and what shows each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.adam import RowAdam
from keyss.fitting.checkpoint import (
    State,
    pack_density,
    pack_network,
    pack_optimizers,
    unpack_density,
    unpack_network,
    unpack_optimizers,
)
from keyss.fitting.density import CappedStrategy, Drawn, combine_densification, draw_views
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import make_optimizers, to_parameters
from keyss.fitting.ranks import here
from keyss.fitting.sampling import Shuffle, own_randomness
from keyss.methods.peers.options import PeerOptions
from keyss.methods.points import combined_points
from keyss.methods.poses import CombinedPoses, PlacedScene

Picture = tuple[Tensor, dict[str, Any]]  # [H, W, 3], and the meta of what was drawn for it


class PeerRun:
    """The state of a peer's training, and its step; what a peer is made of, its subclass says.

    `prepare` adds parameters of the Gaussians (`add`) and `networks`; `draw` makes pictures of both.
    """

    def __init__(self, scenes: Sequence[PlacedScene], options: PeerOptions, device: torch.device) -> None:
        fit = options.fit
        self.options, self.device, self.scenes = options, device, scenes
        self.iterations, self.iteration = fit.iterations, 0
        self.views_per_step = here().views(fit.views_per_step)
        self.weights = (options.cover_weight, options.secret_weight)
        self.generator = torch.Generator().manual_seed(fit.known_seed)
        self.poses = CombinedPoses(scenes, device)
        self.watched = [subsample_views(placed.scene.test, 8) for placed in scenes]
        self.backgrounds = [placed.scene.background.to(device) for placed in scenes]
        self.owner_order = Shuffle(len(scenes), self.generator)
        self.shuffles = [Shuffle(len(placed.scene.train), self.generator) for placed in scenes]
        self.extent = scenes[0].scene.extent

        sources = scenes if options.points == "both" else scenes[:1]
        start = combined_points([placed.scene for placed in sources], fit, self.generator)
        self.parameters = to_parameters(start, device)
        self.optimizers = make_optimizers(self.parameters, fit, self.extent)
        self.networks = torch.nn.ModuleList()
        with own_randomness(fit.known_seed):
            self.prepare(start)
        self.networks.to(device)
        # An optimiser has something to optimise, also where there is no network.
        weights = list(self.networks.parameters()) or [torch.nn.Parameter(torch.zeros(1))]
        self.network_optimizer = torch.optim.Adam(weights, lr=options.network_rate)
        self.rate_of_means = self.optimizers["means"].param_groups[0]["lr"]
        self.strategy = CappedStrategy(fit, self.opacity_for_pruning)
        self.density: dict[str, Any] = self.strategy.initialize_state(self.extent)

    def prepare(self, start: Gaussians) -> None:
        """Add what the peer has beside plain Gaussians; weights are drawn from a seed of the run's."""

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """Pictures of the cover (0) or the secret (1), in that order; they may share what was drawn."""
        raise NotImplementedError

    def opacity_for_pruning(self) -> Tensor:
        """[N] how visible a Gaussian is where it is seen most."""
        return self.parameters["opacities"].sigmoid()

    def add(self, name: str, values: Tensor, optimizer: RowAdam | float) -> None:
        """A parameter [N, ...] of the Gaussians, with a rate or what moves it."""
        self.parameters[name] = parameter = torch.nn.Parameter(values.to(self.device).contiguous())
        if isinstance(optimizer, RowAdam):
            optimizer.param_groups[0]["params"] = [parameter]
            self.optimizers[name] = optimizer
        else:
            fused = self.device.type == "cuda"
            self.optimizers[name] = RowAdam(
                [{"params": [parameter], "lr": optimizer}], eps=1e-15, fused=fused
            )

    def geometry(self) -> dict[str, Tensor]:
        """What all scenes share, by the names of `Gaussians`, attached to the graph."""
        names = {"means": "means", "quats": "quats", "log_scales": "scales"}
        return {name: self.parameters[own] for name, own in names.items()}

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self) -> None:
        self.iteration += 1
        views = [self._draw_poses() for _ in range(self.views_per_step)]
        total, drawn = draw_views(views, self._loss_at)
        trained = (*self.parameters.values(), *self.networks.parameters())
        seen = combine_densification(drawn, len(self))
        self.loss, seen = self.strategy.over_ranks(total, trained, self.parameters, seen)
        self._set_rates()
        for optimizer in (*self.optimizers.values(), self.network_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, seen)

    def _loss_at(self, view: Sequence[tuple[list[int], tuple[int, int]]]) -> tuple[Tensor, list[Drawn]]:
        """The losses of both scenes, and what was drawn for them; see `_draw_poses`."""
        options = self.options
        degree = options.fit.sh_degree_at(self.iteration)
        total = torch.zeros((), device=self.device)
        drawn: dict[int, Drawn] = {}
        for scenes, pose in view:
            pictures = self.draw(scenes, self.poses.camera(*pose), degree)
            for scene, (image, meta) in zip(scenes, pictures, strict=True):
                target = self.poses.target(scene, *pose)
                weight = self.weights[scene]
                total = total + weight * photometric_loss(image, target, options.fit.ssim_weight)
                _, _, before = drawn.get(id(meta), (None, None, 0.0))
                drawn[id(meta)] = (meta, None, before + weight)
        return total, list(drawn.values())

    def _draw_poses(self) -> list[tuple[list[int], tuple[int, int]]]:
        """Scenes, and the training pose of one of them from which they are drawn."""
        if float(torch.rand((), generator=self.generator)) < self.options.common_poses:
            owner = self.owner_order.draw()
            return [([0, 1], (owner, self.shuffles[owner].draw()))]
        return [([scene], (scene, self.shuffles[scene].draw())) for scene in (0, 1)]

    def _set_rates(self) -> None:
        progress = self.iteration / self.iterations
        self.optimizers["means"].param_groups[0]["lr"] = self.rate_of_means * 0.01**progress
        self.network_optimizer.param_groups[0]["lr"] = self.options.network_rate * 0.05**progress

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        found, degree = {}, self.options.fit.sh_degree
        for scene, (name, views) in enumerate(zip(("cover", "secret"), self.watched, strict=True)):
            values = [
                psnr(self.draw([scene], view.camera, degree)[0][0], view.image.to(self.device).float() / 255)
                for view in views
            ]
            found[name] = sum(values) / len(values)
        return found

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_optimizers(self.parameters, self.optimizers) | pack_density(self.density)
        tensors |= pack_network("networks", self.networks, self.network_optimizer)
        tensors |= {"owners": self.owner_order.state(), "generator": self.generator.get_state()}
        tensors |= {f"order.{i}": shuffle.state() for i, shuffle in enumerate(self.shuffles)}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_optimizers(tensors, self.parameters, self.optimizers)
        unpack_density(tensors, self.density, self.device)
        unpack_network(tensors, "networks", self.networks, self.network_optimizer)
        self.owner_order.load(tensors["owners"])
        for i, shuffle in enumerate(self.shuffles):
            shuffle.load(tensors[f"order.{i}"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])

    def kept(self) -> dict[str, Tensor]:
        """The parameters on the CPU, without Gaussians that fell below the limit of pruning at the end."""
        seen = self.opacity_for_pruning() >= self.options.fit.prune_opacity
        seen = seen if bool(seen.any()) else torch.ones_like(seen)
        return {name: value.detach()[seen].cpu() for name, value in self.parameters.items()}
