"""Changes of a published model: accidents, and attacks with photos of the cover.

Each is a pure function from `Gaussians` to `Gaussians`, deterministic in its seed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene
from keyss.fitting.config import FitConfig
from keyss.fitting.image_metrics import subsample_views
from keyss.fitting.plain import PlainRun
from keyss.rendering import contributions

_FIELDS = {"position": "means", "log scale": "log_scales", "quaternion": "quats"}
_FIELDS |= {"logit opacity": "opacity_logits"}
NOISY = (*_FIELDS, "colour", "harmonics")
VIEWS = 64  # used by purification


@dataclass(frozen=True)
class Change:
    """One change of a model. Raises BackendError when called without a tool that it needs."""

    attack: str  # changes of one attack differ in strength only
    strength: float
    sentence: str  # what it does, for the report
    apply: Callable[[Gaussians], Gaussians]

    def __call__(self, model: Gaussians) -> Gaussians:
        return self.apply(model)


def random_pruning(share: float, seed: int = 0) -> Change:
    """Remove a share of the Gaussians, in [0, 1), at random (KeySS, supplement: pruning)."""

    def order(model: Gaussians) -> Tensor:
        return torch.randperm(len(model), generator=_generator("pruning", seed)).to(model.device)

    return _pruning("random pruning", share, f"A random {share:.0%} of the Gaussians are removed.", order)


def opacity_pruning(share: float) -> Change:
    """Remove the share of the Gaussians, in [0, 1), whose opacity is lowest (KeySS, supplement: pruning)."""
    sentence = f"The {share:.0%} of the Gaussians with the lowest opacity are removed."
    return _pruning("pruning by opacity", share, sentence, lambda m: m.opacity_logits.argsort(stable=True))


def _pruning(attack: str, share: float, sentence: str, order: Callable[[Gaussians], Tensor]) -> Change:
    """Remove the first `share` of the Gaussians in an order, but never all."""
    if not 0 <= share < 1:
        raise UsageError(f"pruning: expected a share of 0 or more and less than 1, got {share}")

    def apply(model: Gaussians) -> Gaussians:
        removed = min(round(share * len(model)), len(model) - 1)
        return model[order(model)[removed:].sort().values]

    return Change(attack, share, sentence, apply)


def noise(attribute: str, strength: float, seed: int = 0) -> Change:
    """Add normal noise to one attribute of every Gaussian; `attribute` is one of NOISY.

    Its standard deviation is `strength` times the attribute's spread: per component, half the distance
    between the quantiles 0.159 and 0.841, a robust standard deviation. Raises UsageError for another
    attribute.
    """
    if attribute not in NOISY:
        raise UsageError(f"noise: expected one of {', '.join(NOISY)}, got {attribute!r}")

    def noisy(values: Tensor) -> Tensor:
        random = torch.randn(values.shape, generator=_generator(f"noise on {attribute}", seed)).to(values)
        return values + strength * _spread(values) * random

    def apply(model: Gaussians) -> Gaussians:
        if attribute in _FIELDS:
            name = _FIELDS[attribute]
            return replace(model, **{name: noisy(getattr(model, name))})
        constant, others = model.sh[:, :1], model.sh[:, 1:]
        changed = [noisy(constant), others] if attribute == "colour" else [constant, noisy(others)]
        return replace(model, sh=torch.cat(changed, dim=1))

    sentence = f"Normal noise of {strength:g} times its spread is added to the {attribute} of every Gaussian."
    return Change(f"noise on {attribute}", strength, sentence, apply)


def _spread(values: Tensor) -> Tensor:
    """[...] of values [N, ...]: half the distance between their quantiles 0.159 and 0.841."""
    low, high = np.quantile(values.detach().cpu().numpy(), (0.158655, 0.841345), axis=0)
    return torch.as_tensor((high - low) / 2, dtype=values.dtype, device=values.device)


def cropping(seed: int = 0) -> Change:
    """Keep the half of the Gaussians on one side of a plane with a random direction."""

    def apply(model: Gaussians) -> Gaussians:
        direction = torch.randn(3, generator=_generator("cropping", seed)).to(model.device)
        order = (model.means @ direction).argsort(stable=True)
        return model[order[len(model) // 2 :].sort().values]

    sentence = "Only the half of the Gaussians on one side of a plane is kept."
    return Change("cropping", 0.5, sentence, apply)


def fewer_harmonics(degree: int) -> Change:
    """Drop the spherical harmonics above a degree, 0 to 3."""
    sentence = f"Spherical harmonics above degree {degree} are dropped."

    def apply(model: Gaussians) -> Gaussians:
        return model.with_sh_degree(min(degree, model.sh_degree))

    return Change("fewer harmonics", degree, sentence, apply)


def half_floats() -> Change:
    """Round every number to half precision (IEEE 754 binary16) and back."""
    sentence = "Every number is rounded to half precision."
    return Change("half floats", 16, sentence, lambda m: m.map(lambda x: x.half().float()))


def fine_tuning(cover: Scene, steps: int = 500, seed: int = 0) -> Change:
    """Continue training on the cover's photos, as plain 3DGS without density control."""
    sentence = f"Training continues on the cover's photos for {steps} steps."
    apply = partial(fine_tune, scene=cover, steps=steps, seed=seed)
    return Change("fine-tuning", steps, sentence, apply)


def purification(cover: Scene, given_up: float = 0.0, steps: int = 300, seed: int = 0) -> Change:
    """Prune the Gaussians that the cover's training views do not use, but never all, then train.

    Follows GSPure (arXiv 2511.22262), which prunes by clusters of the same weights. `given_up`: maximum share
    of the blending weights of the pruned, summed over pixels and views.
    """

    def apply(model: Gaussians) -> Gaussians:
        cameras = [view.camera for view in subsample_views(cover.train, VIEWS)]
        ascending, order = contributions(model, cameras).double().sort(stable=True)
        unused = int((ascending.cumsum(0) <= given_up * ascending.sum()).sum())
        kept = order[min(unused, len(model) - 1) :].sort().values
        return fine_tune(model[kept], cover, steps, seed)

    sentence = (
        "Gaussians that the cover's photos do not use are removed"
        f"{f', giving up {given_up:.1%} of what those show' if given_up else ''}; "
        f"then training continues for {steps} steps."
    )
    return Change("purification", given_up, sentence, apply)


def fine_tune(model: Gaussians, scene: Scene, steps: int, seed: int = 0) -> Gaussians:
    """Fine-tune `model` for `steps` steps of plain 3DGS on the training views."""
    config = FitConfig(iterations=max(steps, 1), boost=1.0, sh_degree=model.sh_degree, seed=seed)
    run = PlainRun(scene, config, model.device, model)
    for _ in range(steps):
        run.step()
    return run.gaussians()


def _generator(use: str, seed: int) -> torch.Generator:
    """A generator independent of trainings and other changes with the same seed.

    Otherwise a change could remove exactly the Gaussians that a training sampled, such as a secret's anchors.
    """
    digest = hashlib.sha256(f"keyss/robustness/{use} {seed}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)
