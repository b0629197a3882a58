"""Joint training of one model and one decoder, from scratch, with three losses (KeySS, sections 3.1 to 3.4).

`KeyssTraining` is the paper's. The design `latent` and the baselines override parts of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.checkpoint import State
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.joint import JointRun
from keyss.fitting.loop import train
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import to_gaussians
from keyss.fitting.sampling import Shuffle
from keyss.keys.derivation import random_embeddings, stream
from keyss.methods.base import Context, MethodOptions, Source, role_of
from keyss.methods.keyss.combined import CombinedPoses, PlacedScene, combined_points
from keyss.methods.keyss.options import Design, Scenes
from keyss.methods.keyss.secret import DECODERS, KeyssSecret, choose_anchors, visibility
from keyss.rendering import render_with_meta

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


class KeyssTraining(JointRun):
    """All scenes are in the cover's frame; scene 0 is the cover, scene s is secret s."""

    def __init__(
        self,
        scenes: Sequence[PlacedScene],
        keys: Sequence[Tensor],  # [K] k^s, the vector of each secret's key
        options: MethodOptions,
        design: Design,
        device: torch.device,
        random_key: Callable[[torch.Generator], Tensor] | None = None,  # [K] vector of a random key
    ) -> None:
        count = len(scenes)
        names = [role_of(scene, count) for scene in range(count)]
        super().__init__([placed.scene for placed in scenes], options.fit, device, names)
        self.scenes, self.options, self.design = scenes, options, design
        self.keys, self.random_key = [key.to(device) for key in keys], random_key
        self.betas = [design.beta_cover, *[design.beta_secret] * (count - 1)]
        self.poses = CombinedPoses(scenes, device)
        self.owners = scene_indices(design.poses, count)
        self.growing = scene_indices(design.densification, count)
        self.owner_order = Shuffle(len(self.owners), self.generator)
        self.begin(self.start(), design.decoder_rate, design.weight_decay)

    def start(self) -> Gaussians:
        """G_cover at the first step: the combined SfM points (section 3.4)."""
        chosen = [self.scenes[i].scene for i in scene_indices(self.design.points, len(self.scenes))]
        return combined_points(chosen, self.fit, self.generator)

    def prepare(self, start: Gaussians) -> None:
        """One decoder for all secrets."""
        shape = self.design.decoder.with_sizes(self.fit.sh_degree, len(self.keys[0]), len(self.keys))
        self.decoder = DECODERS[shape.kind](shape)
        self.networks.append(self.decoder)

    def density_control(self) -> CappedStrategy:
        """Density control; the authors' program stops it at the cap."""
        return CappedStrategy(self.fit, self.opacity_for_pruning, freeze=self.design.decoder.released)

    def step(self) -> None:
        self.iteration += 1
        views = [(self.sample_poses(), self.wrong_key()) for _ in range(self.views_per_step)]
        self.optimise(views, lambda view: self.losses(*view))

    def sample_poses(self) -> list[Pose]:
        """The training pose for each scene: one of any scene (combined camera poses)."""
        count = len(self.scenes)
        if float(torch.rand((), generator=self.generator)) < self.design.common_poses:
            owner = self.owners[self.owner_order.sample()]
            return [(owner, self.shuffles[owner].sample())] * count
        return [(scene, self.shuffles[scene].sample()) for scene in range(count)]

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
        renders: dict[int, Rendered] = {}  # baselines render scenes together
        for pose in dict.fromkeys(poses):
            scenes = [scene for scene, own in enumerate(poses) if own == pose]
            pictures = self.draw(scenes, self.poses.camera(*pose), degree)
            for scene, picture in zip(scenes, pictures, strict=True):
                target, beta = self.poses.target(scene, *pose), self.betas[scene]
                # L_cover of equation 4 for scene 0, L_secret^s of equation 5 for scene s.
                total = total + beta * photometric_loss(picture.image, target, ssim_weight)
                if scene in self.growing:
                    shared = renders.get(id(picture.meta))
                    weight = beta + (shared[2] if shared else 0.0)
                    renders[id(picture.meta)] = (picture.meta, picture.indices, weight)
        if wrong_key is not None:  # L_incorrect of equation 7
            shown = self.decoder(self.cover(), wrong_key)
            picture = self.render(shown, 0, self.poses.camera(*poses[0]), degree)
            incorrect = photometric_loss(picture.image, self.poses.target(0, *poses[0]), ssim_weight)
            total = total + self.design.beta_incorrect * incorrect
        if self.design.decoder.released:  # gradients of the weighted losses, unscaled
            return total, [(meta, indices, 1.0) for meta, indices, _ in renders.values()]
        return total, list(renders.values())

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

    def show(self, scene: int, camera: Camera, sh_degree: int) -> Tensor:
        return self.draw([scene], camera, sh_degree)[0].image

    @torch.no_grad()
    def opacity_for_pruning(self) -> Tensor:
        """[N] maximum opacity over the scenes; in the authors' program, the cover's."""
        cover = to_gaussians(self.parameters).detach()
        secrets = [] if self.design.decoder.released else range(1, len(self.scenes))
        models = [cover, *(self.secret(cover, scene) for scene in secrets)]
        return torch.stack([model.opacities for model in models]).amax(0)

    def publish(self, entropy: bytes) -> tuple[Gaussians, list[KeyssSecret]]:
        """G_cover on the CPU, before its low bits are written, and the secrets.

        `entropy`: 32 secret bytes that seed all randomness.
        """
        # Shuffle: in training, the points of each scene are contiguous.
        stego = self.gaussians().to("cpu")
        numbers = np.frombuffer(stream(entropy, "order", 8 * len(stego)), "<u8")
        stego = stego[torch.from_numpy(numbers.argsort(kind="stable"))]
        anchors = choose_anchors(stego, self.fit.known_seed)
        decoder, secrets = self.decoder.to("cpu").requires_grad_(False), []
        for placed, key in zip(self.scenes[1:], self.keys, strict=True):
            shown = visibility(decoder.decode(stego, key.cpu()))
            secrets.append(KeyssSecret(decoder, key.cpu(), placed.frame, anchors, *shown))
        return stego, secrets

    def gaussians(self) -> Gaussians:
        """The model to publish."""
        return self.cover().detach()

    def train(self, sources: Sequence[Source], context: Context) -> None:
        """Take all steps. Raises Interrupted, and InputError for a checkpoint of another run."""
        train(
            self,
            "hide",
            self.fit,
            fingerprint={
                "method": self.options.method,
                "scenes": [source.scene.digest() for source in sources],
                "models": [source.model.digest() for source in sources],
                "options": json.loads(json.dumps(asdict(self.options))),  # tuples become lists
            },
            checkpoint=context.checkpoints / "joint.safetensors" if context.checkpoints else None,
            resume=context.resume,
            reporter=context.reporter,
        )

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors, meta = super().state()
        return tensors | {"owners": self.owner_order.state()}, meta

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        super().load(tensors, meta)
        self.owner_order.load(tensors["owners"])
