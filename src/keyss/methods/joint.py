"""Joint training: one set of Gaussians shows the cover and, decoded in some way, the secrets.

`JointTraining` is the state and the step that KeySS and the methods it is compared with have in common. A
subclass says what is trained beside plain Gaussians, and how a scene is rendered.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.core.similarity import Similarity, align
from keyss.fitting.adam import RowAdam
from keyss.fitting.checkpoint import State, pack_model, pack_network, unpack_model, unpack_network
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.loop import train
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import make_optimizers, to_parameters
from keyss.fitting.ranks import here
from keyss.fitting.sampling import Shuffle, own_randomness
from keyss.fitting.schedule import Schedule
from keyss.methods.base import Context, MethodOptions, Plan, Source, Training, check_above_zero, role_of
from keyss.methods.combined import CombinedPoses, PlacedScene, combined_points
from keyss.rendering import render_with_meta

Pose = tuple[int, int]  # a scene and the index of its training view
Scenes = Literal["both", "cover", "secret"]  # "both": all scenes, also with several secrets


def chosen_scenes(which: Scenes, count: int) -> list[int]:
    """Indices of the scenes that `which` stands for, of the cover (0) and the secrets."""
    return {"both": list(range(count)), "cover": [0], "secret": list(range(1, count))}[which]


@dataclass(frozen=True, kw_only=True)
class JointOptions(MethodOptions):
    """A training of all scenes together from sparse points; `fit` has its length, size and rates."""

    points: Scenes = "both"  # scenes whose sparse points start the model (combined SfM initialisation)
    poses: Scenes = "both"  # scenes whose training poses are used (combined camera poses)
    densification: Scenes = "both"  # scenes whose gradients ask for growth (combined densification)
    cover_weight: float = 0.5
    secret_weight: float = 0.5  # of each secret

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.publish != "ply":
            raise UsageError(
                f'`publish="{self.publish}"`: this method needs the published model bit for bit: leave it '
                'out, or use `method="carry"`'
            )
        check_above_zero(self, "cover_weight", "secret_weight")

    def training(self, scenes: int) -> tuple[Training, ...]:
        """Every step renders all scenes."""
        return (Training(self.fit.iterations, continues=False),) * scenes

    def check_poses(self, common_poses: float) -> None:
        """Raise UsageError for a share of common poses that does not go with `poses`."""
        if not 0 <= common_poses <= 1:
            raise UsageError(f"`common_poses`: expected 0 to 1, got {common_poses}")
        if self.poses != "both" and common_poses < 1:
            raise UsageError(
                "poses of some scenes only: needs common_poses = 1, because all scenes are rendered from them"
            )

    def joint_plan(self, secrets: int, *, gaussian_weights: float = 0.0, pixel_weights: float = 0.0) -> Plan:
        """The plan where all scenes share as many Gaussians as a plain model has. `*_weights`: see `Plan`."""
        fit = self.fit
        return Plan(
            gaussians=fit.max_gaussians,
            sh_degree=fit.sh_degree,
            secret_gaussians=secrets * fit.max_gaussians,
            capacity=fit.max_gaussians,
            steps=fit.iterations,
            rendered=(fit.max_gaussians,) * (1 + secrets),
            gaussian_weights=gaussian_weights,
            pixel_weights=pixel_weights,
        )


@dataclass(frozen=True)
class Picture:
    """A render of a scene."""

    image: Tensor  # [H, W, 3]
    meta: dict[str, Any]  # of the rasterization
    indices: Tensor | None = None  # of the Gaussians that were rendered; None: all


class JointTraining(ABC):
    """See `keyss.fitting.loop.TrainingRun`. All scenes are in the cover's frame, the cover comes first."""

    apart = 0.0  # logits between the opacities of two scenes at the start
    warm_up = 0  # steps in which the networks' rate rises to its value

    def __init__(
        self,
        scenes: Sequence[PlacedScene],
        options: JointOptions,
        device: torch.device,
        *,
        common_poses: float,  # share of steps that render all scenes from one pose
        network_rate: float = 0.0,  # of AdamW, decays to 5 % of it
        weight_decay: float = 0.0,
    ) -> None:
        fit = options.fit
        self.options, self.device, self.scenes = options, device, scenes
        self.common_poses, self.network_rate = common_poses, network_rate
        self.iterations, self.iteration = fit.iterations, 0
        self.views_per_step = here().views(fit.views_per_step)
        self.weights = [options.cover_weight, *[options.secret_weight] * (len(scenes) - 1)]
        self.generator = torch.Generator().manual_seed(fit.known_seed)
        self.poses = CombinedPoses(scenes, device)
        self.watched = [subsample_views(placed.scene.test, 8) for placed in scenes]
        self.backgrounds = [placed.scene.background.to(device) for placed in scenes]
        self.owners = chosen_scenes(options.poses, len(scenes))
        self.growing = chosen_scenes(options.densification, len(scenes))
        self.owner_order = Shuffle(len(self.owners), self.generator)
        # Each scene's order of views is its own: the cover's must not depend on the secrets.
        self.orders = [
            torch.Generator().manual_seed(fit.seed_of(f"views of scene {index}"))
            for index in range(len(scenes))
        ]
        self.shuffles = [
            Shuffle(len(placed.scene.train), order) for placed, order in zip(scenes, self.orders, strict=True)
        ]
        self.extent = scenes[0].scene.extent
        cameras = [view.camera for placed in scenes for view in placed.scene.train]
        self.schedule = Schedule(fit, cameras, self.extent)

        start = self.start()
        self.parameters = to_parameters(start, device)
        self.optimizers = make_optimizers(self.parameters, fit, self.extent)
        self.networks = torch.nn.ModuleList()
        with own_randomness(fit.known_seed):
            self.prepare(start)
        self.networks.to(device)
        # Without networks, the optimiser still needs a parameter.
        weights = list(self.networks.parameters()) or [torch.nn.Parameter(torch.zeros(1))]
        self.network_optimizer = torch.optim.AdamW(weights, lr=network_rate, weight_decay=weight_decay)
        self.strategy = self.density_control()
        self.density: dict[str, Any] = self.strategy.initialize_state(self.extent)

    def start(self) -> Gaussians:
        """The Gaussians that training starts with: the sparse points of the scenes that options name."""
        chosen = chosen_scenes(self.options.points, len(self.scenes))
        return combined_points(
            [self.scenes[index].scene for index in chosen], self.options.fit, self.generator, self.apart
        )

    def density_control(self) -> CappedStrategy:
        """The strategy that clones, splits and prunes."""
        return CappedStrategy(self.options.fit, self.opacity_for_pruning)

    @abstractmethod
    def prepare(self, start: Gaussians) -> None:
        """Add parameters (`add`) and networks (`networks`); their random numbers are the run's own."""

    @abstractmethod
    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """Render some scenes, in that order; they may share a render."""

    def render(
        self, model: Gaussians, scene: int, camera: Camera, sh_degree: int, indices: Tensor | None = None
    ) -> Picture:
        """Render `model` as a scene, with its background."""
        image, meta = render_with_meta(model, camera, self.backgrounds[scene], sh_degree=sh_degree)
        return Picture(image, meta, indices)

    def opacity_for_pruning(self) -> Tensor:
        """[N] how visible each Gaussian is in the scene that shows it most."""
        return self.parameters["opacities"].detach().sigmoid()

    def add(self, name: str, values: Tensor, optimizer: RowAdam | float) -> None:
        """Add a parameter [N, ...] of the Gaussians, with its optimiser or a rate for a new one."""
        self.parameters[name] = parameter = torch.nn.Parameter(values.to(self.device).contiguous())
        if isinstance(optimizer, RowAdam):
            optimizer.param_groups[0]["params"] = [parameter]
            self.optimizers[name] = optimizer
        else:
            fused = self.device.type == "cuda"
            self.optimizers[name] = RowAdam(
                [{"params": [parameter], "lr": optimizer}], eps=1e-15, fused=fused
            )

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self) -> None:
        self.iteration += 1
        poses = [self._sample_poses() for _ in range(self.views_per_step)]
        views = list(zip(poses, self.extras(), strict=True))
        trained = (*self.parameters.values(), *self.networks.parameters())
        self.loss, info = self.strategy.backward(
            views, lambda view: self.loss_at(*view), trained, self.parameters
        )
        self._set_rates()
        for optimizer in (*self.optimizers.values(), self.network_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, info)

    def extras(self) -> Sequence[Any]:
        """Further inputs of the loss of each of `views_per_step` views, the same on every rank."""
        return [None] * self.views_per_step

    def loss_at(self, poses: Sequence[Pose], extra: Any) -> tuple[Tensor, list[Rendered]]:
        """The weighted losses of all scenes, each at its pose, and the renders that density control uses."""
        fit = self.options.fit
        total = torch.zeros((), device=self.device)
        renders: dict[int, Rendered] = {}  # scenes may share a render
        for pose in dict.fromkeys(poses):
            scenes = [scene for scene, own in enumerate(poses) if own == pose]
            pictures = self.draw(scenes, self.poses.camera(*pose), fit.sh_degree_at(self.iteration))
            for scene, picture in zip(scenes, pictures, strict=True):
                target, weight = self.poses.target(scene, *pose), self.weights[scene]
                total = total + weight * photometric_loss(picture.image, target, fit.ssim_weight)
                if scene in self.growing:
                    shared = renders.get(id(picture.meta))
                    weight += shared[2] if shared else 0.0
                    renders[id(picture.meta)] = (picture.meta, picture.indices, weight)
        return total, list(renders.values())

    def _sample_poses(self) -> list[Pose]:
        """The training pose that each scene is rendered from in this step."""
        count = len(self.scenes)
        if float(torch.rand((), generator=self.generator)) < self.common_poses:
            owner = self.owners[self.owner_order.sample()]
            return [(owner, self.shuffles[owner].sample())] * count
        return [(scene, self.shuffles[scene].sample()) for scene in range(count)]

    def _set_rates(self) -> None:
        progress = self.iteration / self.iterations
        self.schedule.set(self.optimizers, self.iteration)
        risen = min(1.0, self.iteration / self.warm_up) if self.warm_up else 1.0
        self.network_optimizer.param_groups[0]["lr"] = self.network_rate * risen * 0.05**progress

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Mean PSNR of each scene on held-out views."""
        found, degree = {}, self.options.fit.sh_degree
        for scene, views in enumerate(self.watched):
            photos = [(view, view.image.to(self.device).float() / 255) for view in views]
            values = [psnr(self.draw([scene], view.camera, degree)[0].image, photo) for view, photo in photos]
            found[role_of(scene, len(self.scenes))] = sum(values) / len(values)
        return found

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_model(self.parameters, self.optimizers, self.density)
        tensors |= pack_network("networks", self.networks, self.network_optimizer)
        tensors |= {"owners": self.owner_order.state(), "generator": self.generator.get_state()}
        tensors |= {f"order.{i}": shuffle.state() for i, shuffle in enumerate(self.shuffles)}
        tensors |= {f"order_generator.{i}": order.get_state() for i, order in enumerate(self.orders)}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_model(tensors, self.parameters, self.optimizers, self.density)
        unpack_network(tensors, "networks", self.networks, self.network_optimizer)
        self.owner_order.load(tensors["owners"])
        for i, shuffle in enumerate(self.shuffles):
            shuffle.load(tensors[f"order.{i}"])
            self.orders[i].set_state(tensors[f"order_generator.{i}"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])


TrainingT = TypeVar("TrainingT", bound=JointTraining)


def train_jointly(
    begin: Callable[[Sequence[PlacedScene]], TrainingT],
    cover: Source,
    secrets: Sequence[Source],
    context: Context,
) -> TrainingT:
    """Train what `begin` makes of the scenes, all placed in the cover's frame.

    Raises Interrupted, and InputError for a checkpoint of another run.
    """
    sources = [cover, *secrets]
    cameras = [[view.camera for view in source.scene.train] for source in sources]
    frames = [Similarity(), *(align(each, cameras[0]) for each in cameras[1:])]
    run = begin(
        [PlacedScene.of(each.scene, each.model, at) for each, at in zip(sources, frames, strict=True)]
    )
    train(
        run,
        "hide",
        run.options.fit,
        fingerprint={
            "method": run.options.method,
            "scenes": [source.scene.digest() for source in sources],
            "models": [source.model.digest() for source in sources],
            "options": json.loads(json.dumps(asdict(run.options))),  # tuples as they are read back
        },
        checkpoint=context.checkpoints / "joint.safetensors" if context.checkpoints else None,
        resume=context.resume,
        reporter=context.reporter,
    )
    return run
