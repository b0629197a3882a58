"""Attacks on a stego model and on plain models, and how much of the secret they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
import torch.nn.functional as F
from torch import Tensor

from keyss.core.errors import UsageError
from keyss.core.gaussians import Gaussians
from keyss.core.scene import Scene, View
from keyss.core.similarity import Similarity
from keyss.fitting.image_metrics import subsample_views
from keyss.measure.leaks.attacks import Attack, Parameter
from keyss.measure.leaks.scores import LeakScores, scores
from keyss.rendering import render

_GAP = 4  # pixels between the parts of a picture


@dataclass(frozen=True)
class AttackResult:
    """What an attack shows of a secret in the stego model and in control models.

    An attack has variants: thresholds, shares, clusters. Each score is the maximum over them, since an
    attacker recognises the secret; `best` is the variant that shows most of its shapes.
    """

    attack: str
    sentence: str
    parameters: dict[str, Parameter]
    with_key: bool  # not an attack, but the revealed secret
    views: int  # number of variants
    best: str  # the variant with the largest `LeakScores.evidence`, which is pictured and judged
    best_leak: LeakScores  # its scores less `control`
    scores: LeakScores
    control: LeakScores  # the mean over the control models
    control_max: LeakScores  # the maximum over them
    leak: LeakScores  # `scores` less `control`, which cancels the number of variants
    picture: str | None = None  # name of a file, in an audit


def look_for_secret(
    stego: Gaussians,
    controls: Sequence[Gaussians],
    secret: Scene,
    frame: Similarity,
    attacks: Sequence[Attack],
    *,
    test_views: int = 8,
) -> tuple[list[AttackResult], dict[str, Tensor]]:
    """How well attacks show the secret, from its own test cameras, against its photos.

    The strictest assumption: the attacker looks from where the secret was photographed. `stego` and
    `controls`, plain models of the cover, are in the cover's frame; `frame` leads from the frame of `secret`
    into it. At most `test_views` test views are used. Images are uint8 [H, W, 3] by the attack's name: its
    best variant on the stego model and on the first control, from the first test camera, and the photo.
    Raises UsageError without a control or without test views.
    """
    if not controls:
        raise UsageError("leaks: expected at least one plain model of the cover to compare with")
    if not secret.test:
        raise UsageError(f"leaks: the scene {secret.name} has no test views")
    views = [
        View(frame.apply_camera(view.camera), view.image) for view in subsample_views(secret.test, test_views)
    ]
    results, pictures = [], {}
    for each in attacks:
        found = _look(each, stego, views, secret.background)
        innocent = [_look(each, model, views, secret.background) for model in controls]
        highest = [LeakScores.combined(max, [variant.scores for variant in one]) for one in innocent]
        control = LeakScores.combined(fmean, highest)
        best = max(found, key=lambda variant: (variant.scores - control).evidence())
        scored = LeakScores.combined(max, [variant.scores for variant in found])
        results.append(
            AttackResult(
                attack=each.name,
                sentence=each.sentence,
                parameters=each.parameters,
                with_key=each.with_key,
                views=len(found),
                best=best.label,
                best_leak=best.scores - control,
                scores=scored,
                control=control,
                control_max=LeakScores.combined(max, highest),
                leak=scored - control,
            )
        )
        same = next((variant for variant in innocent[0] if variant.label == best.label), innocent[0][0])
        pictures[each.name] = _beside([best.picture, same.picture, views[0].image])
    return results, pictures


@dataclass(frozen=True)
class _Variant:
    """One variant of an attack on a model."""

    label: str
    scores: LeakScores
    picture: Tensor  # [H, W, 3] uint8, from the first view


@torch.no_grad()
def _look(attack: Attack, model: Gaussians, views: Sequence[View], background: Tensor) -> list[_Variant]:
    """All variants of an attack on a model."""
    found = []
    for label, shown in attack.show(model):
        image = render(shown, views[0].camera, background).clamp(0, 1)
        picture = (image * 255).round().to(torch.uint8).cpu()
        found.append(_Variant(label, scores(shown, views, background), picture))
    return found


def _beside(images: Sequence[Tensor]) -> Tensor:
    """The images [H, W, 3] side by side, with white gaps."""
    return torch.cat([F.pad(image.cpu(), (0, 0, 0, _GAP), value=255) for image in images], dim=1)[:, :-_GAP]
