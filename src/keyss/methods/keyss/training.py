"""The joint training of the published model and the decoders (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.density import Rendered
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import to_gaussians
from keyss.keys.derivation import random_embeddings
from keyss.methods.joint import JointTraining, Picture, Pose
from keyss.methods.keyss.decoder import Decoder
from keyss.methods.keyss.options import KeyssOptions
from keyss.methods.poses import PlacedScene

_SLACK = 0.02  # scene extents by which a decoder may move a Gaussian


class KeyssTraining(JointTraining):
    """Gaussians that show the cover, and for each secret a decoder that makes its Gaussians of them."""

    warm_up = 100

    def __init__(
        self,
        scenes: Sequence[PlacedScene],
        embeddings: Sequence[Tensor],  # [64] of each secret's key
        options: KeyssOptions,
        device: torch.device,
    ) -> None:
        self.settings = settings = options.settings
        self.shape = options.decoder_shape
        self.embeddings = [embedding.to(device) for embedding in embeddings]
        super().__init__(
            scenes,
            options,
            device,
            common_poses=settings.common_poses,
            network_rate=settings.decoder_rate,
            weight_decay=options.weight_decay,
            freeze=settings.at_cap == "freeze",
        )

    def prepare(self, start: Gaussians) -> None:
        # One for each secret: whoever opens one of them has no network that knows another.
        self.decoders = [Decoder(self.shape) for _ in self.embeddings]
        for decoder, embedding in zip(self.decoders, self.embeddings, strict=True):
            decoder.prepare(start, embedding)
        self.networks.extend(self.decoders)

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        cover = to_gaussians(self.parameters)
        return [self._draw(cover, scene, camera, sh_degree) for scene in scenes]

    def _draw(self, cover: Gaussians, scene: int, camera: Camera, sh_degree: int) -> Picture:
        if scene == 0:
            return self.render(cover, scene, camera, sh_degree)
        seen = possibly_seen(cover, camera, _SLACK * self.extent)
        secret = self.decoders[scene - 1](cover[seen], self.embeddings[scene - 1], cover)
        return self.render(secret, scene, camera, sh_degree, seen)

    def extras(self) -> Sequence[Tensor | None]:
        """Embeddings [64] of wrong keys; a gate needs none."""
        settings = self.settings
        if settings.conditioning == "gate" or self.iteration % settings.incorrect_every:
            return super().extras()
        return [random_embeddings(1, self.generator)[0].to(self.device) for _ in range(self.views_per_step)]

    def loss_at(self, poses: Sequence[Pose], extra: Tensor | None) -> tuple[Tensor, list[Rendered]]:
        total, drawn = super().loss_at(poses, extra)
        if extra is not None:
            total = total + self._incorrect_loss(poses[0], extra)
        return total, drawn

    def _incorrect_loss(self, pose: Pose, embedding: Tensor) -> Tensor:
        """The cover is right already: only the decoders learn from wrong keys, in turns."""
        settings, fit = self.settings, self.options.fit
        cover, camera = self.gaussians(), self.poses.camera(*pose)
        decoder = self.decoders[self.iteration // settings.incorrect_every % len(self.decoders)]
        part = cover[possibly_seen(cover, camera, _SLACK * self.extent)]
        wrong = decoder(part, embedding, cover)
        picture = self.render(wrong, 0, camera, fit.sh_degree_at(self.iteration))
        loss = photometric_loss(picture.image, self.poses.target(0, *pose), fit.ssim_weight)
        return settings.incorrect_weight * settings.incorrect_every * len(self.decoders) * loss

    @torch.no_grad()
    def opacity_for_pruning(self) -> Tensor:
        if self.settings.prune_by == "cover":
            return super().opacity_for_pruning()
        cover = self.gaussians()
        decoded = [each(cover, key) for each, key in zip(self.decoders, self.embeddings, strict=True)]
        return torch.stack([model.opacities for model in (cover, *decoded)]).amax(0)

    def gaussians(self) -> Gaussians:
        """The model as it would be published."""
        return to_gaussians(self.parameters).detach()


@torch.no_grad()
def possibly_seen(gaussians: Gaussians, camera: Camera, slack: float) -> Tensor:
    """Indices of the Gaussians that may touch the view once decoded: only they are worth decoding.

    A Gaussian is left out when a ball of 3 standard deviations around it, widened by `slack` (world units, by
    what the decoder may move it), lies outside the frustum, widened by a tenth.
    """
    viewmat, intrinsics = camera.viewmat.to(gaussians.device), camera.K
    x, y, z = (gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
    radius = 3 * gaussians.scales.amax(1) + slack
    depth = z + radius
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    half_width = max(cx, camera.width - cx) / fx
    half_height = max(cy, camera.height - cy) / fy
    seen = (
        (depth > 0.01)
        & (x.abs() - radius < 1.1 * half_width * depth)
        & (y.abs() - radius < 1.1 * half_height * depth)
    )
    return seen.nonzero()[:, 0]
