"""The joint training of the published model and the decoder (KeySS, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
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
from keyss.fitting.image_metrics import mean_psnr, subsample_views
from keyss.fitting.losses import photometric_loss
from keyss.fitting.parameters import make_optimizers, to_gaussians, to_parameters
from keyss.fitting.ranks import here
from keyss.fitting.sampling import Shuffle, own_randomness
from keyss.keys.derivation import random_embeddings
from keyss.methods.learned.decoder import Decoder
from keyss.methods.learned.options import LearnedOptions, chosen_scenes, decoder_shape
from keyss.methods.learned.start import make_start
from keyss.methods.poses import CombinedPoses, PlacedScene, possibly_seen
from keyss.rendering import render_with_meta


class JointRun:
    """The state of a hiding, and its step: the losses of all scenes, each at one pose."""

    def __init__(
        self,
        scenes: Sequence[PlacedScene],  # the cover, then the secrets
        embeddings: Sequence[Tensor],  # [64] of each secret's key
        config: LearnedOptions,
        device: torch.device,
    ) -> None:
        self.config = config
        self.device = device
        self.scenes = scenes
        self.embeddings = [embedding.to(device) for embedding in embeddings]
        self.iterations = config.fit.iterations
        self.iteration = 0
        self.views_per_step = here().views(config.fit.views_per_step)
        self.generator = torch.Generator().manual_seed(config.fit.known_seed)
        self.poses = CombinedPoses(scenes, device)
        self.watched = [subsample_views(placed.scene.test, 8) for placed in scenes]
        self.backgrounds = [placed.scene.background.to(device) for placed in scenes]
        self.owners = chosen_scenes(config.poses, len(scenes))
        self.owner_order = Shuffle(len(self.owners), self.generator)
        # Each scene's order of views is its own: what a cover becomes must not depend on the secrets.
        self.orders = [
            torch.Generator().manual_seed(config.fit.seed_of(f"views of scene {index}"))
            for index in range(len(scenes))
        ]
        self.shuffles = [
            Shuffle(len(placed.scene.train), order) for placed, order in zip(scenes, self.orders, strict=True)
        ]
        self.extent = scenes[0].scene.extent

        self.parameters = to_parameters(make_start(scenes, config, self.generator), device)
        self.optimizers = make_optimizers(self.parameters, config.fit, self.extent)
        self.rate_of_means = self.optimizers["means"].param_groups[0]["lr"]
        opacities = self._largest_opacity if config.prune_by == "all" else None
        self.strategy = CappedStrategy(config.fit, opacities, freeze=config.at_cap == "freeze")
        self.density: dict[str, Any] = self.strategy.initialize_state(self.extent)

        with own_randomness(config.fit.known_seed):
            # One for each secret: who opens one of them holds no network that knows another.
            self.decoders = [Decoder(decoder_shape(config)).to(device) for _ in embeddings]
        for decoder, embedding in self._keyed_decoders():
            decoder.prepare(self.gaussians(), embedding)
        self._all_decoders = torch.nn.ModuleList(self.decoders)
        self.decoder_optimizer = torch.optim.AdamW(
            self._all_decoders.parameters(), lr=config.decoder_rate, weight_decay=config.weight_decay
        )

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self) -> None:
        config = self.config
        self.iteration += 1
        views = [self._draw_poses() for _ in range(self.views_per_step)]
        wrong: list[Tensor | None] = [None] * len(views)
        if config.conditioning == "bias" and self.iteration % config.incorrect_every == 0:
            wrong = [random_embeddings(1, self.generator)[0].to(self.device) for _ in views]
        total, drawn = draw_views(list(zip(views, wrong, strict=True)), self._loss_at)
        trained = (*self.parameters.values(), *self._all_decoders.parameters())
        seen = combine_densification(drawn, len(self))
        self.loss, seen = self.strategy.over_ranks(total, trained, self.parameters, seen)
        self._set_rates()
        for optimizer in (*self.optimizers.values(), self.decoder_optimizer):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.strategy.step_post_backward(self.parameters, self.optimizers, self.density, self.iteration, seen)

    def _loss_at(self, view: tuple[Sequence[tuple[int, int]], Tensor | None]) -> tuple[Tensor, list[Drawn]]:
        """The losses of all scenes, each at its pose, with a wrong key or none; what asks for density."""
        (poses, wrong), config = view, self.config
        degree = config.fit.sh_degree_at(self.iteration)

        def loss_of(drawn: Gaussians, scene: int) -> tuple[Tensor, dict[str, Any]]:
            background, target = self.backgrounds[scene], self.poses.target(scene, *poses[scene])
            camera = self.poses.camera(*poses[scene])
            image, meta = render_with_meta(drawn, camera, background, sh_degree=degree)
            return photometric_loss(image, target, config.fit.ssim_weight), meta

        cover = to_gaussians(self.parameters)
        cover_loss, meta = loss_of(cover, 0)
        total = config.cover_weight * cover_loss
        drawn: list[Drawn] = [(meta, None, config.cover_weight)]
        for scene, (decoder, embedding) in enumerate(self._keyed_decoders(), start=1):
            seen = possibly_seen(cover, self.poses.camera(*poses[scene]), 0.02 * self.extent)
            loss, meta = loss_of(decoder(cover[seen], embedding, cover), scene)
            total = total + config.secret_weight * loss
            drawn.append((meta, seen, config.secret_weight))
        if wrong is not None:
            total = total + self._incorrect_loss(cover.detach(), poses[0], wrong, loss_of)
        return total, [drawn[scene] for scene in chosen_scenes(config.densification, len(drawn))]

    def _incorrect_loss(self, cover: Gaussians, pose: tuple[int, int], wrong: Tensor, loss_of: Any) -> Tensor:
        """The cover is right already: only the decoders are to learn from wrong keys, in turns."""
        config = self.config
        decoder = self.decoders[self.iteration // config.incorrect_every % len(self.decoders)]
        part = cover[possibly_seen(cover, self.poses.camera(*pose), 0.02 * self.extent)]
        loss: Tensor = loss_of(decoder(part, wrong, cover), 0)[0]
        return config.incorrect_weight * config.incorrect_every * len(self.decoders) * loss

    def _draw_poses(self) -> list[tuple[int, int]]:
        """For each scene whose training pose it is drawn from, and which one."""
        count = len(self.scenes)
        if float(torch.rand((), generator=self.generator)) < self.config.common_poses:
            owner = self.owners[self.owner_order.draw()]
            return [(owner, self.shuffles[owner].draw())] * count
        return [(scene, self.shuffles[scene].draw()) for scene in range(count)]

    def _keyed_decoders(self) -> list[tuple[Decoder, Tensor]]:
        """Each secret's decoder and what its key becomes."""
        return list(zip(self.decoders, self.embeddings, strict=True))

    def _set_rates(self) -> None:
        progress = self.iteration / self.iterations
        self.optimizers["means"].param_groups[0]["lr"] = self.rate_of_means * 0.01**progress
        warm_up = min(1.0, self.iteration / 100)
        self.decoder_optimizer.param_groups[0]["lr"] = self.config.decoder_rate * warm_up * 0.05**progress

    @torch.no_grad()
    def _largest_opacity(self) -> Tensor:
        """[N] the largest opacity over the cover and all secrets."""
        return torch.stack([model.opacities for model in self._models()]).amax(0)

    def gaussians(self) -> Gaussians:
        """The model as it would be published."""
        return to_gaussians(self.parameters).detach()

    @torch.no_grad()
    def evaluate(self) -> dict[str, float]:
        secrets = len(self.embeddings)
        names = ["cover", *(f"secret {i}" if secrets > 1 else "secret" for i in range(1, secrets + 1))]
        seen = zip(names, self._models(), self.watched, self.backgrounds, strict=True)
        return {name: mean_psnr(model, views, background) for name, model, views, background in seen}

    def _models(self) -> list[Gaussians]:
        """What every key, and none, shows of the model as it would be published."""
        cover = self.gaussians()
        return [cover, *(decoder(cover, embedding) for decoder, embedding in self._keyed_decoders())]

    def state(self) -> tuple[State, dict[str, Any]]:
        tensors = pack_optimizers(self.parameters, self.optimizers) | pack_density(self.density)
        tensors |= pack_network("decoders", self._all_decoders, self.decoder_optimizer)
        tensors |= {"owners": self.owner_order.state(), "generator": self.generator.get_state()}
        tensors |= {f"order.{i}": shuffle.state() for i, shuffle in enumerate(self.shuffles)}
        tensors |= {f"order_generator.{i}": order.get_state() for i, order in enumerate(self.orders)}
        return tensors, {"iteration": self.iteration}

    def load(self, tensors: State, meta: dict[str, Any]) -> None:
        unpack_optimizers(tensors, self.parameters, self.optimizers)
        unpack_density(tensors, self.density, self.device)
        unpack_network(tensors, "decoders", self._all_decoders, self.decoder_optimizer)
        self.owner_order.load(tensors["owners"])
        for i, shuffle in enumerate(self.shuffles):
            shuffle.load(tensors[f"order.{i}"])
            self.orders[i].set_state(tensors[f"order_generator.{i}"])
        self.generator.set_state(tensors["generator"])
        self.iteration = int(meta["iteration"])
