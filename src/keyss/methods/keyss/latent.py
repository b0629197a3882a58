"""The training of the design `latent` (ours). Every row of the model is a Gaussian of each scene.

Like plain 3DGS, each scene has its own starting points up to the cap, views and density control. The cover
trains with noise in the place of the encrypted latents, the secrets with harmonics decoded from codes. Adam's
moments are those of latents before encryption: with moments of encrypted latents, secrets lose 1.1 dB. Wrong
keys open no row and need no loss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from keyss.channels.harmonics import KEPT_DEGREE, high_harmonics, row_ids, with_high_harmonics
from keyss.core.arrays import Doubles
from keyss.core.errors import InputError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.adam import RowAdam
from keyss.fitting.density import EMPTY, CappedStrategy, FixedRows, of_scene
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.parameters import make_optimizers, to_parameters
from keyss.fitting.plain import without_faint
from keyss.fitting.schedule import Schedule
from keyss.keys.derivation import stream
from keyss.methods.keyss.decoder import Colours, LatentDecoder
from keyss.methods.keyss.keyss_secret import KeyssSecret, choose_anchors, visibility
from keyss.methods.keyss.training import KeyssTraining, Picture, combined_points
from keyss.rendering.view import contributions

PRUNED_SHARE = 0.25  # fraction of the published rows, faintest first, that pruned steps leave out
BASIS_SIZE = 2.0  # length of the vectors of the initial basis
BOUND = 0.9  # share of the steps after which rows are assigned
NOISE_STEPS, WORTH_STEPS = 50, 100  # steps between updates of the noise, and of the pruned rows
VIEWS, FEW_VIEWS = 64, 16  # views for measuring contributions: when publishing, in training
_LOW = 3 * (KEPT_DEGREE + 1) ** 2  # numbers of the cover's colours that are harmonics, not a code


class LatentTraining(KeyssTraining):
    """See `KeyssTraining`. Parameters of secret s have names like `s/means`; `sh` are codes of colours."""

    decoders: list[LatentDecoder]
    pruned = False  # True while a step renders pruned models

    def start(self) -> Gaussians:
        return self.pad_to_cap(0)

    def pad_to_cap(self, scene: int) -> Gaussians:
        """A scene's sparse points, like the start of plain 3DGS, padded with empty slots to the cap."""
        model = combined_points([self.scenes[scene].scene], self.fit, self.generator)
        rest = model[torch.arange(self.fit.max_gaussians - len(model)) % len(model)]
        rest = replace(rest, opacity_logits=torch.full((len(rest),), EMPTY))
        return Gaussians.cat([model, rest])

    def prepare(self, start: Gaussians) -> None:
        fit = self.fit
        self.decoders = [LatentDecoder(replace(self.shape, secret=each)) for each in range(len(self.keys))]
        self.kept = self.decoders[0].place.fit(self.scenes[0].plain).T.contiguous().to(self.device)
        place = self.decoders[0].place.state_dict()
        for decoder, placed in zip(self.decoders, self.scenes[1:], strict=True):
            decoder.place.load_state_dict(place)
            decoder.basis.data.copy_(initial_basis(placed.plain, *decoder.basis.shape))
        self.networks.extend(self.decoders)
        self.schedules = []
        for scene, placed in enumerate(self.scenes):
            cameras = [view.camera for view in placed.scene.train]
            self.schedules.append(Schedule(fit, cameras, placed.scene.extent))
            own = to_parameters(self.pad_to_cap(scene) if scene else start, self.device)
            optimizers = make_optimizers(own, fit, placed.scene.extent)
            first, coded = (3, len(self.decoders[scene - 1].basis)) if scene else (_LOW, len(self.kept))
            # The rate of a code's number is the sum of those of the harmonics that it encodes.
            rates = torch.full((first + coded,), fit.shN_rate, device=self.device)
            rates[:3] = fit.sh0_rate
            rates[first:] *= (own["sh"][0].numel() - first) / max(1, coded)
            rows = torch.zeros(len(own["sh"]), first + coded, device=self.device)
            rows[:, :3] = own["sh"].detach()[:, 0]
            own["sh"] = torch.nn.Parameter(rows)
            optimizers["sh"] = RowAdam(own["sh"], 1.0, rates)
            prefix = f"{scene}/" if scene else ""
            self.parameters |= {prefix + name: values for name, values in own.items()}
            self.optimizers |= {prefix + name: optimizers[name] for name in own}

    def density_control(self) -> CappedStrategy:
        return FixedRows(self.fit, [placed.scene.extent for placed in self.scenes], self.generator)

    def step(self) -> None:
        if self.iteration == self.binding:
            self.bind()
        since = self.iteration - self.binding
        if since >= 0 and since % NOISE_STEPS == 0:
            high = high_harmonics(self.gaussians_of(0))
            written = self.decoders[0].place.write(
                high, self.ranks(self.fit.seed_of("ranks").to_bytes(32, "big"))
            )
            self.density["noise"] = torch.from_numpy(written - high).float().to(self.device)
        grown = self.iteration >= self.strategy.refine_stop_iter
        self.pruned = grown and float(torch.rand((), generator=self.generator)) < self.design.pruned_steps
        if self.pruned and ("kept.0" not in self.density or self.iteration % WORTH_STEPS == 0):
            self.choose_kept()
        super().step()
        self.pruned = False

    @property
    def binding(self) -> int:
        """The step that assigns rows to the secrets' Gaussians and freezes the cover's geometry."""
        return int(BOUND * self.iterations)

    @torch.no_grad()
    def bind(self) -> None:
        """Assign rows to the secrets' Gaussians: the largest contributions get the most opaque rows."""
        rows = self.usable_rows()
        if not len(rows):
            raise InputError(
                "no Gaussian of the cover has harmonics to hide one of a secret: train longer, or use "
                '`method="carry"`'
            )
        for scene, decoder in enumerate(self.decoders, 1):
            model, own = self.gaussians_of(scene), of_scene(self.parameters, scene)
            faint = model.opacities < self.fit.prune_opacity
            worth = self.contribution(model, scene, VIEWS).masked_fill(faint, 0.0)
            best = worth.argsort(descending=True, stable=True)[: len(rows)]
            rest = torch.ones(len(model), dtype=torch.bool, device=self.device)
            rest[best] = False
            order = torch.empty_like(rest, dtype=torch.int64)
            order[rows] = best
            free = torch.ones_like(rest)
            free[rows] = False
            order[free] = rest.nonzero()[:, 0]
            for name, parameter in own.items():
                state = self.optimizers[f"{scene}/{name}"].state[parameter]
                for values in (parameter.data, *state.values()):
                    if isinstance(values, Tensor) and values.shape[:1] == parameter.shape[:1]:
                        values.copy_(values[order].clone())
            own["opacities"].data[free] = EMPTY  # without a row, a Gaussian is not published
            decoder.fit_secret(self.latents(scene)[rows.cpu().numpy()])

    def usable_rows(self) -> Tensor:
        """[M] rows that can hide a Gaussian, most opaque first."""
        cover = self.gaussians_of(0).detach()
        # Equal IDs would reuse a pad.
        _, index, counts = np.unique(row_ids(cover), axis=0, return_inverse=True, return_counts=True)
        once = torch.from_numpy(counts[index.reshape(-1)] == 1).to(self.device)
        high = (cover.sh[:, (KEPT_DEGREE + 1) ** 2 :] != 0).flatten(1).any(1)
        usable = once & high & (cover.opacities >= self.fit.prune_opacity)
        # Rows with a saturated channel come last: `publish` writes nothing into those that stay saturated.
        first = cover.opacity_logits.masked_fill(is_saturated(cover).any(1), -math.inf)
        order = first.argsort(descending=True, stable=True)
        return order[usable[order]]

    def latents(self, scene: int) -> Doubles:
        """[N, D] latents of a secret's Gaussians."""
        model, rows = self.gaussians_of(scene).detach(), self.parameters[f"{scene}/sh"].detach()
        return self.decoders[scene - 1].to_latents(model, rows).double().cpu().numpy()

    def ranks(self, entropy: bytes) -> Doubles:
        """[N, R] ranks to write into the rows: encrypted latents, and noise seeded by `entropy`."""
        count = self.decoders[0].place.directions.shape[1]
        words = np.frombuffer(stream(entropy, "latents", 8 * len(self) * count), "<u8")
        ranks: Doubles = ((words >> np.uint64(11)) / 2.0**53).reshape(len(self), count)
        rows, ids = self.usable_rows().cpu().numpy(), row_ids(self.gaussians_of(0))
        for scene, (decoder, key) in enumerate(zip(self.decoders, self.keys, strict=True), 1):
            ranks[rows, decoder.own] = decoder.encrypt(self.latents(scene)[rows], key, ids[rows])
        return ranks

    def set_rates(self) -> None:
        super().set_rates()
        if self.iteration > self.binding:  # pads depend on the geometry
            for name in ("means", "quats", "scales", "opacities"):
                self.optimizers[name].param_groups[0]["lr"] = 0.0

    @torch.no_grad()
    def choose_kept(self) -> None:
        """Update the masks [N] of Gaussians left when the faintest PRUNED_SHARE of the rows is removed."""
        cover = self.gaussians_of(0)
        alive = cover.opacities >= self.fit.prune_opacity
        faintest = cover.opacity_logits.masked_fill(~alive, -math.inf).argsort()
        kept = alive.clone()
        kept[faintest[: int((~alive).sum()) + int(PRUNED_SHARE * int(alive.sum()))]] = False
        self.density["kept.0"] = kept
        left = int(kept[self.usable_rows()].sum())
        for scene in range(1, len(self.scenes)):
            best = kept.clone()
            if self.iteration < self.binding:
                worth = self.contribution(self.gaussians_of(scene), scene, FEW_VIEWS)
                best = torch.zeros_like(kept)
                best[worth.argsort(descending=True, stable=True)[:left]] = True
            self.density[f"kept.{scene}"] = best

    def contribution(self, model: Gaussians, scene: int, views: int) -> Tensor:
        """[N] contribution of each Gaussian of a secret to views of its scene."""
        cameras = [view.camera for view in subsample_views(self.scenes[scene].scene.train, views)]
        return contributions(model, cameras) * model.opacities

    def gaussians_of(self, scene: int, noise: Tensor | None = None) -> Gaussians:
        """The Gaussians of a scene, attached to the graph, with `noise` in place of the latents."""
        own = of_scene(self.parameters, scene)
        basis = self.decoders[scene - 1].basis if scene else self.kept
        sh = Colours.apply(own["sh"], basis, noise)  # type: ignore[no-untyped-call]
        return Gaussians(own["means"], own["quats"], own["scales"], own["opacities"], sh)

    def cover(self) -> Gaussians:
        return self.gaussians_of(0, self.density.get("noise"))

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        pictures = []
        for scene in scenes:
            model = self.gaussians_of(scene) if scene else self.cover()
            if self.pruned:
                logits = model.opacity_logits.where(self.density[f"kept.{scene}"], -20.0)
                model = replace(model, opacity_logits=logits)
            pictures.append(self.render(model, scene, camera, sh_degree))
        return pictures

    @torch.no_grad()
    def publish(self, entropy: bytes) -> tuple[Gaussians, list[KeyssSecret]]:
        clean = self.gaussians_of(0).detach()
        high = self.decoders[0].place.write(high_harmonics(clean), self.ranks(entropy))
        # Harmonics of a saturated channel stay at 0, as in training.
        high *= ~is_saturated(clean).repeat(1, high.shape[1] // 3).cpu().numpy()
        # Sort rows like plain 3DGS, which appends new Gaussians.
        born = self.density["born"].argsort(stable=True)
        stego = without_faint(with_high_harmonics(clean, high)[born].to("cpu"), self.fit.prune_opacity)
        # Pruned training steps already compensate for the faintest rows: count losses from there on.
        opaque = stego[stego.opacities.argsort()[int(PRUNED_SHARE * len(stego)) :]]
        anchors, secrets = choose_anchors(stego, self.fit.known_seed), []
        for decoder, key, placed in zip(self.decoders, self.keys, self.scenes[1:], strict=True):
            decoder = decoder.to("cpu").requires_grad_(False)
            found = visibility(decoder.decode(stego, key))[0], visibility(decoder.decode(opaque, key))[1]
            secrets.append(KeyssSecret(decoder, key.cpu(), placed.frame, anchors, *found))
        return stego, secrets


def is_saturated(model: Gaussians) -> Tensor:
    """[N, 3] True for channels whose harmonics of degree 1 are all 0."""
    return (model.sh[:, 1:4] == 0).all(1)


def initial_basis(plain: Gaussians, count: int, width: int) -> Tensor:
    """[count, width] principal directions of the harmonics of a plain model."""
    harmonics = plain.sh[:, 1:].flatten(1) * plain.opacities[:, None]
    vectors = torch.linalg.eigh(harmonics.T @ harmonics)[1]
    basis: Tensor = BASIS_SIZE * vectors.flip(1)[:, :count].T
    return basis.contiguous()
