"""Density control (ours) with a fixed number of rows: each row holds one Gaussian of every scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.density import CappedStrategy, Rendered
from keyss.fitting.parameters import Optimizers, Parameters

EMPTY = -8.0  # opacity logit of an empty slot
_FILLING = 5  # last rounds of density control, which fill the remaining empty slots
T = TypeVar("T")


def of_scene(named: dict[str, T], scene: int) -> dict[str, T]:
    """The entries of one scene, by their names in it: `means` is the cover's, `1/means` secret 1's."""
    own = str(scene) if scene else ""
    return {name.rpartition("/")[2]: value for name, value in named.items() if name.rpartition("/")[0] == own}


class FixedRows(CappedStrategy):
    """Density control that puts clones and splits into the slots of pruned Gaussians, for each scene.

    Thresholds and intervals are those of plain 3DGS. The last rounds also fill the remaining empty slots, an
    equal part each: a row without a Gaussian of the cover cannot have one of a secret.
    """

    def __init__(self, fit: FitConfig, extents: Sequence[float], generator: torch.Generator) -> None:
        super().__init__(fit)
        self.extents, self.generator = extents, generator

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """`born`: [N] the index of the cover's Gaussian in each row if plain 3DGS had appended it."""
        state: dict[str, Any] = super().initialize_state(scene_scale)
        return state | {"born": torch.arange(self.max_gaussians)}

    def densification_info(self, renders: Sequence[Rendered], count: int) -> dict[str, Any]:
        return self.scene_stats(renders, count, len(self.extents), dim=0)

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
        gradients, born = state["grad2d"] / state["count"].clamp_min(1), state["born"]
        for scene in range(len(self.extents)):
            own = of_scene(params, scene), of_scene(optimizers, scene)
            grown = self.grow(*own, scene, gradients[scene], left, born).to(born.device)
            if scene == 0:
                born[grown] = born.max() + 1 + torch.arange(len(grown), device=born.device)
        state["grad2d"], state["count"] = None, None

    def grow(
        self,
        params: Parameters,
        optimizers: Optimizers,
        scene: int,
        gradients: Tensor,  # [N]
        left: int,
        born: Tensor,  # [N]
    ) -> Tensor:
        """Clone small Gaussians and split large ones into dead places, the largest gradients first.

        Returns the rows of new Gaussians in plain 3DGS's order: clones, then first and second halves of
        splits, each sorted by `born`.
        """
        dead = params["opacities"].detach().sigmoid() < self.prune_opa
        places = dead.nonzero()[:, 0]
        gradients = gradients.masked_fill(dead, 0)
        asking = int((gradients > self.grow_grad2d).sum())
        alive = len(dead) - len(places)
        filling = math.ceil(len(places) / left) if left <= _FILLING else 0
        count = min(len(places), alive, max(asking, filling))
        source, target = gradients.topk(count).indices, places[:count]
        source = source[born.to(source.device)[source].argsort()]
        values = {name: parameter.detach()[source] for name, parameter in params.items()}
        large = values["scales"].exp().amax(1) > self.grow_scale3d * self.extents[scene]
        noise = torch.randn(2, count, 3, generator=self.generator).to(large.device)
        offsets = noise * values["scales"].exp() * large[:, None]
        rotations = normalized_quat_to_rotmat(F.normalize(values["quats"], dim=1))
        offsets = torch.einsum("nij,bnj->bni", rotations, offsets)
        values["scales"] = values["scales"] - math.log(1.6) * large[:, None]
        every = torch.ones_like(large)
        for rows, offset, fresh in ((source, offsets[0], large), (target, offsets[1], every)):
            for name, parameter in params.items():
                parameter.data[rows] = values[name] + offset if name == "means" else values[name]
                for key, moment in optimizers[name].state[parameter].items():
                    if key != "step":
                        moment[rows[fresh]] = 0
        return torch.cat([target[~large], source[large], target[large]])
