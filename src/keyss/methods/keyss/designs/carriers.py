"""The design `carriers`: every row of the model is a Gaussian of each scene.

A row has the cover's 59 numbers, and for each secret those of one of its Gaussians, which publication writes
into the spare bits of the row's harmonics (`rows`). Start: each scene has the whole cap, as plain 3DGS does.
Density: where a scene's Gaussian in a row is pruned, a clone or split of the same scene replaces it; the
row's other Gaussians stay. Conditioning: the key's embedding decrypts rows, so wrong keys need no loss.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from keyss.core.errors import InputError, UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera
from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.parameters import Optimizers, Parameters, make_optimizers, to_gaussians, to_parameters
from keyss.fitting.plain import without_faint
from keyss.fitting.schedule import Schedule
from keyss.methods.combined import combined_points
from keyss.methods.joint import Picture
from keyss.methods.keyss.designs.base import Design, DesignTraining
from keyss.methods.keyss.rows import (
    PAYLOAD_BYTES,
    RowSecret,
    carrying,
    encrypt_rows,
    secret_tables,
    visibility,
)
from keyss.methods.records.quantise import Codec
from keyss.rendering.view import contributions

PRUNED_SHARE = 0.25  # of each scene's Gaussians, the faintest, in steps that render without them
T = TypeVar("T")

_EMPTY = -8.0  # opacity logit of a place without a Gaussian
_FILLING = 5  # last steps of density control, which fill the places that are still empty
_VIEWS = 64  # in which the contribution of each Gaussian of a secret is measured


class CarriersTraining(DesignTraining):
    """One set of rows, and for each scene its own numbers, views and density control."""

    design: CarriersDesign
    pruned = False  # whether a step renders without the faintest Gaussians

    def start(self) -> Gaussians:
        self.tables = secret_tables(self.options.fit.sh_degree, len(self.embeddings))
        return self._filled(0, self.options.fit.sh_degree)

    def _filled(self, scene: int, sh_degree: int) -> Gaussians:
        """A scene's sparse points, as plain 3DGS starts, and empty places up to the cap."""
        fit = replace(self.options.fit, sh_degree=sh_degree)
        model = combined_points([self.scenes[scene].scene], fit, self.generator)
        rest = model[torch.arange(fit.max_gaussians - len(model)) % len(model)]
        rest = replace(rest, opacity_logits=torch.full((len(rest),), _EMPTY))
        return Gaussians.cat([model, rest])

    def prepare(self, start: Gaussians) -> None:
        fit = self.options.fit
        self.schedules = [
            Schedule(fit, [view.camera for view in placed.scene.train], placed.scene.extent)
            for placed in self.scenes
        ]
        for scene, placed in enumerate(self.scenes[1:], 1):
            secret = to_parameters(self._filled(scene, self.tables[0].sh_degree), self.device)
            optimizers = make_optimizers(secret, fit, placed.scene.extent)
            for name, values in secret.items():
                self.parameters[f"{scene}/{name}"] = values
                self.optimizers[f"{scene}/{name}"] = optimizers[name]

    def density_control(self) -> CappedStrategy:
        return DeadPlaces(self.options.fit, [placed.scene.extent for placed in self.scenes], self.generator)

    def step(self) -> None:
        grown = self.iteration >= self.strategy.refine_stop_iter
        self.pruned = grown and float(torch.rand((), generator=self.generator)) < self.design.pruned_steps
        super().step()
        self.pruned = False

    def draw(self, scenes: Sequence[int], camera: Camera, sh_degree: int) -> list[Picture]:
        models = [self.scene_gaussians(scene) for scene in scenes]
        if self.pruned:
            models = [without_faintest(model, self.options.fit.prune_opacity) for model in models]
        return [
            self.render(model, scene, camera, min(sh_degree, model.sh_degree))
            for scene, model in zip(scenes, models, strict=True)
        ]

    def scene_gaussians(self, scene: int) -> Gaussians:
        """[N] the Gaussian of a scene in each row, attached to the graph."""
        return to_gaussians(numbers_of(self.parameters, scene))

    def _set_rates(self) -> None:
        for scene, schedule in enumerate(self.schedules):
            schedule.set(numbers_of(self.optimizers, scene), self.iteration)

    def publish(self, entropy: bytes) -> tuple[Gaussians, list[RowSecret]]:
        least = self.options.fit.prune_opacity
        # The rows in the order of plain 3DGS, which appends what grows.
        model = self.scene_gaussians(0).detach().to("cpu")
        cover = without_faint(model[self.density["born"].cpu().argsort(stable=True)], least)
        counts = [len(kind.rows) for kind in carrying(cover)][: len(self.tables)]
        if not counts[0]:
            raise InputError(
                "no Gaussian of the cover has harmonics to hide one of a secret: train longer, or use "
                '`method="carry"`'
            )
        models, secrets = [], []
        for index, (placed, embedding) in enumerate(zip(self.scenes[1:], self.embeddings, strict=True)):
            model = without_faint(self.scene_gaussians(index + 1).detach().to("cpu"), least)
            cameras = [view.camera for view in subsample_views(placed.scene.train, _VIEWS)]
            parts = arranged(model, contributions(model, cameras), counts)
            codecs = [
                Codec.fit(part.with_sh_degree(table.sh_degree), table)
                for part, table in zip(parts, self.tables, strict=True)
                if len(part)
            ]
            model, share = Gaussians.cat(parts), (index, len(self.embeddings))
            secrets.append(
                RowSecret(embedding.cpu(), tuple(codecs), placed.frame, *share, len(model), visibility(model))
            )
            models.append(model)
        return encrypt_rows(cover, secrets, models, entropy), secrets


def arranged(model: Gaussians, weights: Tensor, counts: Sequence[int]) -> list[Gaussians]:
    """The Gaussians for the `counts` rows of each kind, the most important ones first.

    Opaque Gaussians that contribute much are kept longest. Rows of a later kind, which have less room, get
    those whose harmonics matter least.
    """
    order = (weights * model.opacities).argsort(descending=True, stable=True)[: sum(counts)]
    harmonics = (model.sh[:, 1:].square().mean((1, 2)).sqrt() * weights)[order]
    later = torch.zeros(len(order), dtype=torch.bool)
    later[harmonics.argsort(stable=True)[: max(0, len(order) - counts[0])]] = True
    return [model[order[~later]], model[order[later]]][: len(counts)]


def without_faintest(model: Gaussians, least: float) -> Gaussians:
    """[N] the same with the faintest PRUNED_SHARE of those above an opacity of `least` made invisible."""
    logits = model.opacity_logits.detach()
    empty = int((logits < math.log(least / (1 - least))).sum())
    limit = logits.kthvalue(empty + max(1, int(PRUNED_SHARE * (len(logits) - empty)))).values
    return replace(model, opacity_logits=model.opacity_logits.where(logits > limit, -20.0))


def numbers_of(parameters: dict[str, T], scene: int) -> dict[str, T]:
    """Those parameters of the rows that belong to a scene."""
    own = str(scene) if scene else ""
    return {
        name.rpartition("/")[2]: values
        for name, values in parameters.items()
        if name.rpartition("/")[0] == own
    }


class DeadPlaces(CappedStrategy):
    """Density control with a fixed number of rows: clones and splits take the places of pruned Gaussians.

    Thresholds and times are those of plain 3DGS. The last steps also fill the places that are still empty, an
    equal part each, because a row without a Gaussian of the cover cannot carry one of a secret.
    """

    def __init__(self, fit: FitConfig, extents: Sequence[float], generator: torch.Generator) -> None:
        super().__init__(fit)
        self.extents, self.generator = extents, generator

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """`born`: [N] the place that plain 3DGS gives the cover's Gaussian in each row."""
        state: dict[str, Any] = super().initialize_state(scene_scale)
        return state | {"born": torch.arange(self.max_gaussians)}

    def combined(self, renders: Sequence[Rendered], count: int) -> dict[str, Any]:
        return self.by_scene(renders, count, len(self.extents), dim=0)

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        if step >= self.refine_stop_iter:
            return
        self._update_state(params, state, info)
        if step <= self.refine_start_iter or step % self.refine_every:
            return
        left = (self.refine_stop_iter - 1 - step) // self.refine_every + 1
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        born = state["born"]
        for scene in range(len(self.extents)):
            own = numbers_of(params, scene)
            grown = self._grow(own, optimizers, scene, gradients[scene], left, born).to(born.device)
            if scene == 0:
                born[grown] = born.max() + 1 + torch.arange(len(grown), device=born.device)
        state["grad2d"], state["count"] = None, None

    def _grow(
        self,
        params: Parameters,
        optimizers: Optimizers,
        scene: int,
        gradients: Tensor,  # [N]
        left: int,
        born: Tensor,  # [N]
    ) -> Tensor:
        """Clone small Gaussians and split large ones into dead places, the largest gradients first.

        Returns the rows of new Gaussians in the order in which plain 3DGS appends them: clones, then the
        first and the second halves of splits, each in the order of `born`.
        """
        model = to_gaussians(params).detach()
        dead = model.opacities < self.prune_opa
        places = dead.nonzero()[:, 0]
        gradients = gradients.masked_fill(dead, 0)
        asking = int((gradients > self.grow_grad2d).sum())
        alive = len(dead) - len(places)
        filling = math.ceil(len(places) / left) if left <= _FILLING else 0
        count = min(len(places), alive, max(asking, filling))
        source, target = gradients.topk(count).indices, places[:count]
        source = source[born.to(source.device)[source].argsort()]
        part = model[source]
        large = part.scales.amax(1) > self.grow_scale3d * self.extents[scene]
        noise = torch.randn(2, count, 3, generator=self.generator).to(large.device)
        offsets = noise * part.scales * large[:, None]
        rotations = normalized_quat_to_rotmat(F.normalize(part.quats, dim=1))
        offsets = torch.einsum("nij,bnj->bni", rotations, offsets)
        scales = part.log_scales - math.log(1.6) * large[:, None]
        every = torch.ones_like(large)
        for rows, offset, fresh in ((source, offsets[0], large), (target, offsets[1], every)):
            moved = replace(part, means=part.means + offset, log_scales=scales)
            for (name, parameter), values in zip(params.items(), vars(moved).values(), strict=True):
                parameter.data[rows] = values
                full = f"{scene}/{name}" if scene else name
                for key, moment in optimizers[full].state[parameter].items():
                    if key != "step":
                        moment[rows[fresh]] = 0
        return torch.cat([target[~large], source[large], target[large]])


@dataclass(frozen=True, kw_only=True)
class CarriersDesign(Design):
    """Rows that are a Gaussian of each scene."""

    training = CarriersTraining

    # Share of the steps after density control that render without the faintest quarter of each scene. With
    # more, pruning costs less, but the model has more faint Gaussians than plain ones have.
    pruned_steps: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.pruned_steps <= 1:
            raise UsageError(f"`pruned_steps`: expected 0 to 1, got {self.pruned_steps}")

    def payload_bytes(self, sh_degree: int, secrets: int) -> int:
        secret_tables(sh_degree, secrets)
        return PAYLOAD_BYTES


CARRIERS = CarriersDesign()
