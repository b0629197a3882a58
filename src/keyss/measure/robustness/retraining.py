"""Changes by somebody who has the cover's photos: purification, and training on."""

from __future__ import annotations

import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.losses import Target, photometric_loss
from keyss.fitting.parameters import make_optimizers, to_gaussians, to_parameters
from keyss.fitting.sampling import Shuffle
from keyss.measure.robustness.changes import Change
from keyss.rendering import render
from keyss.rendering.contributions import contributions

VIEWS = 64  # in which purification looks for what is used


def fine_tuning(cover: Scene, steps: int = 500, seed: int = 0) -> Change:
    """Train on with the cover's photos, as plain 3DGS is trained, without density control."""
    sentence = f"Training goes on with the cover's photos for {steps} steps."
    return Change(
        "fine-tuning", steps, "steps", sentence, lambda model: refined(model, cover, steps, seed), seed
    )


def purification(cover: Scene, given_up: float = 0.0, steps: int = 300, seed: int = 0) -> Change:
    """Prune what the cover's training views do not use, then train on: after GSPure (arXiv 2511.22262).

    `given_up`: see `unused`. GSPure finds what to prune by the same weights, but clusters them.
    """

    def apply(model: Gaussians) -> Gaussians:
        return refined(model[~unused(model, cover, given_up)], cover, steps, seed)

    sentence = (
        "Gaussians that the cover's photos do not use are removed"
        f"{f', giving up {given_up:.1%} of what those show' if given_up else ''}; "
        f"then training goes on for {steps} steps."
    )
    return Change("purification", given_up, "share of the blending weight given up", sentence, apply, seed)


def unused(model: Gaussians, cover: Scene, given_up: float = 0.0) -> Tensor:
    """[N] the Gaussians that add nothing to the training views, and then those that add least.

    Of all weights with which Gaussians are blended, summed over pixels and views, no more than the share
    `given_up` is theirs. Never all of them.
    """
    weights = contributions(model, [view.camera for view in subsample_views(cover.train, VIEWS)]).double()
    ascending, order = weights.sort(stable=True)
    least = ascending.cumsum(0) <= given_up * ascending.sum()
    least[-1] = False
    result = torch.zeros_like(least)
    result[order] = least
    return result


def refined(model: Gaussians, scene: Scene, steps: int, seed: int = 0) -> Gaussians:
    """`model` after as many steps of plain 3DGS on the training views, at the rates of such a run."""
    config = FitConfig(iterations=max(steps, 1))
    parameters = to_parameters(model, model.device)
    optimizers = make_optimizers(parameters, config, scene.extent)
    background = scene.background.to(model.device)
    shuffle = Shuffle(len(scene.train), torch.Generator().manual_seed(seed))
    for step in range(1, steps + 1):
        view = scene.train[shuffle.draw()]
        image = render(to_gaussians(parameters), view.camera, background)
        target = Target.of(view.image.to(model.device))
        photometric_loss(image, target, config.ssim_weight).backward()
        rate = config.means_rate * scene.extent * 0.01 ** (step / config.iterations)
        optimizers["means"].param_groups[0]["lr"] = rate
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    return to_gaussians(parameters).detach()
