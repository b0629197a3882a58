"""Adaptive density control: gsplat's DefaultStrategy under a cap on the number of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.schedule import boost_of

T = TypeVar("T")

# The meta of a render, the indices of its Gaussians (None: all), and the weight of its loss.
Rendered = tuple[dict[str, Any], Tensor | None, float]

# Boosted rates make larger gradients. Without a larger threshold, models below the cap would grow too much.
_BOOSTED_GRADIENT = 0.45

EMPTY = -8.0  # opacity logit of an empty slot of `FixedRows`
_FILLING = 5  # its last rounds, which fill the remaining empty slots


class CappedStrategy(DefaultStrategy):  # type: ignore[misc]
    """DefaultStrategy that never exceeds `max_gaussians`.

    At the cap, the Gaussians with the largest screen-space gradients are cloned or split first. Pruning
    continues and makes room again, unless `freeze`.
    `opacity_for_pruning` gives the visibility of each Gaussian, [N] in [0, 1], by default its opacity. In
    hiding it is the maximum opacity over all scenes: no scene loses Gaussians that only it needs.
    """

    def __init__(
        self,
        config: FitConfig,
        opacity_for_pruning: Callable[[], Tensor] | None = None,
        *,
        freeze: bool = False,
    ) -> None:
        super().__init__(
            prune_opa=config.prune_opacity,
            grow_grad2d=config.grow_gradient * max(1.0, _BOOSTED_GRADIENT * boost_of(config)),
            refine_start_iter=min(500, int(config.iterations * config.grow_start)),
            refine_stop_iter=int(config.iterations * config.grow_stop),
            refine_every=config.refine_every,
            reset_every=10**9,  # gsplat 1.5 never resets anyway: `step % reset_every == 0 & step > 0`
        )
        self.max_gaussians = config.max_gaussians
        self.opacity_for_pruning = opacity_for_pruning
        self.freeze = freeze

    def statistics(self, renders: Sequence[Rendered], count: int) -> list[Tensor]:
        """[2, `count`] for each render: norms of screen-space gradients, and 1 for visible Gaussians.

        Combined densification (KeySS, section 3.4) adds them up over the renders of all scenes. Gradients
        are for a screen from -1 to 1 as large as that of the first render, and divided by the weight of the
        loss, to match the thresholds of plain 3DGS.
        """
        width, height = renders[0][0]["width"], renders[0][0]["height"]
        found = []
        for meta, indices, weight in renders:
            gradients, radii = meta["means2d"].grad[0], meta["radii"][0]  # [M, 2]
            size = gradients.new_tensor([meta["width"] / width, meta["height"] / height])
            gradients = gradients * (size / weight) * gradients.new_tensor([width / 2, height / 2])
            visible = (radii > 0).all(1)
            values = gradients.new_zeros(2, count)
            where = slice(None) if indices is None else indices
            values[0, where] = torch.where(visible, torch.linalg.vector_norm(gradients, dim=1), 0)
            values[1, where] = visible.float()
            found.append(values)
        return found

    def _update_state(
        self, params: Parameters, state: dict[str, Any], info: list[Tensor], packed: bool = False
    ) -> None:
        """Add the results of `statistics`.

        The sums equal gsplat's. Selecting the visible Gaussians first, as gsplat does, takes twice as long on
        a CPU.
        """
        for values in info:
            for name, value in zip(("grad2d", "count"), values, strict=True):
                state[name] = value if state[name] is None else state[name] + value

    @torch.no_grad()
    def _grow_gs(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int
    ) -> tuple[int, int]:
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        growing = gradients > self.grow_grad2d
        room = max(0, self.max_gaussians - len(gradients))
        if int(growing.sum()) > room:
            refused = torch.ones_like(growing)
            refused[gradients.topk(room).indices] = False
            state["grad2d"][refused] = 0
        return super()._grow_gs(params, optimizers, state, step)  # type: ignore[no-any-return]

    @torch.no_grad()
    def _prune_gs(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> int:
        if self.freeze and len(params["means"]) >= self.max_gaussians:
            return 0
        visible = self.opacity_for_pruning or params["opacities"].sigmoid
        pruned = visible() < self.prune_opa
        count = int(pruned.sum())
        if 0 < count < len(pruned):
            remove(params=params, optimizers=optimizers, state=state, mask=pruned)
        return count


def of_scene(named: dict[str, T], scene: int) -> dict[str, T]:
    """The entries of one scene, by their names in it: `means` is the cover's, `1/means` secret 1's."""
    own = str(scene) if scene else ""
    return {name.rpartition("/")[2]: value for name, value in named.items() if name.rpartition("/")[0] == own}


class FixedRows(CappedStrategy):
    """Density control (ours) with a fixed number of rows: each row holds one Gaussian of every scene.

    For each scene, clones and splits go into the slots of pruned Gaussians. Thresholds and intervals are
    those of plain 3DGS. The last rounds also fill the remaining empty slots, an equal part each: a row
    without a Gaussian of the cover cannot have one of a secret.
    """

    def __init__(self, fit: FitConfig, extents: Sequence[float], generator: torch.Generator) -> None:
        super().__init__(fit)
        self.extents, self.generator = extents, generator

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """`born`: [N] the index of the cover's Gaussian in each row if plain 3DGS had appended it."""
        state: dict[str, Any] = super().initialize_state(scene_scale)
        return state | {"born": torch.arange(self.max_gaussians)}

    def statistics(self, renders: Sequence[Rendered], count: int) -> list[Tensor]:
        """[2, S, N] of the render of each scene."""
        own = [CappedStrategy.statistics(self, [each], count)[0] for each in renders]
        return [torch.stack(own, dim=1)]

    @torch.no_grad()
    def step_post_backward(
        self,
        params: Parameters,
        optimizers: Optimizers,
        state: dict[str, Any],
        step: int,
        info: list[Tensor],
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
