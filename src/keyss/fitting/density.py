"""Adaptive density control: gsplat's DefaultStrategy under a cap on the number of Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import remove
from torch import Tensor

from keyss.fitting.config import FitConfig
from keyss.fitting.parameters import Optimizers, Parameters
from keyss.fitting.schedule import boost_of

T = TypeVar("T")

# The meta of a render, the indices of its Gaussians (None: all), and the weight of its loss.
Rendered = tuple[dict[str, Any], Tensor | None, float]

# Boosted rates make larger gradients. Without a larger threshold, models below the cap would grow too much.
_BOOSTED_GRADIENT = 0.45

# Sums of DefaultStrategy over steps: norms of screen-space gradients [N], and numbers of renders [N].
_STATISTICS = ("grad2d", "count")


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

    def backward(
        self,
        views: Sequence[T],
        loss_at: Callable[[T], tuple[Tensor, list[Rendered]]],
        count: int,
    ) -> tuple[Tensor, dict[str, Any]]:
        """Compute the gradients of the mean loss of a step's `views` of `count` Gaussians.

        `loss_at` renders one view and returns its loss and the renders that count for densification. Returns
        the mean loss, and the info that `step_post_backward` takes.
        """
        losses: list[Tensor] = []
        renders: list[Rendered] = []
        for view in views:
            loss, rendered = loss_at(view)
            for meta, _, _ in rendered:
                meta["means2d"].retain_grad()
            (loss / len(views)).backward()
            losses.append(loss.detach() / len(views))
            renders += [(meta, indices, weight / len(views)) for meta, indices, weight in rendered]
        return torch.stack(losses).sum(), self.densification_info(renders, count)

    def densification_info(self, renders: Sequence[Rendered], count: int) -> dict[str, Any]:
        """The info of a step's renders of `count` Gaussians."""
        return combine_densification(renders, count)

    def scene_stats(
        self, renders: Sequence[Rendered], count: int, scenes: int, *, dim: int
    ) -> dict[str, Any]:
        """Statistics of each scene's own renders, stacked along `dim`; `renders` cycle through the scenes."""
        found: list[dict[str, Any]] = []
        for scene in range(scenes):
            found.append(dict.fromkeys(_STATISTICS))
            self._update_state({}, found[-1], combine_densification(renders[scene::scenes], count))
        return {name: torch.stack([each[name] for each in found], dim) for name in _STATISTICS}

    def _update_state(
        self, params: Parameters, state: dict[str, Any], info: dict[str, Any], packed: bool = False
    ) -> None:
        """Add the statistics of renders, given by their meta, or summed by `scene_stats`.

        The sums equal gsplat's. Selecting the visible Gaussians first, as gsplat does, takes twice as long on
        a CPU.
        """
        summed = set(_STATISTICS) <= set(info)
        for values in [[info[name] for name in _STATISTICS]] if summed else _camera_statistics(info):
            for name, value in zip(_STATISTICS, values, strict=True):
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


def _camera_statistics(info: dict[str, Any]) -> Iterator[tuple[Tensor, Tensor]]:
    """`_STATISTICS` of each camera of a render; gradients are for a screen from -1 to 1."""
    gradients = info["means2d"].grad  # [C, N, 2]
    halves = gradients.new_tensor([info["width"] / 2, info["height"] / 2]) * info["n_cameras"]
    for gradient, radii in zip(gradients, info["radii"], strict=True):
        visible = (radii[:, 0] > 0) & (radii[:, 1] > 0)
        norms = torch.linalg.vector_norm(gradient * halves, dim=-1)
        yield torch.where(visible, norms, 0), visible.float()


def combine_densification(renders: Sequence[Rendered], count: int) -> dict[str, Any]:
    """Combined densification (KeySS, section 3.4): the renders of all scenes as cameras of one batch.

    The gradients of each render, for all `count` Gaussians or some, are divided by the weight of its loss, to
    match the thresholds of plain 3DGS.
    """
    if len(renders) == 1 and renders[0][1] is None and renders[0][2] == 1:
        return renders[0][0]
    device = renders[0][0]["means2d"].device
    gradients = torch.zeros(len(renders), count, 2, device=device)
    radii = torch.zeros(len(renders), count, 2, device=device)
    width, height = renders[0][0]["width"], renders[0][0]["height"]
    for row, (meta, indices, weight) in enumerate(renders):
        where = slice(None) if indices is None else indices
        size = gradients.new_tensor([meta["width"] / width, meta["height"] / height])
        gradients[row, where] = meta["means2d"].grad[0] * (size / weight)
        radii[row, where] = meta["radii"][0].float()
    means2d = torch.zeros_like(gradients)
    means2d.grad = gradients
    batch = {"width": width, "height": height, "n_cameras": 1, "gaussian_ids": None}
    return {"means2d": means2d, "radii": radii, **batch}
