"""Adaptive density control: gsplat's DefaultStrategy under a cap on the number of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.ranks import here

T = TypeVar("T")

# A render's meta, the indices of the Gaussians it was made of (None: all), the weight of its loss.
Drawn = tuple[dict[str, Any], Tensor | None, float]

# What a DefaultStrategy sums up from step to step: norms of screen-space gradients [N], and of how many
# renders [N].
_STATISTICS = ("grad2d", "count")


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

    def over_ranks(
        self, loss: Tensor, trained: Iterable[Tensor], params: Parameters, info: dict[str, Any] | None
    ) -> tuple[Tensor, dict[str, Any]]:
        """After backward: the gradients of all ranks in `trained`, and the sum of their losses.

        And `info`, the meta of this rank's renders, as `step_post_backward` takes it, with what all ranks
        have seen; None: nothing grows.
        """
        ranks = here()
        if ranks.count == 1:
            return loss, info or {}
        if info is None:
            return ranks.sum(trained, [loss])[0], {}
        found: dict[str, Any] = dict.fromkeys(_STATISTICS)
        self._update_state(params, found, info)
        loss, *sums = ranks.sum(trained, [loss, *(found[name] for name in _STATISTICS)])
        return loss, dict(zip(_STATISTICS, sums, strict=True))

    def _update_state(
        self, params: Parameters, state: dict[str, Any], info: dict[str, Any], packed: bool = False
    ) -> None:
        """By the meta of renders, or by the statistics of all ranks' renders.

        Of renders it adds up what gsplat does, without picking out the Gaussians that are seen: on a CPU that
        takes twice as long.
        """
        known = set(_STATISTICS) <= set(info)
        for values in [[info[name] for name in _STATISTICS]] if known else _seen_by_cameras(info):
            for name, each in zip(_STATISTICS, values, strict=True):
                state[name] = each if state[name] is None else state[name] + each

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


def _seen_by_cameras(info: dict[str, Any]) -> Iterator[tuple[Tensor, Tensor]]:
    """`_STATISTICS` of each camera of a render's meta; gradients are those on a screen from -1 to 1."""
    gradients = info["means2d"].grad  # [C, N, 2]
    halves = gradients.new_tensor([info["width"] / 2, info["height"] / 2]) * info["n_cameras"]
    for gradient, radii in zip(gradients, info["radii"], strict=True):
        seen = (radii[:, 0] > 0) & (radii[:, 1] > 0)
        norms = torch.linalg.vector_norm(gradient * halves, dim=-1)
        yield torch.where(seen, norms, 0), seen.float()


def draw_views(
    views: Sequence[T], loss_at: Callable[[T], tuple[Tensor, list[Drawn]]]
) -> tuple[Tensor, list[Drawn]]:
    """The mean loss of a step's `views`, and the renders that density control goes by.

    Of both this rank's share; its backward pass is done. `loss_at` draws a view.
    """
    share = 1 / len(views)
    losses: list[Tensor] = []
    found: list[Drawn] = []
    for view in here().mine(views):
        loss, drawn = loss_at(view)
        for meta, _, _ in drawn:
            meta["means2d"].retain_grad()
        (share * loss).backward()
        losses.append(share * loss.detach())
        found += [(meta, indices, share * weight) for meta, indices, weight in drawn]
    return torch.stack(losses).sum(), found


def combine_densification(drawn: Sequence[Drawn], count: int) -> dict[str, Any]:
    """Combined densification (KeySS, section 3.4): the renders of all scenes as cameras of one batch.

    `drawn` holds for each render its meta, the indices of the Gaussians it was made of (None: all
    `count`), and the weight of its loss, by which its gradients are divided to be as large as those that
    the thresholds of plain 3DGS are meant for.
    """
    if len(drawn) == 1 and drawn[0][1] is None and drawn[0][2] == 1:
        return drawn[0][0]  # as plain 3DGS has it
    device = drawn[0][0]["means2d"].device
    gradients = torch.zeros(len(drawn), count, 2, device=device)
    radii = torch.zeros(len(drawn), count, 2, device=device)
    width, height = drawn[0][0]["width"], drawn[0][0]["height"]
    for row, (meta, indices, weight) in enumerate(drawn):
        where = slice(None) if indices is None else indices
        size = gradients.new_tensor([meta["width"] / width, meta["height"] / height])
        gradients[row, where] = meta["means2d"].grad[0] * (size / weight)
        radii[row, where] = meta["radii"][0].float()
    means2d = torch.zeros_like(gradients)
    means2d.grad = gradients
    batch = {"width": width, "height": height, "n_cameras": 1, "gaussian_ids": None}
    return {"means2d": means2d, "radii": radii, **batch}
