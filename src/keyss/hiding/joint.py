"""The joint training of the published model and the decoder (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.checkpoint import State, pack_density, pack_optimizers, unpack_density, unpack_optimizers
from keyss.fitting.density import CappedStrategy
from keyss.fitting.image_metrics import mean_psnr, thin
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import make_optimizers, to_gaussians, to_parameters
from keyss.fitting.sampling import Shuffle
from keyss.hiding.config import HideConfig
from keyss.hiding.decoder import Decoder, DecoderShape
from keyss.hiding.distil import distil
from keyss.hiding.start import make_start
from keyss.hiding.targets import CombinedPoses, PlacedScene
from keyss.rendering import render_with_meta
from keyss.seal.keys import random_embeddings

# A render's meta, the indices of the Gaussians it was made of (None: all), the weight of its loss.
Drawn = tuple[dict[str, Any], Tensor | None, float]


class JointRun:
    """The state of a hiding, and its step: the tripled loss at one pose of all scenes' poses."""

    def __init__(
        self,
        scenes: Sequence[PlacedScene],  # the cover, then the secrets
        embeddings: Sequence[Tensor],  # [64] of each secret's key
        config: HideConfig,
        device: torch.device,
    ) -> None:
        self.config = config
        self.device = device
        self.scenes = scenes
        self.embeddings = [embedding.to(device) for embedding in embeddings]
        self.iterations = config.fit.iterations
        self.iteration = 0
        self.generator = torch.Generator().manual_seed(config.fit.seed)
        self.poses = CombinedPoses(scenes, device)
        self.watched = [thin(placed.scene.test, 8) for placed in scenes]
        self.backgrounds = [placed.scene.background.to(device) for placed in scenes]
        self.owners = Shuffle(len(scenes), self.generator)
        self.shuffles = [Shuffle(len(placed.scene.train), self.generator) for placed in scenes]
        self.extent = scenes[0].scene.extent

        start = make_start(scenes, config, self.generator)
        self.opacity_logits = start.opacity_logits
        self.parameters = to_parameters(start.gaussians, device)
        rate = config.warm_rate if start.opacity_logits is not None else 1.0
        self.optimizers = make_optimizers(self.parameters, config.fit, self.extent)
        for optimizer in self.optimizers.values():
            optimizer.param_groups[0]["lr"] *= rate
        self.means_rate = self.optimizers["means"].param_groups[0]["lr"]
        self.strategy = CappedStrategy(config.fit, self._largest_opacity)
        self.density: dict[str, Any] = self.strategy.initialize_state(self.extent)

        with torch.random.fork_rng():
            torch.manual_seed(config.fit.seed)
            # One for each secret: who opens one of them holds no network that knows another.
            self.decoders = [Decoder(decoder_shape(config)).to(device) for _ in embeddings]
        for decoder in self.decoders:
            decoder.standardise(self.gaussians())
        self._all_decoders = torch.nn.ModuleList(self.decoders)
        self.decoder_optimizer = torch.optim.AdamW(
            self._all_decoders.parameters(), lr=config.decoder_rate, weight_decay=config.weight_decay
        )

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def prepare(self) -> None:
        """What a fresh run does before its first step, and a resumed one has behind it."""
        if self.opacity_logits is not None:
            gaussians = self.gaussians()
            for decoder, embedding, logits in zip(
                self.decoders, self.embeddings, self.opacity_logits, strict=True
            ):
                distil(decoder, gaussians, embedding, logits.to(self.device), self.config, self.generator)

    def step(self) -> None:
        config = self.config
        owner = self.owners.draw()
        index = self.shuffles[owner].draw()
        camera = self.poses.camera(owner, index)
        self.iteration += 1
        degree = (
            config.fit.sh_degree
            if self.opacity_logits is not None
            else config.fit.sh_degree_at(self.iteration)
        )

        def loss_of(drawn: Gaussians, scene: int, target: Target) -> tuple[Tensor, dict[str, Any]]:
            image, meta = render_with_meta(drawn, camera, self.backgrounds[scene], sh_degree=degree)
            return photometric_loss(image, target, config.fit.ssim_weight), meta

        cover = to_gaussians(self.parameters)
        cover_target = self.poses.target(0, owner, index)
        cover_loss, meta = loss_of(cover, 0, cover_target)
        total = config.cover_weight * cover_loss
        drawn: list[Drawn] = [(meta, None, config.cover_weight)]

        seen = self._possibly_seen(cover, camera)
        part = cover[seen]
        description = self.decoders[0].describe(part)  # the same for all
        for secret, (decoder, embedding) in enumerate(self._keyed_decoders(), start=1):
            decoded = decoder(part, embedding, description)
            loss, meta = loss_of(decoded, secret, self.poses.target(secret, owner, index))
            total = total + config.secret_weight * loss
            drawn.append((meta, seen, config.secret_weight))
        if config.incorrect_weight > 0 and self.iteration % config.incorrect_every == 0:
            # The cover is right already: only the decoders are to learn from wrong keys, in turns.
            turn = self.iteration // config.incorrect_every % len(self.decoders)
            wrong = random_embeddings(1, self.generator)[0].to(self.device)
            decoded = self.decoders[turn](part.detach(), wrong, description.detach())
            loss, _ = loss_of(decoded, 0, cover_target)
            total = total + config.incorrect_weight * config.incorrect_every * len(self.decoders) * loss

        for meta, _, _ in drawn:
            meta["means2d"].retain_grad()
        total.backward()
        self._set_rates()
        for optimizer in (*self.optimizers.values(), self.decoder_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        combined = combine_densification(drawn, len(self))
        self.strategy.step_post_backward(
            self.parameters, self.optimizers, self.density, self.iteration, combined
        )

    def _keyed_decoders(self) -> list[tuple[Decoder, Tensor]]:
        """Each secret's decoder and what its key becomes."""
        return list(zip(self.decoders, self.embeddings, strict=True))

    def _set_rates(self) -> None:
        progress = self.iteration / self.iterations
        self.optimizers["means"].param_groups[0]["lr"] = self.means_rate * 0.01**progress
        warm_up = min(1.0, self.iteration / 100)
        self.decoder_optimizer.param_groups[0]["lr"] = self.config.decoder_rate * warm_up * 0.05**progress

    @torch.no_grad()
    def _possibly_seen(self, gaussians: Gaussians, camera: Camera) -> Tensor:
        """Indices of the Gaussians that may touch the view once decoded: only they are worth decoding.

        A Gaussian is left out when a ball of 3 standard deviations around it, widened by what the decoder
        moves things by, lies outside the frustum (widened by a tenth).
        """
        viewmat, intrinsics = camera.viewmat.to(self.device), camera.K.to(self.device)
        x, y, z = (gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
        radius = 3 * gaussians.scales.amax(1) + 0.02 * self.extent
        depth = z + radius
        half_width = max(float(intrinsics[0, 2]), camera.width - float(intrinsics[0, 2])) / float(
            intrinsics[0, 0]
        )
        half_height = max(float(intrinsics[1, 2]), camera.height - float(intrinsics[1, 2])) / float(
            intrinsics[1, 1]
        )
        seen = (
            (depth > 0.01)
            & (x.abs() - radius < 1.1 * half_width * depth)
            & (y.abs() - radius < 1.1 * half_height * depth)
        )
        return seen.nonzero()[:, 0]

    @torch.no_grad()
    def _largest_opacity(self) -> Tensor:
        """[N] the largest opacity over the cover and all secrets."""
        gaussians = self.gaussians()
        opacities = [gaussians.opacities]
        opacities += [
            decoder(gaussians, embedding).opacities for decoder, embedding in self._keyed_decoders()
        ]
        return torch.stack(opacities).amax(0)

    def gaussians(self) -> Gaussians:
        """The model as it would be published."""
        return to_gaussians(self.parameters).detach()

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        gaussians = self.gaussians()
        numbers = {"cover": mean_psnr(gaussians, self.watched[0], self.backgrounds[0])}
        for secret, (decoder, embedding) in enumerate(self._keyed_decoders(), start=1):
            name = "secret" if len(self.embeddings) == 1 else f"secret {secret}"
            decoded = decoder(gaussians, embedding)
            numbers[name] = mean_psnr(decoded, self.watched[secret], self.backgrounds[secret])
        return numbers

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_optimizers(self.parameters, self.optimizers) | pack_density(self.density)
        tensors |= {f"decoders.{name}": value for name, value in self._all_decoders.state_dict().items()}
        for index, moments in self.decoder_optimizer.state_dict()["state"].items():
            tensors |= {f"decoder_adam.{index}.{name}": value for name, value in moments.items()}
        tensors |= {"owners": self.owners.state(), "generator": self.generator.get_state()}
        tensors |= {f"order.{i}": shuffle.state() for i, shuffle in enumerate(self.shuffles)}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_optimizers(tensors, self.parameters, self.optimizers)
        unpack_density(tensors, self.density, self.device)
        prefix = "decoders."
        self._all_decoders.load_state_dict(
            {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
        )
        adam = self.decoder_optimizer.state_dict()
        for name, value in tensors.items():
            if name.startswith("decoder_adam."):
                _, index, key = name.split(".")
                adam["state"].setdefault(int(index), {})[key] = value
        self.decoder_optimizer.load_state_dict(adam)
        self.owners.load(tensors["owners"])
        for i, shuffle in enumerate(self.shuffles):
            shuffle.load(tensors[f"order.{i}"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])


def decoder_shape(config: HideConfig) -> DecoderShape:
    """The sizes of the decoder that `config` asks for."""
    return DecoderShape(
        mask=config.mask,
        hidden=config.hidden,
        branch=config.branch,
        frequencies=config.frequencies,
        sh_degree=config.fit.sh_degree,
    )


def combine_densification(drawn: Sequence[Drawn], count: int) -> dict[str, Any]:
    """Combined densification (KeySS, section 3.4): the renders of all scenes as cameras of one batch.

    `drawn` holds for each render its meta, the indices of the Gaussians it was made of (None: all
    `count`), and the weight of its loss, by which its gradients are divided to be as large as those that
    the thresholds of plain 3DGS are meant for.
    """
    device = drawn[0][0]["means2d"].device
    gradients = torch.zeros(len(drawn), count, 2, device=device)
    radii = torch.zeros(len(drawn), count, 2, device=device)
    for row, (meta, indices, weight) in enumerate(drawn):
        where = slice(None) if indices is None else indices
        gradients[row, where] = meta["means2d"].grad[0] / weight
        radii[row, where] = meta["radii"][0].float()
    means2d = torch.zeros_like(gradients)
    means2d.grad = gradients
    width, height = drawn[0][0]["width"], drawn[0][0]["height"]
    return {
        "means2d": means2d,
        "radii": radii,
        "width": width,
        "height": height,
        "n_cameras": 1,
        "gaussian_ids": None,
    }
