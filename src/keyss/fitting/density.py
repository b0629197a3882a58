"""Adaptive density control: gsplat's DefaultStrategy under a cap on the number of Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers, Parameters


class CappedStrategy(DefaultStrategy):  # type: ignore[misc]
    """DefaultStrategy that never exceeds `max_gaussians`.

    Where more Gaussians ask to be cloned or split than there is room for, those with the largest
    screen-space gradients go first. Pruning goes on at the cap, so that it always makes room again.
    `opacity_for_pruning` says how visible a Gaussian is ([N] in [0, 1]; by default its own opacity): in
    hiding it is the largest opacity over all scenes, so that none loses what only it needs. `freeze`: at
    the cap nothing is pruned either.
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
            grow_grad2d=config.grow_gradient,
            refine_start_iter=min(500, int(config.iterations * config.grow_start)),
            refine_stop_iter=int(config.iterations * config.grow_stop),
            refine_every=config.grow_every,
            reset_every=10**9,  # gsplat 1.5 never resets anyway: `step % reset_every == 0 & step > 0`
        )
        self.max_gaussians = config.max_gaussians
        self.opacity_for_pruning = opacity_for_pruning
        self.freeze = freeze

    @torch.no_grad()
    def _grow_gs(
        self, params: Parameters, optimizers: Optimizers, state: dict[str, Any], step: int
    ) -> tuple[int, int]:
        gradients = state["grad2d"] / state["count"].clamp_min(1)
        wanting = gradients > self.grow_grad2d
        room = max(0, self.max_gaussians - len(gradients))
        if int(wanting.sum()) > room:
            refused = torch.ones_like(wanting)
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
