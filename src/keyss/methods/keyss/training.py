"""Joint training of one model and one decoder, from scratch, with three losses (KeySS, sections 3.1 to 3.4).

Every training pose of every scene supervises all scenes. A scene's target is its photo from that pose, or a
render of its plain 3DGS model if there is none. Everything is in the cover's frame. `KeyssTraining` is the
paper's; the baselines of `keyss.lab.baselines` override parts of it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, CombinedStrategy, Rendered
from keyss.fitting.image_metrics import psnr, subsample_views
from keyss.fitting.loop import Shuffle, TrainingRun, own_randomness, train
from keyss.fitting.losses import Target, Targets, photometric_loss
from keyss.fitting.parameters import (
    initial_gaussians,
    initial_points,
    make_optimizers,
    to_gaussians,
    to_parameters,
)
from keyss.fitting.schedule import Schedule, boost_of
from keyss.keys.derivation import random_embeddings
from keyss.methods.keyss.decoder import Decoder
from keyss.methods.keyss.keyss_options import JointOptions, Scenes
from keyss.methods.method import Context, Source, divide, role_of
from keyss.methods.placed_scene import PlacedScene
from keyss.rendering import render, render_with_meta

CACHE_BYTES = 2 << 30
LAST_NETWORK_RATE = 0.05  # final factor on the decoder's rate
FAINT = 0.006  # opacity, just visible, of points in scenes that are not theirs
PRETRAINING_RATE = 3e-3  # of Adam, at first
PRETRAINING_POINTS, WRONG_KEYS = 256, 4  # of a step of the pretraining
Pose = tuple[int, int]  # a scene and the index of its training view


def scene_indices(which: Scenes, count: int) -> list[int]:
    """Indices of the scenes in `which`: 0 is the cover, then the secrets."""
    return {"both": list(range(count)), "cover": [0], "secret": list(range(1, count))}[which]


@dataclass(frozen=True)
class Picture:
    """A render of a scene."""

    image: Tensor  # [H, W, 3]
    meta: dict[str, Any]  # second result of the rasterization
    indices: Tensor | None = None  # Gaussians that were rendered; None: all


def combined_points(
    scenes: Sequence[PlacedScene], limit: int, fit: FitConfig, generator: torch.Generator
) -> tuple[Gaussians, Tensor]:
    """Gaussians at up to `limit` points of all scenes, and [N] the scene of each.

    Scenes have equal shares if they have enough points, and those of their plain models if they have none
    (ours): random points are alike in all scenes, so a decoder cannot tell them apart. Gaussians are as wide
    as the distance to their neighbours in the combined cloud.
    """
    clouds = [initial_points(placed.scene, fit.max_gaussians, generator, placed.plain) for placed in scenes]
    counts = divide([len(points) for points, _ in clouds], limit)
    chosen = [
        torch.randperm(len(points), generator=generator)[:count].sort().values
        for (points, _), count in zip(clouds, counts, strict=True)
    ]
    points, colors = (
        torch.cat([cloud[part][rows] for cloud, rows in zip(clouds, chosen, strict=True)]) for part in (0, 1)
    )
    model = initial_gaussians(points, colors, fit.sh_degree, len(points), generator)
    return model, torch.arange(len(scenes)).repeat_interleave(torch.tensor(counts))


class CombinedPoses:
    """All training poses of all scenes, and every scene's target at each of them."""

    def __init__(self, scenes: Sequence[PlacedScene], device: torch.device) -> None:
        self.scenes, self.device = scenes, device
        self.plains = [placed.plain.to(device) for placed in scenes]
        self._rendered: dict[tuple[int, int, int], Tensor] = {}
        self._left = CACHE_BYTES
        self._targets = Targets()

    def camera(self, owner: int, index: int) -> Camera:
        """Training pose `index` of scene `owner`."""
        return self.scenes[owner].scene.train[index].camera

    def target(self, scene: int, owner: int, index: int) -> Target:
        """The target of `scene` at training pose `index` of `owner`."""
        photo = self.scenes[owner].scene.train[index] if scene == owner else None

        def make() -> Target:
            image = photo.image if photo else self._render(scene, owner, index)
            return Target.of(image.to(self.device), photo.mask if photo else None)

        return self._targets.of((scene, owner, index), make)

    def _render(self, scene: int, owner: int, index: int) -> Tensor:
        """Render once, and cache as 8-bit pixels, like photos, up to CACHE_BYTES."""
        cached = self._rendered.get((scene, owner, index))
        if cached is not None:
            return cached
        with torch.no_grad():
            background = self.scenes[scene].scene.background
            image = render(self.plains[scene], self.camera(owner, index), background)
        pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
        if pixels.numel() <= self._left:
            self._rendered[scene, owner, index] = pixels
            self._left -= pixels.numel()
        return pixels


class KeyssTraining(TrainingRun):
    """All scenes are in the cover's frame; scene 0 is the cover, scene s is secret s."""

    def __init__(
        self,
        scenes: Sequence[PlacedScene],
        keys: Sequence[Tensor],  # [K] k^s, the vector of each secret's key
        options: JointOptions,
        device: torch.device,
        random_key: Callable[[torch.Generator], Tensor] | None = None,  # [K] vector of a random key
    ) -> None:
        super().__init__(options.fit, device)
        design, count = options.configuration, len(scenes)
        self.scenes, self.options, self.design = scenes, options, design
        self.keys, self.random_key = [key.to(device) for key in keys], random_key
        self.betas = [design.beta_cover, *[design.beta_secret] * (count - 1)]
        self.poses = CombinedPoses(scenes, device)
        self.backgrounds = [placed.scene.background.to(device) for placed in scenes]
        self.growing = scene_indices(design.densification, count)
        views = [len(placed.scene.train) for placed in scenes]
        self.owners = scene_indices(design.poses, count)
        self.combined = [(owner, index) for owner in self.owners for index in range(views[owner])]
        self.shuffles["combined"] = Shuffle(len(self.combined), self.generator)
        for scene in self.owners:
            self.shuffles[f"photos.{scene}"] = Shuffle(views[scene], self.generator)
        self.extent = scenes[0].scene.extent
        cameras = [view.camera for placed in scenes for view in placed.scene.train]
        self.schedule = Schedule(self.fit, cameras, self.extent)
        chosen = [scenes[index] for index in scene_indices(design.points, count)]
        limit = max(1, int(design.start_share * self.fit.max_gaussians))
        start, self.scene_of_point = combined_points(chosen, limit, self.fit, self.generator)
        self.started = len(start)
        self.parameters = to_parameters(start, device)
        self.optimizers = make_optimizers(self.parameters, self.fit, self.extent)
        with own_randomness(self.fit.known_seed):
            self.prepare(start)
        self.networks.to(device)
        if weights := list(self.networks.parameters()):
            self.network_optimizer = torch.optim.AdamW(weights, weight_decay=design.weight_decay)
        # The authors' program sums up the gradients of all scenes, and stops density control at the cap.
        released = design.decoder.released
        strategy = CappedStrategy if released else CombinedStrategy
        self.strategy = strategy(self.fit, self.opacity_for_pruning, freeze=released)
        self.density = self.strategy.initialize_state(self.extent)

    def prepare(self, start: Gaussians) -> None:
        """Add what trains beside `start`: one decoder for all secrets. Random numbers are the run's own."""
        shape = replace(self.design.decoder, sh_degree=self.fit.sh_degree, key_size=len(self.keys[0]))
        self.decoder = Decoder(shape)
        self.networks.append(self.decoder)
        if self.design.pretraining and self.design.points == "both" and "op" in shape.mask:
            self.pretrain(start)

    def pretrain(self, start: Gaussians) -> None:
        """Train the decoder alone, without renders, to show each scene the points of its own only.

        In the cover, the points of secrets start nearly transparent. A right key makes those of its secret as
        opaque as the cover's and all others transparent; a wrong key changes nothing.
        """
        opaque, faint = float(start.opacity_logits[0]), math.log(FAINT / (1 - FAINT))
        start.opacity_logits[self.scene_of_point > 0] = faint
        with torch.no_grad():
            self.parameters["opacities"].copy_(start.opacity_logits)
        optimizer = torch.optim.Adam(self.decoder.parameters())
        for step in range(self.design.pretraining):
            rows = torch.randint(len(start), (PRETRAINING_POINTS,), generator=self.generator)
            points, scene = start[rows], self.scene_of_point[rows]
            targets = [(key, torch.where(scene == i, opaque, faint)) for i, key in enumerate(self.keys, 1)]
            wrong = [self.wrong_key() for _ in range(WRONG_KEYS)]
            targets += [(key, points.opacity_logits) for key in wrong if key is not None]
            errors = [self.decoder(points, key.cpu()).opacity_logits - target for key, target in targets]
            loss = torch.stack([error.square().mean() for error in errors]).sum()
            optimizer.param_groups[0]["lr"] = PRETRAINING_RATE * (1 - step / self.design.pretraining)
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()

    def step(self) -> None:
        self.iteration += 1
        self.optimise(*self.losses(self.sample_poses(), self.wrong_key()))

    def set_rates(self) -> None:
        super().set_rates()
        if self.network_optimizer is None:
            return
        progress = self.iteration / self.iterations
        rate = self.design.decoder_rate * boost_of(self.fit) * LAST_NETWORK_RATE**progress
        if self.design.warm_up:
            rate *= min(1.0, progress / self.design.warm_up)
        self.network_optimizer.param_groups[0]["lr"] = rate

    def sample_poses(self) -> list[Pose]:
        """The training pose for each scene: one of any scene for all (combined camera poses), or its own."""
        shared = float(torch.rand((), generator=self.generator)) < self.design.common_poses
        alone = [not shared and scene in self.owners for scene in range(len(self.scenes))]
        common = [] if all(alone) else [self.combined[self.shuffles["combined"].sample()]]
        return [
            (scene, self.shuffles[f"photos.{scene}"].sample()) if has_own else common[0]
            for scene, has_own in enumerate(alone)
        ]

    def wrong_key(self) -> Tensor | None:
        """[K] vector of a wrong key, sampled at every step."""
        if not self.design.beta_incorrect:
            return None
        if self.random_key is not None:
            return self.random_key(self.generator).to(self.device)
        return random_embeddings(1, self.generator, len(self.keys[0]))[0].to(self.device)

    def losses(self, poses: Sequence[Pose], wrong_key: Tensor | None) -> tuple[Tensor, list[Rendered]]:
        """L of equation 11, and the renders whose gradients count for combined densification."""
        degree, ssim_weight = self.fit.sh_degree_at(self.iteration), self.fit.ssim_weight
        total = torch.zeros((), device=self.device)
        drawn: dict[int, Picture] = {}
        weights: dict[int, float] = {}  # one per render: baselines render scenes together
        for pose in dict.fromkeys(poses):
            scenes = [scene for scene, scene_pose in enumerate(poses) if scene_pose == pose]
            pictures = self.draw(scenes, self.poses.camera(*pose), degree)
            for scene, picture in zip(scenes, pictures, strict=True):
                target, beta = self.poses.target(scene, *pose), self.betas[scene]
                # L_cover of equation 4 for scene 0, L_secret^s of equation 5 for scene s.
                total = total + beta * photometric_loss(picture.image, target, ssim_weight)
                drawn[scene] = picture
                weights[id(picture.meta)] = weights.get(id(picture.meta), 0.0) + beta
        if wrong_key is not None:  # L_incorrect of equation 7
            shown = self.decoder(self.cover(), wrong_key)
            picture = self.render(shown, 0, self.poses.camera(*poses[0]), degree)
            incorrect = photometric_loss(picture.image, self.poses.target(0, *poses[0]), ssim_weight)
            total = total + self.design.beta_incorrect * incorrect
        # The authors' program takes the gradients of the weighted losses.
        released = self.design.decoder.released
        growing = [drawn[scene] for scene in self.growing]
        return total, [
            (render.meta, render.indices, 1.0 if released else weights[id(render.meta)]) for render in growing
        ]

    def cover(self) -> Gaussians:
        """G_cover, attached to the graph."""
        return to_gaussians(self.parameters)

    def secret(self, cover: Gaussians, scene: int) -> Gaussians:
        """G_secret^s = D(G_cover, k^s), equation 6."""
        return self.decoder(cover, self.keys[scene - 1])  # type: ignore[no-any-return]

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        """Render scenes, in the given order."""
        cover, pictures = self.cover(), []
        for scene in scenes:
            model, indices = (self.secret(cover, scene), None) if scene else (cover, None)
            if scene and self.design.decoder.released:
                # The authors' program masks a secret's opacities and scales by the Gaussian's visibility in
                # the cover's render. A published file cannot do that.
                indices = self.visible_rows(cover, camera)
                model = model[indices]
            pictures.append(self.render(model, scene, camera, sh_degree, indices))
        return pictures

    @torch.no_grad()
    def visible_rows(self, cover: Gaussians, camera: Camera) -> Tensor:
        """Indices of the cover's Gaussians that are visible in a view."""
        radii = self.render(cover.detach().with_sh_degree(0), 0, camera, 0).meta["radii"][0]
        return (radii > 0).all(1).nonzero()[:, 0]  # type: ignore[no-any-return]

    def render(
        self, model: Gaussians, scene: int, camera: Camera, sh_degree: int, indices: Tensor | None = None
    ) -> Picture:
        """Render `model` as a scene, with its background."""
        image, meta = render_with_meta(model, camera, self.backgrounds[scene], sh_degree=sh_degree)
        return Picture(image, meta, indices)

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        """Mean PSNR of each scene on held-out views."""
        means = {}
        for scene, placed in enumerate(self.scenes):
            views = subsample_views(placed.scene.test, 8)
            means[role_of(scene, len(self.scenes))] = fmean(
                psnr(
                    self.draw([scene], view.camera, self.fit.sh_degree)[0].image,
                    view.photo(self.device),
                    view.mask,
                )
                for view in views
            )
        return means

    @torch.no_grad()
    def opacity_for_pruning(self) -> Tensor:
        """[N] maximum opacity over the scenes; in the authors' program, the cover's."""
        cover = to_gaussians(self.parameters).detach()
        secrets = [] if self.design.decoder.released else range(1, len(self.scenes))
        models = [cover, *(self.secret(cover, scene) for scene in secrets)]
        return torch.stack([model.opacities for model in models]).amax(0)

    def train(self, sources: Sequence[Source], context: Context) -> None:
        """Take all steps. Raises Interrupted, and InputError for a checkpoint of another run."""
        train(
            self,
            "hide",
            fingerprint={
                "method": self.options.method,
                "scenes": [source.scene.digest() for source in sources],
                "models": [source.model.digest() for source in sources],
                "options": json.loads(json.dumps(asdict(self.options))),  # tuples become lists
            },
            **context.loop_arguments("joint"),
        )
