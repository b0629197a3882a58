"""Adaptive density control: gsplat's DefaultStrategy under a cap on the number of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.schedule import boost_of

# The meta of a render, the indices of its Gaussians (None: all), and the weight of its loss.
Rendered = tuple[dict[str, Any], Tensor | None, float]

# Boosted rates make larger gradients. Without a larger threshold, models below the cap would grow too much.
_BOOSTED_GRADIENT = 0.45


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

        Gradients are for a screen from -1 to 1 as large as that of the first render, and divided by the
        weight of the loss, to match the thresholds of plain 3DGS.
        """
        width, height = renders[0][0]["width"], renders[0][0]["height"]
        kinds = []
        for meta, indices, weight in renders:
            gradients, radii = meta["means2d"].grad[0], meta["radii"][0]  # [M, 2]
            size = gradients.new_tensor([meta["width"] / width, meta["height"] / height])
            gradients = gradients * (size / weight) * gradients.new_tensor([width / 2, height / 2])
            visible = (radii > 0).all(1)
            values = gradients.new_zeros(2, count)
            where = slice(None) if indices is None else indices
            values[0, where] = torch.where(visible, torch.linalg.vector_norm(gradients, dim=1), 0)
            values[1, where] = visible.float()
            kinds.append(values)
        return kinds

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

    def _prune_gs(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int) -> int:
        if self.freeze and len(params["means"]) >= self.max_gaussians:
            return 0
        return self.prune(params, optimizers, state)

    @torch.no_grad()
    def prune(self, params: Parameters, optimizers: Optimizers, state: dict[str, Any]) -> int:
        """Remove the Gaussians below the minimum opacity unless all are; returns their number."""
        visible = self.opacity_for_pruning or params["opacities"].sigmoid
        pruned = visible() < self.prune_opa
        count = int(pruned.sum())
        if 0 < count < len(pruned):
            remove(params=params, optimizers=optimizers, state=state, mask=pruned)
        return count


class CombinedStrategy(CappedStrategy):
    """Combined densification (KeySS, section 3.4): view-space gradients of all scenes choose what grows.

    The paper does not say how. Here every scene has an equal share of the room below the cap, and every round
    an equal share of what is left. With sums of gradients, the scene whose points are in place first takes
    all room, and the other one is left with a few Gaussians.
    """

    def statistics(self, renders: Sequence[Rendered], count: int) -> list[Tensor]:
        """[2, `count`, S], see `CappedStrategy.statistics`, of the renders of S scenes."""
        return [torch.stack(super().statistics(renders, count), dim=2)]

    @torch.no_grad()
    def _grow_gs(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int
    ) -> tuple[int, int]:
        gradients = state["grad2d"] / state["count"].clamp_min(1)  # [N, S]
        scenes, asking = gradients.shape[1], gradients > self.grow_grad2d
        rounds = (self.refine_stop_iter - 1 - step) // self.refine_every + 1
        room = -(-max(0, self.max_gaussians - len(gradients)) // rounds)
        growing = asking.any(1)
        if int(growing.sum()) > room:
            growing = torch.zeros_like(growing)
            for norms, count in zip(gradients.T, asking.sum(0).tolist(), strict=True):
                growing[norms.topk(min(room // scenes, count)).indices] = True
        # gsplat compares one number for each Gaussian with its threshold.
        state["grad2d"], state["count"] = growing * 2 * self.grow_grad2d, torch.ones_like(gradients[:, 0])
        grown: tuple[int, int] = DefaultStrategy._grow_gs(self, params, optimizers, state, step)
        # Two tensors: checkpoints refuse one under two names.
        for name in ("grad2d", "count"):
            state[name] = gradients.new_zeros(len(params["means"]), scenes)
        return grown
